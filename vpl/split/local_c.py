"""c of virtual lights on surfaces, by place: the only code that computes it.

Where lines hit surfaces with the density ρ (per area), a light stands for the area 1 / ρ, and its intensity is the
radiance L of the surface over ρ.  The light contributes at most its intensity over c²
(:mod:`vpl.transport.carried_share`).  With

    c² = k² / ρ,

every light thus contributes at most L / k².  Where lights are sparse, for example beyond the edge of the image, they
leave more of the light nearby to paths and make weaker soft spots.  Where lights are dense, they carry more.
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
        """c² on the sides of surfaces with a ``normal``, world units²."""
        return self.squared_by(self.density.at(position, normal, active))

    def squared_by(self, density: mi.Float) -> mi.Float:
        """c² where the density has this value, world units²."""
        return self.scale / density
