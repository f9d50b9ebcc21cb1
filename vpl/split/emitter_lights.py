"""Emitters with a place as virtual lights, for scenes of many: what a first vertex receives of them is split, too.

    f1 L = w F1 L + (f1 L - w F1 L)

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
_SAME_NORMAL = 0.9999


@dataclass
class EmitterLights:
    """Virtual lights that stand for emitters.

    ``omni``: points and spots, of kind "spot", none or some; ``carried`` (rows,) bool: area emitters that lights stand
    for, of ``emitters``.
    """

    emitters: Emitters
    omni: VirtualLights
    carried: np.ndarray

    def spacing(self, count: int) -> float:
        """Typical distance between ``count`` lights on area emitters, world units: as they are drawn by power, the mean
        over them of the area that each stands for is that of all over their number."""
        area = float(self.emitters.area.area[self.carried].sum(dtype=np.float64))
        return (area / count) ** 0.5 if count else 0.0

    def groups(self, count: int, seed: int) -> list[ScatteredGroup]:
        """The lights with their trees, ``count`` of them on area emitters."""
        lights = [self.omni]
        area = self.emitters.area
        # The others emit nothing here, so that none is drawn on them
        area = replace(area, radiance=np.where(self.carried[:, None], area.radiance, 0).astype(np.float32))
        if np.any(area.power > 0):
            on_areas = area_lights(replace(self.emitters, area=area), count, derived_seed(seed, 0))
            lights.append(replace(on_areas, kind="surface", facing=on_areas.direction).without_bad()[0])
        return [ScatteredGroup.of(x, derived_seed(seed, 1, k)) for k, x in enumerate(lights) if x.count]


def has_true_normals(shape) -> bool:
    """Whether the normals of an emitting shape are those of its surface.  Elsewhere, on meshes with other normals at
    their vertices, Mitsuba's densities and the sides that shine go by these: what it makes of them no light does."""
    if not shape.is_mesh() or shape.has_face_normals() or not shape.has_vertex_normals():
        return True
    faces = np.array(shape.faces_buffer()).reshape(-1, 3)
    positions, normals = (
        np.array(buffer, np.float64).reshape(-1, 3)
        for buffer in (shape.vertex_positions_buffer(), shape.vertex_normals_buffer())
    )
    corner, second, third = (positions[faces[:, k]] for k in range(3))
    flat = np.cross(second - corner, third - corner)
    length = np.linalg.norm(flat, axis=1)
    cosine = np.abs((normals[faces] * flat[:, None]).sum(2)) / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    return bool((cosine[length > 0] > _SAME_NORMAL).all())
