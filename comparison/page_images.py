"""Compact encodings of images for the report's page, with enough dynamic range for exposure changes.

A colour is a half-precision number without its sign and its last `BITS_LEFT_OUT` bits. The remaining 12 bits cover 14
stops below to 16 stops above the white of the pictures, in invisible steps of 0.8%. Horizontal differences, split into
planes of high and low bytes, are compressed by zlib; pixels.js decodes them. Error maps have 8 bits, on scales wide
enough for exposure changes.
"""

import base64
import zlib

import mitsuba as mi
import numpy as np

from . import images

BITS_LEFT_OUT = 3
RELATIVE_ENDS = (1e-4, 10.0)  # logarithmic scale of relative errors
LARGEST = 2**20  # pixels; larger images are reduced to means of blocks


def block_size(height, width):
    """Return the side of the image blocks shown as one pixel of the page: 1 up to `LARGEST` pixels."""
    return max(1, int(np.ceil(np.sqrt(height * width / LARGEST))))


def reduce(image):
    """Reduce an image (height, width, channels) to means of blocks; those at the right and lower edges may be
    smaller."""
    block = block_size(*image.shape[:2])
    if block == 1:
        return image
    rows, columns = np.arange(0, image.shape[0], block), np.arange(0, image.shape[1], block)
    counts = np.minimum(block, image.shape[0] - rows)[:, None] * np.minimum(block, image.shape[1] - columns)
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)
    return sums / counts[..., None]


def colours(rgb, scale):
    """Encode linear colours (height, width, channels) times `scale`; return a dict for pixels.js. Negative and
    non-finite values become black; large values saturate."""
    limit = float(np.finfo(np.float16).max)
    scaled = np.clip(reduce(np.nan_to_num(rgb, posinf=0, neginf=0)) * scale, 0, limit)
    half = scaled.astype(np.float16).view(np.uint16)
    rounded = np.minimum(half + (1 << BITS_LEFT_OUT >> 1), 0x7BFF)
    return _pack(rounded >> BITS_LEFT_OUT, 2)


def relative(errors):
    """Encode relative errors, (height, width), on a logarithmic scale."""
    return _plane(images.logarithmic_position(_reduced(errors), RELATIVE_ENDS))


def signed(errors):
    """Encode signed errors (height, width), clipped to ±100%, by square roots, which resolve small errors."""
    errors = np.clip(_reduced(errors), -1, 1)
    return _plane(0.5 + 0.5 * np.sign(errors) * np.sqrt(np.abs(errors)))


def plane(values):
    """Encode values from 0 to 1, (height, width)."""
    return _plane(_reduced(values))


def jpeg(pixels):
    """Encode an image (height, width, 3) uint8 sRGB as a JPEG data URL."""
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(reduce(pixels).astype(np.uint8))).write(stream, mi.Bitmap.FileFormat.JPEG, 85)
    return "data:image/jpeg;base64," + base64.b64encode(stream.raw_buffer()).decode()


def _reduced(values):
    return reduce(np.nan_to_num(values, nan=1, posinf=1e30, neginf=-1e30)[..., None])[..., 0]


def _plane(values):
    """Encode values from 0 to 1 with 8 bits."""
    return _pack((np.clip(values, 0, 1)[..., None] * 255 + 0.5).astype(np.uint16), 1)


def _pack(codes, depth):
    """Return "width", "height", "channels", "depth" (bytes per code) and "data" of codes (height, width, channels)."""
    differences = np.diff(codes, axis=1, prepend=0)  # modulo 65536
    planes = np.moveaxis(differences, -1, 0)
    content = [(planes >> shift & 255).astype(np.uint8).tobytes() for shift in (0, 8)[:depth]]
    data = base64.b64encode(zlib.compress(b"".join(content), 9)).decode()
    height, width, channels = codes.shape
    return {"width": width, "height": height, "channels": channels, "depth": depth, "data": data}
