"""Light paths with the full BSDFs; a virtual point light at every diffuse bounce.

A path that scatters by a diffuse lobe at a surface leaves a virtual point light there: the lobe was chosen by the
BSDF's own sampling, so that its weight is the flux that leaves by that lobe, for any material, and glossy or specular
bounces only carry the path on.  (Departure from the instant-radiosity papers, which store a light at every vertex and
scale it by the diffuse albedo: it needs nothing but ``bsdf.sample``, and is equal in expectation for materials that
weight a sample by its own lobe; those that weight it by all lobes, as ``principled`` does, share out the energy where
lobes overlap.)  Glossy lobes that are broad enough are stored as diffuse ones: an approximation, with ``lobe_limit`` as
its knob.
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
from ..core.sampling import derived_seed, independent_sampler, stratified
from .emission import emission_groups
from .emitters import Emitters
from .focus import Focus
from .perturbed import Perturbed, Scattered, scatter_perturbed
from .virtual_lights import VirtualLights

_PILOT_PATHS = 4096
_LARGEST_WAVEFRONT = 1 << 20
# A scene that stores a light on one path in a thousand gets an honest but bounded number of paths.
_MOST_PATHS_PER_LIGHT = 16
_DEFENSIVE_SHARE = 0.05
# Share of lights that have to matter, or there is a warning
_LEAST_THAT_MATTER = 0.02


@dataclass(frozen=True)
class PathLimits:
    """``deepest``: edges of the longest light path whose end may store a light (math.inf: no limit);
    ``rr_depth``: edges after which Russian roulette begins, as in Mitsuba's ``path``;
    ``lobe_limit``: a direction scattered by a glossy lobe with at most this probability density, per steradian, stores
    a light too, as though the lobe were diffuse (whose density is at most 1 / pi); 0 stores diffuse lobes only."""

    deepest: float
    rr_depth: int
    lobe_limit: float


@dataclass
class TracedLights:
    """Result of tracing: the lights, how many paths were emitted for them, how many bad values were dropped."""

    lights: VirtualLights
    paths: int
    dropped: int


@dataclass(frozen=True)
class _Walk:
    """What all light paths of a render have in common; ``perturbed``: the shapes with bump or normal maps;
    ``focus``: where the camera looks, if that is a small part of the scene; ``bounce``: one edge of them all, see
    :func:`_bounce`."""

    perturbed: Perturbed
    focus: Focus | None
    limits: PathLimits
    bounce: Callable

    @classmethod
    def of(cls, scene, focus: Focus | None, limits: PathLimits) -> _Walk:
        """Paths in a scene, which may not be edited before all of them are traced: an edge is recorded once and
        replayed, for where there are many shapes and materials, recording takes longer than tracing."""
        perturbed = Perturbed(scene)
        return cls(perturbed, focus, limits, partial(dr.freeze(_bounce), scene, perturbed, limits))


def _scatter(si, sampler, throughput, limits: PathLimits) -> Scattered:
    """Scatter light paths by the sampling of the BSDF; surfaces with bump or normal maps are not meant here."""
    context = mi.BSDFContext(mi.TransportMode.Importance)
    sample, weight = si.bsdf().sample(context, si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
    direction = si.to_world(sample.wo)

    # ---- Shading normals: Veach's correction for light paths [Veach 1997, eq. 5.19], no leaks through the surface
    in_geometric, out_geometric = dr.dot(si.n, si.to_world(si.wi)), dr.dot(si.n, direction)
    in_shading, out_shading = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(sample.wo)
    valid = si.is_valid() & (in_geometric * in_shading > 0) & (out_geometric * out_shading > 0)
    leaving = throughput * mi.unpolarized_spectrum(weight) * dr.abs(in_shading / in_geometric)
    valid &= dr.any(leaving > 0)

    # ---- A light where the sampled lobe was diffuse, on the side to which it scatters
    broad = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Glossy) & (sample.pdf <= limits.lobe_limit)
    stored = valid & (mi.has_flag(sample.sampled_type, mi.BSDFFlags.Diffuse) | broad)
    normal = si.n * dr.sign(out_geometric)
    following = leaving * dr.abs(out_geometric / out_shading)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return Scattered(stored, leaving, normal, normal, valid, direction, following, delta)


def _bounce(scene, perturbed, limits: PathLimits, sampler, ray, throughput, power, depth, refuses_delta):
    """One edge of all paths, in one kernel that is the same at every depth.

    ``throughput`` starts at 1 and ``power`` stays what the emitter gave: Russian roulette sees relative values only.
    ``refuses_delta``: whether paths end where they are scattered by a lobe without an extent.  Returns (stored mask,
    position, normal, flux / pi, facing), (alive mask, origin, direction, throughput), mask of values that are not
    finite, all evaluated.
    """
    si = scene.ray_intersect(ray)
    scattered = _scatter(si, sampler, throughput, limits)
    if perturbed.exist:
        here = si.is_valid() & perturbed.at(si, si.is_valid())
        turned = scatter_perturbed(si, sampler, throughput, limits.lobe_limit, here)
        scattered = select_record(here, turned, scattered)
    leaving, following = scattered.leaving, scattered.following
    bad = scattered.stored & ~dr.all(dr.isfinite(leaving)) | scattered.goes_on & ~dr.all(dr.isfinite(following))
    stored = scattered.stored & ~bad
    intensity = spectrum_to_rgb(leaving * power) * dr.inv_pi

    # ---- Russian roulette, as in ``path``
    survival = dr.minimum(dr.max(following), 0.95)
    alive = scattered.goes_on & ~bad & ~(scattered.delta & refuses_delta)
    alive &= (depth < limits.rr_depth) | (sampler.next_1d() < survival)
    following = dr.select(depth < limits.rr_depth, following, following / survival)

    next_ray = si.spawn_ray(scattered.direction)
    light = (stored, si.p, scattered.normal, intensity, scattered.facing)
    onward = (alive, next_ray.o, next_ray.d, following)
    # One kernel for everything; a count before would be a kernel of its own that does all the work twice
    dr.eval(light, onward, bad)
    return light, onward, bad


def _paths_of_group(walk: _Walk, group, first: int, count: int, total: int, seed: int):
    """Trace the paths first .. first + count - 1 of the ``total`` that a group of emitters gets.

    Mirrors, glass and masks end paths that come straight from a point or from one direction: no path that Mitsuba's
    ``path`` counts passes there.
    """
    sampler = independent_sampler(derived_seed(seed, 0), count)
    chosen = stratified(sampler, count, first, total)
    ray, power = group.sample(chosen, sampler.next_2d(), sampler.next_2d())
    power = mi.unpolarized_spectrum(power) / dr.opaque(mi.Float, float(total))
    origin, direction, throughput = ray.o, ray.d, ones(count)

    parts, dropped, depth = [], 0, 1
    while count > 0 and depth <= walk.limits.deepest:
        sampler.seed(derived_seed(seed, depth), count)
        dr.make_opaque(origin, direction, throughput, power)  # or each depth would have a kernel of its own
        ray = mi.Ray3f(origin, direction)
        refuses_delta = dr.opaque(mi.Bool, group.delta and depth == 1)
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


def _trace_group(walk: _Walk, group, number: int, paths: int, seed: int):
    """Trace all ``paths`` of a group in bounded wavefronts."""
    parts, dropped = [VirtualLights.of("oriented", [], [], [])], 0
    for first, last in even_chunks(paths, most=_LARGEST_WAVEFRONT):
        stream = derived_seed(seed, number, first)
        new_parts, bad = _paths_of_group(walk, group, first, last - first, paths, stream)
        parts += new_parts
        dropped += bad
    return VirtualLights.concatenate(parts), dropped


def _shares(walk: _Walk, groups, count: int, seed: int) -> list[int]:
    """Numbers of paths that each group gets, from a pilot whose lights are thrown away.

    Lights are wanted where flux arrives: an environment emitter around a closed building has nearly all the power
    and leaves hardly a light.  So each group should leave lights in proportion to the flux that its pilot stored; a
    small part is kept for groups whose pilot was unlucky.  What is far from a focus counts less.
    """
    flux, lights_per_path = np.zeros(len(groups)), np.zeros(len(groups))
    for number, group in enumerate(groups):
        lights, _ = _trace_group(walk, group, number, _PILOT_PATHS, derived_seed(seed, 1))
        lights, _ = lights.without_bad()
        flux[number] = _importance(walk, lights).sum()
        lights_per_path[number] = lights.count / _PILOT_PATHS
    wanted = np.full(len(groups), count / len(groups))
    if flux.sum() > 0:
        wanted = count * ((1 - _DEFENSIVE_SHARE) * flux / flux.sum() + _DEFENSIVE_SHARE / len(groups))
    paths = wanted / np.maximum(lights_per_path, 1 / _MOST_PATHS_PER_LIGHT)
    return [max(round(share), 1) for share in paths]


def _importance(walk: _Walk, lights: VirtualLights) -> np.ndarray:
    """How much each light counts where the camera looks, (n,)."""
    intensity = lights.intensity.sum(1, dtype=np.float64)
    return intensity if walk.focus is None else intensity * walk.focus.importance(lights.position)


def _warn_of_few(walk: _Walk, lights: VirtualLights) -> None:
    """Log a warning where hardly any of the lights matter for what the camera sees."""
    importance, focus = _importance(walk, lights), walk.focus
    if focus is None or not importance.any():
        return
    # As many lights of the same importance would make as much noise [Kish 1965, effective sample size]
    matter = importance.sum() ** 2 / (importance**2).sum()
    if matter < _LEAST_THAT_MATTER * lights.count:
        place = ", ".join(f"{x:.3g}" for x in focus.center)
        mi.Log(
            mi.LogLevel.Warn,
            f"Only about {matter:.0f} of {lights.count} virtual lights matter where the camera looks, within "
            f"{focus.radius:.3g} of ({place}), while the scene reaches as far as {focus.reach:.3g}: indirect light "
            "will be noisy. Leave out what is far away, or raise vpl_count.",
        )


@garbage_kept()
def trace_lights(
    scene, emitters: Emitters, count: int, seed: int, limits: PathLimits, focus: Focus | None = None
) -> TracedLights:
    """Trace light paths from all emitters until about ``count`` virtual point lights are stored.

    The number of paths is fixed before the first of them is traced, and intensities are divided by emitted paths, not
    by stored lights, so that the estimate is unbiased.  Depth of a light: edges of its path (1 for the first surface).
    ``focus``: where the camera looks, if that is a small part of the scene.  Returns "oriented" lights.
    """
    groups = emission_groups(scene, emitters, focus)
    traced = TracedLights(VirtualLights.of("oriented", [], [], []), 0, 0)
    if not groups or limits.deepest < 1:
        return traced
    walk = _Walk.of(scene, focus, limits)
    shares = _shares(walk, groups, count, seed)
    parts = [traced.lights]
    for number, (group, paths) in enumerate(zip(groups, shares, strict=True)):
        lights, dropped = _trace_group(walk, group, number, paths, derived_seed(seed, 2))
        parts.append(lights)
        traced.dropped += dropped
        traced.paths += paths
    traced.lights, bad = VirtualLights.concatenate(parts).without_bad()
    traced.dropped += bad
    if traced.dropped:
        mi.Log(mi.LogLevel.Warn, f"{traced.dropped} virtual light(s) with values that are not finite were dropped.")
    _warn_of_few(walk, traced.lights)
    return traced
