"""The traced part of the split: paths as Mitsuba's ``path`` follows them, less what virtual lights carry.

A path from the camera goes on through mirrors and glass to its first vertex with a floor, x1, where virtual lights are
gathered.  What its next vertex x2 would send back by w F1 F2 is theirs (:mod:`vpl.split.floors`) and is taken off the
BSDF of x2, in next-event estimation as well as in the throughput of the path, which goes on from x2 as ``path`` would.
The rest may be negative.  Russian roulette by how much is left ends most paths at x2: nearly all of them where both
surfaces are Lambertian and far apart.  What goes on may be gathered in turn, at x2 and wherever there is a floor.

The same kernel follows paths of which nothing is taken off: those that find the irradiance of a virtual light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import LARGEST_VALUE, channel_mean, ones, select_record
from ..direct.emitter_sampling import power_heuristic
from ..lights.perturbed import Perturbed
from .floors import agrees, carried_share, floor_of, side_of
from .gather_vertices import Arrival, GatherVertices
from .worth import Worth

# Where a path is: before its first vertex with a floor; on its way from one where lights are gathered to the next
# vertex; and anywhere else
SEEKING, CONNECTING, PAST = range(1, 4)
# Where lights are gathered: the last state in which floors are looked at
NOWHERE, AT_FIRST, EVERYWHERE = 0, CONNECTING, PAST
# No path is ended with more than this probability because little is left of it: what is left is known only roughly
_LEAST_SURVIVAL = 0.02


@dataclass
class Limits:
    """``max_depth`` (edges), ``rr_depth``: as in ``path``, UInt32; ``squared_c``: of the split, world units²;
    ``gathering``: where lights are gathered, NOWHERE, AT_FIRST or EVERYWHERE; all opaque.

    ``worth`` of following paths; ``perturbed``: shapes without a floor; ``hide_emitters``: of Python.
    """

    max_depth: object
    rr_depth: object
    squared_c: object
    gathering: object
    worth: Worth
    perturbed: Perturbed
    hide_emitters: bool


@dataclass
class FirstEdge:
    """First edges of paths, one per lane, evaluated.

    ``vertex``: where they begin; ``ray``; ``throughput``: unpolarized spectrum; ``density``: of the direction, per
    solid angle; ``delta``: whether it was drawn from none; ``state``: see above; ``site``: of the vertex,
    :mod:`vpl.split.next_event`; ``importance``: of radiance, :mod:`vpl.split.worth`; ``active``.
    """

    vertex: object
    ray: object
    throughput: object
    density: object
    delta: object
    state: object
    site: object
    importance: object
    active: object

    @classmethod
    def of_camera(cls, ray, importance, active) -> FirstEdge:
        """Camera rays."""
        density = dr.opaque(mi.Float, 1.0, dr.width(ray.d))
        return cls.of(ray.o, ray, ones(len(density)), density, True, SEEKING, mi.UInt32(0), importance, active)

    @classmethod
    def of(cls, vertex, ray, throughput, density, delta: bool, state: int, site, importance, active) -> FirstEdge:
        """Rays in directions of a density."""
        count = dr.width(ray.d)
        # Opaque and of full width, so that all paths are followed by one kernel
        wide = dr.opaque(mi.Float, 0.0, count)
        ray = mi.Ray3f(ray.o + wide, ray.d + wide, ray.time + wide)
        ray.maxt = dr.largest(mi.Float) + wide
        active = mi.Bool(active) & (wide == 0)
        edge = cls(
            vertex + wide,
            ray,
            throughput,
            density,
            wide == (0 if delta else 1),
            dr.full(mi.UInt32, state, count),
            site + dr.opaque(mi.UInt32, 0, count),
            importance + wide,
            active,
        )
        dr.make_opaque(edge)
        return edge


@dataclass
class Found:
    """What a path found: ``radiance``; ``drawn``: one of the contributions that it is the sum of, drawn by its share
    and divided by the probability of that; ``length``: edges of the path that brought this one; ``valid``: whether a
    surface was met that the film's alpha shows; ``edges``: of the path, but the last."""

    radiance: object
    drawn: object
    length: object
    valid: object
    edges: object


