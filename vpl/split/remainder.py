"""The traced part of the split: paths as Mitsuba's ``path`` follows them, less what virtual lights carry.

A path from the camera goes on through mirrors and glass to its first vertex with a floor, x1, where virtual lights are
gathered.  What its next vertex x2 would send back by w F1 F2 is theirs (:mod:`vpl.split.floors`) and is taken off the
BSDF of x2, in next-event estimation as well as in the throughput of the path, which goes on from x2 as ``path`` would.
The rest may be negative.  Russian roulette by how much is left ends most paths at x2: nearly all of them where both
surfaces are Lambertian and far apart.  What goes on may be gathered in turn, at x2 and wherever there is a floor.

Where virtual lights stand for emitters, too, light that comes straight from these is taken off in the same two ways
wherever lights are gathered.

The same kernel follows paths of which nothing is taken off: those that find the irradiance of a virtual light.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.arrays import channel_mean, select_record
from ..core.loops import recorded_once
from ..direct.emitter_sampling import power_heuristic
from .emitter_samples import EmitterSample, MetEmitter
from .floors import agrees, carried_share, carried_share_of_emitter
from .gather_vertices import Arrival
from .paths import CONNECTING, PAST, PLACING, SEEKING, FirstEdge, Found, Gains, Gathered, Limits, Met, Path

# Paths and shadow rays go on with this probability at least, however little is left: that is known only roughly
_LEAST_SURVIVAL = 0.02


@recorded_once
@dr.syntax
def follow(scene, emission, first: FirstEdge, numbers, sampler, limits: Limits):
    """Follow paths to their ends: (:class:`Found`, first gather vertices, one of the later ones, drawn by weight, and
    :class:`Arrival`), evaluated.

    ``emission``: how emitters are sampled, see :mod:`vpl.split.next_event`; ``numbers``
    (:class:`vpl.split.numbers.SpreadNumbers`): choose an emitter, a place on it, a lobe, and a direction at vertices
    that scatter; ``sampler``: for all else.
    """
    context, count = mi.BSDFContext(), dr.width(first.throughput)
    path, gains, gathered = Path.of(first), Gains.none(count), Gathered.none(count)

    while dr.hint(path.active, exclude=[first, numbers, limits, emission, context]):
        met = Met.by(scene, path, limits)
        # Emission, by BSDF sampling
        emitter = emission.met(path.vertex, path.site, path.ray, met.si, ~path.delta, path.active & ~met.hidden)
        mis = power_heuristic(path.density, emitter.density)
        gains.add(_left_of_emitter(path, emitter, limits) * emitter.radiance * mis, path.depth + 1, sampler)
        connects = _carry(path, met, limits, gains.radiance, gathered)
        _end_by_worth(path, met, connects, limits, sampler)
        gathers, weight = gathered.add(path, met, limits, sampler)
        # Where lights are placed, that is all
        met.goes_on &= limits.gathering != PLACING
        met.smooth &= met.goes_on
        # Emission, by next-event estimation
        chosen, place, lobe, turn = numbers.at(path.scattered)
        path.scattered += dr.select(met.smooth, 1, 0)
        path.site, member = emission.choice.site(met.si.p, met.si.sh_frame.n * met.side), sampler.next_1d()
        sample = emission.sample(met.si, path.site, chosen, member, place, met.smooth)
        lobe = dr.select(met.smooth, lobe, sampler.next_1d())
        turn = dr.select(met.smooth, turn, sampler.next_2d())
        # One call: kernels hold the code of all materials for each
        toward = met.si.to_local(sample.direction)
        value, density, turned, share = met.bsdf.eval_pdf_sample(
            context, met.si, toward, lobe, turn, path.active & ~met.hidden
        )  # fmt: skip
        lit = _lit(path, met, sample, toward.z, value, density, weight, limits, sampler)
        gains.add(lit * sample.arriving(scene, dr.max(dr.abs(lit)) > 0), path.depth + 2, sampler)
        kept = _turn(path, met, turned, share, gathers, weight)
        _end_as_path(path, met, kept, limits, sampler)
        if dr.hint(limits.hide_emitters, mode="scalar"):
            _pass_hidden(path, met, first)

    drawn = gains.drawn * dr.select(gains.level > 0, gains.level / dr.sum(dr.abs(gains.drawn)), 0)
    found = Found(gains.radiance, drawn, gains.length, path.valid, path.depth)
    later, whole = gathered.later, gathered.all_later
    later.weight *= dr.select(whole > 0, whole / channel_mean(dr.abs(later.weight)), 0)
    dr.eval(found, gathered.first, later, gathered.arrival)
    return found, gathered.first, later, gathered.arrival


def _carry(path: Path, met: Met, limits: Limits, radiance, gathered: Gathered):
    """Find what virtual lights carry of what paths would reflect: where, if anything."""
    si = met.si
    w = carried_share(limits.squared_c, path.cosine, dr.abs(dr.dot(si.n, path.ray.d)), dr.square(si.t))
    # Lights at x2 shine to where its shading normal faces, too
    connects = met.smooth & (path.state == CONNECTING) & agrees(si, met.side)
    path.carried = dr.select(connects, path.carried * met.floor, 0)
    outward = si.n * dr.mulsign(mi.Float(1), -dr.dot(si.n, path.ray.d))
    means = (channel_mean(x) for x in (path.carried, path.throughput, radiance))
    second = connects | (met.smooth & (path.scattered == 1))
    gathered.arrival = select_record(second, Arrival(si.p, outward, *means), gathered.arrival)
    path.carried *= w
    return connects


def _end_by_worth(path: Path, met: Met, connects, limits: Limits, sampler) -> None:
    """Russian roulette by what is left to trace, and by what that may bring."""
    reflected = path.throughput * met.floor
    left = dr.max(dr.abs(reflected - path.carried)) / dr.max(dr.abs(reflected))
    left = dr.select(connects & _is_diffuse(met), dr.clip(left, _LEAST_SURVIVAL, 1), 1)
    left = dr.select(dr.isfinite(left), left, 1)
    # Not before a surface was met that alpha shows: paths that have only passed masks are still to find one
    judged = met.smooth & (path.scattered > 0) & path.valid
    by_worth = limits.worth.survival(met.si, met.side, path.throughput, path.importance, left)
    survival = dr.select(judged, by_worth, left)
    met.goes_on &= sampler.next_1d() < survival
    met.smooth &= met.goes_on
    path.throughput /= survival
    path.carried /= survival


def _is_diffuse(met: Met):
    """Whether the floor is all that surfaces reflect, so that it tells how much is left whatever the direction."""
    other_lobes = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
    return (met.flags & other_lobes) == 0


def _left_of_emitter(path: Path, emitter: MetEmitter, limits: Limits):
    """Throughput with which an emitter is met, less what virtual lights that stand for it carry."""
    if emitter.nearness is None:
        return path.throughput
    w = carried_share_of_emitter(limits.emitters_squared_c, emitter.nearness, path.cosine)
    carried = limits.emitters_carried & (path.state == CONNECTING)
    return path.throughput - dr.select(carried, path.carried * w, 0)


def _lit(path: Path, met: Met, sample: EmitterSample, height, value, density, weight, limits: Limits, sampler):
    """What paths bring of the light of the emitters that were sampled, less what virtual lights carry.  ``height``: of
    the direction above the surface, ``value`` and ``density`` that the BSDF has there; ``weight``: of the gather vertex
    that this is, or 0."""
    full = path.throughput * mi.unpolarized_spectrum(value)
    cosine = dr.select(height * met.side > 0, dr.abs(height), 0)
    value = full - path.carried * cosine
    if sample.nearness is not None:
        w = carried_share_of_emitter(limits.emitters_squared_c, sample.nearness, cosine)
        value -= dr.select(limits.emitters_carried, weight * (w * cosine), 0)
        # Few shadow rays, where little is left
        left = dr.max(dr.abs(value)) / dr.max(dr.abs(full))
        left = dr.select(limits.emitters_carried & dr.isfinite(left), dr.clip(left, _LEAST_SURVIVAL, 1), 1)
        value = dr.select(sampler.next_1d() < left, value / left, 0)
    mis = dr.select(sample.is_point, 1, power_heuristic(sample.density, density))
    return dr.select(met.smooth & (sample.density > 0), value * mis, 0)


def _turn(path: Path, met: Met, bs, share, gathers, weight):
    """Take the direction that the BSDF has drawn, ``bs`` with its weight ``share``: how much virtual lights leave of
    what goes there.  ``gathers``, ``weight``: whether lights are gathered here."""
    full = path.throughput * mi.unpolarized_spectrum(share)
    path.delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    # As in `path`, by the direction that is drawn, even where the path ends
    null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    path.valid |= path.active & met.si.is_valid() & ~met.hidden & ~null
    path.cosine, path.density, path.eta = dr.abs(bs.wo.z), bs.pdf, path.eta * bs.eta
    # Lambertian reflection over the density of the direction
    lambertian = ~path.delta & (bs.wo.z * met.side > 0) & (path.density > 0)
    lambertian = dr.select(lambertian, path.cosine / path.density, 0)
    path.throughput = full - path.carried * lambertian
    kept = dr.max(dr.abs(path.throughput)) / dr.max(dr.abs(full))
    # Where that was known beforehand, paths have ended by it already
    judged = (dr.max(dr.abs(path.carried)) > 0) & ~_is_diffuse(met) & dr.isfinite(kept)
    kept = dr.select(judged, dr.clip(kept, _LEAST_SURVIVAL, 1), 1)
    path.carried = weight * lambertian
    onward = dr.select(gathers & ~path.delta, mi.UInt32(CONNECTING), mi.UInt32(PAST))
    path.state = dr.select((path.state == SEEKING) & ~gathers, mi.UInt32(SEEKING), onward)
    path.ray = met.si.spawn_ray(dr.select(met.hidden, path.ray.d, met.si.to_world(bs.wo)))
    path.vertex = mi.Point3f(met.si.p)
    path.depth += dr.select(met.goes_on, 1, 0)
    return kept


def _end_as_path(path: Path, met: Met, kept, limits: Limits, sampler) -> None:
    """Russian roulette as in ``path``, and by what is left of a direction."""
    # Where a BSDF is 0 its floor may still have to be taken off
    most = dr.maximum(dr.max(dr.abs(path.throughput)), dr.max(dr.abs(path.carried)))
    survival = dr.minimum(most * dr.square(path.eta), 0.95)
    survival = kept * dr.select(path.depth >= limits.rr_depth, survival, 1)
    path.active = met.goes_on & (most > 0) & (sampler.next_1d() < survival)
    path.throughput /= survival
    path.carried /= survival


def _pass_hidden(path: Path, met: Met, first: FirstEdge) -> None:
    """Let paths go on behind emitters that are not shown, as if nothing had been there."""
    passes = met.hidden & met.si.is_valid()
    path.active |= passes
    path.throughput = dr.select(passes, first.throughput, path.throughput)
    path.delta, path.eta = path.delta | passes, dr.select(passes, 1, path.eta)
    path.state = dr.select(passes, mi.UInt32(SEEKING), path.state)
