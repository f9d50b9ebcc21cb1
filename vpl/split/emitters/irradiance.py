"""Irradiance that an emitter sampler finds at places on surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...core.arrays import channel_mean
from ...core.loops import recorded_once
from ...core.sampling import independent_sampler
from ...direct.emitter_sampling import power_heuristic
from ...transport.minorant import Lobe
from ..contributions import Contributions
from .base import EmitterSampler


@dataclass
class Places:
    """Points on surfaces, one per lane, evaluated: ``position``, geometric ``normal`` on the lit side, and ``facing``:
    the axis of a cosine lobe there, for example the shading normal."""

    position: mi.Point3f
    normal: mi.Normal3f
    facing: mi.Normal3f

    @classmethod
    def of_facing(cls, position: mi.Point3f, facing: mi.Point3f) -> Places:
        """Points of which only the shading normal is known."""
        facing = mi.Normal3f(facing)
        # Two distinct arrays of normals, as for virtual lights: both use the same kernel
        return cls(position, facing + dr.opaque(mi.Float, 0.0), facing)

    @property
    def count(self) -> int:
        """Number of points."""
        return dr.width(self.position)

    @property
    def lobe(self) -> Lobe:
        """Cosine lobes of the lit side."""
        return Lobe(self.facing, self.normal)

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
    one for each surface passed and one more; ``group`` of the emitter.
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

    ``most``: surfaces that light may pass.  Where there are groups, or light may pass surfaces, the irradiance has the
    colour of one sample, because light belongs to one group and has one length.  Virtual lights and learning samplers
    share this kernel, because compiling it takes a good part of a first render.
    """
    si, sampler, number = places.interaction(), independent_sampler(seed, places.count), mi.UInt32(0)
    wanted = dr.opaque(mi.UInt32, samples)
    found, unoccluded = Contributions.none(places.count), dr.zeros(mi.Float, places.count)
    draws = emitters.groups is not None or emitters.traits.null or emitters.refracts
    while dr.hint(number < wanted, exclude=[scene, emitters, si, places, cell, wanted, most]):
        sample = emitters.sample(si, cell, sampler.next_1d(), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
        cosine = places.lobe.cosine(sample.direction)
        mis = dr.select(sample.is_point, 1, power_heuristic(sample.density, cosine * dr.inv_pi))
        arriving, crossings = sample.arriving(scene, emitters, most, cosine > 0)
        reached = dr.select(sample.density > 0, arriving * cosine * mis, 0)
        draw = sampler.next_1d() if draws else mi.Float(0)
        found.add(reached, crossings + 1, sample.group, draw)
        unoccluded += channel_mean(sample.weight) * cosine
        number += 1
    reached = (found.one if draws else found.radiance) / mi.Float(wanted)
    irradiance = Irradiance(reached, unoccluded / mi.Float(wanted), found.length, found.group)
    dr.eval(irradiance)
    return irradiance
