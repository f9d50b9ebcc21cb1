"""Lights that a view is lit by, besides what is traced."""

from __future__ import annotations

from dataclasses import dataclass

from ..lights.light_set import LightGroup, LightSet

# c of the split, as a multiple of the distance between lights, below which single ones show as blotches
_TAPER = 6.0


def spaced_lights(groups: list[LightGroup], spacing: float, max_depth: float) -> LightSet:
    """The light set of groups with a typical distance between lights, world units, and with it their c; ``max_depth``
    (edges) of the image."""
    return LightSet(groups, _TAPER * spacing, max_depth, 0, 0, {})


@dataclass(frozen=True)
class ViewLights:
    """Virtual lights on ``surfaces``, and those that stand for ``emitters``; None where there are none.  The smallest
    distance of each is c of :mod:`vpl.split.floors`."""

    surfaces: LightSet | None = None
    emitters: LightSet | None = None

    @property
    def all(self) -> list[LightSet]:
        """Those that there are."""
        return [lights for lights in (self.surfaces, self.emitters) if lights is not None]
