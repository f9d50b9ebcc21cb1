"""Spreading: a part of the light of virtual lights is divided among all camera rays of a pixel.

A cut of a pixel has few pairs for each cell of a finer film, so the light of a cell varies more than that of the pixel,
and a denoiser keeps part of the excess.  Spreading lowers the variance of the cells.  The light of a pixel is a sum of
products of a weight and an irradiance; the spread part has the weight of each ray and the mean irradiance of the pixel.
The sum over the pixel is unchanged, and light inside the pixel is slightly blurred.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.loops import recorded_once
from .pixel_rays import PixelRays


def spread(light, weight, rays: PixelRays, fraction: float) -> mi.UnpolarizedSpectrum:
    """``light`` of which a ``fraction`` is divided among the camera ``rays`` of each pixel in proportion to ``weight``.

    ``light``, and ``weight`` of first gather vertices: unpolarized spectra, one entry for each ray.  Channels in which
    no ray of a pixel has a weight keep their light.  Evaluated.
    """
    dr.eval(light, weight)
    mean = _mean_irradiance(light, weight, rays.device_first, rays.by_level(rays.sizes))
    pixel = rays.places(dr.arange(mi.UInt32, rays.count)).pixel
    even = dr.abs(weight) * dr.gather(mi.UnpolarizedSpectrum, mean, pixel)
    moved = light + dr.opaque(mi.Float, fraction) * (even - light)
    result = dr.select(dr.isfinite(even), moved, light)
    dr.eval(result)
    return result


@recorded_once
@dr.syntax
def _mean_irradiance(light, weight, first, rays):
    """Sum of the light over the sum of the weights of each pixel, not finite without a weight; evaluated.

    ``first``, ``rays``: first ray and number of rays of the pixels.
    """
    total, whole = (dr.zeros(mi.UnpolarizedSpectrum, dr.width(first)) for _ in range(2))
    k = dr.zeros(mi.UInt32, dr.width(first))
    while dr.hint(k < rays, exclude=[light, weight, first, rays]):
        total += dr.gather(mi.UnpolarizedSpectrum, light, first + k)
        whole += dr.abs(dr.gather(mi.UnpolarizedSpectrum, weight, first + k))
        k += 1
    mean = total / whole
    dr.eval(mean)
    return mean
