"""Columns of the light matrix: clusters of lights below a forest of light trees (NumPy only) [LS].

The light matrix has a row per gather point and a column per light.  A node of a light tree represents a range of
columns.  Pruning the trees reduces the number of columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class ColumnForest:
    """Pruned trees, concatenated in preorder: m nodes, of which the c leaves are the columns, in the same order.

    ``group``: (m,) int64, tree of a node; ``node``: (m,) int64, index in the tree; ``escape``: (m,) int64, node after
    the subtree, i + 1 for a leaf i.
    """

    group: np.ndarray
    node: np.ndarray
    escape: np.ndarray

    @classmethod
    def of_tree(cls, escape: np.ndarray, group: int = 0) -> ColumnForest:
        """The whole of a tree with the given ``escape``: see :class:`vpl.lights.light_tree.LightTree`."""
        return cls(np.full(len(escape), group), np.arange(len(escape)), escape.astype(np.int64))

    @classmethod
    def joined(cls, forests: list[ColumnForest]) -> ColumnForest:
        """Concatenate forests."""
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
        """Mask of the inner nodes, (m,) bool."""
        return self.escape > np.arange(self.size) + 1

    @cached_property
    def first(self) -> np.ndarray:
        """First column of each node, then the number of columns, (m + 1,) int64.

        Node i has the columns ``first[i]`` to ``first[escape[i]]`` - 1.
        """
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
        """Split the costliest nodes, up to ``most`` columns; at least the root of each tree remains.

        ``cost`` (m,): at least 0, and apart from rounding at most the cost of the parent.
        """
        split = self.inner & (cost > split_threshold(cost[None, self.inner], most - len(self.roots))[0])
        # A node that is not split hides its descendants
        whole, size = np.flatnonzero(~split), self.size + 1
        hidden = np.bincount(whole + 1, minlength=size) - np.bincount(self.escape[whole], minlength=size)
        kept = np.cumsum(hidden)[:-1] == 0
        place = np.concatenate([[0], np.cumsum(kept)])
        escape = np.where(split, place[self.escape], place[:-1] + 1)
        return ColumnForest(self.group[kept], self.node[kept], escape[kept])


def split_threshold(cost: np.ndarray, splits: int) -> np.ndarray:
    """Threshold on the cost of nodes above which at most ``splits`` nodes of a row are split, (s,).

    ``cost`` (s, m): costs of inner nodes.  Nodes of cost 0 are never split.
    """
    nodes, splits = cost.shape[1], max(splits, 0)
    if splits >= nodes:
        return np.zeros(len(cost), cost.dtype)
    return np.maximum(np.partition(cost, nodes - splits - 1, axis=1)[:, nodes - splits - 1], 0)
