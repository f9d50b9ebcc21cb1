"""The part of the scene that the camera sees (focus), and the distance between lights there (NumPy only).

A scene may extend far beyond the visible part, such as a room on a large ground plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Radius of the focus over the median distance of visible points from its centre: twice the radius that holds a half
_MARGIN = 2.0
# Ratio of scene radius to focus radius from which a focus is used: below, at least a sixteenth of the rays that an
# environment sends to the disk of the scene meets the focus
_SCENE_TO_FOCUS = 4.0
# Most lights and places whose distances are computed, two million in all; number of nearest lights per place
_LIGHTS, _PLACES, _NEAREST = 8192, 256, 8
# Quantile of the spacing over the places: lights are densest where most of the light is
_QUANTILE = 0.25


@dataclass(frozen=True)
class Focus:
    """Sphere around most visible points: ``center`` (3,) and ``radius``, world units; ``reach``: radius of the
    concentric sphere that encloses the whole scene."""

    center: np.ndarray
    radius: float
    reach: float

    @classmethod
    def of(cls, places: np.ndarray, sphere) -> Focus | None:
        """Focus of a camera that sees ``places`` (n, 3) of a scene with bounding ``sphere``.

        None if the camera sees nothing or a large part of the scene.
        """
        if len(places) == 0:
            return None
        center = np.median(places, axis=0).astype(np.float64)
        radius = _MARGIN * float(np.median(np.linalg.norm(places - center, axis=1)))
        reach = float(sphere.radius) + float(np.linalg.norm(center - np.array(sphere.center, np.float64).ravel()))
        return cls(center, radius, reach) if 0 < _SCENE_TO_FOCUS * radius < float(sphere.radius) else None

    def importance(self, position: np.ndarray) -> np.ndarray:
        """Importance of lights at ``position`` (n, 3), (n,): 1 in the focus, outside (radius / distance)²."""
        distance2 = np.sum((position.astype(np.float64) - self.center) ** 2, axis=1)
        return self.radius**2 / np.maximum(distance2, self.radius**2)


def spacing(lights: np.ndarray, places: np.ndarray) -> float:
    """Typical distance between ``lights`` (n, 3) on surfaces around ``places`` (m, 3), world units; 0 if either is
    empty.

    Uses a random subset of at most _LIGHTS lights; a factor of sqrt(subset / n) scales its distances to all lights.
    """
    if len(lights) == 0 or len(places) == 0:
        return 0.0
    subset, around = (_subset(*rows).astype(np.float64) for rows in ((lights, _LIGHTS), (places, _PLACES)))
    nearest = min(_NEAREST, len(subset))
    offset = subset.mean(0)
    subset, around = subset - offset, around - offset
    distance2 = (around**2).sum(1)[:, None] - 2 * around @ subset.T + (subset**2).sum(1)
    # A disk with this squared radius on a surface holds the nearest lights
    radius2 = np.maximum(np.partition(distance2, nearest - 1, axis=1)[:, nearest - 1], 0)
    distance = np.sqrt(np.pi * radius2 / nearest * (len(subset) / len(lights)))
    return float(np.quantile(distance, _QUANTILE))


def _subset(rows: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` random rows, drawn with a fixed seed."""
    return rows if len(rows) <= most else rows[np.random.default_rng(0).choice(len(rows), most, replace=False)]
