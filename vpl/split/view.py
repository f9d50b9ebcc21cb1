"""View: the camera rays of one image, or of one pass of it, and what all paths that begin with them share."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.sampling import derived_seed, independent_sampler
from ..lights.light_set import LightGroup, LightSet
from ..lights.perturbed import Perturbed
from .numbers import SpreadNumbers
from .paths import AT_FIRST, EVERYWHERE, NOWHERE, FirstEdge, Limits, Rules
from .remainder import follow
from .view_lights import ViewLights, spaced_lights
from .worth import Worth

# c of paths that are whole, beyond every distance, world units: nothing is left to virtual lights
_WHOLE = 1e15


@dataclass
class View:
    """Camera rays: the ``scene`` and how its emitters are sampled (``emission``), its shapes without a
    floor (``perturbed``); the ``rules`` of its paths; the camera's ``ray`` and which of them are ``active``, evaluated;
    ``width`` of the image and ``samples`` of a pixel, which lie next to each other; ``seed``; ``importance`` of
    radiance in each pixel, and the ``worth`` of paths (:mod:`vpl.split.worth`), once they are known."""

    scene: object
    emission: object
    perturbed: Perturbed
    rules: Rules
    ray: object
    active: object
    width: int
    samples: int
    seed: int
    importance: object
    worth: Worth

    @property
    def count(self) -> int:
        return dr.width(self.ray.o)

    @property
    def pixels(self) -> int:
        """How many pixels there are."""
        return -(-self.count // self.samples)

    def pairs(self, most: int) -> np.ndarray:
        """Some of the rays, two next to each other at a time, evenly over the image: so many at most."""
        pairs = max(min(most, self.count // 4) // 2, 1)
        first = np.arange(pairs) * self.count // pairs // 2 * 2
        return np.minimum(first[:, None] + [0, 1], self.count - 1).reshape(-1)

    def emitter_lights(self, groups: list[LightGroup]) -> LightSet:
        """The lights that stand for emitters, in ``groups``; none where only their c is wanted."""
        lights = self.emission.lights
        return spaced_lights(groups, lights.spacing(lights.points(self.count)), self.rules.max_depth)

    def limits(self, lights: ViewLights, least: int = NOWHERE) -> Limits:
        """Limits, by the view's rules and worth, of paths of which ``lights`` carry a part; ``least``: where lights are
        gathered (:mod:`vpl.split.paths`) even if there are none, to learn of these vertices."""
        # At later vertices, few of which are lit, lights that stand for emitters alone bring noise of their own
        gathering = EVERYWHERE if lights.surfaces else AT_FIRST if lights.emitters else least
        longest = dr.opaque(mi.UInt32, int(min(self.rules.max_depth, 0xFFFFFFFF)))
        squared_c, of_emitters = (
            dr.opaque(mi.Float, (x.smallest_distance if x else _WHOLE) ** 2) for x in (lights.surfaces, lights.emitters)
        )
        return Limits(
            longest, dr.opaque(mi.UInt32, self.rules.rr_depth), squared_c, dr.opaque(mi.UInt32, gathering),
            dr.opaque(mi.Bool, lights.emitters is not None), of_emitters, self.worth, self.perturbed,
            self.rules.hide_emitters,
        )  # fmt: skip

    def follow(self, lane, limits: Limits, *stream: int):
        """Follow the camera rays ``lane`` (UInt32): see :func:`vpl.split.remainder.follow`."""
        seed, ray = derived_seed(self.seed, *stream), self.ray
        part = mi.Ray3f(*(dr.gather(type(x), x, lane) for x in (ray.o, ray.d, ray.time)))
        importance = dr.gather(mi.Float, self.importance, lane // dr.opaque(mi.UInt32, self.samples))
        edge = FirstEdge.of_camera(part, importance, dr.gather(mi.Bool, self.active, lane))
        numbers = SpreadNumbers(lane, self.samples, derived_seed(seed, 0))
        sampler = independent_sampler(derived_seed(seed, 1), dr.width(lane))
        return follow(self.scene, self.emission, edge, numbers, sampler, limits)
