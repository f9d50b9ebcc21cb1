"""Light paths with the full BSDFs, and a virtual point light at every diffuse bounce.

A path that scatters by a diffuse lobe stores a virtual point light.  The BSDF's sampling routine chooses the lobe, and
the sample weight is the flux scattered by the lobe, for any material.  Glossy and specular bounces only continue the
path.

Departure from the instant-radiosity papers, which store a light at every vertex and scale it by the diffuse albedo:
this method needs nothing but ``bsdf.sample``, and has the same expectation for materials that weight a sample by the
sampled lobe.  Materials that weight it by the sum of lobes, such as ``principled``, divide the energy where lobes
overlap.

Approximations: lights of lobes that are not Lambertian shine evenly, with the right flux: diffuse lobes below a glossy
interface, such as that of ``plastic``, and glossy lobes with a density of at most ``lobe_limit``.  On surfaces with
shading normals, a light shines into the hemisphere of the geometric normal, with the flux of the directions above both
horizons: for normals 20 degrees apart, its radiance is 3% too low, and 3% of its light goes below the shading horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, even_chunks, ones, select_record, spectrum_to_rgb
from ..core.garbage import garbage_kept
from ..core.path_limits import throughput_survival
from ..core.sampling import derived_seed, independent_sampler, stratified
from .emission import emitter_samplers
from .emitters import Emitters
from .focus import Focus
from .perturbed import Perturbed, Scattered, scatter_perturbed
from .virtual_lights import VirtualLights

# Pilot paths of each emitter sampler; they set the numbers of its paths alone
_PILOT_PATHS = 4096
# Light paths traced at a time
_LARGEST_WAVEFRONT = 1 << 20
# Upper bound of emitted paths per wanted light, for scenes in which few paths store a light
_MOST_PATHS_PER_LIGHT = 16
# Fraction of the lights divided equally between the emitter samplers: a pilot may miss the light of one
_DEFENSIVE_SHARE = 0.05
# Fraction of effective lights below which a warning is logged: 4000 of the usual 200 000
_LEAST_EFFECTIVE = 0.02


@dataclass(frozen=True)
class LightPathSettings:
    """Settings of light paths.

    ``deepest``: edges of the longest light path whose end may store a light (math.inf: no limit); ``rr_depth``: edges
    after which Russian roulette begins, as in Mitsuba's ``path``; ``lobe_limit``: largest probability density, per
    steradian, of a glossy scattering direction that stores a light like a diffuse direction (at most 1 / pi); 0 stores
    lights of diffuse lobes only.
    """

    deepest: float
    rr_depth: int
    lobe_limit: float


@dataclass
class TracedLights:
    """Result of tracing: the lights, the number of emitted paths, and the number of dropped invalid lights."""

    lights: VirtualLights
    paths: int
    dropped: int


@dataclass(frozen=True)
class _Walk:
    """Common data of the light paths of a render.

    ``perturbed``: shapes with bump or normal maps; ``focus``: visible part of the scene, if small; ``bounce``: frozen
    :func:`_bounce`.
    """

    perturbed: Perturbed
    focus: Focus | None
    settings: LightPathSettings
    bounce: Callable

    @classmethod
    def of(cls, scene, focus: Focus | None, settings: LightPathSettings) -> _Walk:
        """Walk in a scene that must stay unchanged during tracing.

        Dr.Jit records an edge once and replays it: for many shapes and materials, recording takes longer than tracing.
        """
        perturbed = Perturbed(scene)
        return cls(perturbed, focus, settings, partial(dr.freeze(_bounce), scene, perturbed, settings))


def _scatter(si, sampler, throughput, settings: LightPathSettings) -> Scattered:
    """Scatter light paths by BSDF sampling, at surfaces without bump or normal map."""
    context = mi.BSDFContext(mi.TransportMode.Importance)
    sample, weight = si.bsdf().sample(context, si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
    direction = si.to_world(sample.wo)

    # ---- Shading normals: correction for light paths [Veach 1997, eq. 5.19], no leaks through the surface
    in_geometric, out_geometric = dr.dot(si.n, si.to_world(si.wi)), dr.dot(si.n, direction)
    in_shading, out_shading = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(sample.wo)
    valid = si.is_valid() & (in_geometric * in_shading > 0) & (out_geometric * out_shading > 0)
    leaving = throughput * mi.unpolarized_spectrum(weight) * dr.abs(in_shading / in_geometric)
    valid &= dr.any(leaving > 0)

    # ---- Virtual light of a diffuse lobe, on the side of the scattered direction
    broad = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Glossy) & (sample.pdf <= settings.lobe_limit)
    stored = valid & (mi.has_flag(sample.sampled_type, mi.BSDFFlags.Diffuse) | broad)
    normal = si.n * dr.sign(out_geometric)
    following = leaving * dr.abs(out_geometric / out_shading)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return Scattered(stored, leaving, normal, normal, valid, direction, following, delta)


def _bounce(scene, perturbed, settings: LightPathSettings, sampler, ray, throughput, power, depth, refuses_delta):
    """One edge of every path, in one kernel for every depth.

    ``throughput`` starts at 1, and ``power`` remains the emitted power: Russian roulette uses relative values.
    ``refuses_delta``: whether scattering by a delta lobe ends the path.  Returns (stored mask, position, normal,
    flux / pi, facing), (alive mask, origin, direction, throughput), mask of non-finite values; evaluated.
    """
    si = scene.ray_intersect(ray)
    scattered = _scatter(si, sampler, throughput, settings)
    if perturbed.exist:
        here = si.is_valid() & perturbed.at(si, si.is_valid())
        by_map = scatter_perturbed(si, sampler, throughput, settings.lobe_limit, here)
        scattered = select_record(here, by_map, scattered)
    leaving, following = scattered.leaving, scattered.following
    bad = scattered.stored & ~dr.all(dr.isfinite(leaving)) | scattered.goes_on & ~dr.all(dr.isfinite(following))
    stored = scattered.stored & ~bad
    intensity = spectrum_to_rgb(leaving * power) * dr.inv_pi

    # ---- Russian roulette, as in ``path``
    survival = throughput_survival(dr.max(following), 1, depth >= settings.rr_depth)
    alive = scattered.goes_on & ~bad & ~(scattered.delta & refuses_delta) & (sampler.next_1d() < survival)
    following = following / survival

    next_ray = si.spawn_ray(scattered.direction)
    light = (stored, si.p, scattered.normal, intensity, scattered.facing)
    onward = (alive, next_ray.o, next_ray.d, following)
    # Evaluate here, in one kernel; a count before would launch a second kernel with the same work
    dr.eval(light, onward, bad)
    return light, onward, bad


def _trace_wavefront(walk: _Walk, emitter_sampler, first: int, count: int, total: int, seed: int):
    """Trace the paths first .. first + count - 1 of the ``total`` paths of an emitter sampler.

    Mirrors, glass and masks end paths straight from a point, spot or directional emitter, because Mitsuba's ``path``
    does not count them.
    """
    sampler = independent_sampler(derived_seed(seed, 0), count)
    chosen = stratified(sampler, count, first, total)
    ray, power = emitter_sampler.sample(chosen, sampler.next_2d(), sampler.next_2d())
    power = mi.unpolarized_spectrum(power) / dr.opaque(mi.Float, float(total))
    origin, direction, throughput = ray.o, ray.d, ones(count)

    parts, dropped, depth = [], 0, 1
    while count > 0 and depth <= walk.settings.deepest:
        sampler.seed(derived_seed(seed, depth), count)
        dr.make_opaque(origin, direction, throughput, power)  # otherwise every depth compiles its own kernel
        ray = mi.Ray3f(origin, direction)
        refuses_delta = dr.opaque(mi.Bool, emitter_sampler.delta and depth == 1)
        edges = dr.opaque(mi.UInt32, depth)
        stored, alive, bad = walk.bounce(sampler, ray, throughput, power, edges, refuses_delta)
        dropped += int(dr.count(bad)[0])
        kept = dr.compress(stored[0])
        if len(kept):
            *columns, facing = (download(dr.gather(type(column), column, kept)) for column in stored[1:])
            facing = facing if walk.perturbed.exist else None
            parts.append(VirtualLights.of("oriented", *columns, depth, facing=facing))
        going = dr.compress(alive[0])
        count, depth = len(going), depth + 1
        origin, direction, throughput = (dr.gather(type(column), column, going) for column in alive[1:])
        power = dr.gather(type(power), power, going)
    return parts, dropped


def _trace_paths(walk: _Walk, emitter_sampler, number: int, paths: int, seed: int):
    """Trace the ``paths`` of an emitter sampler in wavefronts of at most _LARGEST_WAVEFRONT paths."""
    parts, dropped = [VirtualLights.of("oriented", [], [], [])], 0
    for first, last in even_chunks(paths, most=_LARGEST_WAVEFRONT):
        stream = derived_seed(seed, number, first)
        new_parts, bad = _trace_wavefront(walk, emitter_sampler, first, last - first, paths, stream)
        parts += new_parts
        dropped += bad
    return VirtualLights.concatenate(parts), dropped


def _path_counts(walk: _Walk, samplers, count: int, seed: int) -> list[int]:
    """Number of paths of each emitter sampler, from a pilot pass whose lights are discarded.

    The number of lights is proportional to the flux stored by the sampler's pilot, not to its power: an environment
    emitter around a closed building has nearly all the power and stores hardly any light.  A fraction _DEFENSIVE_SHARE
    is divided equally, in case a pilot missed flux.  Flux far from a focus has less weight.
    """
    flux, lights_per_path = np.zeros(len(samplers)), np.zeros(len(samplers))
    for number, emitter_sampler in enumerate(samplers):
        lights, _ = _trace_paths(walk, emitter_sampler, number, _PILOT_PATHS, derived_seed(seed, 1))
        lights, _ = lights.without_bad()
        flux[number] = _importance(walk, lights).sum()
        lights_per_path[number] = lights.count / _PILOT_PATHS
    wanted = np.full(len(samplers), count / len(samplers))
    if flux.sum() > 0:
        wanted = count * ((1 - _DEFENSIVE_SHARE) * flux / flux.sum() + _DEFENSIVE_SHARE / len(samplers))
    paths = wanted / np.maximum(lights_per_path, 1 / _MOST_PATHS_PER_LIGHT)
    return [max(round(number), 1) for number in paths]


def _importance(walk: _Walk, lights: VirtualLights) -> np.ndarray:
    """Importance of each light for the visible part of the scene, (n,): intensity, less far from a focus."""
    intensity = lights.intensity.sum(1, dtype=np.float64)
    return intensity if walk.focus is None else intensity * walk.focus.importance(lights.position)


def _warn_of_few(walk: _Walk, lights: VirtualLights) -> None:
    """Log a warning if few lights are effective in the visible part of the scene."""
    importance, focus = _importance(walk, lights), walk.focus
    if focus is None or not importance.any():
        return
    # Effective sample size [Kish 1965]
    effective = importance.sum() ** 2 / (importance**2).sum()
    if effective < _LEAST_EFFECTIVE * lights.count:
        center = ", ".join(f"{x:.3g}" for x in focus.center)
        mi.Log(
            mi.LogLevel.Warn,
            f"Only about {effective:.0f} of {lights.count} virtual lights are effective in the visible part of the "
            f"scene, within {focus.radius:.3g} of ({center}); the scene extends to {focus.reach:.3g}: indirect light "
            "will be noisy. Remove distant geometry, or raise vpl_count.",
        )


@garbage_kept()
def trace_lights(
    scene, emitters: Emitters, count: int, seed: int, settings: LightPathSettings, focus: Focus | None = None
) -> TracedLights:
    """Trace light paths from all emitters that store about ``count`` virtual point lights, of kind "oriented".

    The number of paths is fixed in advance, and intensities are divided by the number of emitted paths, not of stored
    lights: the estimate is unbiased.  Depth of a light: edges of its path (1 for the first surface).  ``focus``:
    visible part of the scene, if small.
    """
    samplers = emitter_samplers(scene, emitters, focus)
    traced = TracedLights(VirtualLights.of("oriented", [], [], []), 0, 0)
    if not samplers or settings.deepest < 1:
        return traced
    walk = _Walk.of(scene, focus, settings)
    path_counts = _path_counts(walk, samplers, count, seed)
    parts = [traced.lights]
    for number, (emitter_sampler, paths) in enumerate(zip(samplers, path_counts, strict=True)):
        lights, dropped = _trace_paths(walk, emitter_sampler, number, paths, derived_seed(seed, 2))
        parts.append(lights)
        traced.dropped += dropped
        traced.paths += paths
    traced.lights, bad = VirtualLights.concatenate(parts).without_bad()
    traced.dropped += bad
    if traced.dropped:
        mi.Log(mi.LogLevel.Warn, f"Dropped {traced.dropped} virtual light(s) with non-finite values.")
    _warn_of_few(walk, traced.lights)
    return traced
