"""Films of twice the resolution for images that will be denoised, and the images of the usual resolution from them.

At twice the resolution a denoiser sees both sides of an edge inside a pixel, and the mean over fine pixels lowers the
errors of the denoiser itself: with equal samples, denoised errors are a quarter smaller (docs/decisions.md).
The film has a box filter, whose noise the denoiser recognises; the filter of the scene's film follows afterwards.
"""

import re
from contextlib import contextmanager

import mitsuba as mi
import numpy as np

from vpl.core.arrays import upload
from vpl.core.exclusive import exclusive

LARGEST = 2**23  # pixels of a fine film: a pass has a sample for each, which bounds memory. 1920 × 1080 have 2^22.98
PARTS = 2  # pixels of a fine film along each side of a pixel. With 4: 0.9 to 1.06 times the error, four times as long
_POINTS = 16  # per fine pixel, of the mean of a filter


def usual_parts(sensor, integrator, spp):
    """Return the pixels of the film along each side of a pixel, for an image by a `mi.Sensor` with `spp` samples per
    pixel, None if unlimited: pixels of the film have a sample at least."""
    film = sensor.film()
    pixels = PARTS**2 * int(np.prod(np.array(film.crop_size(), np.int64)))
    is_usual = film.class_name() == "HDRFilm" and not film.sample_border()
    # A batch of sensors divides its film between them
    is_possible = is_usual and sensor.class_name() != "BatchSensor" and pixels <= LARGEST
    return PARTS if is_possible and _suits(integrator) and (spp is None or spp >= PARTS**2) else 1


def _suits(integrator):
    """Return whether an integrator gains by a fine film: not one that splats light, whose sensor knows its resolution,
    nor plugins of this project that share work between the samples of a pixel."""
    return getattr(integrator, "suits_fine_film", isinstance(integrator, mi.SamplingIntegrator))


@contextmanager
def fine_film(sensor, parts):
    """Within the block, a `mi.Sensor` has a film with `parts`² pixels for each of its film, and a box filter, if
    `parts` is more than one. Samples per pixel are then those of the fine pixels. Raises RuntimeError if another thread
    uses the sensor."""
    if parts == 1:
        yield
        return
    with exclusive(sensor=sensor):
        film = sensor.film()
        sensor.m_film = _refined(film, parts)
        try:
            yield
        finally:
            sensor.m_film = film


def _refined(film, parts):
    """Return a film with `parts`² pixels for each of a `film`."""
    (width, height), (crop_width, crop_height), (x, y) = (
        [parts * int(number) for number in pair] for pair in (film.size(), film.crop_size(), film.crop_offset())
    )
    # A bitmap would tell the format, too, but replace the image of the film
    form = re.search(r"pixel_format = (\w+)", str(film)).group(1)
    return mi.load_dict({
        "type": "hdrfilm", "width": width, "height": height, "crop_width": crop_width, "crop_height": crop_height,
        "crop_offset_x": x, "crop_offset_y": y, "component_format": "float32", "rfilter": {"type": "box"},
        "pixel_format": {"y": "luminance", "ya": "luminance_alpha"}.get(form, form),
    })  # fmt: skip


def merged(image, parts, filter):
    """Return the image (height, width, channels) of a film from that of a fine film with `parts`² pixels for each, by
    the `filter` of the film (`mi.ReconstructionFilter`). At the border, weights are those of the pixels that exist, as
    in Mitsuba."""
    if parts == 1:
        return image
    first, weights = _weights(filter, parts)
    for axis in (0, 1):
        image = np.moveaxis(_merged_rows(np.moveaxis(image, axis, 0), parts, first, weights), 0, axis)
    return image


def _weights(filter, parts):
    """Return the weights (n,) of fine pixels in the row of a pixel, and the first, relative to its first fine pixel."""
    if filter.is_box_filter():
        return 0, np.ones(parts)
    beyond = int(np.ceil((filter.radius() - 0.5) * parts)) + 1
    # Mean of the filter over each fine pixel
    place = (np.arange(-beyond * _POINTS, (parts + beyond) * _POINTS) + 0.5) / (_POINTS * parts) - 0.5
    values = np.array(filter.eval(upload(mi.Float, place))) * (np.abs(place) < filter.radius())
    means = values.reshape(-1, _POINTS).mean(axis=1)
    # Two means over fine pixels widen the filter. To second order, this takes it back
    weights = means - np.convolve(means, (1, -2, 1), mode="same") / 12
    # Around bright pixels, negative weights would make dark ones negative
    return -beyond, weights if values.min() < 0 else np.maximum(weights, 0)


def _merged_rows(fine, parts, first, weights):
    """Return the weighted means of the rows (n, ...) of fine pixels, for every row of pixels."""
    count, last = len(fine) // parts, first + len(weights)
    padding = [(max(-first, 0), max(last - parts, 0)), *[(0, 0)] * (fine.ndim - 1)]
    rows = np.pad(fine, padding)
    exists = np.pad(np.ones(len(fine)), padding[0])
    total, whole = np.zeros((count, *fine.shape[1:]), fine.dtype), np.zeros(count)
    weighted = np.empty_like(total)
    for number, weight in enumerate(weights):
        if weight:
            steps = slice(number, number + parts * count, parts)
            total += np.multiply(rows[steps], fine.dtype.type(weight), out=weighted)
            whole += weight * exists[steps]
    total /= whole.reshape(-1, *[1] * (fine.ndim - 1)).astype(fine.dtype)
    return total
