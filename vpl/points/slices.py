"""Slices: groups of gather points that are near to each other and face alike, by splitting 6-D boxes (NumPy only) [LS].

A point is its position and its normal, scaled by an eighth of the diagonal of all points. The box with the most points
times its squared longest side is halved across that side, until there are as many boxes as wanted. A few dozen random
points for each slice decide where; then all points go down the tree that resulted, whose leaves are the slices.

Departures from the paper: boxes are chosen by how far their points lie apart rather than by number alone, and halved in
the middle rather than at the median, which at equal slices and columns gave three quarters of the error (cornell).
A box whose middle divides nothing, for all its points coincide but for rounding, is divided above the lowest of them.

[LS] Ou and Pellacini 2011, LightSlice: matrix slice sampling for the many-lights problem.
"""

from __future__ import annotations

import heapq

import numpy as np

from .point_tree import PointTree, require_finite

_NORMAL_SCALE = 1 / 8
# Random points that decide where boxes are split, for each slice
_SAMPLE = 64


class _Splits:
    """Boxes of a sample of points, (n, 6): of every box the axis and place of its split, and its first child (0: none;
    the second is the next one)."""

    def __init__(self, points: np.ndarray, wanted: int):
        self._points, self._waiting = points, []
        self.axis, self.place, self.child = [], [], []
        self._add(np.arange(len(points)))
        while len(self._waiting) and (len(self.child) + 1) // 2 < wanted:
            _, box, inside = heapq.heappop(self._waiting)
            self._split(box, inside)

    def _add(self, inside: np.ndarray) -> None:
        points = self._points[inside]
        side = points.max(0) - points.min(0)
        axis = int(side.argmax())
        self.axis.append(axis)
        self.place.append(0.0)
        self.child.append(0)
        # Points that all coincide are one slice, however many they are
        if side[axis] > 0:
            heapq.heappush(self._waiting, (-len(inside) * side[axis] ** 2, len(self.child) - 1, inside))

    def _split(self, box: int, inside: np.ndarray) -> None:
        along = self._points[inside, self.axis[box]]
        # Halved before they are added, so that nothing overflows; the largest value always lies above
        place = 0.5 * along.min() + 0.5 * along.max()
        if place >= along.max():
            place = along.min()
        self.place[box], self.child[box] = place, len(self.child)
        self._add(inside[along <= place])
        self._add(inside[along > place])


def build_slices(
    position: np.ndarray, normal: np.ndarray, slices: int, seed: int = 0, rank: np.ndarray | None = None
) -> PointTree:
    """A tree over points whose leaves are at most ``slices`` slices, none of them empty.

    position: (n, 3) float32, world units, n > 0.  normal: (n, 3) float32 unit vectors.  There are fewer slices where
    there are fewer points, or fewer different ones.  seed: of the choice of points that decide.  rank: None, or (n,)
    numbers by which the points of a slice are sorted.

    Raises ValueError, naming the argument, where an input is not finite or ``slices`` is less than 1.
    """
    if slices < 1:
        raise ValueError(f"slices must be at least 1, got {slices}")
    require_finite(position=position, normal=normal)
    points = six_dimensional(position, normal)
    sample = np.random.default_rng(seed).choice(len(points), min(len(points), _SAMPLE * slices), replace=False)
    return _tree_of(_Splits(points[sample], slices), points, rank)


def six_dimensional(position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Positions in units of the diagonal of their box, and scaled normals: (n, 6) float64."""
    low = position.min(0).astype(np.float64)
    diagonal = np.linalg.norm(position.max(0) - low) or 1.0
    return np.concatenate([(position - low) / diagonal, _NORMAL_SCALE * normal], axis=1)


def _tree_of(splits: _Splits, points: np.ndarray, rank: np.ndarray | None) -> PointTree:
    """Lay the boxes out breadth first and sort all points into them."""
    split_child = np.array(splits.child)
    levels, boxes = [0], [np.zeros(1, np.int64)]
    while len(inner := boxes[-1][split_child[boxes[-1]] > 0]):
        levels.append(levels[-1] + len(boxes[-1]))
        boxes.append(np.repeat(split_child[inner], 2) + np.tile([0, 1], len(inner)))
    box = np.concatenate(boxes)
    levels.append(len(box))
    node = np.empty(len(box), np.int64)
    node[box] = np.arange(len(box))
    child = np.where(split_child[box] > 0, node[split_child[box]], 0)
    inner = np.flatnonzero(child)
    parent = np.zeros(len(box), np.int64)
    parent[child[inner]] = parent[child[inner] + 1] = inner

    leaf = node[_descend(splits, points)]
    count, first = np.bincount(leaf, minlength=len(box)), np.zeros(len(box), np.int64)
    # Children stand behind their parents
    for k in inner[::-1]:
        count[k] = count[child[k]] + count[child[k] + 1]
    for k in inner:
        first[child[k]], first[child[k] + 1] = first[k], first[k] + count[child[k]]
    order = np.argsort(first[leaf], kind="stable") if rank is None else np.lexsort((rank, first[leaf]))
    columns = (x.astype(np.uint32) for x in (order, first, count, child, parent))
    return PointTree(*columns, np.array(levels), leaf[order].astype(np.uint32))


def _descend(splits: _Splits, points: np.ndarray) -> np.ndarray:
    """The box without a split that each point lies in, (n,) int64."""
    axis, place, child = (np.array(column) for column in (splits.axis, splits.place, splits.child))
    box, walking = np.zeros(len(points), np.int64), np.arange(len(points) if child[0] else 0)
    while len(walking):
        here = box[walking]
        box[walking] = here = child[here] + (points[walking, axis[here]] > place[here])
        walking = walking[child[here] > 0]
    return box
