"""View: the camera rays of one image or pass, the virtual lights, and the path settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import ones, upload_limit
from ..core.materials import Materials
from ..lights.light_set import LightGroup, LightSet
from .contributions import Layers
from .cost_model import CostModel
from .emitters.base import EmitterSampler
from .local_c import LocalC
from .pixel_rays import PixelRays
from .roulette import OutgoingRadiance

# c of paths without a carried part, world units: beyond every distance, with a finite square
_WHOLE = 1e15


class Stream(IntEnum):
    """Streams of random numbers, derived from the seed of a view."""

    PILOT = 1
    SURFACE_LIGHTS = 2
    IMAGE = 4
    GATHER = 5
    LEARNING = 6
    EMITTER_LIGHTS = 7
    ALPHA = 8
    OCTREE = 9
    STRATA = 10


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


@dataclass(frozen=True)
class PathRules:
    """Parameters of Mitsuba's ``path``: ``max_depth`` (edges, may be infinite), ``rr_depth``, ``hide_emitters``."""

    max_depth: float
    rr_depth: int
    hide_emitters: bool


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


@dataclass(frozen=True)
class ViewLights:
    """Virtual lights on ``surfaces`` and virtual lights representing ``emitters``; None for no lights.

    ``c``: of lights on surfaces; ``emitters_c``: of lights representing emitters, world units.  Without such lights,
    c is beyond every distance, and the lights would carry nothing.
    """

    surfaces: LightSet | None = None
    emitters: LightSet | None = None
    c: LocalC = field(default_factory=lambda: LocalC.constant(_WHOLE))
    emitters_c: float = _WHOLE

    @property
    def all(self) -> list[LightSet]:
        """The sets that exist."""
        return [lights for lights in (self.surfaces, self.emitters) if lights is not None]


@dataclass(frozen=True)
class View:
    """Camera rays of one image or pass.

    ``scene``; ``emitters``: emitter sampler; ``with_minorant``: materials with a minorant; ``rules`` of the paths;
    ``ray``, ``active``: of the camera, evaluated, by pixel as in ``rays``; ``width`` of the image in pixels;
    ``seed``; ``importance`` of radiance in each pixel and ``outgoing`` radiance of surfaces: for Russian roulette;
    ``direct_samples``: number of emitter samples at the first scattering vertices of each pixel;
    ``learning_count``: number of camera rays, for the size of the emitter sampler's learning; ``planned_count``: the
    same for the size of the pilot; ``model``: constants of the decisions; ``layers`` of the image.
    """

    scene: mi.Scene
    emitters: EmitterSampler
    with_minorant: Materials
    rules: PathRules
    ray: mi.Ray3f
    active: mi.Bool
    width: int
    rays: PixelRays
    seed: int
    importance: mi.Float
    direct_samples: mi.UInt32
    outgoing: OutgoingRadiance
    learning_count: int
    planned_count: int
    model: CostModel
    layers: Layers

    @property
    def count(self) -> int:
        """Number of camera rays."""
        return dr.width(self.ray.o)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.rays.pixels

    @property
    def samples(self) -> int:
        """Mean number of camera rays of a pixel."""
        return self.rays.mean

    def groups(self, most: int, size: int) -> np.ndarray:
        """Indices of at most ``most`` rays in groups of ``size`` neighbours, evenly over the image; at least one
        group."""
        groups = max(min(most, self.count) // size, 1)
        first = np.arange(groups) * self.count // groups // size * size
        return np.minimum(first[:, None] + np.arange(size), self.count - 1).reshape(-1)

    def light_set(self, groups: list[LightGroup]) -> LightSet:
        """The light set of ``groups`` in this view."""
        return LightSet(groups, 0, self.rules.max_depth, 0, 0, {})

    @property
    def emitters_c(self) -> float:
        """c of lights representing emitters, world units."""
        lights = self.emitters.lights
        return self.model.c_per_spacing * lights.spacing(lights.points(self.count, self.model))

    def settings(self, lights: ViewLights, least: int = Gathering.NOWHERE) -> PathSettings:
        """Settings of paths of which ``lights`` carry a part; without lights, vertices are gathered by ``least``."""
        # Without lights on surfaces, lights representing emitters are gathered at x1 only: at the few lit later
        # vertices, the lights would add more variance than the lights remove
        gathering = Gathering.EVERYWHERE if lights.surfaces else Gathering.AT_FIRST if lights.emitters else least
        return PathSettings(
            upload_limit(self.rules.max_depth), dr.opaque(mi.UInt32, self.rules.rr_depth), lights.c,
            dr.opaque(mi.UInt32, gathering), dr.opaque(mi.Bool, lights.emitters is not None),
            dr.opaque(mi.Float, lights.emitters_c**2), self.outgoing, self.with_minorant, self.rules.hide_emitters,
        )  # fmt: skip
