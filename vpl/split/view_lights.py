"""Lights that a view is lit by, besides what is traced."""

from __future__ import annotations

from dataclasses import dataclass

from ..lights.light_set import LightSet


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
