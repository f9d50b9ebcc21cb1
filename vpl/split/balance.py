"""What a scene needs: whether virtual lights pay, how many, and how finely they are clustered.

Decided from a pilot's paths alone, by counts and variances and never by the clock, so that the same seed gives the same
image.  Costs are in units of one path from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# What making lights and clusters costs besides (kernels that are traced and started, trees), and a path from a light
_FIXED_COST, _LIGHT_PATH_COST = 200_000, 4.0
# Share of the indirect light's variance that lights take away where they carry it
_GAIN = 0.9
# Relative standard error that one set of lights leaves in the mean of the image
_SET_ERROR = 0.03
# Light paths as a share of the paths from the camera, and how few and how many there may be
_SHARES, _FEWEST, _MOST = (1 / 64, 1 / 8), 20_000, 500_000
# Relative variance that cuts leave, times shadow rays a pixel; and the cost of one of these rays
_CUT_NOISE, _RAY_COST = 0.1, 0.5
# Shadow rays for each sample of a pixel, at least and at most
_RAYS = (0.25, 8.0)
# Bound on a pair of clusters, relative to its pixel, with which a cut has so many rays, and how the two go together
_ERROR, _RAYS_AT_ERROR, _SLOPE = 0.05, 70, 1.6
_FINEST, _COARSEST = 0.003, 0.2
# Squared brightness of the image that black places are taken to have, and share of the worst that is left out
_BLACK, _WORST = 0.01, 0.001
# Gather vertices of a pixel: one of so many samples, and at most so many
_SAMPLES_A_VERTEX, _MOST_VERTICES = 4, 16


@dataclass(frozen=True)
class Balance:
    """``light_paths``: 0 where lights do not pay; ``error`` of cuts; ``vertices`` of a pixel that are lit;
    ``reason``, in words."""

    light_paths: int
    error: float
    vertices: int
    reason: str


def balance(radiance: np.ndarray, indirect: np.ndarray, brightness: np.ndarray, paths: int, samples: int) -> Balance:
    """The balance for ``paths`` camera paths, ``samples`` a pixel.

    ``radiance`` (n,): what a pilot's paths found, two next to each other from one pixel; ``indirect`` (n,): the part of
    it that came by way of surfaces that virtual lights may stand for; ``brightness`` (n,): of the image around.
    """
    if not indirect.any():
        return without_lights("no light comes by way of surfaces that virtual lights could stand for")
    whole, direct = noise(radiance, brightness), noise(radiance - indirect, brightness)
    share = max(1 - direct / max(whole, np.finfo(np.float64).tiny), 0.0)
    # Relative variance of what a path from the camera brings by way of lights
    spread = len(indirect) * np.sum(indirect**2) / np.sum(indirect) ** 2
    wanted = np.clip(spread / _SET_ERROR**2, _SHARES[0] * paths, _SHARES[1] * paths)
    light_paths = int(np.clip(wanted, _FEWEST, _MOST))
    cost = _FIXED_COST + _LIGHT_PATH_COST * light_paths
    if _GAIN * share * paths < cost * (1 - _GAIN * share):
        return without_lights(
            f"virtual lights would cost as much as {cost / paths:.2g} of the paths and save {share:.0%} of them"
        )
    # The least of (noise of paths / samples + noise of cuts / rays) × (samples + rays × their cost)
    rest = whole * (1 - _GAIN * share)
    rays = samples * np.clip((_CUT_NOISE / (_RAY_COST * max(rest, 1e-9))) ** 0.5, *_RAYS)
    error = float(np.clip(_ERROR * (rays / _RAYS_AT_ERROR) ** -_SLOPE, _FINEST, _COARSEST))
    vertices = int(np.clip(samples // _SAMPLES_A_VERTEX, 1, _MOST_VERTICES))
    return Balance(light_paths, error, vertices, f"{share:.0%} of the noise is that of indirect light")


def without_lights(reason: str) -> Balance:
    """The balance of scenes in which virtual lights do not pay."""
    return Balance(0, 0.0, 0, reason)


def noise(values: np.ndarray, brightness: np.ndarray) -> float:
    """Variance of a path, from the ``values`` (n,) of two in each pixel, relative to ``brightness`` (n,), as images are
    judged: without the worst, and as if no place was black."""
    count = len(values) // 2
    first, second = values[: 2 * count].astype(np.float64).reshape(-1, 2).T
    level = brightness[: 2 * count : 2] ** 2 + _BLACK * np.mean(brightness) ** 2
    error = np.sort(0.5 * (first - second) ** 2 / np.maximum(level, np.finfo(np.float64).tiny))
    return float(np.mean(error[: count - int(_WORST * count)])) if count else 0.0
