"""Camera rays that are opaque in the film's alpha, as in Mitsuba's ``path``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.loops import recorded_once
from ..core.path_limits import PathLimits


@recorded_once
@dr.syntax
def opaque_rays(traits, si: mi.SurfaceInteraction3f, limits: PathLimits, sampler):
    """Mask of the rays whose paths scatter at a surface, rather than only pass masks and thin glass, evaluated.

    ``traits`` of the scene; ``si``: the first surface of each ray.  As in ``path``, rays that end behind masks by
    Russian roulette are transparent.
    """
    si, depth, opaque = mi.SurfaceInteraction3f(si), mi.UInt32(1), mi.Bool(False)
    throughput, going = mi.UnpolarizedSpectrum(1), si.is_valid()
    while dr.hint(going, exclude=[traits, limits]):
        numbers = sampler.next_1d(), sampler.next_2d()
        # Of other materials, the sample is 0, and the surface is opaque
        onward, weight = traits.open_materials.sample(si.bsdf(), si, *numbers, going)
        passes = going & mi.has_flag(onward.sampled_type, mi.BSDFFlags.Null)
        opaque |= going & ~passes
        throughput *= mi.unpolarized_spectrum(weight)
        survival = limits.survival(throughput, 1, depth)
        passes &= (depth < limits.max_depth) & (dr.max(throughput) > 0) & (sampler.next_1d() < survival)
        throughput /= survival
        si = traits.interactions.meet(si.spawn_ray(si.to_world(onward.wo)), passes)
        depth += 1
        going = passes & si.is_valid()
    dr.eval(opaque)
    return opaque
