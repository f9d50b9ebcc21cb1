"""What a scene needs: whether virtual lights pay, how many, and how finely they are clustered.

Decided from a pilot's paths alone, by counts and variances and never by the clock, so that the same seed gives the same
image.  Costs are in units of one path from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .worth import survival_of

# What making lights and clusters costs besides (kernels that are traced and started, trees), and a path from a light
_FIXED_COST, _LIGHT_PATH_COST = 200_000, 4.0
# Variance of what is left that samples of a pixel, spread well, leave at best, next to that of the pilot's; where there
# are more emitters than samples, these are hardly spread over them
_SPREAD, _MANY_EMITTERS_SPREAD = 0.5, 1.0
# Share of the indirect light's variance that lights are assumed to take away, and by how many times more may be left
# when that is followed, which is rough, too, before it is believed instead
_GAIN, _DOUBTFUL = 0.9, 1.5
# Relative standard error that one set of lights leaves in the mean of the image
_SET_ERROR = 0.03
# Relative variance that a set of lights leaves in a pixel, times the paths that it was made by, next to that of the
# indirect light that one camera path finds; and how many times as much as other noise it weighs: neighbouring pixels
# share it, so that it shows as blotches, which no denoiser takes away
_LIGHT_NOISE, _SHARED = 50.0, 4.0
# Light paths as a share of the paths from the camera, and how few and how many there may be
_SHARES, _FEWEST, _MOST = (1 / 64, 1 / 8), 20_000, 2_000_000
# Relative variance that cuts leave, times shadow rays a pixel; and the cost of one of these rays
_CUT_NOISE, _RAY_COST = 0.3, 0.2
# Noise and rays of cuts of lights that stand for emitters, next to those of lights on surfaces
_EMITTER_CUTS = 0.4
# Shadow rays for each sample of a pixel, at least and at most
_RAYS = (0.25, 8.0)
# Bound on a pair of clusters, relative to its pixel, with which a cut has so many rays, and how the two go together
_ERROR, _RAYS_AT_ERROR, _SLOPE = 0.05, 110, 1.6
_FINEST, _COARSEST = 0.001, 2.0
# Squared brightness of the image that black places are taken to have, and share of the worst that is left out
_BLACK, _WORST = 0.01, 0.001
# Cost of a path up to its second vertex, in edges of those after it
_FIRST_EDGES = 4.0
# Variance × cost of paths that may end, next to that of whole paths, at most: what is expected of a few is rough
_LARGEST_PRODUCT = 0.95
# Variance × cost with lights, next to that without, below which they are used
_PAYS_BELOW = 1.0
# Relative variance that one gather vertex leaves by standing for all of its pixel, its cost, and how many there are at
# least, as a share of the samples
_VERTEX_NOISE, _VERTEX_COST, _LEAST_VERTICES = 0.06, 0.8, 1 / 8
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class Balance:
    """``light_paths``: 0 where lights on surfaces do not pay; ``emitters``: whether lights stand for emitters, too;
    ``error`` of cuts; ``vertices`` of a pixel that are lit; ``noise`` that is left of a path from the camera, relative
    variance; ``reason``, in words."""

    light_paths: int
    emitters: bool
    error: float
    vertices: int
    noise: float
    reason: str

    @property
    def gathers(self) -> bool:
        """Whether there are any lights."""
        return self.emitters or self.light_paths > 0


@dataclass(frozen=True)
class Option:
    """Lights of some kinds: on ``surfaces``, or that stand for ``emitters``, or both.

    Of a pilot's paths, (n,) each: ``traced``: what they find without lights on surfaces; ``indirect``: the part of it
    that comes by way of surfaces that lights may stand for; ``left``: what they find besides light of lights on
    surfaces, None where that was not followed.
    """

    surfaces: bool
    emitters: bool
    traced: np.ndarray
    indirect: np.ndarray
    left: np.ndarray | None = None

    @property
    def expected(self) -> np.ndarray:
        """What the paths are expected to find besides light of lights, (n,)."""
        return self.traced - self.indirect * self.surfaces

    @property
    def clumps(self) -> float:
        """Mean square of the indirect light over its squared mean."""
        total = np.sum(self.indirect)
        return len(self.indirect) * np.sum(self.indirect**2) / total**2 if total else 0.0

    def noise(self, evidence: Evidence) -> float:
        """Relative variance that lights leave of a path."""
        traced = evidence.noise(self.traced)
        if not self.surfaces:
            return traced
        assumed = traced - _GAIN * (traced - min(evidence.noise(self.expected), traced))
        followed = assumed if self.left is None else evidence.noise(self.left)
        return followed if followed > _DOUBTFUL * assumed else assumed


@dataclass(frozen=True)
class Evidence:
    """Evidence of a pilot on an image of ``paths`` camera paths, ``samples`` a pixel.

    ``radiance`` (n,): what the pilot's paths found, two next to each other, of one pixel if it has so many; ``direct``
    (n,): without what came by way of surfaces that lights may stand for; ``brightness`` (n,): of the image around;
    ``emitters``: whether lights may stand for these, which are many.
    """

    radiance: np.ndarray
    direct: np.ndarray
    brightness: np.ndarray
    paths: int
    samples: int
    emitters: bool

    def noise(self, radiance: np.ndarray) -> float:
        """Relative variance of a path that finds ``radiance`` (n,), when samples of a pixel are spread well."""
        spread = max(_MANY_EMITTERS_SPREAD if self.emitters else _SPREAD, self.samples**-0.5)
        whole = noise(radiance, self.brightness)
        return whole - (1 - spread) * min(noise(self.direct, self.brightness), whole)


def balance(evidence: Evidence, options: list[Option]) -> Balance:
    """The balance of what a pilot has seen: without lights, or with those of the best option."""
    if not options:
        return without_lights("no light comes by way of surfaces that virtual lights could stand for")
    whole = evidence.noise(evidence.radiance)
    product, cost, best = min((_priced(evidence, option) for option in options), key=lambda option: option[0])
    left_over = best.noise / max(whole, _TINY)
    if product > _PAYS_BELOW * whole:
        costs = f"virtual lights would cost {cost - 1:.2g} times as much as the paths"
        return without_lights(f"{costs} and leave {left_over:.0%} of the noise")
    return replace(best, reason=f"virtual lights take {1 - left_over:.0%} of the noise away")


def price(evidence: Evidence, option: Option) -> float:
    """Variance × cost with the lights of an option."""
    return _priced(evidence, option)[0]


def may_pay(evidence: Evidence, option: Option, others: list[Option]) -> bool:
    """Whether lights of an option seem to pay, and more than those of all ``others``."""
    least = _PAYS_BELOW * evidence.noise(evidence.radiance)
    return price(evidence, option) <= min([least, *(price(evidence, other) for other in others)])


def _priced(evidence: Evidence, option: Option) -> tuple[float, float, Balance]:
    """(Variance × cost, cost, what is best) with the lights of an option."""
    rest, paths, samples = option.noise(evidence), evidence.paths, evidence.samples
    # The least of (noise of paths / samples + noise of cuts / rays) × (samples + rays × their cost), rays of a pixel
    cuts = _EMITTER_CUTS * option.emitters + option.surfaces
    rays = samples * np.clip((_CUT_NOISE / (_RAY_COST * max(rest, 1e-9))) ** 0.5, *_RAYS)
    error = float(np.clip(_ERROR * (rays / _RAYS_AT_ERROR) ** -_SLOPE, _FINEST, _COARSEST))
    # A cut has some nodes, however few rays are wanted
    rays = _RAYS_AT_ERROR * (error / _ERROR) ** (-1 / _SLOPE)
    # Never 0, for cuts leave some
    left, light_paths = rest + cuts * _CUT_NOISE * samples / rays, 0
    if option.surfaces:
        # The least of (noise of these / samples + noise of lights / their paths) × cost
        of_lights = _SHARED * _LIGHT_NOISE * noise(option.indirect, evidence.brightness)
        balanced = (of_lights * samples * paths / (_LIGHT_PATH_COST * left)) ** 0.5
        wanted = np.clip(max(balanced, option.clumps / _SET_ERROR**2), _SHARES[0] * paths, _SHARES[1] * paths)
        light_paths = int(np.clip(wanted, _FEWEST, _MOST))
    fixed = (_FIXED_COST + _LIGHT_PATH_COST * light_paths) / paths
    cost = 1 + cuts * _RAY_COST * rays / samples + fixed
    # The least of (noise of all else + noise of these / their share) × (cost of all else + their share × their cost)
    share = np.clip((_VERTEX_NOISE * cost / (_VERTEX_COST * left)) ** 0.5, _LEAST_VERTICES, 1)
    vertices = max(round(float(share) * samples), 1)
    return cost * left, cost, Balance(light_paths, option.emitters, error, vertices, left, "")


def without_lights(reason: str) -> Balance:
    """The balance of scenes in which virtual lights do not pay."""
    return Balance(0, False, 0.0, 0, 0.0, reason)


def noise(values: np.ndarray, brightness: np.ndarray) -> float:
    """Variance of a path, from the ``values`` (n,) of two in each pixel, relative to ``brightness`` (n,), as images are
    judged: without the worst, and as if no place was black."""
    count = len(values) // 2
    first, second = values[: 2 * count].astype(np.float64).reshape(-1, 2).T
    error = np.sort(0.5 * (first - second) ** 2 / judged_by(brightness)[: 2 * count : 2] ** 2)
    return float(np.mean(error[: count - int(_WORST * count)])) if count else 0.0


def judged_by(brightness: np.ndarray) -> np.ndarray:
    """What errors are relative to, (n,), where an image has a ``brightness`` (n,)."""
    level = np.sqrt(brightness**2 + _BLACK * np.mean(brightness) ** 2)
    return np.maximum(level, np.finfo(np.float64).tiny ** 0.5)


def importance(worth: np.ndarray, brought: np.ndarray, edges: np.ndarray, paths: int, whole: float) -> float:
    """The multiple of ``worth`` with which paths should go on from their second and later vertices, so that variance ×
    cost is least, as far as it depends on the second; infinite where none should end, as that would hardly pay.

    ``worth`` (m,) and ``brought`` (m,): what goes on is expected to bring, and what it brought, relative to the image;
    ``edges`` (m,) that it cost; ``paths``: number of all paths; ``whole``: relative variance of each, when samples of a
    pixel are spread well.
    """
    best, least = np.inf, _LARGEST_PRODUCT * whole * (_FIRST_EDGES + edges.sum() / paths)
    for multiple in 2.0 ** np.arange(-3, 5.5, 0.5):
        survival = survival_of(multiple * worth)
        variance = whole + np.sum(brought**2 * (1 / survival - 1)) / paths
        product = variance * (_FIRST_EDGES + np.sum(edges * survival) / paths)
        if product < least:
            best, least = multiple, product
    return float(best)
