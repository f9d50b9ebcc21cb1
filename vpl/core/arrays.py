"""Safe copies of arrays between NumPy and Dr.Jit.

On the LLVM backend ``mi.Float(ndarray)`` aliases NumPy's memory. Kernels read whole packets, and so read past the end
of an array whose length is not a multiple of the packet width. Memory that Dr.Jit allocates is padded; therefore every
upload uses :func:`upload`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

_NUMPY_DTYPES = {
    dr.VarType.Float32: np.float32, dr.VarType.Float64: np.float64,
    dr.VarType.UInt32: np.uint32, dr.VarType.Int32: np.int32, dr.VarType.UInt64: np.uint64,
}  # fmt: skip


def upload(array_type, values):
    """Copy a NumPy array into memory owned by Dr.Jit.

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
    """Copy the rows (n, k) of a NumPy array to vectors of k entries (e.g. ``mi.Point3f``) by :func:`upload`."""
    return vector_type(*(upload(dr.value_t(vector_type), column) for column in rows.T))


def download(values):
    """Copy a Dr.Jit array to NumPy: ``(n,)`` for flat types, ``(n, k)`` for vectors of k entries."""
    dr.eval(values)
    dr.sync_thread()
    if dr.depth_v(type(values)) == 1:
        return np.array(values.numpy(), copy=True)
    # Download channel by channel: a joint array of the vector compiles a kernel for every width
    return np.stack(np.broadcast_arrays(*(download(channel) for channel in values)), axis=1)


def ranges(first: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Concatenate the integer ranges first[i] .. first[i] + size[i] - 1."""
    return np.repeat(first - np.cumsum(size) + size, size) + np.arange(size.sum())


def add_at(target, values, index):
    """Add ``values`` to the entries ``index`` of an array; duplicate indices are allowed. The caller evaluates.

    ``ReduceMode.Local`` keeps the kernel independent of the size of ``target``. By default ``dr.scatter_add``
    duplicates small targets and compiles their width into the kernel.
    """
    dr.scatter_add(target, values, index, mode=dr.ReduceMode.Local)


def spectrum_to_rgb(spectrum) -> mi.Color3f:
    """Convert an unpolarized spectrum of one or three channels to RGB (mono: equal channels)."""
    return mi.Color3f(spectrum[0]) if dr.size_v(mi.Spectrum) == 1 else mi.Color3f(spectrum)


def rgb_to_spectrum(rgb):
    """Invert :func:`spectrum_to_rgb`."""
    return mi.Spectrum(rgb[0]) if dr.size_v(mi.Spectrum) == 1 else mi.Spectrum(rgb)


def channel_mean(spectrum):
    """Mean over the channels, per lane.

    ``dr.mean`` compiles the number of lanes into the kernel, which is then compiled again for every size.
    """
    return dr.sum(spectrum) * (1.0 / dr.size_v(type(spectrum)))


def ones(count: int):
    """Spectrum of ones with a separate evaluated array for each channel.

    Arrays shared by channels change the first kernels that use them, which are then compiled twice.
    """
    channels = [dr.opaque(mi.Float, 1.0, count) for _ in range(dr.size_v(mi.UnpolarizedSpectrum))]
    return mi.UnpolarizedSpectrum(*channels)


def select_record(mask, chosen, otherwise):
    """Apply ``dr.select`` to every field of a dataclass; fields of ``otherwise`` that are None remain None."""
    return type(otherwise)(
        **{
            name: None if value is None else dr.select(mask, getattr(chosen, name), value)
            for name, value in vars(otherwise).items()
        }
    )


# Larger radiances and intensities count as infinite: sums over lights and samples must not overflow single precision
LARGEST_VALUE = 1e30

# Matrix entries or pairs in one chunk: limits the memory independently of the image size
ENTRIES = 1 << 23


# Maximum of a UInt32: no limit in practice
NO_LIMIT = 0xFFFFFFFF


def upload_limit(limit: float):
    """Upload an upper limit of a count (math.inf: none) as an opaque UInt32, so that kernels do not depend on it."""
    return dr.opaque(mi.UInt32, int(min(limit, NO_LIMIT)))


def usable(value):
    """Mask of the radiances, intensities or densities from 0 to ``LARGEST_VALUE``; NumPy or Dr.Jit."""
    return (value >= 0) & (value <= LARGEST_VALUE)


def carries_light(colours: np.ndarray) -> np.ndarray:
    """Mask (n,) of the colours (n, 3) with a positive mean in single precision, the precision of light trees."""
    with np.errstate(invalid="ignore", over="ignore"):
        return colours.mean(1, dtype=np.float64).astype(np.float32) > 0


def finite_or_zero(spectrum):
    """Replace infinite (see :func:`usable`), negative and NaN values by 0, so that a bad texel affects only itself."""
    return dr.select(usable(spectrum), spectrum, 0)


def chunks(sizes: np.ndarray, most: int):
    """Yield ranges (first, last + 1) of consecutive rows with at most ``most`` entries together.

    A row with more entries forms a range alone. ``sizes`` (n,): entries of each row.
    """
    ends, first = np.cumsum(sizes), 0
    while first < len(ends):
        before = ends[first - 1] if first else 0
        last = max(int(np.searchsorted(ends, before + most, side="right")), first + 1)
        yield first, last
        first = last


def even_chunks(rows: int, width: int = 1, most: int | None = None):
    """Split ``rows`` rows of ``width`` entries into chunks of at most ``most`` (default: ENTRIES) entries each."""
    step = max((most or ENTRIES) // width, 1)
    return ((first, min(first + step, rows)) for first in range(0, rows, step))
