"""Which of six ways a surface faces: along which axis, and to which end of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

WAYS = 6


def facing(normal: np.ndarray) -> np.ndarray:
    """The way that normals (n, 3) face: 0 to 5."""
    x, y, z = np.abs(normal).T
    is_x, is_y = (x >= y) & (x >= z), y >= z
    below = np.where(is_x, normal[:, 0], np.where(is_y, normal[:, 1], normal[:, 2])) < 0
    return np.where(is_x, 0, np.where(is_y, 2, 4)) + below


def facing_of(normal):
    """The same of normals on the device, UInt32."""
    x, y, z = (dr.abs(component) for component in normal)
    axis = dr.select((x >= y) & (x >= z), mi.UInt32(0), dr.select(y >= z, mi.UInt32(1), mi.UInt32(2)))
    along = dr.select(axis == 0, normal.x, dr.select(axis == 1, normal.y, normal.z))
    return 2 * axis + dr.select(along < 0, mi.UInt32(1), mi.UInt32(0))
