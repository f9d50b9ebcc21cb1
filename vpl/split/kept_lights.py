"""Lights of one view that serve for others of the same scene.

They were drawn where the paths of the first camera arrive, but with a known density on every surface, which is positive
everywhere (:mod:`vpl.split.cells`): another camera has lights that are fewer where it looks, and no bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..core.parameters import fingerprint_without_camera
from ..lights.light_set import ScatteredGroup
from .surface_lights import SurfaceLights

# Lights of all seeds together, some 400 bytes each
_MOST = 1 << 21


@dataclass
class TreedLights:
    """``surface``: lights, and how they were drawn; ``group``: these with their tree, None where there are none."""

    surface: SurfaceLights
    group: ScatteredGroup | None


class KeptLights:
    """Lights by what they depend on besides the scene, such as a seed, of one scene at a time.

    Whether the scene is that of before is told by all that Mitsuba prints and lists as a parameter of its objects,
    except for its sensors and its integrator: see :func:`vpl.core.parameters.fingerprint`.
    """

    def __init__(self):
        self._scene: str | None = None
        self._known: dict[tuple, TreedLights] = {}

    @property
    def count(self) -> int:
        """Number of lights."""
        return sum(one.surface.lights.count for one in self._known.values())

    def find(self, scene, key: tuple, make: Callable[[], TreedLights]) -> TreedLights:
        """The lights of a scene and a key: those that there are, or what ``make`` returns."""
        found = fingerprint_without_camera(scene)
        if found != self._scene:
            self._scene, self._known = found, {}
        if key in self._known:
            return self._known[key]
        made = make()
        if self.count + made.surface.lights.count <= _MOST:
            self._known[key] = made
        return made
