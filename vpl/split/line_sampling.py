"""Random lines near the arrivals of camera paths, with a known density on surfaces (NumPy).

Virtual lights are wanted where the second vertices of camera paths lie.  These *arrivals* are sorted into an octree,
and a box surrounds the arrivals in each leaf.  A box is drawn, and then a line from the uniform distribution of lines
through the box: from a uniform point on the surface of the box, inwards by the cosine.  By the formulas of Cauchy and
Crofton, a line through a convex body of surface area S is expected to hit each side of a surface of area A inside the
body A / S times, for any shape and orientation of the surface.  Ray tracing alone thus draws points on any kind of
shape with a known density, and few points far from the arrivals.

Camera paths usually arrive at a single side of a surface.  With M the mean normal of the arrivals in a box, a line is
reversed with probability |M| if it runs along M.  A fraction (1 + cos(n, M)) / 2 of the lines through a side with
normal n runs against M, so the density on the side is A / S (1 + n·M).

Parents of the leaves and the whole scene are drawn with a smaller probability, so the density is positive everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.morton import interleave

# Largest number of arrivals in a leaf; largest depth of the octree: the number of bits per axis of a Morton code
_LARGEST_LEAF, _LEVELS = 16, 20
# Number of prior arrivals of average radiance in each leaf: a leaf holds up to 16 arrivals
_PRIOR = 2.0
# Fraction of the lines through parents of leaves and through the whole scene: keeps the density positive everywhere.
# The scene's share makes the soft spots weaker that few bright lights in places without arrivals make (decisions.md)
_PARENT_SHARE, _SCENE_SHARE = 0.15, 0.2
# Margin of a box around the arrivals, as a fraction of the leaf; largest |M|, below 1 to reach both sides
_MARGIN, _LARGEST_TURN = 0.1, 0.9
# The number of a node is its Morton code behind a leading 1: the first number of each level
_FIRST_OF_LEVEL = 8 ** np.arange(_LEVELS + 1, dtype=np.uint64)


@dataclass
class Lines:
    """Line segments inside boxes, world units.

    ``origin``, ``direction`` (n, 3), ``length`` (n,), float32; ``low``, ``size`` (n, 3) float64: the box of each.
    """

    origin: np.ndarray
    direction: np.ndarray
    length: np.ndarray
    low: np.ndarray
    size: np.ndarray

    def hold(self, line, position) -> np.ndarray:
        """Whether points (n, 3) lie in the boxes of the lines with the numbers ``line`` (n,), boundary included."""
        return _inside(position, self.low[line], self.size[line])


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

    ``scene_low``, ``scene_size``: a cube around every surface, world units.  The octree has a random position, so the
    planes do not coincide with walls.
    """

    def __init__(self, position, normal, weight, scene_low, scene_size: float, generator):
        position = np.asarray(position, np.float64)
        low, extent = position.min(0), np.ptp(position, axis=0)
        self._size = max(float(extent.max()), 1e-6 * scene_size) * generator.uniform(1.1, 2.0)
        self._low = low - generator.random(3) * (self._size - extent)
        self._scene_low, self.scene_size = np.asarray(scene_low, np.float64), float(scene_size)
        leaf = _leaves(self._finest(position))
        self._leaves = self._boxes_around(leaf, position, normal, weight)
        self.leaf_of_point = np.searchsorted(self._leaves.number, leaf)
        self.leaf_weight = self._leaves.chance.copy()
        above = np.maximum(leaf >> np.uint64(3), np.uint64(1))
        self._parents = self._boxes_around(above, position, normal, weight)
        self._parents.low = self._corner(self._parents)
        self._parents.size = np.repeat((self._size * 0.5**self._parents.level)[:, None], 3, axis=1)
        self._parent_of_leaf = np.searchsorted(
            self._parents.number, np.maximum(self._leaves.number >> np.uint64(3), np.uint64(1))
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
        self._leaves.chance = (1 - _PARENT_SHARE - _SCENE_SHARE) * share
        self._parents.chance = _PARENT_SHARE * np.bincount(self._parent_of_leaf, share, len(self._parents.number))

    def lines(self, count: int, generator) -> Lines:
        """Draw ``count`` random lines, stratified over the boxes."""
        parts = (self._leaves, self._parents)
        chance = np.concatenate([*(part.chance for part in parts), [_SCENE_SHARE]])
        low = np.concatenate([*(part.low for part in parts), self._scene_low[None]])
        size = np.concatenate([*(part.size for part in parts), np.full((1, 3), self.scene_size)])
        turn = np.concatenate([*(part.turn for part in parts), np.zeros((1, 3))])
        sample = (np.arange(count) + generator.random(count)) / count
        row = np.minimum(np.searchsorted(np.cumsum(chance), sample * chance.sum(), side="right"), len(chance) - 1)
        place, direction, length = _chords(size[row], generator)
        # A reversed line begins where it ended
        back = (generator.random(count) < np.linalg.norm(turn[row], axis=1)) & ((direction * turn[row]).sum(1) > 0)
        place = np.where(back[:, None], place + direction * length[:, None], place)
        direction = np.where(back[:, None], -direction, direction)
        columns = (low[row] + place, direction, length)
        return Lines(*(column.astype(np.float32) for column in columns), low[row], size[row])

    def density(self, position, normal) -> np.ndarray:
        """Expected hits per area of one line, on the side of a surface with the ``normal`` (n, 3): (n,) float64."""
        position = np.asarray(position, np.float64)
        found = np.full(len(position), _SCENE_SHARE / (6 * self.scene_size**2))
        for boxes in (self._leaves, self._parents):
            surface = boxes.surface
            for row, inside in self._found(boxes, position):
                facing = 1 + (normal * boxes.turn[row]).sum(1)
                found += np.where(inside, boxes.chance[row] * facing / surface[row], 0)
        return found

    def _found(self, boxes: Boxes, position):
        """Level by level, the candidate box of each position, and whether the box holds the position."""
        finest = self._finest(position)
        for level in np.unique(boxes.level):
            number = finest >> np.uint64(3 * (_LEVELS - level))
            row = np.minimum(np.searchsorted(boxes.number, number), len(boxes.number) - 1)
            yield row, (boxes.number[row] == number) & _inside(position, boxes.low[row], boxes.size[row])

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
        margin = (_MARGIN * self._size * 0.5**level)[:, None] + (high - low) / np.sqrt(count)[:, None]
        corner, size = self._corner(boxes), (self._size * 0.5**level)[:, None]
        boxes.low = np.maximum(low - margin, corner)
        boxes.size = np.minimum(high + margin, corner + size) - boxes.low
        return boxes

    def _finest(self, position: np.ndarray) -> np.ndarray:
        cell = np.floor((position - self._low) * (2**_LEVELS / self._size))
        return interleave(np.clip(cell, 0, 2**_LEVELS - 1)) + _FIRST_OF_LEVEL[_LEVELS]

    def _corner(self, boxes: Boxes) -> np.ndarray:
        """Lower corners of the nodes of boxes, (n, 3)."""
        code = boxes.number - _FIRST_OF_LEVEL[boxes.level]
        cell = np.zeros((len(code), 3))
        for bit in range(_LEVELS):
            for axis in range(3):
                cell[:, axis] += ((code >> np.uint64(3 * bit + axis)) & np.uint64(1)).astype(np.float64) * 2.0**bit
        return self._low + cell * (self._size * 0.5**boxes.level)[:, None]


def _inside(position, low, size) -> np.ndarray:
    """Whether points (n, 3) lie in boxes, boundary included."""
    beyond = position - low
    return ((beyond >= 0) & (beyond <= size)).all(1)


def _leaves(finest: np.ndarray) -> np.ndarray:
    """Number of the leaf of each point: the largest node with few enough points."""
    order = np.argsort(finest, kind="stable")
    inside, leaf = finest[order], finest[order]
    for level in range(_LEVELS - 1, -1, -1):
        # Points of a node are neighbours in the order
        number = inside >> np.uint64(3 * (_LEVELS - level))
        first = np.flatnonzero(np.concatenate([[True], number[1:] != number[:-1]]))
        count = np.diff(np.append(first, len(number)))
        few = np.repeat(count <= _LARGEST_LEAF, count)
        leaf[few] = number[few]
    found = np.empty_like(leaf)
    found[order] = leaf
    return found


def _chords(size: np.ndarray, generator):
    """Draw a line through each box of ``size`` (n, 3): (entry relative to the lower corner, direction, length)."""
    count, lane = len(size), np.arange(len(size))
    x, y, z = size.T
    areas = np.cumsum(np.stack([y * z, z * x, x * y], axis=1), axis=1)
    axis = (generator.random(count)[:, None] * areas[:, 2:] >= areas[:, :2]).sum(1)
    far = generator.random(count) < 0.5
    place = generator.random((count, 3)) * size
    place[lane, axis] = np.where(far, size[lane, axis], 0)
    radius2, angle = generator.random(count), 2 * np.pi * generator.random(count)
    direction = np.empty((count, 3))
    direction[lane, axis] = np.sqrt(1 - radius2) * np.where(far, -1, 1)
    direction[lane, (axis + 1) % 3] = np.sqrt(radius2) * np.cos(angle)
    direction[lane, (axis + 2) % 3] = np.sqrt(radius2) * np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(direction > 0, (size - place) / direction, -place / direction)
    return place, direction, np.maximum(np.where(direction == 0, np.inf, distance).min(1), 0)
