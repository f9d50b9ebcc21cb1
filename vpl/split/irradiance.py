"""Irradiance of surfaces straight from emitters, by next-event estimation: of virtual lights, and for what sites learn.

One kernel for both, as compiling it takes a good part of a first render.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import channel_mean
from ..core.loops import recorded_once
from ..core.sampling import derived_seed, independent_sampler
from ..direct.emitter_sampling import power_heuristic


@dataclass
class Places:
    """Places on surfaces, one per lane, evaluated: ``position``, geometric ``normal``, and the shading normal on the
    side that they are ``facing``."""

    position: object
    normal: object
    facing: object

    @property
    def count(self) -> int:
        return dr.width(self.position)

    def interaction(self):
        """Surface interactions there, as far as emitters and rays need them."""
        si = dr.zeros(mi.SurfaceInteraction3f, self.count)
        si.p, si.n, si.sh_frame = self.position, self.normal, mi.Frame3f(self.facing)
        return si


@recorded_once
@dr.syntax
def irradiance_from_emitters(scene, emission, places: Places, site, samples: int, seed: int):
    """Irradiance straight from emitters, estimated by so many ``samples`` each: (unpolarized spectrum, weighted for
    multiple importance sampling with directions drawn by the cosine; mean over channels of what it would be if nothing
    was between, without that weight), evaluated.

    ``emission``: how emitters are sampled, see :mod:`vpl.split.next_event`; ``site``: of each place, evaluated.
    """
    si, sampler, number = places.interaction(), independent_sampler(seed, places.count), mi.UInt32(0)
    wanted = dr.opaque(mi.UInt32, samples)
    reached, unoccluded = dr.zeros(mi.UnpolarizedSpectrum, places.count), dr.zeros(mi.Float, places.count)
    while dr.hint(number < wanted, exclude=[scene, emission, si, places, site, wanted]):
        sample = emission.sample(si, site, sampler.next_1d(), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
        cosine = dr.maximum(dr.dot(places.facing, sample.direction), 0)
        mis = dr.select(sample.is_point, 1, power_heuristic(sample.density, cosine * dr.inv_pi))
        reached += dr.select(sample.density > 0, sample.arriving(scene, cosine > 0) * cosine * mis, 0)
        unoccluded += channel_mean(sample.weight) * cosine
        number += 1
    reached, unoccluded = reached / mi.Float(wanted), unoccluded / mi.Float(wanted)
    dr.eval(reached, unoccluded)
    return reached, unoccluded


def learn_emitters(scene, emission, vertices: tuple, rays: int, seed: int) -> bool:
    """Let the choice of emitters learn from ``vertices``: positions and normals, (n, 3) each, with about so many rays:
    whether anything was learned."""

    def look(places, site):
        return irradiance_from_emitters(scene, emission, places, site, 1, derived_seed(seed, 1))

    return emission.choice.learn(*vertices, rays, derived_seed(seed, 0), look)
