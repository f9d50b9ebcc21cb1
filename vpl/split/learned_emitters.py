"""Emitters chosen by what a pilot's vertices see of them, place by place (:mod:`vpl.split.site_choice`).

The sources that are learned of are the emitters, one by one, and regions of the environment
(:mod:`vpl.direct.environment_regions`), so that a room that sees the sky through a window aims there.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, finite_or_zero, upload
from ..core.registry import RegistryTable
from ..direct.environment_regions import regions_of
from .emitter_samples import EmitterSample, MetEmitter
from .site_choice import SiteChoice

# Regions of the environment, and columns of the table that they are made from
_REGIONS, _COLUMNS = 256, 512
# Share of the samples for which emitters have the probability that they have in Mitsuba
_USUAL_SHARE = 0.2


class LearnedEmitters:
    """Emitters and regions of the environment, by site; before anything is learned, every emitter has the same
    probability everywhere, or that of its ``sampling_weight``."""

    # No virtual lights stand for emitters
    lights = None

    def __init__(self, scene):
        order = _reproducible_order(scene.emitters())
        emitters = [scene.emitters()[number] for number in order]
        self._scene, self._count = scene, len(emitters)
        self._emitters = dr.gather(mi.EmitterPtr, scene.emitters_dr(), upload(mi.UInt32, order))
        dr.eval(self._emitters)
        # Emitters with a weight of 0 are never sampled, as in Mitsuba
        weight = np.array([emitter.sampling_weight() for emitter in emitters])
        self._environment = scene.environment()
        of_environment = np.array([emitter.is_environment() for emitter in emitters])
        self._environment_number = int(of_environment.argmax()) if self._environment is not None else -1
        self._regions = None
        if weight[of_environment].any():
            self._regions = regions_of(self._environment, _REGIONS, _COLUMNS)
        registry = download(dr.reinterpret_array(mi.UInt32, self._emitters))
        self._number_of = RegistryTable(registry, np.arange(1, self._count + 1))
        alike = np.zeros(self._count + (self._regions.count if self._regions else 0))
        alike[: self._count] = weight / weight.sum()
        ignored = alike[: self._count] == 0
        if self._regions:
            # Nothing is learned of the environment as a whole: its regions are. Where nothing is known it is drawn by
            # itself, which spreads its samples better
            ignored[self._environment_number] = True
        self.choice = SiteChoice(alike, _USUAL_SHARE, np.flatnonzero(ignored))

    def _draw(self, si, source, member, place, active) -> EmitterSample:
        """A direction to each source."""
        of_emitter = active & (source < self._count)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, dr.minimum(source, self._count - 1))
        ds, weight = emitter.sample_direction(si, place, of_emitter)
        weight = finite_or_zero(mi.unpolarized_spectrum(weight)) & of_emitter
        # Emitters that are infinitely far away have a place outside of the scene's box, which may be too small: Mitsuba
        # 3.9.1 leaves rectangles out of it
        far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        ray = dr.select(far, si.spawn_ray(ds.d), si.spawn_ray_to(ds.p))
        direction, density, delta = ds.d, ds.pdf, ds.delta & of_emitter
        if self._regions:
            of_region = active & ~of_emitter
            # A branch: where nothing is known of any place, no region is drawn
            direction, weight, density = dr.if_stmt(
                (source, member, place, direction, weight, density),
                of_region,
                lambda source, member, place, *_: self._regions.sample(
                    source - self._count, member, place, mi.Bool(True)
                ),
                lambda source, member, place, *drawn: drawn,
            )
            ray = dr.select(of_region, si.spawn_ray(direction), ray)
        return EmitterSample(direction, weight, density, delta, ray)

    def sample(self, si, site, chosen, member, place, active) -> EmitterSample:
        """As :meth:`vpl.split.next_event.UniformEmitters.sample`."""
        source, probability, _ = self.choice.draw(site, chosen, active)
        sample = self._draw(si, source, member, place, active)
        if not self._regions:
            return sample.chosen_with(probability)
        # What both the environment and its regions may draw has the sum of their densities
        of_region = active & (source >= self._count)
        of_environment = of_region | (active & (source == self._environment_number))
        # The emitter's own density where it has drawn: asked for its direction alone, Mitsuba 3.9.1 takes directions at
        # the edge of the sun for the sky's, a hundred thousand times less likely, and as dark. Regions that draw these
        # do not find the sun, either: it loses a thousandth of its light at most
        own = dr.select(of_region, self._own_density(si, sample.direction, of_region), sample.density)
        both = self._environment_density(site, sample.direction, own, of_environment)
        return sample.chosen_with(dr.select(of_environment, both / sample.density, probability))

    def _own_density(self, origin, direction, active):
        """Density with which the environment itself draws a direction: of a black one, Mitsuba's is no number."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = direction
        return finite_or_zero(self._environment.pdf_direction(origin, ds, active))

    def _environment_density(self, site, direction, own, active):
        """Density with which a direction to the environment is drawn; ``own``: by the environment itself."""
        # A branch, as in `_draw`: no region is drawn at site 0; while emitters are learned, that is the first one's
        by_region = dr.if_stmt(
            (site, direction, mi.Float(0)),
            active & (site > 0),
            lambda site, direction, _: self._region_density(site, direction),
            lambda site, direction, none: none,
        )
        return by_region + own * self.choice.probability(site, mi.UInt32(self._environment_number), active)

    def _region_density(self, site, direction):
        """Density with which a direction is drawn by way of its region."""
        region, density = self._regions.find(direction, True)
        return density * self.choice.probability(site, self._count + region, True)

    def _density_met(self, origin, site, direction):
        """Density of a direction in which the environment was met."""
        return self._environment_density(site, direction, self._own_density(origin, direction, True), True)

    def met(self, vertex, site, ray, si, has_density, active) -> MetEmitter:
        """As :meth:`vpl.split.next_event.UniformEmitters.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        emitter = si.emitter(self._scene, active)
        emitted = finite_or_zero(mi.unpolarized_spectrum(emitter.eval(si, active))) & active
        wanted = active & has_density & (emitter != None)  # noqa: E711
        found = self._number_of.at(emitter, wanted)
        wanted, number = wanted & (found > 0), found - 1
        near = wanted & si.is_valid()
        probability = self.choice.probability(site, number, near)
        density = emitter.pdf_direction(origin, ds, near) * probability
        if self._regions:
            # A branch: few packets of paths hold one that has left the scene
            density = dr.if_stmt(
                (origin, site, ray.d, density),
                wanted & ~si.is_valid(),
                lambda origin, site, direction, density: self._density_met(origin, site, direction),
                lambda origin, site, direction, density: density,
            )
        return MetEmitter(emitted, density)


def _reproducible_order(emitters: list) -> np.ndarray:
    """Sort emitters by class, bounding box and printed properties: (n,) indices.

    Mitsuba 3.9.1 lists the shapes of a scene, and with them their emitters, in an order that differs from one loading
    of a file to the next.  With the order of the list, the same seed would give another image each time.
    """

    def key(number: int):
        box = emitters[number].bbox()
        return emitters[number].class_name(), *np.array(box.min), *np.array(box.max), str(emitters[number])

    return np.array(sorted(range(len(emitters)), key=key), np.uint32)
