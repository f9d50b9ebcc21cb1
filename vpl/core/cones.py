"""Cones around directions, whatever is in them: their axes, and by how much their cosines are rounded down."""

from __future__ import annotations

import numpy as np

# A cosine is lowered by this much before it is stored in single precision, so that no cone loses a vector to rounding:
# eight roundings of 2^-24, 3 in a dot product of unit vectors, 1 each for these and the subtraction, 2 to spare
COSINE_ROUNDING = 2.0**-21


def mean_axes(sums: np.ndarray, otherwise, least=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Axes along sums of directions, (n, 3), and which of them balance: (n, 3) float64 unit vectors, (n,) bool.

    ``least``, number or (n,): a sum that is no longer is rounding, and gets the axis ``otherwise``, (3,) or (n, 3).
    """
    length = np.linalg.norm(sums, axis=1)
    balanced = length <= least
    axes = np.where(balanced[:, None], otherwise, sums / np.where(balanced, 1, length)[:, None])
    return axes, balanced
