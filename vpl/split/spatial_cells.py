"""Spatial cells: cubes of space, each once for every axis direction that a surface may face.

The emitter samplers and Russian roulette store a value per cell, learned from the vertices of a pilot.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload

# Facings of a surface: along three axes, to two ends
FACINGS = 6
# Largest number of cubes along the longest side of the box around the vertices: finer cubes hold too few vertices
_FINEST_GRID = 32
# Fraction of the vertices at each end of an axis outside of the grid: outliers must not set the grid size
_OUTLIERS = 0.005
# The 26 cubes around a cube, as offsets in a padded grid
_AROUND = [cube for cube in itertools.product(range(3), repeat=3) if cube != (1, 1, 1)]


def facing(normal: np.ndarray) -> np.ndarray:
    """Facing of normals (n, 3), 0 to 5: the axis and the sign of the largest component."""
    x, y, z = np.abs(normal).T
    is_x, is_y = (x >= y) & (x >= z), y >= z
    below = np.where(is_x, normal[:, 0], np.where(is_y, normal[:, 1], normal[:, 2])) < 0
    return np.where(is_x, 0, np.where(is_y, 2, 4)) + below


def device_facing(normal: mi.Normal3f) -> mi.UInt32:
    """:func:`facing` on the device."""
    x, y, z = (dr.abs(component) for component in normal)
    axis = dr.select((x >= y) & (x >= z), mi.UInt32(0), dr.select(y >= z, mi.UInt32(1), mi.UInt32(2)))
    along = dr.select(axis == 0, normal.x, dr.select(axis == 1, normal.y, normal.z))
    return 2 * axis + dr.select(along < 0, mi.UInt32(1), mi.UInt32(0))


@dataclass
class SpatialCells:
    """A grid of cubes with a numbered cell for each occupied pair of cube and facing.

    ``low``: corner of the grid; ``size``: side of a cube, both world units; ``resolution``: cubes along each axis;
    ``table``: number of the cell for each cube and facing, from 1 on; 0 without vertices.  All opaque.
    """

    low: mi.Point3f
    size: mi.Float
    resolution: mi.Vector3u
    table: mi.UInt32

    @classmethod
    def none(cls) -> SpatialCells:
        """A grid without cells: every position has the number 0."""
        return cls._of(np.zeros(3), 1.0, np.ones(3, np.int64), np.zeros(FACINGS, np.int64))

    @classmethod
    def _of(cls, low: np.ndarray, size: float, resolution: np.ndarray, table: np.ndarray) -> SpatialCells:
        return cls(
            mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in low)),
            dr.opaque(mi.Float, float(size)),
            mi.Vector3u(*(dr.opaque(mi.UInt32, int(x)) for x in resolution)),
            upload(mi.UInt32, table),
        )

    @classmethod
    def around(cls, position: np.ndarray, normal: np.ndarray, most: int) -> tuple[SpatialCells, np.ndarray]:
        """(Cells of vertices (n, 3), the number of the cell of each) in a fine grid with at most ``most`` cells.

        A bisection, so the finest grid if finer ones have more cells.
        """
        low, high = np.quantile(position, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
        # The cubes must have a size in single precision
        longest = max(float((high - low).max()), 1e-6 * float(np.abs([low, high]).max()), 1e-30)
        direction = facing(normal)

        def grid(cubes: int):
            size = longest / cubes
            resolution = np.maximum(np.ceil((high - low) / size), 1).astype(np.int64)
            cube = np.clip(np.floor((position - low) / size), 0, resolution - 1).astype(np.int64)
            key = ((cube[:, 2] * resolution[1] + cube[:, 1]) * resolution[0] + cube[:, 0]) * FACINGS + direction
            occupied = np.zeros(FACINGS * resolution.prod(), bool)
            occupied[key] = True
            return size, resolution, key, occupied

        cubes, above, found = 1, _FINEST_GRID + 1, grid(1)
        while above - cubes > 1:
            tried = above - 1 if above > _FINEST_GRID else (cubes + above) // 2
            finer = grid(tried)
            if np.count_nonzero(finer[-1]) <= most:
                cubes, found = tried, finer
            else:
                above = tried
        size, resolution, key, occupied = found
        table = np.where(occupied, np.cumsum(occupied), 0)
        return cls._of(low, size, resolution, table), table[key]

    def neighbours(self) -> np.ndarray:
        """For cells 1 to n, the cells (n, 26) with the same facing in the cubes around; 0 where there is none."""
        *cubes, table = (download(x) for x in (*self.resolution, self.table))
        grid = table.reshape(*(int(x.item()) for x in reversed(cubes)), FACINGS)
        padded = np.pad(grid, ((1, 1), (1, 1), (1, 1), (0, 0)))
        # np.nonzero lists the cells in the order of their numbers
        z, y, x, direction = np.nonzero(grid)
        return np.stack([padded[z + dz, y + dy, x + dx, direction] for dz, dy, dx in _AROUND], 1)

    def at(self, position: mi.Point3f, normal: mi.Normal3f) -> mi.UInt32:
        """Number of the cell at each position, for vertices that face ``normal``."""
        cube = [
            mi.UInt32(dr.fmin(dr.fmax((x - low) / self.size, 0), mi.Float(count - 1)))
            for x, low, count in zip(position, self.low, self.resolution, strict=True)
        ]
        index = (cube[2] * self.resolution.y + cube[1]) * self.resolution.x + cube[0]
        return dr.gather(mi.UInt32, self.table, index * FACINGS + device_facing(normal))
