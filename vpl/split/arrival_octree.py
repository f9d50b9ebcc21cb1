"""Octree over the arrivals of camera paths: the boxes through which lines are drawn (NumPy).

Virtual lights are wanted where the second vertices of camera paths lie.  These *arrivals* are sorted into an octree,
and a box surrounds the arrivals in each leaf.  Parents of the leaves and the whole scene are boxes, too.  Each box has
a probability of being drawn, and a direction that lines prefer.  :mod:`vpl.split.line_sampling` draws the lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.morton import interleave

# Largest number of arrivals in a leaf; largest depth of the octree: the number of bits per axis of a Morton code
_LARGEST_LEAF, LEVELS = 16, 20
# Number of prior arrivals of average radiance in each leaf: a leaf holds up to 16 arrivals
_PRIOR = 2.0
# Fraction of the lines through parents of leaves and through the whole scene: keeps the density positive everywhere.
# The scene's share makes the soft spots weaker that few bright lights in places without arrivals make (decisions.md)
_PARENT_SHARE, SCENE_SHARE = 0.15, 0.2
# Margin of a box around the arrivals, as a fraction of the leaf; largest |M|, below 1 to reach both sides
_MARGIN, _LARGEST_TURN = 0.1, 0.9
# The number of a node is its Morton code behind a leading 1: the first number of each level
_FIRST_OF_LEVEL = 8 ** np.arange(LEVELS + 1, dtype=np.uint64)


@dataclass
class Boxes:
    """Boxes in nodes of an octree.

    ``number`` (n,) of the node, sorted; ``level`` of the node; ``low``, ``size`` (n, 3): world units; ``turn`` (n, 3):
    M; ``chance`` (n,): probability of being drawn.
    """

    number: np.ndarray
    level: np.ndarray
    low: np.ndarray
    size: np.ndarray
    turn: np.ndarray
    chance: np.ndarray

    @property
    def surface(self) -> np.ndarray:
        """Surface area of each box, (n,)."""
        x, y, z = self.size.T
        return 2 * (x * y + y * z + z * x)


class ArrivalOctree:
    """Octree over arrivals: positions (n, 3), unit normals (n, 3), weights (n,) with a positive sum.

    ``scene_low``, ``scene_size``: a cube around every surface; ``low``, ``size``: the cube of the root; world units.
    The octree has a random position, so the planes do not coincide with walls.  ``leaves``, ``parents``: boxes in the
    leaves, and the parents of the leaves as boxes.  ``leaf_of_point`` (n,); ``leaf_weight`` (leaves,): sum of weights.
    """

    def __init__(self, position, normal, weight, scene_low, scene_size: float, generator):
        position = np.asarray(position, np.float64)
        low, extent = position.min(0), np.ptp(position, axis=0)
        # Boxes of coinciding arrivals far from the origin need a margin that double precision resolves
        resolved = float(np.spacing(np.abs(position).max())) * 2**LEVELS / _MARGIN
        self.size = max(float(extent.max()), 1e-6 * scene_size, resolved) * generator.uniform(1.1, 2.0)
        self.low = low - generator.random(3) * (self.size - extent)
        self.scene_low, self.scene_size = np.asarray(scene_low, np.float64), float(scene_size)
        leaf = _leaves(self._finest(position))
        self.leaves = self._boxes_around(leaf, position, normal, weight)
        self.leaf_of_point = np.searchsorted(self.leaves.number, leaf)
        self.leaf_weight = self.leaves.chance.copy()
        above = np.maximum(leaf >> np.uint64(3), np.uint64(1))
        self.parents = self._boxes_around(above, position, normal, weight)
        self.parents.low = self._corner(self.parents)
        self.parents.size = np.repeat((self.size * 0.5**self.parents.level)[:, None], 3, axis=1)
        self._parent_of_leaf = np.searchsorted(
            self.parents.number, np.maximum(self.leaves.number >> np.uint64(3), np.uint64(1))
        )
        self.choose_by(self.leaf_weight)

    def choose_by_radiance(self, radiance: np.ndarray) -> None:
        """Draw leaves in proportion to the number of arrivals times the root mean square of their ``radiance`` (n,)."""
        leaf, size = self.leaf_of_point, len(self.leaf_weight)
        number, typical = np.bincount(leaf, minlength=size), np.mean(radiance**2)
        if typical > 0:
            squared = np.bincount(leaf, radiance**2, size)
            self.choose_by(number * np.sqrt((squared + _PRIOR * typical) / (number + _PRIOR)))

    def choose_by(self, importance: np.ndarray) -> None:
        """Draw leaves in proportion to ``importance``, (leaves,) float64."""
        share = importance / importance.sum()
        self.leaves.chance = (1 - _PARENT_SHARE - SCENE_SHARE) * share
        self.parents.chance = _PARENT_SHARE * np.bincount(self._parent_of_leaf, share, len(self.parents.number))

    def _boxes_around(self, cell, position, normal, weight) -> Boxes:
        number, row, count = np.unique(cell, return_inverse=True, return_counts=True)
        order = np.argsort(row, kind="stable")
        first = np.cumsum(count) - count
        low, high = (f.reduceat(position[order], first) for f in (np.minimum, np.maximum))
        chance = np.bincount(row, weight)
        turn = np.stack([np.bincount(row, weight * normal[:, k]) for k in range(3)], axis=1)
        turn *= _LARGEST_TURN / np.maximum(chance, np.finfo(np.float64).tiny)[:, None]
        level = np.searchsorted(_FIRST_OF_LEVEL, number, side="right") - 1
        boxes = Boxes(number, level, low, high - low, turn, chance)
        # Within the node, a box extends beyond the arrivals by the distance between arrivals
        margin = (_MARGIN * self.size * 0.5**level)[:, None] + (high - low) / np.sqrt(count)[:, None]
        corner, size = self._corner(boxes), (self.size * 0.5**level)[:, None]
        boxes.low = np.maximum(low - margin, corner)
        boxes.size = np.minimum(high + margin, corner + size) - boxes.low
        return boxes

    def _finest(self, position: np.ndarray) -> np.ndarray:
        cell = np.floor((position - self.low) * (2**LEVELS / self.size))
        return interleave(np.clip(cell, 0, 2**LEVELS - 1)) + _FIRST_OF_LEVEL[LEVELS]

    def _corner(self, boxes: Boxes) -> np.ndarray:
        """Lower corners of the nodes of boxes, (n, 3)."""
        code = boxes.number - _FIRST_OF_LEVEL[boxes.level]
        cell = np.zeros((len(code), 3))
        for bit in range(LEVELS):
            for axis in range(3):
                cell[:, axis] += ((code >> np.uint64(3 * bit + axis)) & np.uint64(1)).astype(np.float64) * 2.0**bit
        return self.low + cell * (self.size * 0.5**boxes.level)[:, None]


def _leaves(finest: np.ndarray) -> np.ndarray:
    """Number of the leaf of each point: the largest node with few enough points."""
    order = np.argsort(finest, kind="stable")
    inside, leaf = finest[order], finest[order]
    for level in range(LEVELS - 1, -1, -1):
        # Points of a node are neighbours in the order
        number = inside >> np.uint64(3 * (LEVELS - level))
        first = np.flatnonzero(np.concatenate([[True], number[1:] != number[:-1]]))
        count = np.diff(np.append(first, len(number)))
        few = np.repeat(count <= _LARGEST_LEAF, count)
        leaf[few] = number[few]
    found = np.empty_like(leaf)
    found[order] = leaf
    return found
