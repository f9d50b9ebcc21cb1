"""Axes of cones around directions, and the rounding of their cosines."""

from __future__ import annotations

import numpy as np

# Subtracted from a cosine before it is stored in single precision, so that no cone excludes a vector by rounding:
# eight roundings of 2^-24, of which a dot product of unit vectors has 3, its operands 1 each, the subtraction 1
COSINE_ROUNDING = 2.0**-21


def mean_axes(sums: np.ndarray, otherwise, least=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Normalize sums of directions (n, 3) to axes (n, 3) float64; also return the mask (n,) of balanced sums.

    ``least``, number or (n,): a sum of at most this length is balanced, its direction is rounding error, and its axis
    is ``otherwise``, (3,) or (n, 3).
    """
    length = np.linalg.norm(sums, axis=1)
    balanced = length <= least
    axes = np.where(balanced[:, None], otherwise, sums / np.where(balanced, 1, length)[:, None])
    return axes, balanced
