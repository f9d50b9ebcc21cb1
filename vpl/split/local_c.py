"""c of the share w of virtual lights on surfaces, by place: the only place that computes c.

A light at a place where lines hit surfaces with the density ρ (per area) stands for an area 1 / ρ.  Its contribution
is bounded by its intensity / c², and the intensity is proportional to 1 / ρ (:mod:`vpl.transport.carried_share`).  With

    c² = k² / ρ,

no light contributes more than light that arrives at, and is reflected by, its place, over k².  Where lights are sparse,
for example beyond the edge of the image, they leave more of the light nearby to paths and make no soft spots.  Where
lights are dense, they carry more.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .line_density import LineDensity


@dataclass
class LocalC:
    """c² = ``scale`` / ``density``; ``scale``: k² over the number of lines, world units², opaque."""

    density: LineDensity
    scale: mi.Float

    @classmethod
    def of(cls, density: LineDensity, lines: int, per_spacing: float) -> LocalC:
        """c for a number of ``lines``; ``per_spacing``: k, c over the local distance between lights."""
        return cls(density, dr.opaque(mi.Float, (per_spacing * density.unit) ** 2 / lines))

    @classmethod
    def constant(cls, c: float) -> LocalC:
        """The same c at every place, world units."""
        return cls(LineDensity.even(), dr.opaque(mi.Float, c**2))

    def squared(self, position: mi.Point3f, normal: mi.Vector3f, active=True) -> mi.Float:
        """c² of the sides of surfaces with a ``normal``, world units²."""
        return self.scale / self.density.at(position, normal, active)
