"""Morton codes of grid cells, and the order of points along a Morton curve."""

from __future__ import annotations

import numpy as np

_SHIFTS = (32, 16, 8, 4, 2)
_MASKS = (0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249)


def interleave(cells: np.ndarray) -> np.ndarray:
    """Morton codes (n,) uint64 of cells (n, 3) with coordinates from 0 to 2^21 - 1; fractions are dropped.

    Bit k of the coordinate along axis a becomes bit 3k + a.
    """
    return interleaved([cells[:, axis].astype(np.uint64) for axis in range(3)])


def interleaved(columns):
    """The same for three columns of unsigned 64-bit integers, of NumPy or Dr.Jit."""
    x, y, z = (_spread(bits) for bits in columns)
    return x | (y << 1) | (z << 2)


def _spread(bits):
    """Move bit k to 3k, by halving the groups of adjacent bits."""
    for shift, mask in zip(_SHIFTS, _MASKS, strict=True):
        bits = (bits | (bits << shift)) & mask
    return bits


def morton_order(points: np.ndarray, bits: int = 21) -> np.ndarray:
    """Indices (n,) int64 of points (n, 3) along a Morton curve through their bounding cube, ``bits`` per axis.

    Cells are computed in the precision of the points.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    cells = 2**bits - 1
    # The inverse of a tiny extent overflows; points of a tiny extent share a cell
    scale = cells / extent if extent > cells * float(np.finfo(points.dtype).tiny) else 0.0
    return np.argsort(interleave(np.minimum((points - low) * scale, cells)), kind="stable")
