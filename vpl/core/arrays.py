"""Arrays that move between NumPy and Dr.Jit, in the only two ways that are safe.

On the LLVM backend ``mi.Float(ndarray)`` aliases NumPy's memory, and kernels read it in whole packets, past the end
when the length is no multiple of the packet width.  Memory that Dr.Jit allocated is padded, so every upload goes
through :func:`upload`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

_NUMPY_DTYPES = {
    dr.VarType.Float32: np.float32, dr.VarType.Float64: np.float64,
    dr.VarType.UInt32: np.uint32, dr.VarType.Int32: np.int32,
}  # fmt: skip


def upload(array_type, values):
    """Copy a NumPy array into memory that Dr.Jit owns.

    Parameters: ``array_type``, a flat Dr.Jit type such as ``mi.Float``; ``values``, any array, which is flattened in C
    order and converted to the type's precision.  Returns an evaluated array of ``values.size`` entries.
    """
    plain_type = dr.detached_t(array_type)
    flat = np.ascontiguousarray(values, dtype=_NUMPY_DTYPES[dr.type_v(plain_type)]).reshape(-1)
    if flat.size == 0:
        return array_type()
    if dr.backend_v(plain_type) != dr.JitBackend.LLVM:
        result = plain_type(flat)
        dr.eval(result)
        return array_type(result)
    result = dr.empty(plain_type, flat.size)
    dr.eval(result)
    dr.sync_thread()
    result.numpy()[:] = flat
    return array_type(result)


def upload_vectors(vector_type, rows):
    """Copy rows (n, k) of NumPy to vectors of k entries, such as ``mi.Point3f``, as :func:`upload` does."""
    return vector_type(*(upload(mi.Float, column) for column in rows.T))


def download(values):
    """Copy a Dr.Jit array to NumPy: ``(n,)`` for flat types, ``(n, k)`` for vectors of k entries."""
    dr.eval(values)
    dr.sync_thread()
    if dr.depth_v(type(values)) == 1:
        return np.array(values.numpy(), copy=True)
    # Channel by channel: making one array of a vector compiles a kernel for every width
    return np.stack(np.broadcast_arrays(*(download(channel) for channel in values)), axis=1)


def ranges(first: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The numbers first[i] .. first[i] + size[i] - 1 for one i after another, of NumPy arrays."""
    return np.repeat(first - np.cumsum(size) + size, size) + np.arange(size.sum())


def add_at(target, values, index):
    """Add values to some entries of an array, several to the same one if need be; to be evaluated by the caller.

    Left to itself, ``dr.scatter_add`` keeps copies of small targets whose width it bakes into the kernel, which is then
    compiled anew for every size.
    """
    dr.scatter_add(target, values, index, mode=dr.ReduceMode.Local)


def spectrum_to_rgb(spectrum) -> mi.Color3f:
    """Widen an unpolarized spectrum of one or three channels to three (mono: the same value three times)."""
    return mi.Color3f(spectrum[0]) if dr.size_v(mi.Spectrum) == 1 else mi.Color3f(spectrum)


def rgb_to_spectrum(rgb):
    """The inverse of :func:`spectrum_to_rgb`."""
    return mi.Spectrum(rgb[0]) if dr.size_v(mi.Spectrum) == 1 else mi.Spectrum(rgb)


def channel_mean(spectrum):
    """Mean over the channels of every lane.  (``dr.mean`` bakes the number of lanes into the kernel, which is then
    compiled anew for every size.)"""
    return dr.sum(spectrum) * (1.0 / dr.size_v(type(spectrum)))


def ones(count: int):
    """A spectrum of ones, as evaluated arrays that are distinct for every channel: arrays shared by the channels would
    make the kernels that first use them other kernels than those that follow."""
    channels = [dr.opaque(mi.Float, 1.0, count) for _ in range(dr.size_v(mi.UnpolarizedSpectrum))]
    return mi.UnpolarizedSpectrum(*channels)


def select_record(mask, chosen, otherwise):
    """``dr.select`` for the fields of a dataclass; those that are None stay so."""
    return type(otherwise)(
        **{
            name: None if value is None else dr.select(mask, getattr(chosen, name), value)
            for name, value in vars(otherwise).items()
        }
    )


# Radiances and intensities above count as infinite: sums over lights and samples must stay in single precision's range
LARGEST_VALUE = 1e30

# Entries of matrices, or pairs, that are worked on at a time: bounds the memory whatever the size of the image
ENTRIES = 1 << 23


# Of a count on the device: as good as no limit
NO_LIMIT = 0xFFFFFFFF


def upload_limit(limit: float):
    """A largest count, math.inf for none, as an opaque UInt32: the kernel is the same whatever it is."""
    return dr.opaque(mi.UInt32, int(min(limit, NO_LIMIT)))


def usable(value):
    """Mask of where a radiance, an intensity or a density is a number from 0 to ``LARGEST_VALUE``; NumPy or Dr.Jit."""
    return (value >= 0) & (value <= LARGEST_VALUE)


def carries_light(colours: np.ndarray) -> np.ndarray:
    """Mask (n,) of colours (n, 3) whose mean is positive in single precision, by which light trees are built."""
    with np.errstate(invalid="ignore", over="ignore"):
        return colours.mean(1, dtype=np.float64).astype(np.float32) > 0


def finite_or_zero(spectrum):
    """Replace values that are infinite (see :func:`usable`), negative or not a number by 0, so that one bad texel
    cannot spoil an image."""
    return dr.select(usable(spectrum), spectrum, 0)


def chunks(sizes: np.ndarray, most: int):
    """Yield ranges of consecutive rows, (first, one past the last), of at most ``most`` entries together, or of one row
    that alone has more.  ``sizes`` (n,): entries of each row."""
    ends, first = np.cumsum(sizes), 0
    while first < len(ends):
        before = ends[first - 1] if first else 0
        last = max(int(np.searchsorted(ends, before + most, side="right")), first + 1)
        yield first, last
        first = last


def even_chunks(rows: int, width: int = 1, most: int | None = None):
    """Chunks, as of :func:`chunks`, of ``rows`` rows of ``width`` entries each; by default at most ENTRIES together."""
    step = max((most or ENTRIES) // width, 1)
    return ((first, min(first + step, rows)) for first in range(0, rows, step))
