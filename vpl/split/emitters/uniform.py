"""Mitsuba's own choice of an emitter."""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi

from ...core.arrays import finite_or_zero
from ...core.interactions import ray_to_emitter
from ...lights.emitter_groups import EmitterGroups
from ...points.camera_paths import SceneTraits, scene_traits
from .base import EmitterSample, MetEmitter, front_density
from .glass import Glass


class UniformEmitters:
    """Mitsuba's own choice, of at most one emitter: one with a position, or an environment about which nothing was
    learned."""

    lights, learns_sky, refracts = None, False, False

    def __init__(
        self, scene, groups: EmitterGroups | None = None, traits: SceneTraits | None = None, glass: Glass | None = None
    ):  # fmt: skip
        """``traits``, ``glass`` of the scene, if known."""
        self._scene, self.groups, self.traits = scene, groups, traits or scene_traits(scene)
        self.glass = glass if traits else Glass.of(scene, self.traits)
        emitters = scene.emitters()
        self._group = dr.opaque(mi.UInt32, groups.number(emitters[0]) if groups and emitters else 0)

    def cell(self, position, facing):
        """The only cell."""
        return mi.UInt32(0)

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.sample`."""
        ds, weight = self._scene.sample_emitter_direction(si, place, False, active)
        ray = ray_to_emitter(si, ds.d, ds.p, mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite))
        return EmitterSample(
            ds.d, finite_or_zero(mi.unpolarized_spectrum(weight)), front_density(ds), ds.delta, ray, self._group
        )

    def emitted(self, si, active) -> mi.UnpolarizedSpectrum:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.emitted`."""
        radiance = si.emitter(self._scene, active).eval(si, active)
        return finite_or_zero(mi.unpolarized_spectrum(radiance)) & active

    def met(self, vertex, cell, ray, si, has_density, active) -> MetEmitter:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        # Mitsuba's density of a black environment is NaN
        density = finite_or_zero(self._scene.pdf_emitter_direction(origin, ds, active & has_density))
        return MetEmitter(self.emitted(si, active), density, self._group)

    def learn(self, position, normal, rays: int, seed: int) -> bool:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.learn`."""
        return False

    def forget(self) -> None:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.forget`."""

    def simplest(self) -> UniformEmitters:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.simplest`."""
        return self

    def copy(self) -> UniformEmitters:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.copy`."""
        return self

    def through_glass(self) -> UniformEmitters:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.through_glass`."""
        other = copy(self)
        other.glass.make_scenes()
        other.refracts = True
        return other
