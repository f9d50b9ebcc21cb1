"""State of the loop of :mod:`vpl.split.path_tracer`: settings, first edges, paths, surfaces that they hit, result."""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi

from ..core.arrays import ones
from ..core.materials import Materials
from ..transport.minorant import is_diffuse, minorant_of, side_of
from .gather_vertices import Gathered
from .local_c import LocalC
from .roulette import OutgoingRadiance


class State:
    """Position of a path relative to its first gather vertex x1: plain integers, for comparison with Dr.Jit arrays."""

    SEEKING = 1  # before x1
    CONNECTING = 2  # on the edge from a gather vertex to the next vertex
    PAST = 3  # on any other edge


class Gathering:
    """Vertices where irradiance from virtual lights is gathered, by the last state in which a minorant is evaluated."""

    NOWHERE = 0
    AT_FIRST = State.CONNECTING
    EVERYWHERE = State.PAST
    # Virtual lights are placed at the first vertices, also where the shading normal faces away: the density of lights
    # does not depend on the shading normal
    PLACING = State.PAST + 1


@dataclass
class PathSettings:
    """Settings of :func:`trace_paths`, opaque on the device unless stated.

    ``max_depth``, ``rr_depth``: as in ``path``; ``c``: of lights on surfaces; ``gathering``: a :class:`Gathering`;
    ``emitters_carried``: whether virtual lights represent emitters, with ``emitters_squared_c``; ``outgoing``: for
    Russian roulette; ``with_minorant``: materials with a minorant; ``hide_emitters``: a Python bool.
    """

    max_depth: mi.UInt32
    rr_depth: mi.UInt32
    c: LocalC
    gathering: mi.UInt32
    emitters_carried: mi.Bool
    emitters_squared_c: mi.Float
    outgoing: OutgoingRadiance
    with_minorant: Materials
    hide_emitters: bool


@dataclass
class Edge:
    """Edges of paths, one per lane.

    ``vertex``: origin; ``ray``; ``throughput``: β; ``density`` of the direction, 1 / sr; ``delta``: whether the
    direction has no density; ``state``: a :class:`State`; ``cell`` of the origin, see
    :class:`vpl.split.emitters.base.EmitterSampler`; ``emitter_samples``: their number at the origin;
    ``importance``: see :meth:`vpl.split.roulette.OutgoingRadiance.survival`; ``active``.
    """

    vertex: mi.Point3f
    ray: mi.Ray3f
    throughput: mi.UnpolarizedSpectrum
    density: mi.Float
    delta: mi.Bool
    state: mi.UInt32
    cell: mi.UInt32
    emitter_samples: mi.UInt32
    importance: mi.Float
    active: mi.Bool


@dataclass
class FirstEdge(Edge):
    """First edges of paths, evaluated; ``direct_samples``: number of emitter samples at the first scattering vertex."""

    direct_samples: mi.UInt32

    @classmethod
    def of_camera(cls, ray, importance, active, direct_samples) -> FirstEdge:
        """Rays without a surface at the origin, for example camera rays."""
        density = dr.opaque(mi.Float, 1.0, dr.width(ray.d))
        return cls.of(
            ray.o, ray, ones(len(density)), density, True, State.SEEKING, mi.UInt32(0), importance, active,
            direct_samples,
        )  # fmt: skip

    @classmethod
    def of(
        cls, vertex, ray, throughput, density, delta: bool, state: int, cell, importance, active, direct_samples
    ) -> FirstEdge:  # fmt: skip
        """Rays whose directions have a ``density``."""
        count = dr.width(ray.d)
        # Arrays of full width, opaque and distinct, give a single kernel for every use
        wide = dr.opaque(mi.Float, 0.0, count)
        limit, ray = ray.maxt + wide, mi.Ray3f(ray.o + wide, ray.d + wide, ray.time + wide)
        ray.maxt = limit
        active = mi.Bool(active) & dr.opaque(mi.Bool, True, count)
        edge = cls(
            vertex + dr.opaque(mi.Float, 0.0, count),
            ray,
            throughput,
            density,
            wide == (0 if delta else 1),
            dr.full(mi.UInt32, state, count),
            cell + dr.opaque(mi.UInt32, 0, count),
            dr.full(mi.UInt32, 1, count),
            importance + wide,
            active,
            direct_samples + dr.opaque(mi.UInt32, 0, count),
        )
        dr.make_opaque(edge)
        return edge


