"""Images: EXR files with metadata, tone mapping, PNG files, false colours.

EXR files are read and written by OpenEXR, as Mitsuba waits for ever with a single thread (threads.py).
"""

from __future__ import annotations

import io
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

# Lightness (CIE L*) increases in steps of about 20: black, indigo, magenta, orange, yellow, pale yellow
FALSE_COLOURS = np.array([(0, 0, 4), (60, 15, 112), (158, 44, 120), (236, 105, 60), (252, 190, 60), (252, 253, 200)])
ERROR_RANGE = (0.01, 1.0)  # relative errors at the ends of the logarithmic scale of false colours
# Of the positive values of an AOV; the rest are pixels at the margin of the film's filter, of tiny values
AOV_PERCENTILES = (1, 99.9)
EXTENSIONS = (".exr", ".png")  # of files from `write`
CHANNELS = {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA"}  # by their number
COLOURS = "RGB", "XYZ", "Y"  # names of the channels of the colour; the first that are all present count
# From CIE XYZ to the primaries of sRGB [IEC 61966-2-1], as Mitsuba's `xyz_to_srgb`
RGB_OF_XYZ = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)
MOST_STOPS = 100.0  # of an exposure: single precision holds 2^-126 to 2^127


@contextmanager
def replacing(path):
    """Yield a temporary path beside `path`, unique to the thread; the file replaces `path` after the block, unless an
    exception leaves it. Each OSError names `path`, also for a full disk."""
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
    """Remove temporary files of killed processes in a folder, only for files with the given `stem` unless it is None.
    No process may be writing these files."""
    name = ".+" if stem is None else re.escape(stem)
    for file in Path(folder).iterdir():
        if re.fullmatch(rf"\.{name}\.\d+\.(exr|png|json|html)", file.name):
            file.unlink()


