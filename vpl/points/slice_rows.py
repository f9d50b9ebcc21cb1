"""Slices of the light matrix with a bounded number of rows: points split in 6-D at medians (NumPy only) [MSR 4.1].

A point is a 6-D vector of position and normal, see :mod:`vpl.points.slices`.  The points are halved across the longest
side of their box, recursively, until every slice contains points of at most a given number of pixels.  The points of
one pixel in a slice form a row of the slice's matrix [MSR 7.2] and share the visibility of lights.  Rows of a slice
follow a Morton curve in the plane perpendicular to the slice's mean normal, therefore adjacent rows are close in the
scene.
"""

from __future__ import annotations

import numpy as np

from ..core.morton import interleave
from .point_tree import PointTree, require_finite
from .slices import six_dimensional

# Bits per axis of the Morton codes that order rows
_CURVE_BITS = 16


def build_row_slices(pixel: np.ndarray, most: int, position: np.ndarray, normal: np.ndarray) -> PointTree:
    """Tree over points with slices of at most ``most`` rows as leaves; the points of a row are consecutive.

    pixel: (n,) int64, of every point.  position: (n, 3) float32, world units, n > 0.  normal: (n, 3) float32 unit
    vectors.

    Raises ValueError with the argument's name if an input is not finite or ``most`` is less than 1.
    """
    if most < 1:
        raise ValueError(f"most must be at least 1, got {most}")
    require_finite(position=position, normal=normal)
    points, order = six_dimensional(position, normal), np.arange(len(pixel))
    first, count, parent, levels, found = [0], [len(pixel)], [0], [0], []
    while first:
        child, begin, size = [], [], []
        following = levels[-1] + len(first)
        for start, length in zip(first, count, strict=True):
            part = order[start : start + length]
            divided = _rows(pixel[part], most) > most
            child.append(following + len(begin) if divided else 0)
            if divided:
                half = length // 2
                order[start : start + length] = _halved(points, part, half)
                begin += [start, start + half]
                size += [half, length - half]
        found.append((first, count, child, parent))
        parent = np.repeat(levels[-1] + np.flatnonzero(child), 2)
        levels.append(following)
        first, count = begin, size
    first, count, child, parent = (np.concatenate(column).astype(np.uint32) for column in zip(*found, strict=True))
    leaves = np.flatnonzero(child == 0)
    leaves = leaves[np.argsort(first[leaves])]
    leaf = np.repeat(leaves.astype(np.uint32), count[leaves])
    order = _along_curve(pixel, position, normal, order, leaf)
    return PointTree(order.astype(np.uint32), first, count, child, parent, np.array(levels), leaf)


def rows_of(pixel: np.ndarray, leaf: np.ndarray) -> np.ndarray:
    """First point of each row, then the number of points, (rows + 1,), from pixels and leaves in tree order."""
    begins = (pixel[1:] != pixel[:-1]) | (leaf[1:] != leaf[:-1])
    return np.concatenate([[0], np.flatnonzero(begins) + 1, [len(pixel)]])


def _rows(pixel: np.ndarray, enough: int) -> int:
    """Number of distinct pixels; without counting, the number of points if that is at most ``enough``."""
    return len(pixel) if len(pixel) <= enough else len(np.unique(pixel))


def _halved(points: np.ndarray, part: np.ndarray, half: int) -> np.ndarray:
    """Partition the points ``part`` at the median along the longest side of their box, lower half first."""
    inside = points[part]
    axis = int((inside.max(0) - inside.min(0)).argmax())
    return part[np.argpartition(inside[:, axis], half)]


def _along_curve(pixel, position, normal, order, leaf) -> np.ndarray:
    """``order`` with the rows of every leaf sorted along a Morton curve."""
    inside = np.concatenate([[True], leaf[1:] != leaf[:-1]])
    first, number = np.flatnonzero(inside), np.cumsum(inside) - 1
    x, y = tangent_places(position[order], normal[order], first, number)
    cells = np.stack([x, y, np.zeros_like(x)], axis=1) * (2**_CURVE_BITS - 1)
    code = interleave(cells)
    # The first point of a row determines the row's code
    rows = np.lexsort((pixel[order], number))
    starts = rows_of(pixel[order][rows], leaf[rows])
    row = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    code_of_row = np.minimum.reduceat(code[rows], starts[:-1])
    return order[rows[np.lexsort((row, code_of_row[row], number[rows]))]]


def tangent_places(position, normal, first: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Coordinates of points in the plane perpendicular to their group's mean normal [MSR 5.1], (2, n), from 0 to 1.

    The longer side of a group's box scales both coordinates.  position, normal: (n, 3), sorted by group; first: first
    point of each group; number: (n,), group of each point.
    """
    axis = np.add.reduceat(normal.astype(np.float64), first)
    # The coordinate axis farthest from the mean normal gives the best conditioned cross product
    helper = np.eye(3)[np.abs(axis).argmin(1)]
    u = np.cross(axis, helper)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
    v = np.cross(axis, u)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)
    places = np.stack([np.einsum("ij,ij->i", position, side[number]) for side in (u, v)])
    places -= np.minimum.reduceat(places, first, axis=1)[:, number]
    extent = np.maximum.reduceat(places, first, axis=1).max(0)
    return places / np.where(extent > 0, extent, 1)[number]


def golden_steps(counts: np.ndarray) -> np.ndarray:
    """For each count, the largest coprime number up to the rounded golden section of the count, at least 1."""
    steps = np.maximum(np.round(counts * (0.5 * (5**0.5 - 1))).astype(np.int64), 1)
    while (common := np.gcd(steps, counts) > 1).any():
        steps[common] -= 1
    return steps
