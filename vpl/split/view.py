"""View: the camera rays of one image or pass, and the virtual lights."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload_limit
from ..lights.light_set import LightGroup, LightSet
from ..transport.minorant import Minorants
from .contributions import Layers
from .cost_model import CostModel
from .emitters.base import EmitterSampler
from .local_c import LocalC
from .path_state import Gathering, PathSettings
from .pixel_rays import PixelRays
from .relays import Relays, relays_by
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
    RELAYS = 11


@dataclass(frozen=True)
class PathRules:
    """Parameters of Mitsuba's ``path``: ``max_depth`` (edges, may be infinite), ``rr_depth``, ``hide_emitters``."""

    max_depth: float
    rr_depth: int
    hide_emitters: bool


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

    ``scene``; ``emitters``: emitter sampler; ``minorants`` of materials; ``rules`` of the paths;
    ``ray``, ``active``: of the camera, evaluated, by pixel as in ``rays``; ``width`` of the image in pixels;
    ``seed``; ``importance`` of radiance in each pixel and ``outgoing`` radiance of surfaces: for Russian roulette;
    ``direct_samples``: number of emitter samples at the first scattering vertices of each pixel;
    ``learning_count``: number of camera rays, for the size of the emitter sampler's learning; ``planned_count``: the
    same for the size of the pilot; ``model``: constants of the decisions; ``layers`` of the image;
    ``relays``: targets of paths, or None.
    """

    scene: mi.Scene
    emitters: EmitterSampler
    minorants: Minorants
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
    relays: Relays | None = None

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

    @property
    def meets_relays(self) -> bool:
        """Whether the scene may have relays."""
        return any(map(relays_by, self.emitters.traits.materials.flags))

    @property
    def plain_from(self) -> float:
        """Number of camera rays from which paths without virtual lights are plain."""
        return self.model.plain_per_material * len(self.emitters.traits.materials.bsdfs)

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
        # The directions to relays take the place of shadow rays that could pass glass
        assert not (self.relays and self.emitters.refracts), "relays exclude shadow rays through glass"
        # Without lights on surfaces, lights representing emitters are gathered at x1 only: at the few lit later
        # vertices, the lights would add more variance than the lights remove
        gathering = Gathering.EVERYWHERE if lights.surfaces else Gathering.AT_FIRST if lights.emitters else least
        return PathSettings(
            upload_limit(self.rules.max_depth), dr.opaque(mi.UInt32, self.rules.rr_depth), lights.c,
            dr.opaque(mi.UInt32, gathering), dr.opaque(mi.Bool, lights.emitters is not None),
            dr.opaque(mi.Float, lights.emitters_c**2), self.outgoing, self.minorants, self.rules.hide_emitters,
            meets_relays=self.meets_relays, relays=self.relays,
        )  # fmt: skip
