"""Where the camera looks: where lights are wanted, and how far apart they are there (NumPy only).

A scene may reach much further than what the camera sees of it, as a room does that stands on a large ground plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# The focus is so many times as large as the typical distance of what is seen from its middle
_MARGIN = 2.0
# What is seen is a small part of scenes that are so many times larger
_MUCH_LARGER = 4.0
# Lights, and places among them, whose distances are looked at; how many of the nearest ones count
_LIGHTS, _PLACES, _NEAREST = 8192, 256, 8
# The share of places around which lights are at most as far apart as is said
_DENSEST = 0.25


@dataclass(frozen=True)
class Focus:
    """Sphere around most of what the camera sees: ``center`` (3,) and ``radius``, world units; ``reach``: radius of one
    around the same center that holds the whole scene."""

    center: np.ndarray
    radius: float
    reach: float

    @classmethod
    def of(cls, places: np.ndarray, sphere) -> Focus | None:
        """Focus of a camera that sees ``places`` (n, 3) of the scene in a bounding ``sphere``; None where that is
        nearly all, or nothing."""
        if len(places) == 0:
            return None
        center = np.median(places, axis=0).astype(np.float64)
        radius = _MARGIN * float(np.median(np.linalg.norm(places - center, axis=1)))
        reach = float(sphere.radius) + float(np.linalg.norm(center - np.array(sphere.center, np.float64).ravel()))
        return cls(center, radius, reach) if 0 < _MUCH_LARGER * radius < float(sphere.radius) else None

    def importance(self, position: np.ndarray) -> np.ndarray:
        """How much light from ``position`` (n, 3) counts, (n,): 1 in the focus, and less by the squared distance."""
        distance2 = np.sum((position.astype(np.float64) - self.center) ** 2, axis=1)
        return self.radius**2 / np.maximum(distance2, self.radius**2)


def spacing(lights: np.ndarray, places: np.ndarray) -> float:
    """Typical distance between ``lights`` (n, 3) on surfaces around ``places`` (m, 3), world units; 0 without any.

    Some of the lights, in no order, stand for all: their distances grow with the square root of how many they are.
    """
    if len(lights) == 0 or len(places) == 0:
        return 0.0
    some, around = (_part(*rows).astype(np.float64) for rows in ((lights, _LIGHTS), (places, _PLACES)))
    nearest = min(_NEAREST, len(some))
    offset = some.mean(0)
    some, around = some - offset, around - offset
    distance2 = (around**2).sum(1)[:, None] - 2 * around @ some.T + (some**2).sum(1)
    # A disk of this radius on a surface holds so many of them
    radius2 = np.maximum(np.partition(distance2, nearest - 1, axis=1)[:, nearest - 1], 0)
    apart = np.sqrt(np.pi * radius2 / nearest * (len(some) / len(lights)))
    return float(np.quantile(apart, _DENSEST))


def _part(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the rows, drawn at random, but always the same."""
    return rows if len(rows) <= most else rows[np.random.default_rng(0).choice(len(rows), most, replace=False)]
