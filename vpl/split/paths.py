"""Paths: where they begin, what they keep to, what they carry along from vertex to vertex, and what they find."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import LARGEST_VALUE, channel_mean, ones, select_record
from ..lights.perturbed import Perturbed
from .floors import agrees, floor_of, side_of
from .gather_vertices import Arrival, GatherVertices
from .worth import Worth

# Where a path is: before its first vertex with a floor; on its way from one where lights are gathered to the next
# vertex; and anywhere else
SEEKING, CONNECTING, PAST = range(1, 4)
# Where lights are gathered: the last state in which floors are looked at. Where they are placed, as at a first vertex,
# but even if it is seen from behind its shading normal: the density of lights knows nothing of that
NOWHERE, AT_FIRST, EVERYWHERE, PLACING = 0, CONNECTING, PAST, PAST + 1


@dataclass(frozen=True)
class Rules:
    """Rules of whole paths, as in ``path``: ``max_depth`` (edges, may be infinite), ``rr_depth``, ``hide_emitters``."""

    max_depth: float
    rr_depth: int
    hide_emitters: bool


@dataclass
class Limits:
    """``max_depth`` (edges), ``rr_depth``: as in ``path``, UInt32; ``squared_c``: of the split, world units²;
    ``gathering``: where lights are gathered or placed, NOWHERE, AT_FIRST, EVERYWHERE or PLACING; ``emitters_carried``:
    whether virtual lights stand for emitters, too, and ``emitters_squared_c`` of these; all opaque.

    ``worth`` of following paths; ``perturbed``: shapes without a floor; ``hide_emitters``: of Python.
    """

    max_depth: object
    rr_depth: object
    squared_c: object
    gathering: object
    emitters_carried: object
    emitters_squared_c: object
    worth: Worth
    perturbed: Perturbed
    hide_emitters: bool


@dataclass
class Edge:
    """Edges of paths, one per lane.

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


@dataclass
class FirstEdge(Edge):
    """First edges of paths, evaluated."""

    @classmethod
    def of_camera(cls, ray, importance, active) -> FirstEdge:
        """Camera rays, and others that begin at no surface."""
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
        # An array of its own, even where all are active and none was drawn from a density
        active = mi.Bool(active) & dr.opaque(mi.Bool, True, count)
        edge = cls(
            # An array of its own, even where rays begin at the vertex itself
            vertex + dr.opaque(mi.Float, 0.0, count),
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
class Path(Edge):
    """Paths on their way along their last edges.

    ``depth``: edges before; ``eta``: as in ``path``; ``scattered``: how many vertices did; ``valid``: whether a surface
    was met that the film's alpha shows.  ``carried``, ``cosine``: of what the last vertex, x1, sends on, the part that
    virtual lights carry but for w and the floor of x2; and the cosine there.
    """

    depth: object
    eta: object
    scattered: object
    valid: object
    carried: object
    cosine: object

    @classmethod
    def of(cls, first: FirstEdge) -> Path:
        """Paths that have begun."""
        # Copies, which the loop changes
        fields = (type(value)(value) for value in vars(first).values())
        carried = dr.zeros(mi.UnpolarizedSpectrum, dr.width(first.throughput))
        return cls(*fields, mi.UInt32(0), mi.Float(1), mi.UInt32(0), mi.Bool(False), carried, mi.Float(1))


@dataclass
class Met:
    """What paths meet next: ``si``, ``bsdf``, its ``flags``; ``side``, ``floor``, see :mod:`vpl.split.floors`;
    ``hidden``: whether it is an emitter that is not shown; ``goes_on``: whether a path may; ``smooth``: and scatters in
    directions that have a density."""

    si: object
    bsdf: object
    flags: object
    side: object
    floor: object
    hidden: object
    goes_on: object
    smooth: object

    @classmethod
    def by(cls, scene, path: Path, limits: Limits) -> Met:
        """What paths meet."""
        si = scene.ray_intersect(path.ray, mi.RayFlags.All, coherent=path.depth == 0, active=path.active)
        bsdf, hidden = si.bsdf(path.ray), mi.Bool(False)
        if limits.hide_emitters:
            # By rays from the camera alone
            seen = path.active & (path.depth == 0) & (path.state == SEEKING) & (limits.gathering != PLACING)
            hidden = seen & (~si.is_valid() | si.shape.is_emitter())
        goes_on = path.active & si.is_valid() & (path.depth + 1 < limits.max_depth) & ~hidden
        flags, side = bsdf.flags(), side_of(si)
        smooth = goes_on & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        floor = floor_of(si, bsdf, side, limits.perturbed, smooth & (limits.gathering >= path.state))
        return cls(si, bsdf, flags, side, floor, hidden, goes_on, smooth)


@dataclass
class Gains:
    """The ``radiance`` that paths found, and one of the contributions to it, drawn by its share: ``drawn``, its
    ``length``; ``level``: the sum of all shares."""

    radiance: object
    drawn: object
    length: object
    level: object

    @classmethod
    def none(cls, count: int) -> Gains:
        """No gains yet."""
        radiance, drawn = dr.zeros(mi.UnpolarizedSpectrum, count), dr.zeros(mi.UnpolarizedSpectrum, count)
        return cls(radiance, drawn, mi.UInt32(0), mi.Float(0))

    def add(self, contribution, edges, sampler) -> None:
        """Add a contribution that paths of so many edges bring."""
        self.radiance += contribution
        more = dr.sum(dr.abs(contribution))
        taken = sampler.next_1d() * (self.level + more) < more
        self.drawn, self.length = dr.select(taken, contribution, self.drawn), dr.select(taken, edges, self.length)
        self.level += more


@dataclass
class Gathered:
    """Vertices where lights are gathered: the ``first`` of each path, and one of those ``later``, drawn by weight, of
    which there is ``all_later``; ``arrival``, see :class:`Arrival`."""

    first: GatherVertices
    later: GatherVertices
    all_later: object
    arrival: Arrival

    @classmethod
    def none(cls, count: int) -> Gathered:
        """No vertices yet."""
        return cls(GatherVertices.none(count), GatherVertices.none(count), mi.Float(0), Arrival.none())

    def add(self, path: Path, met: Met, limits: Limits, sampler):
        """Add the vertices that are met, where lights are gathered: (whether they are, their weight)."""
        si = met.si
        seeks = met.smooth & (path.state == SEEKING)
        gathers = seeks | (met.smooth & (limits.gathering == EVERYWHERE))
        gathers &= agrees(si, met.side) | (limits.gathering == PLACING)
        gathers &= (dr.max(met.floor) > 0) & (limits.emitters_carried | (path.depth + 2 < limits.max_depth))
        weight = path.throughput * met.floor - path.carried
        gathers &= dr.all(dr.abs(weight) <= LARGEST_VALUE)
        weight = dr.select(gathers, weight, 0)
        here = GatherVertices(si.p, si.sh_frame.n * met.side, si.n, weight, path.depth + 1)
        self.first = select_record(seeks, here, self.first)
        amount = dr.select(gathers & ~seeks, channel_mean(dr.abs(weight)), 0)
        self.all_later += amount
        taken = sampler.next_1d() * self.all_later < amount
        self.later = select_record(taken, here, self.later)
        return gathers, weight


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
