"""Gather trees: for every pixel a binary tree over its gather points (NumPy only) [MDLC].

All of them are branches of one :class:`vpl.points.point_tree.PointTree`, whose upper levels hold blocks of pixels: what
is known of all pixels of a block, such as that a cluster of lights lies behind them, is found out once.

Within a pixel points are divided by normal first, then by position within the box of the pixel's own points; the
pixels lie along a Morton curve through the image.

[MDLC] Walter et al. 2006, Multidimensional lightcuts.
"""

from __future__ import annotations

import numpy as np

from ..core.morton import interleave
from .point_tree import PointTree, require_finite, tree_over_codes

_NORMAL_CELLS, _NORMAL_BITS = 7, 3
_MOST_POSITION_BITS, _CODE_BITS = 10, 63


def gather_codes(pixel: np.ndarray, width: int, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, int]:
    """Codes of points, (n,) uint64: the pixel above where the normal points to above where the point is; and how many
    bits lie below the pixel's.

    ``pixel`` (n,): row after row of an image ``width`` wide; ``position``, ``normal``: (n, 3), world units.
    """
    count = np.bincount(pixel)
    pixels = np.flatnonzero(count)
    owner = (np.cumsum(count > 0) - 1)[pixel]
    along = interleave(np.stack([pixels % width, pixels // width, np.zeros_like(pixels)], axis=1))
    place = np.argsort(np.argsort(along)).astype(np.uint64)[owner]
    # The more pixels, the fewer bits are left for what is inside of one
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
    """The tree over points, n > 0, with at most ``leaf_size`` points of one pixel in a leaf; other arguments as in
    :func:`gather_codes`."""
    require_finite(position=position, normal=normal)
    codes, shift = gather_codes(pixel, width, position, normal)
    return tree_over_codes(codes, leaf_size, shift)
