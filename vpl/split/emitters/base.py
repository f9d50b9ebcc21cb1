"""Interface of the emitter samplers, the uniform sampler, and the irradiance that a sampler finds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import channel_mean, finite_or_zero
from ...core.loops import recorded_once
from ...core.sampling import independent_sampler
from ...direct.emitter_sampling import power_heuristic
from ...lights.emitter_groups import EmitterGroups
from ...points.camera_paths import SceneTraits, scene_traits
from ...transport.contribution import passage, unblocked
from ..contributions import Contributions
from ..emitter_lights import EmitterLights


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

    def arriving(self, scene, traits: SceneTraits, most, active: mi.Bool):
        """The weight times the fraction of the light that arrives, and the number of null surfaces on its way: traces a
        shadow ray for nonzero weights.

        ``most``: null surfaces that the light may pass, UInt32.  Null surfaces block points and directions, as in
        ``path``.
        """
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


class EmitterSampler(Protocol):
    """Choice of emitters for next-event estimation.

    ``lights``: virtual lights representing the emitters, or None; ``groups`` of the emitters, or None; ``traits`` of
    the scene; ``learns_sky``: whether regions of the environment are learned.
    """

    lights: EmitterLights | None
    groups: EmitterGroups | None
    traits: SceneTraits
    learns_sky: bool

    def cell(self, position: mi.Point3f, facing: mi.Normal3f) -> mi.UInt32:
        """Number of the spatial cell of each vertex; ``facing``: shading normal on the visible side."""
        raise NotImplementedError

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """Sample a direction to an emitter for each vertex ``si``.

        ``chosen``, ``member``, ``place``: uniform numbers for the choice of a source, a part of the source, and a point
        on the part.
        """
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

    def copy(self) -> EmitterSampler:
        """A sampler of the same emitters that learns independently."""
        raise NotImplementedError


class UniformEmitters:
    """Mitsuba's own choice, of at most one emitter.  There is nothing to learn."""

    lights, learns_sky = None, False

    def __init__(self, scene, groups: EmitterGroups | None = None):
        self._scene, self.groups, self.traits = scene, groups, scene_traits(scene)
        emitters = scene.emitters()
        self._group = dr.opaque(mi.UInt32, groups.number(emitters[0]) if groups and emitters else 0)

    def cell(self, position, facing):
        """The only cell."""
        return mi.UInt32(0)

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """See :meth:`EmitterSampler.sample`."""
        ds, weight = self._scene.sample_emitter_direction(si, place, False, active)
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        ray = dr.select(far, si.spawn_ray(ds.d), si.spawn_ray_to(ds.p))
        return EmitterSample(ds.d, finite_or_zero(mi.unpolarized_spectrum(weight)), ds.pdf, ds.delta, ray, self._group)

    def met(self, vertex, cell, ray, si, has_density, active) -> MetEmitter:
        """See :meth:`EmitterSampler.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        density = self._scene.pdf_emitter_direction(origin, ds, active & has_density)
        emitted = si.emitter(self._scene, active).eval(si, active)
        return MetEmitter(finite_or_zero(mi.unpolarized_spectrum(emitted)) & active, density, self._group)

    def learn(self, position, normal, rays: int, seed: int) -> bool:
        """See :meth:`EmitterSampler.learn`."""
        return False

    def forget(self) -> None:
        """See :meth:`EmitterSampler.forget`."""

    def copy(self) -> UniformEmitters:
        """See :meth:`EmitterSampler.copy`."""
        return self


# ---------------------- Irradiance ----------------------


@dataclass
class Places:
    """Points on surfaces, one per lane, evaluated: ``position``, geometric ``normal``, and ``facing``: the shading
    normal on the lit side."""

    position: mi.Point3f
    normal: mi.Normal3f
    facing: mi.Normal3f

    @property
    def count(self) -> int:
        """Number of points."""
        return dr.width(self.position)

    def interaction(self) -> mi.SurfaceInteraction3f:
        """Surface interactions with the fields required by emitters and rays."""
        si = dr.zeros(mi.SurfaceInteraction3f, self.count)
        si.p, si.n, si.sh_frame = self.position, self.normal, mi.Frame3f(self.facing)
        return si


@dataclass
class Irradiance:
    """Irradiance straight from emitters, one per lane, evaluated.

    ``irradiance``: an unpolarized spectrum, weighted for multiple importance sampling with cosine-distributed
    directions; ``unoccluded``: mean over channels, without the weight; ``length``: edges of the paths to the emitter,
    one for each null surface and one more; ``group`` of the emitter.
    """

    irradiance: mi.UnpolarizedSpectrum
    unoccluded: mi.Float
    length: mi.UInt32
    group: mi.UInt32


@recorded_once
@dr.syntax
def irradiance_from_emitters(
    scene, emitters: EmitterSampler, places: Places, cell, samples: int, most: mi.UInt32, seed: int
) -> Irradiance:
    """Irradiance by next-event estimation with ``samples`` samples for each of the ``places``.

    ``most``: null surfaces that light may pass.  Where there are groups or null surfaces, the irradiance has the colour
    of one sample, because light belongs to one group and has one length.  Virtual lights and learning samplers share
    this kernel, because compiling it takes a good part of a first render.
    """
    si, sampler, number = places.interaction(), independent_sampler(seed, places.count), mi.UInt32(0)
    wanted = dr.opaque(mi.UInt32, samples)
    found, unoccluded = Contributions.none(places.count), dr.zeros(mi.Float, places.count)
    draws = emitters.groups is not None or emitters.traits.null
    while dr.hint(number < wanted, exclude=[scene, emitters, si, places, cell, wanted, most]):
        sample = emitters.sample(si, cell, sampler.next_1d(), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
        cosine = dr.maximum(dr.dot(places.facing, sample.direction), 0)
        mis = dr.select(sample.is_point, 1, power_heuristic(sample.density, cosine * dr.inv_pi))
        arriving, crossings = sample.arriving(scene, emitters.traits, most, cosine > 0)
        reached = dr.select(sample.density > 0, arriving * cosine * mis, 0)
        draw = sampler.next_1d() if draws else mi.Float(0)
        found.add(reached, crossings + 1, sample.group, draw)
        unoccluded += channel_mean(sample.weight) * cosine
        number += 1
    reached = (found.one if draws else found.radiance) / mi.Float(wanted)
    irradiance = Irradiance(reached, unoccluded / mi.Float(wanted), found.length, found.group)
    dr.eval(irradiance)
    return irradiance
