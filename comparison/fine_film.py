"""Films of twice the resolution for images that will be denoised, and the images of the usual resolution from them.

At twice the resolution a denoiser sees both sides of an edge inside a pixel, and the mean over fine pixels lowers the
errors of the denoiser itself: with equal samples, denoised errors are a quarter smaller (docs/decisions.md).
The film has a box filter, whose noise the denoiser recognises; the filter of the scene's film follows afterwards.
"""

from contextlib import contextmanager

import mitsuba as mi
import numpy as np

LARGEST = 2**23  # pixels of a fine film: a pass has a sample for each, which bounds memory. 1920 × 1080 have 2^22.98
_POINTS = 16  # per fine pixel, of the mean of a filter
PARTS = 2  # pixels of a fine film along each side of a pixel. With 4: 0.9 to 1.06 times the error, four times as long


def may_be_finer(sensor):
    """Return whether a `mi.Sensor` can have a fine film. Not a batch of sensors, which divides its film between them,
    and no film that is unknown, or has samples beyond its border."""
    film = sensor.film()
    return film.class_name() == "HDRFilm" and not film.sample_border() and sensor.class_name() != "BatchSensor"


def usual_parts(is_possible, pixels, spp):
    """Return the pixels of the film along each side of a pixel, for an image of `pixels` with `spp` samples per pixel,
    None if unlimited: pixels of the film have a sample at least. `is_possible`: the result of `may_be_finer`."""
    is_enough = spp is None or spp >= PARTS**2
    return PARTS if is_possible and is_enough and PARTS**2 * pixels <= LARGEST else 1


@contextmanager
def fine_film(sensor, parts):
    """Within the block, a `mi.Sensor` has a film with `parts`² pixels for each of its film, and a box filter, if
    `parts` is more than one. Samples per pixel are then those of the fine pixels."""
    film = sensor.film()
    if parts > 1:
        sensor.m_film = _refined(film, parts)
    try:
        yield
    finally:
        sensor.m_film = film


def _refined(film, parts):
    """Return a film with `parts`² pixels for each of a `film`."""
    film.prepare([])
    (width, height), (crop_width, crop_height), (x, y) = (
        [parts * int(number) for number in pair] for pair in (film.size(), film.crop_size(), film.crop_offset())
    )
    form = str(film.bitmap().pixel_format()).rpartition(".")[2].lower()
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
        image = _merged_along(image, axis, parts, first, weights)
    return image


def _weights(filter, parts):
    """Return the weights (n,) of fine pixels in the row of a pixel, and the first, relative to its first fine pixel."""
    if filter.is_box_filter():
        return 0, np.ones(parts)
    beyond = int(np.ceil((filter.radius() - 0.5) * parts)) + 1
    # Mean of the filter over each fine pixel
    place = (np.arange(-beyond * _POINTS, (parts + beyond) * _POINTS) + 0.5) / (_POINTS * parts) - 0.5
    values = np.array([filter.eval(float(x))[0] if abs(x) < filter.radius() else 0.0 for x in place])
    means = values.reshape(-1, _POINTS).mean(axis=1)
    # Two means over fine pixels widen the filter. To second order, this takes it back
    return -beyond, means - np.convolve(means, (1, -2, 1), mode="same") / 12


def _merged_along(image, axis, parts, first, weights):
    """Return the weighted means of the fine pixels along an axis, for every pixel."""
    fine = np.moveaxis(image, axis, 0)
    count = len(fine) // parts
    total, whole = np.zeros((count, *fine.shape[1:])), np.zeros(count)
    for number, weight in enumerate(weights):
        row = parts * np.arange(count) + first + number
        inside = np.flatnonzero((row >= 0) & (row < len(fine)))
        total[inside] += weight * fine[row[inside]]
        whole[inside] += weight
    total /= whole.reshape(-1, *[1] * (fine.ndim - 1))
    return np.moveaxis(total, 0, axis).astype(image.dtype)
