"""Sites: cubes of space, each six times, for the ways that surfaces in it may face."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from .facing import WAYS, facing, facing_of

# Cubes along the longest side of where vertices are, at most; a share of them at its ends that may lie outside
_FINEST_GRID, _OUTLIERS = 32, 0.005
# Cubes around a cube, in a padded grid
_AROUND = [cube for cube in itertools.product(range(3), repeat=3) if cube != (1, 1, 1)]


@dataclass
class Sites:
    """Numbers of sites: ``low`` and ``size`` of the cubes' grid, ``resolution`` along its axes, all opaque;
    ``table``: the site of each cube and facing, 0 where nothing is known."""

    low: object
    size: object
    resolution: object
    table: object

    @classmethod
    def none(cls) -> Sites:
        """Nothing is known anywhere."""
        return cls._of(np.zeros(3), 1.0, np.ones(3, np.int64), np.zeros(WAYS, np.int64))

    @classmethod
    def _of(cls, low, size, resolution, table) -> Sites:
        return cls(
            mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in low)),
            dr.opaque(mi.Float, float(size)),
            mi.Vector3u(*(dr.opaque(mi.UInt32, int(x)) for x in resolution)),
            upload(mi.UInt32, table),
        )

    @classmethod
    def around(cls, position: np.ndarray, normal: np.ndarray, most: int) -> tuple[Sites, np.ndarray]:
        """(Sites of vertices (n, 3), the site of each): at most ``most``, numbered from 1."""
        low, high = np.quantile(position, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
        # Not so small that cubes have no size in single precision
        longest = max(float((high - low).max()), 1e-6 * float(np.abs([low, high]).max()), 1e-30)
        way = facing(normal)
        for cubes in range(_FINEST_GRID, 0, -1):
            size = longest / cubes
            resolution = np.maximum(np.ceil((high - low) / size), 1).astype(np.int64)
            cell = np.clip(np.floor((position - low) / size), 0, resolution - 1).astype(np.int64)
            key = ((cell[:, 2] * resolution[1] + cell[:, 1]) * resolution[0] + cell[:, 0]) * WAYS + way
            known = np.zeros(WAYS * resolution.prod(), bool)
            known[key] = True
            if np.count_nonzero(known) <= most:
                break
        table = np.where(known, np.cumsum(known), 0)
        return cls._of(low, size, resolution, table), table[key]

    def neighbours(self) -> np.ndarray:
        """The sites (n, 26) that face the same way in the cubes around those of sites 1 to n; 0 where there is none."""
        *cubes, table = (download(x) for x in (*self.resolution, self.table))
        grid = table.reshape(*(int(x.item()) for x in reversed(cubes)), WAYS)
        padded = np.pad(grid, ((1, 1), (1, 1), (1, 1), (0, 0)))
        z, y, x, way = np.nonzero(grid)
        # In the order of the sites' numbers
        return np.stack([padded[z + dz, y + dy, x + dx, way] for dz, dy, dx in _AROUND], 1)

    def at(self, position, normal):
        """The site of each position, for vertices that face ``normal``."""
        cell = [
            mi.UInt32(dr.fmin(dr.fmax((x - low) / self.size, 0), mi.Float(count - 1)))
            for x, low, count in zip(position, self.low, self.resolution, strict=True)
        ]
        cube = (cell[2] * self.resolution.y + cell[1]) * self.resolution.x + cell[0]
        return dr.gather(mi.UInt32, self.table, cube * WAYS + facing_of(normal))
