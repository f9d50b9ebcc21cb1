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
from .pixel_rays import PixelRays, half_of


def spread(light, weight, rays: PixelRays, fraction: float) -> mi.UnpolarizedSpectrum:
    """``light``, with a ``fraction`` divided among the camera ``rays`` of each pixel in proportion to ``weight``.

    ``light``, and ``weight`` of first gather vertices, of which absolute values count: unpolarized spectra, one entry
    for each ray.  The two halves of the samples, see :func:`vpl.split.pixel_rays.half_of`, share apart and stay
    independent.  Channels in which the rays of a half have no weight keep their light.  Evaluated.
    """
    # A weight that is not finite must not take the light of the remaining rays
    weight = dr.select(dr.isfinite(weight), dr.abs(weight), 0)
    dr.eval(light, weight)
    cells = dr.opaque(mi.UInt32, rays.cells)
    group = dr.arange(mi.UInt32, 2 * rays.pixels)
    first, count = (dr.gather(mi.UInt32, x, group // 2) for x in (rays.device_first, rays.by_level(rays.sizes)))
    dr.eval(first, count)
    mean = _mean_irradiance(light, weight, first, count, group & 1, cells)
    places = rays.places(dr.arange(mi.UInt32, rays.count))
    even = weight * dr.gather(mi.UnpolarizedSpectrum, mean, 2 * places.pixel + half_of(places.number, cells))
    moved = light + dr.opaque(mi.Float, fraction) * (even - light)
    result = dr.select(dr.isfinite(even), moved, light)
    dr.eval(result)
    return result


@recorded_once
@dr.syntax
def _mean_irradiance(light, weight, first, rays, half, cells):
    """Light over the sum of the weights, of a ``half`` of each pixel's rays; not finite without a weight; evaluated.

    ``first``, ``rays``: first ray and number of rays of the pixels; ``cells`` of a pixel.
    """
    dr.make_opaque(half)
    total, whole = (dr.zeros(mi.UnpolarizedSpectrum, dr.width(first)) for _ in range(2))
    k = dr.zeros(mi.UInt32, dr.width(first))
    while dr.hint(k < rays, exclude=[light, weight, first, rays, half, cells]):
        taken = half_of(k, cells) == half
        total += dr.select(taken, dr.gather(mi.UnpolarizedSpectrum, light, first + k), 0)
        whole += dr.select(taken, dr.gather(mi.UnpolarizedSpectrum, weight, first + k), 0)
        k += 1
    mean = total / whole
    dr.eval(mean)
    return mean
