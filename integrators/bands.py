"""Rendering in bands of rows, with memory independent of the film's size, for methods with a stopping rule per pixel.

Mitsuba divides large renders into passes with fewer samples per pixel.  A stopping rule per pixel would restart in
every pass.  Bands of rows avoid this: they contain every sample of their pixels.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from vpl.core.sampling import derived_seed
from vpl.direct.sites import BLOCK
from vpl.points.camera_paths import PixelGrid

# Largest number of camera rays in a band; a ray needs some 300 bytes
LARGEST_BAND = 1 << 22


def rows_of_a_band(film, samples: int) -> int:
    """Rows of a band: a multiple of the block size, unless fewer rows than a block fit."""
    rows = max(1, LARGEST_BAND // ((int(film.crop_size()[0]) + 2 * _border(film)) * samples))
    return rows if rows < BLOCK else rows - rows % BLOCK


def fits_one_band(film, samples: int) -> bool:
    """Whether the whole image fits in one band."""
    return int(film.crop_size()[1]) + 2 * _border(film) <= rows_of_a_band(film, samples)


def _border(film) -> int:
    return film.rfilter().border_size() if film.sample_border() else 0


def random_rays(sensor, seed: int, count: int):
    """(Sampler, ``count`` camera rays), uniformly distributed over the film."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(1)
    sampler.set_samples_per_wavefront(1)
    sampler.seed(seed, count)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, sampler.next_2d(), aperture)
    return sampler, ray


def render_in_bands(integrator, scene, sensor, seed: int, samples: int, trace) -> None:
    """Render into the sensor's film.

    ``trace(sampler, ray, grid, fraction)`` returns the results of ``integrator.sample``; ``fraction``: rows of the band
    over the remaining rows.
    """
    film = sensor.film()
    film.prepare(integrator.aov_names())
    border, crop = _border(film), film.crop_size()
    width, height = int(crop[0]) + 2 * border, int(crop[1]) + 2 * border
    rows = rows_of_a_band(film, samples)
    for number, first in enumerate(range(0, height, rows)):
        if integrator.stopped():
            break
        count = min(rows, height - first)
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(samples)
        sampler.set_samples_per_wavefront(samples)
        sampler.seed(derived_seed(seed, number), width * count * samples)
        index = dr.arange(mi.UInt32, width * count * samples) // dr.opaque(mi.UInt32, samples)
        row = index // width
        corner = mi.ScalarVector2i(film.crop_offset()) - border + mi.ScalarVector2i(0, first)
        pixel = mi.Vector2i(mi.Int32(index - row * width), mi.Int32(row)) + mi.Vector2i(corner)
        ray, weight, position = _camera_rays(sensor, film, sampler, pixel)
        radiance, valid, channels = trace(sampler, ray, PixelGrid(width, samples), count / (height - first))
        block = film.create_block(mi.ScalarVector2u(width, count), False, not film.rfilter().is_box_filter())
        block.set_offset(mi.ScalarPoint2i(corner))
        _put(block, film, position, radiance * weight, valid, channels)
        film.put_block(block)


def _camera_rays(sensor, film, sampler, pixel):
    """One ray in each pixel: (rays, weights, film positions)."""
    position = mi.Vector2f(pixel) + sampler.next_2d()
    on_sensor = (position - mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.crop_size())
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(time, 0.5, on_sensor, aperture)
    # With a box filter, the pixel's corner: rounding of a position could select the neighbouring pixel
    return ray, weight, mi.Point2f(pixel) if film.rfilter().is_box_filter() else mi.Point2f(position)


def _put(block, film, position, radiance, valid, channels) -> None:
    """Put samples into an image block, with the channels that the film stores."""
    alpha = dr.select(valid, mi.Float(1), mi.Float(0))
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        values = film.prepare_sample(radiance, mi.Spectrum(0), block.channel_count(), weight=mi.Float(1), alpha=alpha)
    else:
        colour = mi.Color3f(radiance.x) if mi.is_monochromatic else mi.Color3f(radiance)
        shown = [alpha] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
        values = [colour.x, colour.y, colour.z, *shown, mi.Float(1), *channels]
    block.put(position, values)
