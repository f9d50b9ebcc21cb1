"""Which camera rays of a pixel are shaded together: adaptive antialiasing [IAS section 4.4] (NumPy only).

A pixel's gather points on the same surface are divided into regions of a quarter of the pixel's footprint, along both
axes in half; one point of each region stands for all of them in the shading, and counts as often as the region has
rays.  So the edges of surfaces have all rays, and light has a few points a pixel.

Departures from the paper: regions are the quarters of a box around the points instead of disks that grow around the
first points, so that all pixels can be divided at once; points off the tangent plane of their region's first point form
a region of their own.
"""

from __future__ import annotations

import numpy as np

from .sites import normal_class

# Points are off the plane where they are farther from it than this share of their distance along it
_OFF_PLANE = 0.2


def representatives(pixel, shape, position, normal, generator) -> np.ndarray:
    """The point that stands for each in the shading, (n,) int64: one at random of every region.

    ``pixel``, ``shape`` (n,): whole numbers; ``position``, ``normal`` (n, 3), world units; ``generator``: of NumPy.
    """
    shuffled = generator.permutation(len(pixel))
    standing = np.empty(len(pixel), np.int64)
    standing[shuffled] = shuffled[_first_points(*(x[shuffled] for x in (pixel, shape, position, normal)))]
    return standing


def _first_points(pixel, shape, position, normal) -> np.ndarray:
    """For each point the first of its region."""
    surface = _number(_number(pixel.astype(np.int64), shape), normal_class(normal))
    quarter = _number(surface, _quarters(surface, position))
    first = _first_of(quarter)
    offset = position - position[first]
    height = np.abs(np.einsum("ij,ij->i", offset, normal[first]))
    off = np.square(height) > _OFF_PLANE**2 * np.einsum("ij,ij->i", offset, offset)
    return _first_of(2 * quarter + off)


def _number(key, more) -> np.ndarray:
    """Number the distinct pairs of two keys from 0."""
    return np.unique(key * (int(more.max()) + 1) + more, return_inverse=True)[1]


def _first_of(key) -> np.ndarray:
    """For each entry the first with the same key."""
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return first[inverse]


def _quarters(surface, position) -> np.ndarray:
    """0 to 3: the quarter of its surface's box, along the two longest sides, that each point lies in."""
    order = np.argsort(surface, kind="stable")
    first = np.searchsorted(surface[order], np.arange(surface[order[-1]] + 1))
    inside = position[order]
    low, high = np.minimum.reduceat(inside, first), np.maximum.reduceat(inside, first)
    longest = np.argsort(low - high, axis=1, kind="stable")[:, :2][surface]
    upper = position > ((low + high) / 2)[surface]
    sides = np.take_along_axis(upper, longest, 1)
    return 2 * sides[:, 0] + sides[:, 1]
