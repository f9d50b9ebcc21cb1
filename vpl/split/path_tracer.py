"""Traced part of the split: the camera paths of Mitsuba's ``path``, minus the light carried by virtual lights.

Let x1 be the first vertex with a minorant F1, x2 the next vertex, and f the BSDFs.  The radiance from x2 to x1 has the
factor

    f1 f2 = w F1 F2  +  (f1 f2 - w F1 F2),      w = 1 / (1 + c² cosθ1 cosθ2 / d²).

Virtual lights carry the first term: x1 is a *gather vertex*, with the weight β F1 for a path of throughput β.  The path
carries w β F1 F2 (``path.carried``) to x2 and subtracts it there from β f1 f2, in next-event estimation and in the
outgoing throughput.  The difference may be negative.  Light leaving x2 may be gathered at x2 and at later vertices in
the same way.

If virtual lights represent emitters, direct light at a gather vertex is split with the same w.  The path subtracts w β
F1 from next-event estimation at x1 and from the emission at the next vertex.

The loop in :func:`trace_paths` has one section per term: hit, emission, subtraction, Russian roulette, gather vertex,
next-event estimation, BSDF sampling.  The kernel also finds the irradiance of virtual lights, by paths without
subtraction, and the surfaces for placing virtual lights.  *Plain* paths are those of large images without virtual
lights: their kernel has no sections for virtual lights and no records for decisions.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.arrays import LARGEST_VALUE, channel_mean, select_record
from ..core.loops import recorded_once
from ..core.path_limits import throughput_survival
from ..core.sampling import SPREAD_STEPS
from ..direct.emitter_sampling import power_heuristic
from ..transport.carried_share import carried_share
from ..transport.minorant import agrees
from .contributions import Contributions, LayerSums
from .covered import evaluated_and_sampled
from .emitters.base import EmitterSample, EmitterSampler, MetEmitter
from .gather_vertices import Gathered, GatherVertices, SecondVertices
from .lattice import Lattice
from .onward import RelayChoice, Turned
from .path_state import FirstEdge, Gathering, Hit, Noise, Path, PathSettings, State, Traced, Vertex
from .relays import relays_by
from .roulette import residual_survival
from .turning import turn


@recorded_once
@dr.syntax
def trace_paths(
    scene, emitters: EmitterSampler, first: FirstEdge, lattice: Lattice, sampler, settings: PathSettings,
    sums: LayerSums | None = None,
) -> Traced:  # fmt: skip
    """Trace paths to their ends.

    ``lattice``: numbers for the choice of emitter, point, lobe and direction at each vertex; ``sampler``: the remaining
    random numbers; ``sums`` by layer, for camera rays.
    """
    count, records = dr.width(first.throughput), not settings.plain
    path, found = Path.of(first, settings, emitters), Contributions.none(count, sums, draws=records)
    gathered, noise = (Gathered.none(count), Noise.none(count)) if records else (None, None)
    lane = dr.arange(mi.UInt32, count)

    while dr.hint(path.active, exclude=[first, lattice, settings, emitters, lane]):
        # ---------------------- Hit ----------------------
        hit = Hit.of(emitters.traits, path, settings)

        # ---------------------- Emission, by BSDF sampling ----------------------
        _add_emission(path, hit, emitters, settings, sampler, found, noise, lane)

        if dr.hint(path.relayed is not None, mode="scalar"):
            path.relayed = path.active & relays_by(hit.flags) & (path.relayed | (path.state != State.SEEKING))

        # ---------------------- Subtraction: w β F1 F2 of x2 ----------------------
        connects = _carry(path, hit, settings, found.radiance, gathered) if records else mi.Bool(False)

        # ---------------------- Russian roulette: residual and expected contribution ----------------------
        _end_at_vertex(path, hit, connects, settings, sampler.next_1d())

        # ---------------------- Gather vertex, with the weight β F1 ----------------------
        gathers, weight = _gather(path, hit, settings, gathered, _draw(sampler, settings)) if records else (None, None)

        # ---------------------- Next-event estimation, with a sample of the BSDF ----------------------
        path.scattered += dr.select(hit.smooth, 1, 0)
        several = hit.smooth & (path.scattered == 1) & settings.several
        samples = dr.select(several, first.direct_samples, 1)
        cell = emitters.cell(hit.si.p, hit.facing)
        # A path that ends needs a sample of the BSDF only to tell whether the surface counts in alpha
        scatters = path.active & ~hit.hidden & (hit.goes_on | ~path.valid)
        share = dr.rcp(mi.Float(samples))
        numbers, choice = lattice.at(path.depth), None
        if dr.hint(settings.relays is not None, mode="scalar"):
            # A relay needs one more edge behind it
            far = scatters & (path.depth + 2 < settings.max_depth)
            choice, numbers = RelayChoice.of(settings.relays, hit, numbers, far)
        vertex = Vertex(hit, gathers, weight, cell, samples, share, numbers, scatters, choice)
        turned = _sample_emitters(scene, emitters, path, vertex, settings, sampler, found, noise, lane)

        # ---------------------- Onward by the sample of the BSDF, or to a relay ----------------------
        survival = turn(path, vertex, turned, emitters)

        # ---------------------- Russian roulette: residual of the direction, and throughput ----------------------
        _end_at_direction(path, hit, survival, settings, sampler.next_1d())
        if dr.hint(settings.hide_emitters, mode="scalar"):
            _pass_hidden(path, hit, first)

    traced = Traced.of(path, found, noise, gathered)
    dr.eval(traced)
    return traced


def _add_emission(
    path: Path, hit: Hit, emitters: EmitterSampler, settings: PathSettings, sampler, found: Contributions,
    noise: Noise | None, lane,
) -> None:  # fmt: skip
    """Add the light of emitters that paths hit to ``found``."""
    met = _met(path, hit, emitters, path.active & ~hit.hidden)
    mis = power_heuristic(path.density, met.density * mi.Float(path.emitter_samples))
    arrived = _less_carried(path, met, settings) * met.radiance
    found.add(arrived * mis, path.depth + 1, met.group, _draw(sampler, settings), lane)
    if noise is not None:
        single = power_heuristic(path.density, met.density)
        noise.add_emission(path, channel_mean(arrived), mis, single)


def _met(path: Path, hit: Hit, emitters: EmitterSampler, active: mi.Bool) -> MetEmitter:
    """Emission that paths hit, with the density of the direction at their last vertices."""
    if not emitters.refracts:
        return emitters.met(path.vertex, path.cell, path.ray, hit.si, ~path.delta, active)
    bent = path.bent & active
    met = emitters.met(path.vertex, path.cell, path.ray, hit.si, ~(path.delta | path.bent), active)
    return replace(met, density=met.density + emitters.glass.density(emitters.met, path, hit.si, bent))


@dr.syntax
def _sample_emitters(
    scene, emitters: EmitterSampler, path: Path, vertex: Vertex, settings: PathSettings, sampler, found: Contributions,
    noise: Noise | None, lane,
) -> Turned:  # fmt: skip
    """Add the light of emitters by the samples at each vertex to ``found``; returns the directions onward."""
    count, samples = dr.width(lane), vertex.samples
    turned, number = Turned.none(count), dr.zeros(mi.UInt32, count)
    if dr.hint(settings.several, mode="scalar"):
        while dr.hint(number < samples, exclude=[scene, emitters, path, vertex, samples, settings, lane]):
            turned = _sample_emitter(
                scene, emitters, path, vertex, turned, number, settings, sampler, found, noise, lane
            )
            number += 1
    else:
        turned = _sample_emitter(scene, emitters, path, vertex, turned, number, settings, sampler, found, noise, lane)
    return turned if vertex.choice is None else vertex.choice.mixed(turned)


def _sample_emitter(
    scene, emitters: EmitterSampler, path: Path, vertex: Vertex, before: Turned, number: mi.UInt32,
    settings: PathSettings, sampler, found: Contributions, noise: Noise | None, lane,
) -> Turned:  # fmt: skip
    """Add the light of emitters by the sample ``number`` at each vertex to ``found``; returns the directions onward,
    ``before`` by earlier samples."""
    hit, edges = vertex.hit, path.depth + 2
    chosen, place, lobe, turn = _numbers_of_sample(vertex.numbers, number) if settings.several else vertex.numbers
    sample = emitters.sample(hit.si, vertex.cell, chosen, sampler.next_1d(), place, hit.smooth)
    if vertex.choice is not None:
        sample = vertex.choice.instead(sample, number)
    toward = hit.si.to_local(sample.direction)
    perturbed = None if settings.plain else settings.minorants.perturbed
    value, density, turned, bsdf_weight = evaluated_and_sampled(
        path, vertex, emitters.traits.materials, perturbed, toward, lobe, turn
    )
    lit, beyond, single = _lit(path, vertex, sample, value, density, settings, sampler)
    arriving, crossings = sample.arriving(scene, emitters, settings.max_depth - edges, dr.max(dr.abs(beyond)) > 0)
    lit = dr.select(crossings > 0, beyond, lit) * arriving
    found.add(lit, edges + crossings, sample.group, _draw(sampler, settings), lane)
    if noise is not None:
        noise.add_sample(path, channel_mean(lit), number, vertex.samples, single)
    turned = Turned(turned, bsdf_weight, turned.pdf)
    return turned if vertex.choice is None else vertex.choice.chosen(before, turned, toward, value, density, number)


def _draw(sampler, settings: PathSettings) -> mi.Float | None:
    """A uniform number for drawing a contribution or a vertex, None for plain paths, which draw none."""
    return None if settings.plain else sampler.next_1d()


def _numbers_of_sample(numbers: tuple, number: mi.UInt32) -> tuple:
    """The ``numbers`` of a vertex for one of its emitter samples: those for the emitter and the point on it are
    shifted, so that they are spread over the samples, and two samples choose different emitters.  The BSDF is sampled
    once."""

    def shifted(value, step):
        # Multiples of 2^-24, which wrap around without rounding
        bits = mi.UInt32(value * 2.0**24) + number * mi.UInt32(round(step * 2**24))
        return mi.Float(bits & (2**24 - 1)) * 2.0**-24

    # The last step is almost one half
    (chosen, place, lobe, turn), (*of_place, half) = numbers, SPREAD_STEPS
    return shifted(chosen, half), mi.Point2f(*map(shifted, place, of_place)), lobe, turn


def _less_carried(path: Path, met: MetEmitter, settings: PathSettings):
    """β for emission on the path, minus w β F1 where a virtual light represents the emitter."""
    if met.nearness is None or settings.plain:
        return path.throughput
    w = emitter_share(settings.emitters_squared_c, met.nearness, path.cosine)
    carried = settings.emitters_carried & (path.state == State.CONNECTING)
    return path.throughput - dr.select(carried, path.carried * w, 0)


def emitter_share(squared_c, nearness, cosine):
    """w for light straight from an emitter; ``nearness``: see :class:`vpl.split.emitters.base.EmitterSample`."""
    return carried_share(squared_c, nearness * cosine) & dr.isfinite(nearness)


def _carry(path: Path, hit: Hit, settings: PathSettings, radiance, gathered: Gathered):
    """Turn ``path.carried`` from β F1 into w β F1 F2 at x2, 0 elsewhere; record second vertices; return the x2 mask."""
    si, outward = hit.si, hit.lobe.outward
    cosine = dr.abs(dr.dot(si.n, path.ray.d))
    # A virtual light at x2 shines only to the side of the normal of its lobe
    connects = hit.smooth & (path.state == State.CONNECTING) & (dr.dot(hit.lobe.normal, path.ray.d) < 0)
    path.carried = dr.select(connects, path.carried * hit.minorant, 0)
    means = (channel_mean(x) for x in (path.carried, path.throughput, radiance))
    second = connects | (hit.smooth & (path.scattered == 1))
    # On the ray, like virtual lights: on large shapes, Mitsuba's point lies beside the ray
    arrival = SecondVertices(path.ray(si.t), outward, *means)
    squared_c = settings.c.squared(arrival.position, outward, connects)
    w = carried_share(squared_c, path.cosine * cosine / dr.square(si.t))
    gathered.second = select_record(second, arrival, gathered.second)
    path.carried = dr.select(connects, path.carried * w, 0)
    return connects


def _end_at_vertex(path: Path, hit: Hit, connects, settings: PathSettings, sample) -> None:
    """Russian roulette by the residual and by the expected contribution of the residual."""
    residual = mi.Float(1)
    if not settings.plain:
        reflected = path.throughput * hit.minorant
        residual = residual_survival(reflected - path.carried, reflected, connects & hit.is_diffuse)
    # Only after the first surface that counts in alpha: a path may pass masks before
    judged = hit.smooth & (path.scattered > 0) & path.valid
    expected = settings.outgoing.survival(hit.si.p, hit.facing, path.throughput, path.importance, residual)
    survival = dr.select(judged, expected, residual)
    hit.goes_on &= sample < survival
    hit.smooth &= hit.goes_on
    path.divide_by(survival)


def _gather(path: Path, hit: Hit, settings: PathSettings, gathered: Gathered, sample):
    """Record gather vertices: (mask, weight β F1 minus the part carried to the vertex by virtual lights).  Where
    virtual lights are placed, paths end at these vertices."""
    si, seeks = hit.si, hit.smooth & (path.state == State.SEEKING)
    gathers = seeks | (hit.smooth & (settings.gathering == Gathering.EVERYWHERE))
    # Without a map, both conditions are the same; a map may turn its normal around where it is seen from behind
    seen = agrees(si, hit.side) & (dr.dot(hit.lobe.normal, path.ray.d) < 0)
    gathers &= seen | (settings.gathering == Gathering.PLACING)
    gathers &= (dr.max(hit.minorant) > 0) & (settings.emitters_carried | (path.depth + 2 < settings.max_depth))
    weight = path.throughput * hit.minorant - path.carried
    gathers &= dr.all(dr.abs(weight) <= LARGEST_VALUE)
    weight = dr.select(gathers, weight, 0)
    gathered.add(GatherVertices(si.p, hit.lobe.normal, hit.lobe.outward, weight, path.depth + 1), seeks, sample)
    hit.goes_on &= settings.gathering != Gathering.PLACING
    hit.smooth &= hit.goes_on
    return gathers, weight


def _lit(
    path: Path, vertex: Vertex, sample: EmitterSample, value, density, settings: PathSettings, sampler
):  # fmt: skip
    """Three factors.  Of the light of the sampled emitters: β f, minus the parts carried by virtual lights.  Of light
    that passes null surfaces or glass, which virtual lights that represent emitters do not carry: the same without
    these parts.
    Of the weight of a sample: from one of several to a single sample.

    ``value`` of the BSDF; ``density`` with which :mod:`vpl.split.covered` draws the direction.
    """
    hit, share = vertex.hit, vertex.share
    value = beyond = full = path.throughput * mi.unpolarized_spectrum(value)
    if not settings.plain:
        cosine = hit.lobe.cosine(sample.direction)
        value = beyond = full - path.carried * cosine
        if sample.nearness is not None:
            w = emitter_share(settings.emitters_squared_c, sample.nearness, cosine)
            value = value - dr.select(settings.emitters_carried, vertex.weight * (w * cosine), 0)
            # Few shadow rays where the residual is small, unless they may pass glass, behind which nothing is carried
            survival = residual_survival(value, full, settings.emitters_carried & (path.toward is None))
            survives = sampler.next_1d() < survival
            value, beyond = (dr.select(survives, one / survival, 0) for one in (value, beyond))
    mis, single = (power_heuristic(sample.density, density * number) for number in (share, 1))
    mis, single = (dr.select(sample.is_point, 1, one) for one in (mis, single))
    mis = dr.select(hit.smooth & (sample.density > 0), share * mis, 0)
    ratio = dr.select(mis > 0, single / mis, 0)
    return value * mis, beyond * mis, ratio


def _end_at_direction(path: Path, hit: Hit, survival, settings: PathSettings, sample) -> None:
    """Russian roulette by ``survival``, the residual of the direction, and by the throughput, as in ``path``."""
    largest = dr.max(dr.abs(path.throughput))
    if path.carried is not None:
        # Even if the BSDF is 0, the minorant may need subtraction
        largest = dr.maximum(largest, dr.max(dr.abs(path.carried)))
    survival *= throughput_survival(largest, path.eta, path.depth >= settings.rr_depth)
    path.active = hit.goes_on & (largest > 0) & (sample < survival)
    path.divide_by(survival)


def _pass_hidden(path: Path, hit: Hit, first: FirstEdge) -> None:
    """Let paths continue behind emitters hidden from the camera, without scattering."""
    passes = hit.hidden & hit.si.is_valid()
    path.active |= passes
    path.density = dr.select(passes, first.density, path.density)
    path.throughput = dr.select(passes, first.throughput, path.throughput)
    path.delta, path.eta = path.delta | passes, dr.select(passes, 1, path.eta)
    if path.state is not None:
        path.state = dr.select(passes, mi.UInt32(State.SEEKING), path.state)
