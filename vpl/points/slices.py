"""Slices: groups of gather points with similar positions and normals, by splitting 6-D boxes (NumPy only) [LS].

A point is a 6-D vector of its position and its normal, times an eighth of the diagonal of the points' box. The box with
the largest product of point count and squared longest side is halved across the longest side, until the number of
boxes is reached. Random points, _SAMPLE per slice, determine the boxes. Finally every point descends the resulting
tree, whose leaves are the slices.

Departures from the paper: boxes are chosen by their extent as well as by their number of points, and are halved at the
midpoint rather than at the median. At equal numbers of slices and columns the error is three quarters (cornell). Points
that coincide except for rounding, with an ineffective midpoint, are split above the lowest coordinate.

[LS] Ou and Pellacini 2011, LightSlice: matrix slice sampling for the many-lights problem.
"""

from __future__ import annotations

import heapq

import numpy as np

from .point_tree import PointTree, require_finite

# Weight of normals relative to positions in units of the diagonal
_NORMAL_SCALE = 1 / 8
# Random points per slice that determine the splits
_SAMPLE = 64


class _Splits:
    """Boxes of a sample of points, (n, 6).

    ``axis``, ``place``: axis and coordinate of every box's split; ``child``: first child, which the second child
    follows; 0 for a leaf.
    """

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
        # Coincident points remain one slice
        if side[axis] > 0:
            heapq.heappush(self._waiting, (-len(inside) * side[axis] ** 2, len(self.child) - 1, inside))

    def _split(self, box: int, inside: np.ndarray) -> None:
        along = self._points[inside, self.axis[box]]
        # Half of each summand, against overflow; the largest value always lies above
        place = 0.5 * along.min() + 0.5 * along.max()
        if place >= along.max():
            place = along.min()
        self.place[box], self.child[box] = place, len(self.child)
        self._add(inside[along <= place])
        self._add(inside[along > place])


def build_slices(
    position: np.ndarray, normal: np.ndarray, slices: int, seed: int = 0, rank: np.ndarray | None = None
) -> PointTree:
    """Tree over points with at most ``slices`` non-empty slices as leaves; fewer if there are fewer distinct points.

    position: (n, 3) float32, world units, n > 0.  normal: (n, 3) float32 unit vectors.  seed: of the random points that
    determine the splits.  rank: None, or (n,) sort keys of points within their slice.

    Raises ValueError with the argument's name if an input is not finite or ``slices`` is less than 1.
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
    """Lay out the boxes breadth first and assign every point to a leaf."""
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
    # Breadth first order: children follow their parents
    for k in inner[::-1]:
        count[k] = count[child[k]] + count[child[k] + 1]
    for k in inner:
        first[child[k]], first[child[k] + 1] = first[k], first[k] + count[child[k]]
    order = np.argsort(first[leaf], kind="stable") if rank is None else np.lexsort((rank, first[leaf]))
    columns = (x.astype(np.uint32) for x in (order, first, count, child, parent))
    return PointTree(*columns, np.array(levels), leaf[order].astype(np.uint32))


def _descend(splits: _Splits, points: np.ndarray) -> np.ndarray:
    """Leaf box of each point, (n,) int64."""
    axis, place, child = (np.array(column) for column in (splits.axis, splits.place, splits.child))
    box, walking = np.zeros(len(points), np.int64), np.arange(len(points) if child[0] else 0)
    while len(walking):
        here = box[walking]
        box[walking] = here = child[here] + (points[walking, axis[here]] > place[here])
        walking = walking[child[here] > 0]
    return box
