"""Virtual lights that stand for many emitters: the direct light of a gather vertex is split, too.

    f L = w F L + (f L - w F L)

Point and spot emitters are virtual lights themselves, with w = 1.  Area emitters get virtual lights on random points,
with the w of :mod:`vpl.transport.carried_share`.  A light cut then represents thousands of emitters, whereas next-event
estimation draws a single emitter.  Next-event estimation keeps the second term.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..core.meshes import faces_of, is_triangle_mesh, normals_of, positions_of
from ..core.sampling import derived_seed
from ..lights.emitters import Emitters
from ..lights.light_set import ScatteredGroup, area_lights
from ..lights.virtual_lights import VirtualLights
from .cost_model import CostModel

# Least cosine between vertex normals and the geometric normal: a deviation of a quarter of a degree, rounding included
_SAME_NORMAL = 0.99999
# Fraction of the points that are uniform over the emitters: around a dim emitter without points, c would be too small
_UNIFORM_SHARE = 0.5
# Least mean number of points on an area emitter that has power: a spacing below the emitter's size
_LEAST_POINTS = 4


@dataclass
class EmitterLights:
    """Virtual lights that stand for emitters.

    ``omni``: point and spot emitters, all of kind "spot"; ``carried`` (rows,) bool: area emitters represented by
    virtual lights.
    """

    emitters: Emitters
    omni: VirtualLights
    carried: np.ndarray

    @property
    def any(self) -> bool:
        """Whether virtual lights can stand for any emitter."""
        return bool(self.omni.count or self._weight.any())

    @property
    def _weight(self) -> np.ndarray:
        """Fraction of the points on each area emitter, (rows,) float64: a mixture of proportional to power and uniform.
        The fractions are 0 if no emitter has power."""
        power = np.where(self.carried, self.emitters.area.power, 0)
        some = np.count_nonzero(power)
        if not some:
            return power
        return (1 - _UNIFORM_SHARE) * power / power.sum() + _UNIFORM_SHARE / some * (power > 0)

    def points(self, paths: int, model: CostModel) -> int:
        """Number of points on area emitters, for a number of camera paths."""
        wanted = np.clip(model.emitter_points_share * paths, model.fewest_emitter_points, model.most_emitter_points)
        return max(int(wanted), _LEAST_POINTS * np.count_nonzero(self.carried))

    def spacing(self, count: int) -> float:
        """Typical distance between ``count`` points on area emitters, world units: the root of the area per point."""
        area = float(self.emitters.area.area[self.carried & (self.emitters.area.power > 0)].sum(dtype=np.float64))
        return (area / count) ** 0.5

    @cached_property
    def _of_omni(self) -> list[ScatteredGroup]:
        """The point and spot emitters with their tree, for all passes of a render."""
        return [ScatteredGroup.of(self.omni)] if self.omni.count else []

    def groups(self, count: int, c: float, seed: int) -> list[ScatteredGroup]:
        """The lights with their trees; ``count``: number of points on area emitters; ``c``: of the points."""
        weight = self._weight
        if not weight.any():
            return self._of_omni
        lights = area_lights(self.emitters, count, derived_seed(seed, 0), weight)
        # `facing` is set as for lights on surfaces: both kinds use the same kernels
        lights = replace(lights, kind="surface", facing=lights.direction).without_bad()[0]
        lights = replace(lights, c=np.full(lights.count, c, np.float32))
        return [*self._of_omni, *([ScatteredGroup.of(lights)] if lights.count else [])]


def has_true_normals(shape) -> bool:
    """Whether the shading normals of an emitting shape are its geometric normals.

    Meshes may have other vertex normals.  Mitsuba uses those for densities and for the side that shines, so virtual
    lights, which use geometric normals, would disagree.
    """
    if not is_triangle_mesh(shape) or not shape.has_vertex_normals():
        return True
    faces, positions, normals = faces_of(shape), positions_of(shape), normals_of(shape)
    corner, second, third = (positions[faces[:, k]] for k in range(3))
    flat, normals = _unit(np.cross(second - corner, third - corner)), _unit(normals)
    cosine = (normals[faces] * flat[:, None]).sum(2)[flat.any(1)]
    return bool((np.abs(cosine.sum(1)) > 3 * _SAME_NORMAL).all())


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Normalise vectors (n, 3); zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
