"""Emitters with a place as virtual lights, for scenes of many: what a gather vertex receives of them is split, too.

    f L = w F L + (f L - w F L)

Points and spots are lights as they are, with w = 1; area emitters are as many points on them as is asked for, with the
w of :mod:`vpl.split.floors`.  So a light cut stands for thousands of emitters, where next-event estimation would draw
one; it is left what gloss and w leave.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.sampling import derived_seed
from ..lights.emitters import Emitters
from ..lights.light_set import ScatteredGroup, area_lights
from ..lights.virtual_lights import VirtualLights

# Cosine of the angle by which normals of vertices may differ from that of the surface
_SAME_NORMAL = 0.99999
# Share of the points that all area emitters have alike: without points the surroundings of a dim one would stay dark
_UNIFORM_SHARE = 0.5
# Points on area emitters, as a share of the camera rays, and how few and many; for each emitter, on average, at least
_POINTS_SHARE, _POINTS, _LEAST_POINTS = 0.03, (10_000, 200_000), 4


@dataclass
class EmitterLights:
    """Virtual lights that stand for emitters.

    ``omni``: points and spots, all of kind "spot"; ``carried`` (rows,) bool: which of the area ``emitters`` lights
    stand for.
    """

    emitters: Emitters
    omni: VirtualLights
    carried: np.ndarray

    @property
    def any(self) -> bool:
        """Whether there is an emitter that lights may stand for."""
        return bool(self.omni.count or self._weight.any())

    @property
    def _weight(self) -> np.ndarray:
        """Share of the points that each area emitter has, (rows,) float64: by power, and alike; 0 where there are
        none."""
        power = np.where(self.carried, self.emitters.area.power, 0)
        some = np.count_nonzero(power)
        if not some:
            return power
        return (1 - _UNIFORM_SHARE) * power / power.sum() + _UNIFORM_SHARE / some * (power > 0)

    def points(self, paths: int) -> int:
        """How many points there are on area emitters, for so many camera rays."""
        return max(int(np.clip(_POINTS_SHARE * paths, *_POINTS)), _LEAST_POINTS * np.count_nonzero(self.carried))

    def spacing(self, count: int) -> float:
        """Typical distance between ``count`` lights on area emitters, world units: the mean over them of the area that
        each stands for is that of all over their number."""
        area = float(self.emitters.area.area[self.carried & (self.emitters.area.power > 0)].sum(dtype=np.float64))
        return (area / count) ** 0.5

    def groups(self, count: int, seed: int) -> list[ScatteredGroup]:
        """The lights with their trees, ``count`` of them on area emitters."""
        lights, weight = [self.omni], self._weight
        if weight.any():
            on_areas = area_lights(self.emitters, count, derived_seed(seed, 0), weight)
            # Facing, as lights on surfaces do, so that the same kernels gather both
            lights.append(replace(on_areas, kind="surface", facing=on_areas.direction).without_bad()[0])
        return [ScatteredGroup.of(x, derived_seed(seed, 1, k)) for k, x in enumerate(lights) if x.count]


def has_true_normals(shape) -> bool:
    """Whether the normals of an emitting shape are those of its surface.

    Meshes may have other normals at their vertices.  Mitsuba's densities, and the sides that shine, go by these, so
    that lights would not agree with them.
    """
    if not shape.is_mesh() or not shape.has_vertex_normals():
        return True
    faces = np.array(shape.faces_buffer()).reshape(-1, 3)
    positions, normals = (
        np.array(buffer, np.float64).reshape(-1, 3)
        for buffer in (shape.vertex_positions_buffer(), shape.vertex_normals_buffer())
    )
    corner, second, third = (positions[faces[:, k]] for k in range(3))
    flat, normals = _unit(np.cross(second - corner, third - corner)), _unit(normals)
    cosine = (normals[faces] * flat[:, None]).sum(2)[flat.any(1)]
    return bool((np.abs(cosine.sum(1)) > 3 * _SAME_NORMAL).all())


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of length 1, but for those of length 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
