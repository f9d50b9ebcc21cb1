"""Gather trees: for every pixel a binary tree over its gather points (NumPy only) [MDLC].

One :class:`vpl.points.point_tree.PointTree` contains the gather trees as subtrees.  Its upper levels are blocks of
pixels, for decisions common to a whole block, such as whether a cluster of lights is behind it.

Within a pixel, points are split by normal first, then by position within the pixel's box.  Pixels are in Morton order
of their image coordinates.

[MDLC] Walter et al. 2006, Multidimensional lightcuts.
"""

from __future__ import annotations

import numpy as np

from ..core.morton import interleave
from .point_tree import PointTree, require_finite, tree_over_codes

# Cells per axis of the cube of normals, odd as in the point tree; bits per axis of their Morton code
_NORMAL_CELLS, _NORMAL_BITS = 7, 3
# Largest number of position bits per axis; bits of a whole code
_MOST_POSITION_BITS, _CODE_BITS = 10, 63


def gather_codes(pixel: np.ndarray, width: int, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, int]:
    """(Codes of points (n,) uint64, number of bits below the pixel): pixel, normal, position, from high to low bits.

    ``pixel`` (n,): row-major index in an image of ``width`` pixels; ``position``, ``normal``: (n, 3), world units.
    """
    count = np.bincount(pixel)
    pixels = np.flatnonzero(count)
    owner = (np.cumsum(count > 0) - 1)[pixel]
    along = interleave(np.stack([pixels % width, pixels // width, np.zeros_like(pixels)], axis=1))
    place = np.argsort(np.argsort(along)).astype(np.uint64)[owner]
    # Bits not needed for the pixel are available for the position
    position_bits = min(_MOST_POSITION_BITS, (_CODE_BITS - len(pixels).bit_length()) // 3 - _NORMAL_BITS)
    shift = 3 * (_NORMAL_BITS + position_bits)
    first = np.concatenate([[0], np.cumsum(count[pixels])[:-1]])
    inside = position[np.argsort(owner, kind="stable")]
    low = np.minimum.reduceat(inside, first)
    extent = (np.maximum.reduceat(inside, first) - low).max(1)
    cells = (position - low[owner]) / np.where(extent > 0, extent, 1)[owner, None] * (2**position_bits - 1)
    by_normal = np.clip((normal + 1) * (0.5 * _NORMAL_CELLS), 0, _NORMAL_CELLS - 1)
    code = place << np.uint64(shift)
    code |= interleave(by_normal) << np.uint64(3 * position_bits)
    return code | interleave(cells), shift


def build_gather_tree(
    pixel: np.ndarray, width: int, leaf_size: int, position: np.ndarray, normal: np.ndarray
) -> PointTree:
    """Tree over n > 0 points, with at most ``leaf_size`` points of one pixel in a leaf.

    ``pixel``, ``width``, ``position``, ``normal``: see :func:`gather_codes`.
    """
    require_finite(position=position, normal=normal)
    codes, shift = gather_codes(pixel, width, position, normal)
    return tree_over_codes(codes, leaf_size, shift)
