"""What one virtual light contributes to one gather point, without visibility: the only such formula in the project."""

from __future__ import annotations

from ..core.arrays import finite_or_zero, rgb_to_spectrum
from ..lights.virtual_lights import Light, geometry


def contribution(kind: str, surface, light: Light, smallest_distance, active=True):
    """Radiance that leaves a surface due to an unoccluded light: BSDF × cosine × geometry × intensity.

    ``surface``: see :mod:`vpl.points.surfaces`.  Values that are not finite count as zero.
    """
    to_light, factor = geometry(kind, surface.interaction.p, light, smallest_distance)
    active = active & (factor > 0)
    reflected = surface.reflected(to_light, active)
    return finite_or_zero(reflected * rgb_to_spectrum(light.intensity) * factor) & active
