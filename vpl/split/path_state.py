"""State of the loop of :mod:`vpl.split.path_tracer`: settings, first edges, paths, surfaces that they hit, result."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi

from ..core.arrays import ones
from ..points.camera_paths import SceneTraits
from ..transport.minorant import Lobe, Minorants, is_diffuse, side_of
from .contributions import Contributions
from .emitters.base import EmitterSampler
from .gather_vertices import Gathered
from .local_c import LocalC
from .onward import RelayChoice
from .relays import Relays
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
    Russian roulette; ``minorants`` of materials; ``hide_emitters``: a Python bool.

    Two more Python bools; ``plain`` and not ``several`` make smaller kernels.  ``plain``: whether paths find only
    radiance and alpha: virtual lights carry nothing, and there are no records for decisions and lights.  ``several``:
    whether first scattering vertices may have several emitter samples.

    ``meets_relays``: whether paths record light by way of relays (a Python bool), also those of the image, which share
    the kernel of the pilot; ``relays``: targets of paths, or None.
    """

    max_depth: mi.UInt32
    rr_depth: mi.UInt32
    c: LocalC
    gathering: mi.UInt32
    emitters_carried: mi.Bool
    emitters_squared_c: mi.Float
    outgoing: OutgoingRadiance
    minorants: Minorants
    hide_emitters: bool
    plain: bool = False
    several: bool = True
    meets_relays: bool = False
    relays: Relays | None = None


@dataclass
class Edge:
    """Edges of paths, one per lane.

    ``vertex``: origin; ``ray``; ``throughput``: β; ``density`` of the direction, 1 / sr; ``delta``: whether the
    direction has no density; ``state``: a :class:`State`, None for plain paths; ``cell`` of the origin, see
    :class:`vpl.split.emitters.base.EmitterSampler`; ``emitter_samples``: their number at the origin;
    ``importance``: see :meth:`vpl.split.roulette.OutgoingRadiance.survival`; ``active``.
    """

    vertex: mi.Point3f
    ray: mi.Ray3f
    throughput: mi.UnpolarizedSpectrum
    density: mi.Float
    delta: mi.Bool
    state: mi.UInt32 | None
    cell: mi.UInt32
    emitter_samples: mi.UInt32
    importance: mi.Float
    active: mi.Bool