def write_exr(path, image, channels, metadata=None, half=False):
    """Write an image (height, width, channels) and the names of the channels. Metadata of types without an EXR
    attribute (lists, dicts, None, integers of more than 32 bits) become JSON text. `half` stores 16-bit numbers, and
    raises ValueError for larger values."""
    if half and np.abs(image).max() > np.finfo(np.float16).max:
        raise ValueError(f"{path}: brighter than the 65504 that half precision holds")
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    for key, value in (metadata or {}).items():
        header[key] = value if _fits_attribute(value) else json.dumps(value)
    planes = np.moveaxis(np.asarray(image, np.float16 if half else np.float32), -1, 0)
    arrays = {name: np.ascontiguousarray(plane) for name, plane in zip(channels, planes, strict=True)}
    # OpenEXR raises no OSError if the disk is full, and no error at all for the last bytes
    content = io.BytesIO()
    with OpenEXR.File(header, arrays) as file:
        file.write(content)
    with replacing(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def _fits_attribute(value):
    if isinstance(value, int):
        return not isinstance(value, bool) and -(2**31) <= value < 2**31
    return isinstance(value, str | float)


def read_exr(path):
    """Return the image (height, width, channels) float32, the sorted names of its channels, and its metadata, a dict of
    finite numbers and strings. Raises OpenEXR's exceptions, and ValueError for text that is not UTF-8."""
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
    # JSON, the format of reports, has only finite numbers
    kept = {key: value for key, value in header.items() if isinstance(value, int | float | str)}
    return {key: value for key, value in kept.items() if isinstance(value, str) or math.isfinite(value)}


def planes_of(bitmap):
    """Return the image (height, width, channels) float32 of a `mi.Bitmap`, and the names of its channels."""
    columns, rows = bitmap.size()
    # Shares the memory of the bitmap, if it holds such numbers
    planes = np.asarray(bitmap).astype(np.float32, copy=False)
    return planes.reshape(rows, columns, -1), [field.name for field in bitmap.struct_()]


def _colour_names(channels, layer=""):
    """Return the names of the channels of the colour, one of `COLOURS`. Raises ValueError if there are none."""
    for names in COLOURS:
        if {layer + name for name in names} <= set(channels):
            return names
    raise ValueError(f"no colour channels among {', '.join(channels)}")


def colour_indices(channels, layer=""):
    """Return the indices of the channels of the colour (of a layer such as "se."), as `COLOURS` names them. Raises
    ValueError if there are none."""
    return [list(channels).index(layer + name) for name in _colour_names(channels, layer)]


def check_colour(channels, purpose):
    """Raise ValueError if there are no channels of a colour among `channels`, which the `purpose` needs."""
    try:
        _colour_names(channels)
    except ValueError as error:
        allowed = ", ".join(COLOURS)
        raise ValueError(f"{purpose} needs an image with colour ({allowed}), such as of a hdrfilm: {error}") from None


def colour(image, channels, layer=""):
    """Return the colour (height, width, 3) of an image: channels R, G and B (of a layer such as "se."), computed from
    X, Y and Z, or three times Y. Raises ValueError if the image has none of them."""
    names, found = _colour_names(channels, layer), image[..., colour_indices(channels, layer)]
    if names == "XYZ":
        return (found @ RGB_OF_XYZ.T).astype(found.dtype)
    return found if names == "RGB" else np.repeat(found, 3, axis=-1)


def with_colour(image, channels, rgb):
    """Return an image (height, width, channels) with another colour `rgb` (height, width, 3)."""
    names, image = _colour_names(channels), np.array(image)
    if names == "XYZ":
        rgb = rgb @ np.linalg.inv(RGB_OF_XYZ).T
    image[..., colour_indices(channels)] = rgb.mean(axis=-1, keepdims=True) if names == "Y" else rgb
    return image


def automatic_exposure(rgb):
    """Return the factor that scales the 95th percentile of the brightness to 0.8, or 1 for a black image. A percentile
    ignores visible emitters, unlike a mean, and a black background, unlike a log average."""
    brightness = np.nan_to_num(rgb, posinf=0, neginf=0).mean(axis=-1)
    level = np.percentile(brightness, 95) or brightness.max()
    return 0.8 / level if level > 0 else 1.0


def tone_map(rgb, exposure):
    """Multiply by `exposure`, clip and apply the sRGB curve; return (height, width, 3) uint8."""
    linear = np.clip(np.nan_to_num(rgb, posinf=0, neginf=0) * exposure, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).astype(np.uint8)


def logarithmic_position(values, ends):
    """Return the positions, 0 to 1, of values (height, width) on a logarithmic scale with the given ends. Values below
    the scale, such as zero, are at 0; values above it and NaN are at 1."""
    low, high = np.log(ends)
    position = (np.log(np.maximum(np.nan_to_num(values, nan=np.inf), ends[0])) - low) / (high - low)
    return np.clip(position, 0, 1)


def false_colours(values, ends=ERROR_RANGE):
    """Return the false colours (height, width, 3) uint8 of values (height, width) on a logarithmic scale, by default
    the scale of relative errors. Values outside the scale are handled as in `logarithmic_position`."""
    return palette(logarithmic_position(values, ends))


def palette(position):
    """Return the colours (..., 3) uint8 of positions (...), 0 to 1, on the scale of false colours."""
    stops = np.linspace(0, 1, len(FALSE_COLOURS))
    return np.stack([np.interp(position, stops, FALSE_COLOURS[:, i]) for i in range(3)], axis=-1).astype(np.uint8)


def logarithmic_ends(planes):
    """Return the ends (low, high) of a common logarithmic scale for images (height, width): the least and greatest of
    the images' `AOV_PERCENTILES`, rounded to two digits for display. The ratio is at least two; without positive values
    the ends are 1 and 2."""
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
    """Write an image (height, width, channels) to an .exr file with all channels, or tone-mapped to a .png file.

    `image`: linear values, as from `mi.render` and `manylights.render`. `channels`: names; by default Y, YA, RGB or
    RGBA by the number of channels. `metadata`: attributes of an .exr file, texts of a .png file. `exposure`: a .png
    file is scaled by 2^exposure, by default so that the 95th percentile of the brightness is 0.8. Works with a single
    thread, unlike `mi.util.write_bitmap`. Raises ValueError for another extension, for a wrong number of names, and for
    an exposure beyond 100 stops, darker or brighter.
    """
    planes = np.atleast_3d(np.asarray(image, np.float32))
    names = list(channels or CHANNELS.get(planes.shape[-1], ()))
    check_extension(path)
    check_exposure(exposure)
    if planes.ndim != 3 or len(names) != planes.shape[-1]:
        raise ValueError(
            f"channels must name the channels of an image of shape {planes.shape}, got {', '.join(names) or 'none'}"
        )
    if Path(path).suffix == ".exr":
        write_exr(path, planes, names, metadata)
        return
    rgb = colour(planes, names)
    write_png(path, tone_map(rgb, automatic_exposure(rgb) if exposure is None else 2.0**exposure), metadata)


def check_extension(path):
    """Raise ValueError for a path without one of the `EXTENSIONS`."""
    if Path(path).suffix not in EXTENSIONS:
        raise ValueError(f"cannot write '{path}': the output must be an .exr or a .png file")


def check_exposure(exposure):
    """Raise ValueError for an exposure, in stops, that is neither None nor from -100 to 100."""
    if exposure is not None and not -MOST_STOPS <= exposure <= MOST_STOPS:
        raise ValueError(f"exposure must be from {-MOST_STOPS:g} to {MOST_STOPS:g} stops, got {exposure!r}")


def read_png(path):
    """Return the pixels (height, width, 3) uint8 of a colour PNG file."""
    return np.array(mi.Bitmap(str(path)))


def write_png(path, pixels, metadata=None):
    """Write sRGB values (height, width, 3) uint8, and metadata as text, JSON unless a value is text."""
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels))
    for key, value in (metadata or {}).items():
        bitmap.metadata()[key] = value if isinstance(value, str) else json.dumps(value)
    content = mi.MemoryStream()
    bitmap.write(content, mi.Bitmap.FileFormat.PNG)
    with replacing(path) as temporary:
        temporary.write_bytes(content.raw_buffer())
