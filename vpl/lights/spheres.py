"""Spheres among area emitters, with corrections of Mitsuba 3.9.1's samples.

Mitsuba's ``sample_position`` ignores the rotation of a sphere in the normal, and ``sample_direction`` computes no
texture coordinates.  Here the normal follows from the position, and the texture coordinates from the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.parameters import matrix_of, parameters_of


@dataclass
class Sphere:
    """``center`` (3,), ``radius``: world units; ``across``, ``axis`` (3,): unit x and z axes; ``handed``: 1 for a
    right-handed frame, -1 for a left-handed frame; ``side``: 1 for outward, -1 for inward emission."""

    center: np.ndarray
    radius: float
    across: np.ndarray
    axis: np.ndarray
    handed: float
    side: float

    @property
    def rotated(self) -> bool:
        """Whether its axes differ from the world's."""
        return self.handed < 0 or self.across[0] < 1 or self.axis[2] < 1

    @classmethod
    def of(cls, shape) -> Sphere:
        """Read a sphere shape of Mitsuba."""
        matrix = matrix_of(parameters_of(shape, below=False)["to_world"])
        linear = matrix[:3, :3]
        # No division by zero for a sphere of radius 0
        lengths = np.maximum(np.linalg.norm(linear, axis=0), np.finfo(np.float64).tiny)
        across, axis = (linear[:, k] / lengths[k] for k in (0, 2))
        side = -1.0 if shape.has_flipped_normals() else 1.0
        radius = float(np.linalg.norm(linear[:, 0]))
        return cls(matrix[:3, 3], radius, across, axis, float(np.sign(np.linalg.det(linear))), side)


def sphere_coordinates(outward, across, axis, handed):
    """Texture coordinates of the point with outward normal ``outward``; the arguments are fields of :class:`Sphere`."""
    y = dr.cross(axis, across) * handed
    azimuth = dr.atan2(dr.dot(outward, y), dr.dot(outward, across))
    azimuth = dr.select(azimuth < 0, azimuth + dr.two_pi, azimuth)
    return mi.Point2f(azimuth * dr.inv_two_pi, dr.safe_acos(dr.dot(outward, axis)) * dr.inv_pi)


class SphereRows:
    """The spheres among rows of shapes, for kernels.  ``shapes``: per row, Mitsuba's sphere or None."""

    def __init__(self, shapes: list[mi.Shape | None]):
        records = np.zeros((len(shapes), 12), np.float32)
        for row, shape in enumerate(shapes):
            if shape is not None:
                sphere = Sphere.of(shape)
                records[row, 0:3], records[row, 3] = sphere.center, sphere.side
                records[row, 4:7], records[row, 7], records[row, 8:11] = sphere.across, sphere.handed, sphere.axis
                # Unrotated spheres keep Mitsuba's normals, which are more precise than normals from positions
                records[row, 11] = sphere.rotated
        self._records = upload(mi.Float, records)

    def _fetch(self, row, part: int, active):
        return dr.gather(mi.Vector4f, self._records, row * 3 + part, active)

    def normal(self, row, sample, active):
        """Normal of a position sample on the shape of each row, on the emitting side."""
        place, rotated = self._fetch(row, 0, active), self._fetch(row, 2, active).w
        outward = mi.Normal3f(dr.normalize(sample.p - place.xyz))
        return dr.select(rotated != 0, outward * place.w, sample.n)

    def coordinates(self, row, sample, active):
        """Texture coordinates of a direction sample on the shape of each row."""
        side = self._fetch(row, 0, active).w
        across, axis = self._fetch(row, 1, active), self._fetch(row, 2, active)
        found = sphere_coordinates(sample.n * side, across.xyz, axis.xyz, across.w)
        return dr.select(side != 0, found, sample.uv)