@dataclass
class FirstEdge(Edge):
    """First edges of paths; ``direct_samples``: number of emitter samples at the first scattering vertex."""

    direct_samples: mi.UInt32

    @classmethod
    def plain(cls, ray, importance, active, direct_samples) -> FirstEdge:
        """Camera rays of plain paths, not evaluated.  Evaluating them takes up to a tenth of the time of the paths."""
        one = dr.ones(mi.UnpolarizedSpectrum, dr.width(ray.d))
        return cls(
            mi.Point3f(ray.o), ray, one, mi.Float(1), mi.Bool(True), None, mi.UInt32(0), mi.UInt32(1), importance,
            active, direct_samples,
        )  # fmt: skip

    @classmethod
    def of_camera(cls, ray, importance, active, direct_samples) -> FirstEdge:
        """Rays without a surface at the origin, for example camera rays, evaluated."""
        density = dr.opaque(mi.Float, 1.0, dr.width(ray.d))
        return cls.of(
            ray.o, ray, ones(len(density)), density, True, State.SEEKING, mi.UInt32(0), importance, active,
            direct_samples,
        )  # fmt: skip

    @classmethod
    def of(
        cls, vertex, ray, throughput, density, delta: bool, state: int, cell, importance, active, direct_samples
    ) -> FirstEdge:  # fmt: skip
        """Rays whose directions have a ``density``, evaluated."""
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
    the path met a surface counted in the film's alpha; ``carried``: β F1 before x2, w β F1 F2 at x2; ``cosine``: cosθ1;
    these two are None for plain paths; ``relayed``: whether the edge begins at a relay (:mod:`vpl.split.relays`) that
    the path met after a surface with a minorant, None if this is not recorded.

    None where they are not needed, as in scenes without glass (:mod:`vpl.split.emitters.glass`): ``bent``: whether
    glass has refracted the path since a direction that has a density, with nothing else between; ``opened``: whether
    the path has passed a null surface since its last vertex; ``origin``, ``toward``: the ray from this vertex, only if
    shadow rays pass the glass.
    """

    depth: mi.UInt32
    eta: mi.Float
    scattered: mi.UInt32
    valid: mi.Bool
    carried: mi.UnpolarizedSpectrum | None = None
    cosine: mi.Float | None = None
    relayed: mi.Bool | None = None
    bent: mi.Bool | None = None
    opened: mi.Bool | None = None
    origin: mi.Point3f | None = None
    toward: mi.Vector3f | None = None

    @classmethod
    def of(cls, first: FirstEdge, settings: PathSettings, emitters: EmitterSampler) -> Path:
        """Paths on the first edges: copies, because the loop changes the arrays."""
        own = (getattr(first, field.name) for field in fields(Edge))
        copies = (None if value is None else type(value)(value) for value in own)
        path = cls(*copies, mi.UInt32(0), mi.Float(1), mi.UInt32(0), mi.Bool(False))
        if not settings.plain:
            path.carried, path.cosine = dr.zeros(mi.UnpolarizedSpectrum, dr.width(first.throughput)), mi.Float(1)
            path.relayed = mi.Bool(False) if settings.meets_relays else None
        if emitters.glass and (emitters.refracts or not settings.plain):
            path.bent, path.opened = mi.Bool(False), mi.Bool(False)
        if emitters.refracts:
            path.origin, path.toward = mi.Point3f(first.ray.o), mi.Vector3f(first.ray.d)
        return path

    def divide_by(self, survival: mi.Float) -> None:
        """Divide the weights of paths by the probability of their survival."""
        self.throughput /= survival
        if self.carried is not None:
            self.carried /= survival


@dataclass
class Hit:
    """Surfaces that paths hit.

    ``si``; ``bsdf`` with its ``flags``; ``side``; ``minorant`` and its ``lobe``: see :mod:`vpl.transport.minorant`,
    None in plain paths; ``hidden``: whether the surface is an emitter hidden from the camera; ``goes_on``: whether the
    path may continue; ``smooth``: whether the path continues at a BSDF with a density; ``perturbed``: whether it has a
    minorant and a bump or normal map, None in scenes without such materials.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    flags: mi.UInt32
    side: mi.Float
    minorant: mi.UnpolarizedSpectrum | None
    lobe: Lobe | None
    hidden: mi.Bool
    goes_on: mi.Bool
    smooth: mi.Bool
    perturbed: mi.Bool | None

    @classmethod
    def of(cls, traits: SceneTraits, path: Path, settings: PathSettings) -> Hit:
        """Intersect the rays with the scene."""
        si = traits.interactions.meet(path.ray, path.active, path.depth == 0)
        bsdf, hidden = si.bsdf(path.ray), mi.Bool(False)
        if settings.hide_emitters:
            from_camera = path.active & (path.depth == 0)
            if not settings.plain:
                from_camera &= (path.state == State.SEEKING) & (settings.gathering != Gathering.PLACING)
            hidden = from_camera & (~si.is_valid() | si.shape.is_emitter())
        goes_on = path.active & si.is_valid() & (path.depth + 1 < settings.max_depth) & ~hidden
        flags, side = bsdf.flags(), side_of(si)
        smooth = goes_on & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        minorant, lobe, perturbed = None, None, None
        if not settings.plain:
            minorants, seeks = settings.minorants, smooth & (settings.gathering >= path.state)
            minorant, lobe = minorants.at(si, bsdf, side, seeks)
            perturbed = None if minorants.perturbed is None else minorants.perturbed.hold(bsdf, seeks)
        return cls(si, bsdf, flags, side, minorant, lobe, hidden, goes_on, smooth, perturbed)

    @property
    def facing(self) -> mi.Normal3f:
        """Axis of the lobe of the minorant; in plain paths the shading normal on the side of arrival."""
        return self.si.sh_frame.n * self.side if self.lobe is None else self.lobe.normal

    @property
    def is_diffuse(self) -> mi.Bool:
        """Whether the BSDF has only a diffuse lobe, about the shading normal."""
        found = is_diffuse(self.flags)
        return found if self.perturbed is None else found & ~self.perturbed


