"""Columns of the light matrix: clusters of lights, and the light trees above them as one forest (NumPy only) [LS].

The light matrix has a row for every gather point and a column for every light.  Nodes of the light trees stand for
ranges of its columns; cutting the trees off at some of them makes a matrix of fewer columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class ColumnForest:
    """The upper parts of some trees, one after another in preorder: m nodes, of which those without children are c
    columns, in the same order.

    ``group``: (m,) int64, which tree a node is of; ``node``: (m,) int64, its index there; ``escape``: (m,) int64, the
    node that follows its subtree; a node without children escapes to the next one.
    """

    group: np.ndarray
    node: np.ndarray
    escape: np.ndarray

    @classmethod
    def of_tree(cls, escape: np.ndarray, group: int = 0) -> ColumnForest:
        """All nodes of one tree, given where each escapes to: see :class:`vpl.lights.light_tree.LightTree`."""
        return cls(np.full(len(escape), group), np.arange(len(escape)), escape.astype(np.int64))

    @classmethod
    def joined(cls, forests: list[ColumnForest]) -> ColumnForest:
        """Several forests as one."""
        sizes = np.array([forest.size for forest in forests])
        start = np.cumsum(sizes) - sizes
        escape = np.concatenate([forest.escape for forest in forests]) + np.repeat(start, sizes)
        group, node = (np.concatenate([getattr(forest, name) for forest in forests]) for name in ("group", "node"))
        return cls(group, node, escape)

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self.node)

    @cached_property
    def inner(self) -> np.ndarray:
        """Mask of the nodes that have children, (m,) bool."""
        return self.escape > np.arange(self.size) + 1

    @cached_property
    def first(self) -> np.ndarray:
        """Columns before each node, and the number of all, (m + 1,) int64: node i has those from ``first[i]`` up to
        ``first[escape[i]]``."""
        return np.concatenate([[0], np.cumsum(~self.inner)])

    @property
    def last(self) -> np.ndarray:
        """One past the last column of each node, (m,) int64."""
        return self.first[self.escape]

    @cached_property
    def columns(self) -> np.ndarray:
        """The node of each column, (c,) int64."""
        return np.flatnonzero(~self.inner)

    @cached_property
    def roots(self) -> np.ndarray:
        """The first node of each tree, (number of trees,) int64."""
        return np.flatnonzero(self.node == 0)

    def pruned(self, cost: np.ndarray, most: int) -> ColumnForest:
        """The forest of at most ``most`` columns, but of each tree's root at least, that comes of splitting the nodes
        that cost most.

        ``cost`` (m,): not negative, and at no node above that of its parent but for rounding.
        """
        split = self.inner & (cost > split_threshold(cost[None, self.inner], most - len(self.roots))[0])
        # A node that is not split hides all that are below it
        whole, size = np.flatnonzero(~split), self.size + 1
        hidden = np.bincount(whole + 1, minlength=size) - np.bincount(self.escape[whole], minlength=size)
        kept = np.cumsum(hidden)[:-1] == 0
        place = np.concatenate([[0], np.cumsum(kept)])
        escape = np.where(split, place[self.escape], place[:-1] + 1)
        return ColumnForest(self.group[kept], self.node[kept], escape[kept])


def split_threshold(cost: np.ndarray, splits: int) -> np.ndarray:
    """Cost above which nodes are split, so that in each row at most ``splits`` are, (s,).

    ``cost`` (s, m): of nodes that can be split, in no order.  Nodes that cost nothing are never split.
    """
    nodes, splits = cost.shape[1], max(splits, 0)
    if splits >= nodes:
        return np.zeros(len(cost), cost.dtype)
    return np.maximum(np.partition(cost, nodes - splits - 1, axis=1)[:, nodes - splits - 1], 0)
