"""Images rendered in bands of rows: memory that does not grow with the film, for methods that need a pixel whole.

Mitsuba divides large renders into passes of fewer samples a pixel.  A method that decides for each pixel when to stop
would do so in every pass anew, so its images are divided by rows instead.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from vpl.core.sampling import derived_seed
from vpl.direct.sites import BLOCK
from vpl.points.camera_paths import PixelGrid

# Camera rays of a band; some 300 bytes each
LARGEST_BAND = 1 << 22


def rows_of_a_band(film, samples: int) -> int:
    """Rows that are rendered at a time, a multiple of the blocks' size where that many fit."""
    rows = max(1, LARGEST_BAND // ((int(film.crop_size()[0]) + 2 * _border(film)) * samples))
    return rows if rows < BLOCK else rows - rows % BLOCK


def fits_one_band(film, samples: int) -> bool:
    """Whether the whole image is no more than one band."""
    return int(film.crop_size()[1]) + 2 * _border(film) <= rows_of_a_band(film, samples)


def _border(film) -> int:
    return film.rfilter().border_size() if film.sample_border() else 0


def random_rays(sensor, seed: int, count: int):
    """Sampler and camera rays all over the film."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(1)
    sampler.set_samples_per_wavefront(1)
    sampler.seed(seed, count)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, sampler.next_2d(), aperture)
    return sampler, ray


def render_in_bands(integrator, scene, sensor, seed: int, samples: int, trace) -> None:
    """Render into the sensor's film.

    ``trace(sampler, ray, grid, share)`` does what ``integrator.sample`` does; ``share``: of the rows that are left,
    those of the band.
    """
    film = sensor.film()
    film.prepare(integrator.aov_names())
    border, crop = _border(film), film.crop_size()
    width, height = int(crop[0]) + 2 * border, int(crop[1]) + 2 * border
    rows = rows_of_a_band(film, samples)
    for number, first in enumerate(range(0, height, rows)):
        if integrator.should_stop():
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
    """One ray in each pixel: (rays, weights, where they belong on the film)."""
    position = mi.Vector2f(pixel) + sampler.next_2d()
    on_sensor = (position - mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.crop_size())
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(time, 0.5, on_sensor, aperture)
    # Box filters take the pixel's corner, so that rounding moves no sample to its neighbour
    return ray, weight, mi.Point2f(pixel) if film.rfilter().is_box_filter() else mi.Point2f(position)


def _put(block, film, position, radiance, valid, channels) -> None:
    alpha = dr.select(valid, mi.Float(1), mi.Float(0))
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        values = film.prepare_sample(radiance, mi.Spectrum(0), block.channel_count(), weight=mi.Float(1), alpha=alpha)
    else:
        colour = mi.Color3f(radiance.x) if mi.is_monochromatic else mi.Color3f(radiance)
        shown = [alpha] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
        values = [colour.x, colour.y, colour.z, *shown, mi.Float(1), *channels]
    block.put(position, values)