@dataclass
class Vertex:
    """Vertices where paths scatter.

    ``hit``; ``gathers``, ``weight``: mask and weights of gather vertices, None in plain paths; ``cell`` of the emitter
    sampler; ``samples``: number of emitter samples; ``share`` of a sample in their light; ``numbers`` of the lattice;
    ``scatters``: whether a sample of the BSDF is needed; ``choice``: between the BSDF and relays, None without relays.
    """

    hit: Hit
    gathers: mi.Bool | None
    weight: mi.UnpolarizedSpectrum | None
    cell: mi.UInt32
    samples: mi.UInt32
    share: mi.Float
    numbers: tuple
    scatters: mi.Bool
    choice: RelayChoice | None


@dataclass
class Noise:
    """Records of the noise of paths, one per lane, means over channels.

    ``seen``: emission at the end of the first edge; ``difference``: contributions of the emitter samples with even
    numbers at the first scattering vertex less those with odd numbers; ``alone_excess``: radiance with the first of
    these samples alone, weighted as a single sample, less the radiance; ``relayed``: radiance by way of relays;
    ``refracted``: emission that paths meet where glass has bent them, see :class:`Path`.
    """

    seen: mi.Float
    difference: mi.Float
    alone_excess: mi.Float
    relayed: mi.Float
    refracted: mi.Float

    @classmethod
    def none(cls, count: int) -> Noise:
        """Paths that have found nothing."""
        return cls(*(dr.zeros(mi.Float, count) for _ in range(5)))

    def add_emission(self, path: Path, arrived, mis, single) -> None:
        """Add the emission that paths hit: radiance ``arrived``, with the weight ``mis``; ``single``: the weight beside
        a single emitter sample."""
        self.seen += dr.select(path.depth == 0, arrived * mis, 0)
        self.alone_excess += arrived * (single - mis)
        if path.relayed is not None:
            self.relayed += dr.select(path.relayed, arrived * mis, 0)
        if path.bent is not None:
            self.refracted += dr.select(path.bent, arrived * mis, 0)

    def add_sample(self, path: Path, level, number, samples, single) -> None:
        """Add the contribution ``level`` of an emitter sample, which has a ``number`` among the ``samples`` of its
        vertex.  ``single``: weight of an only sample over the weight of this one."""
        if path.relayed is not None:
            self.relayed += dr.select(path.relayed, level, 0)
        signed = dr.select((number & 1) == 0, level, -level)
        self.difference += dr.select(samples > 1, signed, 0)
        self.alone_excess += dr.select(number == 0, level * single, 0) - level


@dataclass
class Traced:
    """Result of :func:`trace_paths`, one record per lane, evaluated.

    ``radiance``; ``valid``: whether a surface counts in the film's alpha; ``edges`` without the last.  Plain paths have
    no other results: ``drawn``: a contribution over its probability, from a path of ``length`` edges to an emitter of
    ``group``; ``noise``; ``gathered``: gather vertices.
    """

    radiance: mi.UnpolarizedSpectrum
    valid: mi.Bool
    edges: mi.UInt32
    drawn: mi.UnpolarizedSpectrum | None = None
    length: mi.UInt32 | None = None
    group: mi.UInt32 | None = None
    noise: Noise | None = None
    gathered: Gathered | None = None

    @classmethod
    def of(cls, path: Path, found: Contributions, noise: Noise | None, gathered: Gathered | None) -> Traced:
        """The records of ended paths; without ``gathered``, those of plain paths."""
        result = cls(found.radiance, path.valid, path.depth)
        if gathered is None:
            return result
        gathered.finish()
        return replace(result, drawn=found.one, length=found.length, group=found.group, noise=noise, gathered=gathered)
