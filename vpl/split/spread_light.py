"""Spreading: a part of the light of virtual lights is divided among all camera rays of a pixel.

A cut of a pixel has few pairs for each cell of a finer film, so the light of a cell varies more than that of the pixel,
and a denoiser keeps part of the excess.  Spreading lowers the variance of the cells.  The spread light is in proportion
to the absolute weights of the first gather vertices: a ray gets its weight times the light of the pixel over the sum of
the weights, which is about the mean irradiance.  The sum over the pixel is unchanged, and its light is slightly blurred
inside the pixel.  Later gather vertices share in the same proportion.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.loops import recorded_once
from .pixel_rays import PixelRays


def spread(light, weight, rays: PixelRays, fraction: float) -> mi.UnpolarizedSpectrum:
    """``light``, with a ``fraction`` divided among the camera ``rays`` of each pixel in proportion to ``weight``.

    ``light``, and ``weight`` of first gather vertices, of which absolute values count: unpolarized spectra, one entry
    for each ray.  Channels in which no ray of a pixel has a weight keep their light.  Evaluated.
    """
    # A weight that is not finite must not take the light of the remaining rays
    weight = dr.select(dr.isfinite(weight), dr.abs(weight), 0)
    dr.eval(light, weight)
    mean = _mean_irradiance(light, weight, rays.device_first, rays.by_level(rays.sizes))
    pixel = rays.places(dr.arange(mi.UInt32, rays.count)).pixel
    even = weight * dr.gather(mi.UnpolarizedSpectrum, mean, pixel)
    moved = light + dr.opaque(mi.Float, fraction) * (even - light)
    result = dr.select(dr.isfinite(even), moved, light)
    dr.eval(result)
    return result


@recorded_once
@dr.syntax
def _mean_irradiance(light, weight, first, rays):
    """Light of each pixel over the sum of its weights, not finite without a weight; evaluated.

    ``first``, ``rays``: first ray and number of rays of the pixels.
    """
    total, whole = (dr.zeros(mi.UnpolarizedSpectrum, dr.width(first)) for _ in range(2))
    k = dr.zeros(mi.UInt32, dr.width(first))
    while dr.hint(k < rays, exclude=[light, weight, first, rays]):
        total += dr.gather(mi.UnpolarizedSpectrum, light, first + k)
        whole += dr.gather(mi.UnpolarizedSpectrum, weight, first + k)
        k += 1
    mean = total / whole
    dr.eval(mean)
    return mean