@dataclass
class Path(Edge):
    """Paths on their current edges.

    ``depth``: edges before; ``eta``: as in ``path``; ``scattered``: number of scattering vertices; ``valid``: whether
    the path met a surface counted in the film's alpha; ``carried``: β F1 before x2, w β F1 F2 at x2; ``cosine``: cosθ1.
    """

    depth: mi.UInt32
    eta: mi.Float
    scattered: mi.UInt32
    valid: mi.Bool
    carried: mi.UnpolarizedSpectrum
    cosine: mi.Float

    @classmethod
    def of(cls, first: FirstEdge) -> Path:
        """Paths on the first edges: copies, because the loop changes the arrays."""
        own = (getattr(first, field.name) for field in fields(Edge))
        copies = (type(value)(value) for value in own)
        carried = dr.zeros(mi.UnpolarizedSpectrum, dr.width(first.throughput))
        return cls(*copies, mi.UInt32(0), mi.Float(1), mi.UInt32(0), mi.Bool(False), carried, mi.Float(1))


@dataclass
class Hit:
    """Surfaces that paths hit.

    ``si``; ``bsdf`` with its ``flags``; ``side``, ``minorant``: see :mod:`vpl.transport.minorant`; ``hidden``: whether
    the surface is an emitter hidden from the camera; ``goes_on``: whether the path may continue; ``smooth``: whether
    the path continues at a BSDF with a density.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    flags: mi.UInt32
    side: mi.Float
    minorant: mi.UnpolarizedSpectrum
    hidden: mi.Bool
    goes_on: mi.Bool
    smooth: mi.Bool

    @classmethod
    def of(cls, scene, path: Path, settings: PathSettings) -> Hit:
        """Intersect the rays with the scene."""
        si = scene.ray_intersect(path.ray, mi.RayFlags.All, coherent=path.depth == 0, active=path.active)
        bsdf, hidden = si.bsdf(path.ray), mi.Bool(False)
        if settings.hide_emitters:
            from_camera = path.active & (path.depth == 0) & (path.state == State.SEEKING)
            from_camera &= settings.gathering != Gathering.PLACING
            hidden = from_camera & (~si.is_valid() | si.shape.is_emitter())
        goes_on = path.active & si.is_valid() & (path.depth + 1 < settings.max_depth) & ~hidden
        flags, side = bsdf.flags(), side_of(si)
        smooth = goes_on & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        minorant = minorant_of(si, bsdf, side, settings.with_minorant, smooth & (settings.gathering >= path.state))
        return cls(si, bsdf, flags, side, minorant, hidden, goes_on, smooth)

    @property
    def is_diffuse(self) -> mi.Bool:
        """Whether the BSDF has only a diffuse lobe."""
        return is_diffuse(self.flags)


@dataclass
class Vertex:
    """Vertices where paths scatter.

    ``hit``; ``gathers``, ``weight``: mask and weights of gather vertices; ``cell`` of the emitter sampler; ``samples``:
    number of emitter samples; ``numbers`` of the lattice.
    """

    hit: Hit
    gathers: mi.Bool
    weight: mi.UnpolarizedSpectrum
    cell: mi.UInt32
    samples: mi.UInt32
    numbers: tuple


@dataclass
class Traced:
    """Result of :func:`trace_paths`, one record per lane, evaluated.

    ``radiance``; ``drawn``: a contribution over its probability, from a path of ``length`` edges to an emitter of
    ``group``; ``seen``: emission at the end of the first edge, mean over channels; ``difference``: contributions of the
    emitter samples with even numbers at the first scattering vertex less those with odd numbers, mean over channels;
    ``alone_excess``: radiance with the first of these samples alone, weighted as a single sample, less ``radiance``,
    mean over channels; ``valid``: whether a surface counts in the film's alpha; ``edges`` without the last;
    ``gathered``: gather vertices.
    """

    radiance: mi.UnpolarizedSpectrum
    drawn: mi.UnpolarizedSpectrum
    length: mi.UInt32
    group: mi.UInt32
    seen: mi.Float
    difference: mi.Float
    alone_excess: mi.Float
    valid: mi.Bool
    edges: mi.UInt32
    gathered: Gathered
