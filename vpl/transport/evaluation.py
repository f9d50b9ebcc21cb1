"""Evaluation of chosen pairs: the only place for shading and tracing pairs of a gather point and a light."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import channel_mean, download, even_chunks, select_record
from ..core.sampling import Choice, independent_sampler
from ..lights.light_set import LightGroup, LightSet
from ..points.camera_paths import SceneTraits
from ..points.surfaces import Batch, Surface
from .contribution import contribution, shadow_ray, transmittance

# Largest number of lights summed by a kernel in single precision; sums over kernels are in double precision
_LIGHTS_PER_KERNEL = 4096
# Largest number of shadow rays of a kernel: no render can be stopped before the end of a kernel
_RAYS_PER_KERNEL = 1 << 26


@dataclass(frozen=True)
class Transport:
    """Context of evaluation: the ``scene``, the ``traits`` of the surfaces, and the ``lights`` of a render.

    Functions for lights of a single kind take a ``group`` in addition.
    """

    scene: mi.Scene
    traits: SceneTraits
    lights: LightSet


def evaluate_pairs(transport: Transport, group: LightGroup, surface, light, scale, seen=None):
    """Shade one (surface, light) pair per lane and trace its shadow ray, unless nothing would arrive.

    ``light``: lights gathered from ``group``; ``scale``: factor on their intensity; ``seen``: lanes with visibility 1
    without a ray (None: no lane).  Returns (radiance with visibility, mask of the lanes whose ray was traced).
    """
    value = unoccluded(transport.lights, group, surface, light) * scale
    arrives = dr.any(value > 0)
    traced = arrives if seen is None else arrives & ~seen
    passed = _visibility(transport, group, surface, light, traced)
    if seen is not None:
        passed = dr.select(seen, 1, passed)
    return dr.select(arrives, value * passed, 0), traced


def evaluate_representatives(transport: Transport, group: LightGroup, batch: Batch, rows, light, intensity):
    """Shade and trace pairs of ``rows`` of a batch and lights of a group, each of which stands for a cluster.

    ``light``: indices of the lights; ``intensity``: of the clusters, the mean over channels.  Every method of choosing
    pairs uses the same kernel, compiled once.  Returns as :func:`evaluate_pairs`, evaluated.
    """
    dr.eval(rows, light, intensity)
    value, traced = evaluate_pairs(transport, group, batch.surfaces_at(rows), *group.standing_for(light, intensity))
    dr.eval(value, traced)
    return value, traced


def evaluate_one_of(transport: Transport, group: LightGroup, surface, candidates: list, number):
    """Shade several representative lights of a cluster, and trace the ray of a single light, drawn by unoccluded
    contribution.

    ``candidates``: (light, factor on its intensity) pairs, each sufficient alone; ``number``: UInt32, distinct for
    independent draws.  The expectation is the mean of the candidates, with the visibility of a single light: resampled
    importance sampling [Talbot et al. 2005].  Returns as :func:`evaluate_pairs`.
    """
    (light, scale), *others = candidates
    if not others:
        return evaluate_pairs(transport, group, surface, light, scale)
    value = unoccluded(transport.lights, group, surface, light) * scale
    strength = channel_mean(value)
    total = mi.Float(strength)
    for k, (other, scale) in enumerate(others):
        new = unoccluded(transport.lights, group, surface, other) * scale
        new_strength = channel_mean(new)
        total += new_strength
        taken = mi.sample_tea_float32(number, mi.UInt32(k)) * total < new_strength
        value, strength = dr.select(taken, new, value), dr.select(taken, new_strength, strength)
        light = select_record(taken, other, light)
    arrives = strength > 0
    passed = _visibility(transport, group, surface, light, arrives)
    # The strength of the drawn light cancels, except for the colour
    share = total / (strength * len(candidates))
    return dr.select(arrives, value * passed * share, 0), arrives


def probe_visibility(transport: Transport, group: LightGroup, surface: Surface, light, active=True):
    """Fraction of arriving light for each (surface, light) pair with a nonzero unoccluded contribution.

    Returns (fraction, mask of the traced lanes).
    """
    traced = dr.any(unoccluded(transport.lights, group, surface, light) > 0) & active
    # Always of several channels: all() and any() over a single channel would run over the lanes
    return mi.UnpolarizedSpectrum(_visibility(transport, group, surface, light, traced)), traced


def unoccluded(lights: LightSet, group: LightGroup, surface: Surface, light):
    """Unoccluded contribution of lights to surfaces, pair by pair."""
    allowed = lights.allowed(surface.depth, light.depth)
    return contribution(group.kind, surface, light, lights.clamp, allowed)


def _visibility(transport: Transport, group: LightGroup, surface: Surface, light, active):
    ray = shadow_ray(group.kind, surface.interaction, light)
    most = transport.lights.edges_left(surface.depth, light.depth)
    return transmittance(transport.scene, transport.traits, group.kind, ray, most, active)


@dr.syntax
def sum_lights(transport: Transport, group: LightGroup, surface: Surface, first, last, pick):
    """Sum over the numbers first .. last - 1 of every surface, in step: (radiance, shadow rays per surface).

    ``surface``: evaluated; ``pick``: function of a number to the candidates of :func:`evaluate_one_of`.
    """
    count = dr.width(first)
    lane = dr.arange(mi.UInt32, count)
    j, end = mi.UInt32(first), mi.UInt32(last)
    radiance, rays = dr.zeros(mi.UnpolarizedSpectrum, count), dr.zeros(mi.UInt32, count)
    while dr.hint(j < end, exclude=[transport, group, surface, pick]):
        number, _ = mi.sample_tea_32(lane, j)
        value, traced = evaluate_one_of(transport, group, surface, pick(j), number)
        radiance += value
        rays += dr.select(traced, 1, 0)
        j += 1
    dr.eval(radiance, rays)
    return radiance, rays


def sum_all_lights(transport: Transport, batch: Batch, stopped=lambda: False):
    """Every light at every point of a batch: the oracle of all methods.

    ``stopped``: asked between kernels; once true the sum ends early.  Returns (radiance, shadow rays per point).
    """
    precise = dr.float64_array_t(mi.UnpolarizedSpectrum)
    total, rays = dr.zeros(precise, batch.count), dr.zeros(mi.UInt32, batch.count)
    most = max(1, min(_LIGHTS_PER_KERNEL, _RAYS_PER_KERNEL // batch.count))
    for group in transport.lights.groups:
        for first, last in even_chunks(group.count, most=most):
            if stopped():
                break
            begin, end = dr.opaque(mi.UInt32, first, batch.count), dr.opaque(mi.UInt32, last)
            radiance, traced = sum_lights(transport, group, batch.surfaces, begin, end, group.pick)
            total += precise(radiance)
            rays += traced
            dr.eval(total, rays)
    return mi.UnpolarizedSpectrum(total), rays


def mean_radiance(transport: Transport, batch: Batch, seed: int, count: int = 1 << 15) -> float:
    """Mean over points and channels of the light of all lights, from ``count`` random pairs per group.

    Points are drawn uniformly, lights by intensity; the result only sets the scale of thresholds.
    """
    total = 0.0
    for group in transport.lights.groups:
        choice = Choice(group.lights.scalar_intensity)
        sampler = independent_sampler(seed, count)
        points = dr.opaque(mi.UInt32, batch.count)
        row = dr.minimum(mi.UInt32(sampler.next_1d() * mi.Float(points)), points - 1)
        index = choice.row(sampler.next_1d())
        # Drawn by intensity, each light represents the whole group
        everything = dr.opaque(mi.Float, float(group.lights.scalar_intensity.sum()), count)
        value, _ = evaluate_representatives(transport, group, batch, row, mi.UInt32(index), everything)
        total += float(download(value).mean(dtype="float64"))
    return total
