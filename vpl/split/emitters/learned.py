"""Emitters chosen by spatial cell, from the light of each that a pilot's vertices receive.

Vertices in a cell trace a few rays to every source of light; neighbouring cells count as well.  A fraction of the
samples keeps the usual probabilities; cells without vertices use only the usual probabilities.  Sources are single
emitters and regions of the environment (:mod:`vpl.direct.environment_regions`): a room lit by the sky through a window
samples the window.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import download, finite_or_zero, upload
from ...core.interactions import ray_to_emitter
from ...core.registry import RegistryTable
from ...direct.environment_regions import regions_of
from ...lights.emitter_groups import EmitterGroups
from ...points.camera_paths import scene_traits
from .base import EmitterSample, EmitterSampler, MetEmitter, front_density
from .cell_choice import CellChoice
from .cell_emitters import CellEmitters
from .glass import Glass
from .uniform import UniformEmitters

# Regions of the environment: with 1024, learning takes three seconds (decisions.md); columns of the radiance table for
# building regions
_REGIONS, _COLUMNS = 256, 512
# Fraction of the samples with Mitsuba's probabilities: a cell may see emitters invisible from the pilot vertices
_USUAL_SHARE = 0.2


class LearnedEmitters(CellEmitters):
    """Learned choice among single emitters and regions of the environment.

    Before anything is learned, the probability of an emitter is proportional to ``sampling_weight``, as in Mitsuba.
    """

    # No virtual lights stand for emitters
    lights = None

    def __init__(self, scene, groups: EmitterGroups | None = None):
        order = _reproducible_order(scene.emitters())
        emitters = [scene.emitters()[number] for number in order]
        self._scene, self._count, self.groups, self.traits = scene, len(emitters), groups, scene_traits(scene)
        self.glass = Glass.of(scene, self.traits)
        self._emitters = dr.gather(mi.EmitterPtr, scene.emitters_dr(), upload(mi.UInt32, order))
        dr.eval(self._emitters)
        # Emitters with a weight of 0 are never sampled, as in Mitsuba
        weight = np.array([emitter.sampling_weight() for emitter in emitters])
        self._environment = scene.environment()
        of_environment = np.array([emitter.is_environment() for emitter in emitters])
        self._environment_number = int(of_environment.argmax()) if self._environment is not None else -1
        self._on_surfaces = any(emitter.get_shape() is not None for emitter in emitters)
        self._regions = None
        if weight[of_environment].any():
            self._regions = regions_of(self._environment, _REGIONS, _COLUMNS)
        self.learns_sky = self._regions is not None
        registry = download(dr.reinterpret_array(mi.UInt32, self._emitters))
        self._number_of = RegistryTable(registry, np.arange(1, self._count + 1))
        # A number for each source: the regions belong to the group of the environment
        self._group = None
        if groups:
            of_regions = [groups.number(self._environment)] * self._regions.count if self._regions else []
            self._group = upload(mi.UInt32, [*map(groups.number, emitters), *of_regions])
        alike = np.zeros(self._count + (self._regions.count if self._regions else 0))
        alike[: self._count] = weight / weight.sum()
        ignored = alike[: self._count] == 0
        if self._regions:
            # Regions are learned instead of the whole environment. Where nothing is known, the environment draws
            # directions, because the environment's samples are better stratified
            ignored[self._environment_number] = True
        self.choice = CellChoice(alike, _USUAL_SHARE, np.flatnonzero(ignored))

    def simplest(self) -> EmitterSampler:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.simplest`."""
        # Mitsuba lists several emitters in an order that differs between loads of a scene
        if self._count > 1 or self.choice.has_learned:
            return self
        uniform = UniformEmitters(self._scene, self.groups, self.traits, self.glass)
        return uniform.through_glass() if self.refracts else uniform

    def _draw(self, si, source, member, place, active) -> EmitterSample:
        """Sample a direction to each source."""
        of_emitter = active & (source < self._count)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, dr.minimum(source, self._count - 1))
        ds, weight = emitter.sample_direction(si, place, of_emitter)
        weight = finite_or_zero(mi.unpolarized_spectrum(weight)) & of_emitter
        ray = ray_to_emitter(si, ds.d, ds.p, mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite))
        direction, density, delta = ds.d, front_density(ds), ds.delta & of_emitter
        if self._regions:
            of_region = active & ~of_emitter
            # A branch, because no region is drawn where nothing is known
            direction, weight, density = dr.if_stmt(
                (source, member, place, direction, weight, density),
                of_region,
                lambda source, member, place, *_: self._regions.sample(
                    source - self._count, member, place, mi.Bool(True)
                ),
                lambda source, member, place, *drawn: drawn,
            )
            ray = dr.select(of_region, si.spawn_ray(direction), ray)
        group = dr.gather(mi.UInt32, self._group, source, active) if self.groups else mi.UInt32(0)
        return EmitterSample(direction, weight, density, delta, ray, group)

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.sample`."""
        source, probability, rest = self.choice.draw(cell, chosen, active)
        # The rest of `chosen` draws the cell of a region, so that well spread numbers spread cells, too. `member` fills
        # the gaps: `chosen` is a multiple of 2^-23 or 2^-24
        rest += member * (2.0**-23 / probability)
        rest = dr.minimum(rest - dr.floor(rest), dr.one_minus_epsilon(mi.Float))
        sample = self._draw(si, source, rest, place, active)
        if not self._regions:
            return sample.chosen_with(probability)
        # The environment and its regions may draw the same direction: the density is the sum of both densities
        of_region = active & (source >= self._count)
        of_environment = of_region | (active & (source == self._environment_number))
        # The density that the emitter returned with its sample: asked for the density of a direction at the edge of the
        # sun, Mitsuba 3.9.1 returns the density of the sky, a hundred thousand times less. Regions also find the
        # radiance of the sky in these directions, so the sun loses no more than a thousandth of the light
        own = dr.select(of_region, self._own_density(si, sample.direction, of_region), sample.density)
        both = self._environment_density(cell, sample.direction, own, of_environment)
        return sample.chosen_with(dr.select(of_environment, both / sample.density, probability))

    def _own_density(self, origin, direction, active):
        """Density with which the environment itself draws a direction; Mitsuba's is NaN for a black environment."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = direction
        return finite_or_zero(self._environment.pdf_direction(origin, ds, active))

    def _environment_density(self, cell, direction, own, active):
        """Density of a direction to the environment; ``own``: density under the environment's sampling."""
        # A branch, as in `_draw`: cell 0 draws no region, also while emitters are learned, when it is the first
        # emitter's
        by_region = dr.if_stmt(
            (cell, direction, mi.Float(0)),
            active & (cell > 0),
            lambda cell, direction, _: self._region_density(cell, direction),
            lambda cell, direction, none: none,
        )
        return by_region + own * self.choice.probability(cell, mi.UInt32(self._environment_number), active)

    def _region_density(self, cell, direction):
        """Density of a direction drawn through a region."""
        region, density = self._regions.find(direction, True)
        return density * self.choice.probability(cell, self._count + region, True)

    def _density_met(self, origin, cell, direction):
        """Density of the direction of a ray to the environment."""
        return self._environment_density(cell, direction, self._own_density(origin, direction, True), True)

    def emitted(self, si, active) -> mi.UnpolarizedSpectrum:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.emitted`."""
        radiance = si.emitter(self._scene, active).eval(si, active)
        return finite_or_zero(mi.unpolarized_spectrum(radiance)) & active

    def met(self, vertex, cell, ray, si, has_density, active) -> MetEmitter:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        emitter = si.emitter(self._scene, active)
        emitted = self.emitted(si, active)
        wanted = active & has_density & (emitter != None)  # noqa: E711
        found = self._number_of.at(emitter, wanted)
        wanted, number = wanted & (found > 0), found - 1
        density = mi.Float(0)
        if self._on_surfaces:
            # Without emitters on surfaces, the density is 0, but Dr.Jit would still compile the call: 7% of the kernel
            # under a `sunsky`
            near = wanted & si.is_valid()
            density = emitter.pdf_direction(origin, ds, near) * self.choice.probability(cell, number, near)
        if self._regions:
            # A branch, because few packets hold a path that leaves the scene
            density = dr.if_stmt(
                (origin, cell, ray.d, density),
                wanted & ~si.is_valid(),
                lambda origin, cell, direction, density: self._density_met(origin, cell, direction),
                lambda origin, cell, direction, density: density,
            )
        return MetEmitter(emitted, density, self._group_met(si))


def _reproducible_order(emitters: list) -> np.ndarray:
    """Sort emitters by class, bounding box and printed properties: (n,) indices.

    Mitsuba 3.9.1 lists the shapes of a scene, and thus the emitters, in an order that differs between loads of the same
    file.  With the order of the list, the same seed would give another image each time.
    """

    def key(number: int):
        box = emitters[number].bbox()
        return emitters[number].class_name(), *np.array(box.min), *np.array(box.max), str(emitters[number])

    return np.array(sorted(range(len(emitters)), key=key), np.uint32)
