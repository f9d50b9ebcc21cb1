"""Next-event estimation for area and environment emitters, and for emitters of unknown kind.

One emitter sample and one BSDF sample, combined by the power heuristic as in Mitsuba's ``path``.  A BSDF sample
continues through delta surfaces, so emitters behind glass light the scene as in ``path``.  Half of the emitter samples
draw an emitter by power, half uniformly.  Point, spot and directional emitters are virtual lights instead.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero
from ..core.interactions import direction_sample, ray_to_emitter
from ..core.loops import recorded_once
from ..core.path_limits import PathLimits
from ..core.sampling import Choice, SpreadSamples, derived_seed, independent_sampler
from ..lights.emission import bounding_sphere, other_power
from ..lights.emitters import Emitters
from ..points.camera_paths import GatherPoints, emitted_towards

_UNIFORM_SHARE = 0.5


def power_heuristic(pdf_a, pdf_b):
    """MIS weight of a sample drawn with density a among densities a and b (power 2)."""
    # A ratio, because squares of densities exceed the range of single precision
    return dr.select(pdf_a > 0, dr.rcp(1 + dr.square(pdf_b / pdf_a)), 0)


class ExtendedEmitters:
    """Emitters for next-event estimation, by row: area emitters, the environment, emitters of unknown kind."""

    def __init__(self, scene, emitters: Emitters):
        self.emitters = emitters
        sphere = bounding_sphere(scene)
        self.single = [emitter for _, emitter in emitters.others]
        if emitters.environment is not None:
            self.single.insert(0, emitters.environment)
        power = np.concatenate([emitters.area.power, [other_power(emitter, sphere) for emitter in self.single]])
        self.choice = None
        if power.sum() > 0:
            uniform = (power > 0) / np.count_nonzero(power)
            self.choice = Choice((1 - _UNIFORM_SHARE) * power / power.sum() + _UNIFORM_SHARE * uniform)

    def sample(self, si, row_sample, direction_sample, active):
        """Sample an emitter and a direction: (direction sample, shadow ray, radiance over density, density)."""
        row = self.choice.row(row_sample)
        probability = self.choice.probability(row)
        areas, is_infinite = self.emitters.area.count, mi.Bool(False)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(si.p))
        weight = dr.zeros(mi.UnpolarizedSpectrum, dr.width(si.p))
        if areas:
            here = active & (row < areas)
            ds = self.emitters.area.sample_direction(row, si, direction_sample, here)
            facing = here & (dr.dot(ds.d, ds.n) < 0) & (ds.pdf > 0)
            weight = dr.select(facing, self.emitters.area.emitted_in_front(row, ds, facing) / ds.pdf, 0)
        for number, emitter in enumerate(self.single):
            here = active & (row == areas + number)
            one, one_weight = emitter.sample_direction(si, direction_sample, here)
            ds = dr.select(here, one, ds)
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
                is_infinite |= here
            weight = dr.select(here, finite_or_zero(mi.unpolarized_spectrum(one_weight)), weight)
        ray = ray_to_emitter(si, ds.d, ds.p, is_infinite)
        return ds, ray, weight / probability, ds.pdf * probability

    def density(self, si, hit, direction, active):
        """Density of :meth:`sample` for the direction of a ray from ``si`` and the emitter that the ray hit."""
        density = dr.zeros(mi.Float, dr.width(si.p))
        areas = self.emitters.area.count
        ds = direction_sample(si.p, hit, direction)
        if areas:
            row = self.emitters.area.row(hit, active & hit.is_valid())
            here = active & hit.is_valid() & (row > 0)
            pdf = self.emitters.area.on_shape("pdf_direction", row - 1, si, ds, here)
            density = dr.select(here, pdf * self.choice.probability(row - 1, here), 0)
        if self.emitters.environment is not None:
            here = active & ~hit.is_valid()
            pdf = self.emitters.environment.pdf_direction(si, ds, here)
            density = dr.select(here, pdf * self.choice.probability(mi.UInt32(areas), here), density)
        return density


def _scattered_emission(extended: ExtendedEmitters, traits, si, sample, depth, limits, sampler, active):
    """Emitted radiance along a BSDF sample, MIS-weighted; beyond delta surfaces the weight is 1."""
    direction = si.to_world(sample.wo)
    hit = traits.interactions.meet(si.spawn_ray(direction), active)
    weight = power_heuristic(sample.pdf, extended.density(si, hit, direction, active))
    radiance = emitted_towards(extended.emitters, hit, active) * weight
    if traits.delta:
        edges = mi.UInt32(depth) + 1
        radiance += emission_beyond_delta(extended.emitters, traits, hit, edges, limits, sampler, active)
    return finite_or_zero(radiance)


@dr.syntax
def emission_beyond_delta(emitters: Emitters, traits, hit, depth, limits: PathLimits, sampler, active):
    """Emitted radiance that a ray finds through mirrors, glass and masks.

    ``hit``: first surface of the ray; ``depth``: edges from the camera to ``hit``.  The throughput
    for Russian roulette is 1 at ``hit``.
    """
    hit, depth = mi.SurfaceInteraction3f(hit), mi.UInt32(depth)
    radiance = dr.zeros(mi.UnpolarizedSpectrum, dr.width(hit.p))
    factor = dr.full(mi.UnpolarizedSpectrum, 1, dr.width(hit.p))
    eta, going = mi.Float(1), active & hit.is_valid() & (depth < limits.max_depth)
    while dr.hint(going, exclude=[emitters, traits, limits]):
        onward, share = hit.bsdf().sample(mi.BSDFContext(), hit, sampler.next_1d(going), sampler.next_2d(going), going)
        going &= mi.has_flag(onward.sampled_type, mi.BSDFFlags.Delta)
        factor *= mi.unpolarized_spectrum(share)
        eta *= onward.eta
        hit = traits.interactions.meet(hit.spawn_ray(hit.to_world(onward.wo)), going)
        radiance += dr.select(going, factor * emitted_towards(emitters, hit, going), 0)
        survival = limits.survival(factor, eta, depth)
        depth += 1
        going &= hit.is_valid() & (depth < limits.max_depth) & (dr.max(factor) > 0)
        going &= sampler.next_1d() < survival
        factor /= survival
    return radiance


@recorded_once
@dr.syntax
def direct_light(
    scene, extended: ExtendedEmitters, traits, points: GatherPoints, limits: PathLimits, samples: int,
    rays_per_pixel: int, seed: int,
):  # fmt: skip
    """Direct light of ``extended`` at every gather point: (radiance, number of shadow rays).

    ``samples``: pairs of an emitter sample and a BSDF sample per point.  The samples of a pixel, that is of
    ``rays_per_pixel`` successive camera rays, are stratified jointly.
    """
    si, bsdf = points.si, points.si.bsdf()
    if dr.hint(extended.choice is None, mode="scalar"):
        return dr.zeros(mi.UnpolarizedSpectrum, points.count), 0
    sampler = independent_sampler(seed, points.count)
    context = mi.BSDFContext()
    total, of_pixel = dr.opaque(mi.UInt32, samples), dr.opaque(mi.UInt32, rays_per_pixel)
    pixel = points.ray // of_pixel
    first = (points.ray - pixel * of_pixel) * total
    to_emitters, to_directions = (SpreadSamples.of(pixel, derived_seed(seed, stream)) for stream in (1, 2))
    radiance, rays = dr.zeros(mi.UnpolarizedSpectrum, points.count), dr.zeros(mi.UInt32, points.count)
    k = mi.UInt32(0)
    while dr.hint(
        k < total,
        exclude=[scene, extended, traits, points, si, bsdf, context, limits, first, total, to_emitters, to_directions],
    ):
        # ---- Emitter sampling
        choice, *sample = to_emitters.at(first + k)
        ds, ray, weight, density = extended.sample(si, choice, mi.Point2f(*sample), mi.Bool(True))
        active = dr.any(weight > 0)
        wo = si.to_local(ds.d)
        value, pdf = bsdf.eval_pdf(context, si, wo, active)
        arriving = mi.unpolarized_spectrum(value) * weight
        active &= dr.any(arriving > 0)
        mis = dr.select(ds.delta, 1, power_heuristic(density, pdf))
        blocked = scene.ray_test(ray, active)
        rays += dr.select(active, 1, 0)
        radiance += dr.select(active & ~blocked, finite_or_zero(arriving * mis), 0)

        # ---- BSDF sampling
        choice, *sample = to_directions.at(first + k)
        sample, value = bsdf.sample(context, si, choice, mi.Point2f(*sample))
        smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Smooth) & dr.any(mi.unpolarized_spectrum(value) > 0)
        found = _scattered_emission(extended, traits, si, sample, points.depth, limits, sampler, smooth)
        radiance += dr.select(smooth, finite_or_zero(mi.unpolarized_spectrum(value) * found), 0)
        k += 1
    radiance /= mi.Float(total)
    dr.eval(radiance, rays)
    return radiance, int(dr.sum(rays)[0])
