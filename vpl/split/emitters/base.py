"""Interface of the emitter samplers, and their results."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import finite_or_zero
from ...lights.emitter_groups import EmitterGroups
from ...points.camera_paths import SceneTraits
from ...transport.contribution import passage, unblocked
from ..emitter_lights import EmitterLights
from .glass import Glass


@dataclass
class EmitterSample:
    """Sampled directions to emitters, one per lane.

    ``direction``: unit vector; ``weight``: unoccluded radiance over the density; ``density``: 1 / sr, 1 for points and
    directions; ``is_point``: mask of points and directions; ``ray``: shadow ray.  ``nearness``: cosine at the emitter
    over the squared distance, 0 for points, infinite if no virtual light represents the emitter; None if no virtual
    light represents any emitter.  ``group``: of the emitter, see :class:`vpl.lights.emitter_groups.EmitterGroups`, 0
    without groups.
    """

    direction: mi.Vector3f
    weight: mi.UnpolarizedSpectrum
    density: mi.Float
    is_point: mi.Bool
    ray: mi.Ray3f
    group: mi.UInt32
    nearness: mi.Float | None = None

    def chosen_with(self, probability: mi.Float) -> EmitterSample:
        """The sample where the emitter was chosen with a probability."""
        weight = finite_or_zero(self.weight / probability)
        return replace(self, weight=weight, density=self.density * probability)

    def arriving(self, scene, emitters: EmitterSampler, most, active: mi.Bool):
        """The weight times the fraction of the light that arrives, and the number of surfaces that it passes, null
        surfaces or glass: traces a shadow ray for nonzero weights.

        ``most``: surfaces that the light may pass, UInt32.  Null surfaces and glass block points and directions, as in
        ``path``.
        """
        light, crossings = self._unscattered(scene, emitters.traits, most, active)
        if emitters.refracts:
            # Also with the weight 0: the sampled point of an emitter may be black, and the end of the refracted ray not
            active = active & (self.density > 0) & ~self.is_point & ~(dr.max(light) > 0)
            radiance, passed = emitters.glass.light(emitters.emitted, self.ray, most, active)
            light += dr.select(passed > 0, radiance / self.density, 0)
            crossings = dr.select(active, passed, crossings)
        return light, crossings

    def _unscattered(self, scene, traits: SceneTraits, most, active: mi.Bool):
        possible = active & (dr.max(self.weight) > 0) & (self.density > 0)
        if not traits.null:
            return dr.select(unblocked(scene, traits, self.ray, possible) > 0, self.weight, 0), mi.UInt32(0)
        passed, crossings = passage(scene, traits, self.ray, most, possible, ~self.is_point)
        return dr.select(possible, self.weight * passed, 0), crossings


@dataclass
class MetEmitter:
    """Emitters hit by rays: ``radiance``; ``density`` of the direction under the sampler, 1 / sr; ``group``,
    ``nearness``: see :class:`EmitterSample`."""

    radiance: mi.UnpolarizedSpectrum
    density: mi.Float
    group: mi.UInt32
    nearness: mi.Float | None = None


def front_density(ds: mi.DirectionSample3f) -> mi.Float:
    """Density of sampled directions, 0 toward the back of a surface, as for directions of rays.  Mitsuba's samples of
    constant area emitters have a weight of 0 there, but a density."""
    return dr.select(~ds.delta & (dr.dot(ds.d, ds.n) > 0), 0, ds.pdf)


class EmitterSampler(Protocol):
    """Choice of emitters for next-event estimation.

    ``lights``: virtual lights representing the emitters, or None; ``groups`` of the emitters, or None; ``traits`` of
    the scene; ``learns_sky``: whether regions of the environment are learned; ``glass`` of the scene, or None;
    ``refracts``: whether shadow rays pass the glass.
    """

    lights: EmitterLights | None
    groups: EmitterGroups | None
    traits: SceneTraits
    learns_sky: bool
    glass: Glass | None
    refracts: bool

    def cell(self, position: mi.Point3f, facing: mi.Normal3f) -> mi.UInt32:
        """Number of the spatial cell of each vertex; ``facing``: normal on the visible side."""
        raise NotImplementedError

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """Sample a direction to an emitter for each vertex ``si``.

        ``chosen``, ``member``, ``place``: uniform numbers for the choice of a source, a part of the source, and a point
        on the part.  ``chosen``, a multiple of 2^-23 or 2^-24, may choose the part as well.
        """
        raise NotImplementedError

    def emitted(self, si, active) -> mi.UnpolarizedSpectrum:
        """Radiance emitted at each hit ``si`` toward the origin of its ray."""
        raise NotImplementedError

    def met(self, vertex, cell, ray, si, has_density, active) -> MetEmitter:
        """Emission at the hit ``si`` of a ray from ``vertex``; ``has_density``: whether the direction has a density."""
        raise NotImplementedError

    def learn(self, position: np.ndarray, normal: np.ndarray, rays: int, seed: int) -> bool:
        """Learn from vertices (n, 3) with about ``rays`` rays; returns whether anything was learned."""
        raise NotImplementedError

    def forget(self) -> None:
        """Return to the probabilities before :meth:`learn`."""
        raise NotImplementedError

    def simplest(self) -> EmitterSampler:
        """This sampler, or one with the same probabilities and a smaller kernel."""
        raise NotImplementedError

    def copy(self) -> EmitterSampler:
        """A sampler of the same emitters that learns independently."""
        raise NotImplementedError

    def through_glass(self) -> EmitterSampler:
        """A sampler of the same emitters that has learned nothing and whose shadow rays pass glass."""
        raise NotImplementedError
