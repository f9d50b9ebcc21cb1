"""Images: EXR files with metadata, tone mapping, PNG files, false colours.

EXR files are OpenEXR's matter rather than Mitsuba's, whose writer waits for ever where Dr.Jit has a single thread.
"""

from __future__ import annotations

import json
import math
import os
import re
import threading
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR
from numpy.typing import ArrayLike

# Lightness (CIE L*) rises by about 20 from each to the next: black, indigo, magenta, orange, yellow, pale yellow.
FALSE_COLOURS = np.array([(0, 0, 4), (60, 15, 112), (158, 44, 120), (236, 105, 60), (252, 190, 60), (252, 253, 200)])
ERROR_RANGE = (0.01, 1.0)  # relative errors at the two ends of the false colours, which are logarithmic
# Of the positive values of an AOV: pixels that the film's filter just grazes must not add decades to its scale.
AOV_PERCENTILES = (1, 99.9)
EXTENSIONS = (".exr", ".png")  # of images that `write` writes
CHANNELS = {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA"}  # by their number


@contextmanager
def replacing(path):
    """Give a temporary path beside `path`, one for each thread, that takes its place when the block ends without an
    error. An OSError names `path`, which those of a full disk do not."""
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{threading.get_native_id()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        temporary.unlink(missing_ok=True)


def remove_abandoned(folder, stem=None):
    """Remove temporary files that killed processes left in a folder, of the files called `stem` if it is given; nobody
    may be writing there, or those files."""
    name = ".+" if stem is None else re.escape(stem)
    for file in Path(folder).iterdir():
        if re.fullmatch(rf"\.{name}\.\d+\.(exr|png|json|html)", file.name):
            file.unlink()


def write_exr(path, image, channels, metadata=None, half=False):
    """Write an image, (height, width, channels), with the names of its channels; metadata that EXR attributes cannot
    hold (lists, dicts, None, integers of more than 32 bits) become JSON text. `half` stores 16-bit numbers; raises
    ValueError if the image has some that are too large for that."""
    if half and np.abs(image).max() > np.finfo(np.float16).max:
        raise ValueError(f"{path}: brighter than the 65504 that half precision holds")
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    for key, value in (metadata or {}).items():
        header[key] = value if _fits_attribute(value) else json.dumps(value)
    planes = np.moveaxis(np.asarray(image, np.float16 if half else np.float32), -1, 0)
    with replacing(path) as temporary:
        arrays = {name: np.ascontiguousarray(plane) for name, plane in zip(channels, planes, strict=True)}
        with OpenEXR.File(header, arrays) as file:
            file.write(str(temporary))


def _fits_attribute(value):
    if isinstance(value, int):
        return not isinstance(value, bool) and -(2**31) <= value < 2**31
    return isinstance(value, str | float)


def read_exr(path):
    """Return the image (height, width, channels) float32, the names of its channels (sorted), and its metadata: a dict
    of finite numbers and strings. Raises ValueError, besides what OpenEXR raises, for text that is not UTF-8."""
    with _opened(path, separate_channels=True) as file:
        channels = sorted(file.channels())
        image = np.stack([file.channels()[name].pixels.astype(np.float32) for name in channels], axis=-1)
        return image, channels, _plain(file.header())


def read_exr_metadata(path):
    """Return the metadata of an EXR file without reading its pixels."""
    with _opened(path, header_only=True) as file:
        return _plain(file.header())


def _opened(path, **how):
    try:
        return OpenEXR.File(str(path), **how)
    except UnicodeDecodeError as error:
        text = error.object.decode("latin-1")
        raise ValueError(f"'{path}' has an attribute whose text is not UTF-8: {text!r}; leave it out") from error


def _plain(header):
    # Reports are JSON, which has no number that is not finite
    kept = {key: value for key, value in header.items() if isinstance(value, int | float | str)}
    return {key: value for key, value in kept.items() if isinstance(value, str) or math.isfinite(value)}


def colour(image, channels, layer=""):
    """Return the colour of an image, (height, width, 3): its channels R, G, B (of a layer such as "se."), or Y for all
    three. Raises ValueError if it has neither."""
    for names in (("R", "G", "B"), ("Y", "Y", "Y")):
        wanted = [layer + name for name in names]
        if set(wanted) <= set(channels):
            return image[..., [list(channels).index(name) for name in wanted]]
    raise ValueError(f"no colour channels among {', '.join(channels)}")


def automatic_exposure(rgb):
    """Return the factor that brings the 95th percentile of the brightness to 0.8, or 1 for a black image. A
    percentile, unlike a mean, ignores emitters in view; unlike a log average, it ignores a black background."""
    brightness = np.nan_to_num(rgb, posinf=0, neginf=0).mean(axis=-1)
    level = np.percentile(brightness, 95) or brightness.max()
    return 0.8 / level if level > 0 else 1.0


def tone_map(rgb, exposure):
    """Multiply by `exposure`, clip and apply the sRGB curve; return (height, width, 3) uint8."""
    linear = np.clip(np.nan_to_num(rgb, posinf=0, neginf=0) * exposure, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).astype(np.uint8)


def logarithmic_position(values, ends):
    """Return where values, (height, width), are on a logarithmic scale with the given ends: 0 to 1. What is below it,
    such as zero, is at 0, what is above it or not a number at 1."""
    low, high = np.log(ends)
    position = (np.log(np.maximum(np.nan_to_num(values, nan=np.inf), ends[0])) - low) / (high - low)
    return np.clip(position, 0, 1)


def false_colours(values, ends=ERROR_RANGE):
    """Return the colours, (height, width, 3) uint8, of values, (height, width), on a logarithmic scale with the given
    ends, by default that of relative errors. What is below it, such as zero, has the lowest colour, what is above it or
    not a number the highest."""
    return palette(logarithmic_position(values, ends))


def palette(position):
    """Return the colours (..., 3) uint8 of positions (...) between 0 and 1 on the scale of false colours."""
    stops = np.linspace(0, 1, len(FALSE_COLOURS))
    return np.stack([np.interp(position, stops, FALSE_COLOURS[:, i]) for i in range(3)], axis=-1).astype(np.uint8)


def logarithmic_ends(planes):
    """Return the ends (low, high) of one logarithmic scale for several images, (height, width) each: the least and the
    greatest of their `AOV_PERCENTILES`, in two digits so that they can be told in full. They are a factor of two apart
    at least, and 1 and 2 where nothing is positive."""
    positive = [plane[(plane > 0) & np.isfinite(plane)] for plane in planes]
    found = [np.percentile(values, AOV_PERCENTILES) for values in positive if values.size]
    if not found:
        return 1.0, 2.0
    low, high = (float(f"{end:.2g}") for end in (min(low for low, _ in found), max(high for _, high in found)))
    return min(low, high / 2), high


def write(
    path: str | os.PathLike[str],
    image: ArrayLike | mi.TensorXf,
    channels: Sequence[str] | None = None,
    metadata: dict[str, Any] | None = None,
    exposure: float | None = None,
) -> None:
    """Write an image (height, width, channels) to the file `path`: with all channels to .exr, tone-mapped to .png.

    `image`: linear values, such as `mi.render` and `manylights.render` return. `channels`: their names; by default Y,
    YA, RGB or RGBA by their number. `metadata`: a dict, of an .exr file. `exposure`: a .png file is scaled by
    2^exposure, by default so that the 95th percentile of the brightness is 0.8. Unlike `mi.util.write_bitmap`, it
    works with a single thread. Raises ValueError for another extension, and for names that do not fit the channels.
    """
    planes = np.atleast_3d(np.asarray(image, np.float32))
    names = list(channels or CHANNELS.get(planes.shape[-1], ()))
    check_extension(path)
    if planes.ndim != 3 or len(names) != planes.shape[-1]:
        raise ValueError(
            f"channels must name the channels of an image of shape {planes.shape}, got {', '.join(names) or 'none'}"
        )
    if Path(path).suffix == ".exr":
        write_exr(path, planes, names, metadata)
        return
    rgb = colour(planes, names)
    write_png(path, tone_map(rgb, automatic_exposure(rgb) if exposure is None else 2.0**exposure))


def check_extension(path):
    """Raise ValueError for a path that is of none of the kinds of files that `write` writes."""
    if Path(path).suffix not in EXTENSIONS:
        raise ValueError(f"cannot write '{path}': the output must be an .exr or a .png file")


def read_png(path):
    """Return the pixels, (height, width, 3) uint8, of a PNG file of colours."""
    return np.array(mi.Bitmap(str(path)))


def write_png(path, pixels, metadata=None):
    """Write (height, width, 3) uint8 sRGB values, and metadata: a dict of text."""
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels))
    for key, value in (metadata or {}).items():
        bitmap.metadata()[key] = value
    with replacing(path) as temporary:
        bitmap.write(str(temporary))