def follow(scene, emission, first: FirstEdge, numbers, sampler, limits: Limits):
    """Follow paths to their ends: (:class:`Found`, first gather vertices, one of the later ones, drawn by weight, and
    :class:`Arrival`), evaluated.

    ``emission``: how emitters are sampled, see :mod:`vpl.split.next_event`; ``numbers``
    (:class:`vpl.split.numbers.SpreadNumbers`): choose an emitter, a place on it, a lobe, and a direction at vertices
    that scatter; ``sampler``: for all else.
    """
    # Looking for what a loop does not change records its body, all materials of the scene, twice
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        return _follow(scene, emission, first, numbers, sampler, limits)


@dr.syntax
def _follow(scene, emission, first: FirstEdge, numbers, sampler, limits: Limits):
    # With lobes other than a diffuse reflection, the floor does not tell how much is left
    other_lobes = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
    context, count = mi.BSDFContext(), dr.width(first.throughput)
    radiance, drawn = dr.zeros(mi.UnpolarizedSpectrum, count), dr.zeros(mi.UnpolarizedSpectrum, count)
    length, level = mi.UInt32(0), mi.Float(0)
    vertex, ray = mi.Point3f(first.vertex), mi.Ray3f(first.ray)
    throughput, active = mi.UnpolarizedSpectrum(first.throughput), mi.Bool(first.active)
    density, delta, state = mi.Float(first.density), mi.Bool(first.delta), mi.UInt32(first.state)
    depth, eta, valid, scattered = mi.UInt32(0), mi.Float(1), mi.Bool(False), mi.UInt32(0)
    site, importance = mi.UInt32(first.site), mi.Float(first.importance)
    # Of what x1 sends on, the part that virtual lights carry but for w and the floor of x2; and the cosine there
    carried, cosine = dr.zeros(mi.UnpolarizedSpectrum, count), mi.Float(1)
    vertices = GatherVertices.none(count)
    later, all_later = GatherVertices.none(count), mi.Float(0)
    arrival = Arrival.none()

    while dr.hint(active, exclude=[first, numbers, limits, emission, context, count, other_lobes]):
        # ---------------------- Next vertex ----------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
        bsdf = si.bsdf(ray)
        hidden = mi.Bool(False)
        if dr.hint(limits.hide_emitters, mode="scalar"):
            hidden = active & (depth == 0) & (~si.is_valid() | si.shape.is_emitter())

        # ---------------------- Emission, by BSDF sampling ----------------------
        emitted, other = emission.met(vertex, site, ray, si, ~delta, active & ~hidden)
        contribution = throughput * emitted * power_heuristic(density, other)
        radiance += contribution
        drawn, length, level = _draw(drawn, length, level, contribution, depth + 1, sampler)

        # ---------------------- What virtual lights carry ----------------------
        goes_on = active & si.is_valid() & (depth + 1 < limits.max_depth) & ~hidden
        flags, side = bsdf.flags(), side_of(si)
        smooth = goes_on & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        floor = floor_of(si, bsdf, side, limits.perturbed, smooth & (limits.gathering >= state))
        w = carried_share(limits.squared_c, cosine, dr.abs(dr.dot(si.n, ray.d)), dr.square(si.t))
        # Lights at x2 shine to where its shading normal faces, too
        connects = smooth & (state == CONNECTING) & agrees(si, side)
        carried = dr.select(connects, carried * floor, 0)
        met = si.n * dr.mulsign(mi.Float(1), -dr.dot(si.n, ray.d))
        means = (channel_mean(x) for x in (carried, throughput, radiance))
        arrival = select_record(connects | (smooth & (scattered == 1)), Arrival(si.p, met, *means), arrival)
        carried *= w

        # ---------------------- Russian roulette by what is left, and by what that may bring ----------------------
        reflected = throughput * floor
        left = dr.max(dr.abs(reflected - carried)) / dr.max(dr.abs(reflected))
        left = dr.select(connects & ((flags & other_lobes) == 0), dr.clip(left, _LEAST_SURVIVAL, 1), 1)
        left = dr.select(dr.isfinite(left), left, 1)
        # Not before a surface was met that alpha shows: paths that have only passed masks are still to find one
        judged = smooth & (scattered == 1) & valid
        survival = dr.select(judged, limits.worth.survival(si, side, throughput, importance, left), left)
        goes_on &= sampler.next_1d() < survival
        smooth &= goes_on
        throughput /= survival
        carried /= survival

        # ---------------------- A vertex where lights are gathered ----------------------
        seeks = smooth & (state == SEEKING)
        gathers = (seeks | (smooth & (limits.gathering == EVERYWHERE))) & agrees(si, side) & (dr.max(floor) > 0)
        gathers &= depth + 2 < limits.max_depth
        weight = throughput * floor - carried
        gathers &= dr.all(dr.abs(weight) <= LARGEST_VALUE)
        weight = dr.select(gathers, weight, 0)
        here = GatherVertices(si.p, si.sh_frame.n * side, si.n, weight, depth + 1)
        vertices = select_record(seeks, here, vertices)
        amount = dr.select(gathers & ~seeks, channel_mean(dr.abs(weight)), 0)
        all_later += amount
        taken = sampler.next_1d() * all_later < amount
        later = select_record(taken, here, later)

        # ---------------------- Emission, by next-event estimation ----------------------
        chosen, place, lobe, turn = numbers.at(scattered)
        scattered += dr.select(smooth, 1, 0)
        site, member = emission.site(si, side), sampler.next_1d()
        toward, incident, density_there, is_point = emission.sample(si, site, chosen, member, place, smooth)
        local = si.to_local(toward)
        value, density_here = bsdf.eval_pdf(context, si, local, smooth)
        value = throughput * mi.unpolarized_spectrum(value)
        value -= dr.select(local.z * side > 0, carried * dr.abs(local.z), 0)
        mis = dr.select(is_point, 1, power_heuristic(density_there, density_here))
        contribution = dr.select(smooth & (density_there > 0), value * incident * mis, 0)
        radiance += contribution
        drawn, length, level = _draw(drawn, length, level, contribution, depth + 2, sampler)

        # ---------------------- Next direction ----------------------
        lobe = dr.select(smooth, lobe, sampler.next_1d())
        turn = dr.select(smooth, turn, sampler.next_2d())
        bs, share = bsdf.sample(context, si, lobe, turn, active & ~hidden)
        full = throughput * mi.unpolarized_spectrum(share)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        # As in `path`, by the direction that is drawn, even where the path ends
        valid |= active & si.is_valid() & ~hidden & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        cosine, density, eta = dr.abs(bs.wo.z), bs.pdf, eta * bs.eta
        # Lambertian reflection over the density of the direction
        lambertian = dr.select(~delta & (bs.wo.z * side > 0) & (density > 0), cosine / density, 0)
        throughput = full - carried * lambertian
        kept = dr.max(dr.abs(throughput)) / dr.max(dr.abs(full))
        kept = dr.select((dr.max(carried) > 0) & dr.isfinite(kept), dr.clip(kept, _LEAST_SURVIVAL, 1), 1)
        carried = weight * lambertian
        onward = dr.select(gathers & ~delta, mi.UInt32(CONNECTING), mi.UInt32(PAST))
        state = dr.select((state == SEEKING) & ~gathers, mi.UInt32(SEEKING), onward)
        ray, vertex = si.spawn_ray(dr.select(hidden, ray.d, si.to_world(bs.wo))), mi.Point3f(si.p)
        depth += dr.select(goes_on, 1, 0)

        # ---------------------- Russian roulette: as in `path`, and by what is left ----------------------
        # Where a BSDF is 0 its floor may still have to be taken off
        most = dr.maximum(dr.max(dr.abs(throughput)), dr.max(dr.abs(carried)))
        survival = dr.minimum(most * dr.square(eta), 0.95)
        survival = kept * dr.select(depth >= limits.rr_depth, survival, 1)
        active = goes_on & (most > 0) & (sampler.next_1d() < survival)
        throughput /= survival
        carried /= survival
        if dr.hint(limits.hide_emitters, mode="scalar"):
            passes = hidden & si.is_valid()
            active |= passes
            throughput = dr.select(passes, first.throughput, throughput)
            delta, eta = delta | passes, dr.select(passes, 1, eta)
            state = dr.select(passes, mi.UInt32(SEEKING), state)

    found = Found(radiance, drawn * dr.select(level > 0, level / dr.sum(dr.abs(drawn)), 0), length, valid, depth)
    later.weight *= dr.select(all_later > 0, all_later / channel_mean(dr.abs(later.weight)), 0)
    dr.eval(found, vertices, later, arrival)
    return found, vertices, later, arrival


def _draw(drawn, length, level, contribution, edges, sampler):
    """Keep one of all contributions so far, drawn by its share of their sum: (contribution, its length, sum)."""
    more = dr.sum(dr.abs(contribution))
    taken = sampler.next_1d() * (level + more) < more
    return dr.select(taken, contribution, drawn), dr.select(taken, edges, length), level + more
