"""Uploads never read beyond NumPy's memory, and never share it."""

import ctypes
import mmap

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from vpl.core.arrays import download, upload


def array_before_guard_page(count: int) -> np.ndarray:
    """A float32 array whose last byte is the last one before a page that cannot be read."""
    page = mmap.PAGESIZE
    memory = mmap.mmap(-1, 2 * page)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mprotect(ctypes.c_void_p(address + page), page, 0) == 0
    array = np.frombuffer(memory, np.float32, count, page - 4 * count)
    array[:] = np.arange(count)
    return array


@pytest.mark.parametrize("count", range(1, 66))
def test_kernels_on_uploads_of_any_length_stay_inside(count):
    source = array_before_guard_page(count)
    uploaded = upload(mi.Float, source)
    result = uploaded * 2 + dr.gather(mi.Float, uploaded, dr.arange(mi.UInt32, count))
    assert np.array_equal(download(result), np.arange(count) * 3)


def test_uploads_and_downloads_are_copies():
    source = np.arange(20, dtype=np.float32)
    uploaded = upload(mi.Float, source)
    source[:] = -1
    copy = download(uploaded)
    assert np.array_equal(copy, np.arange(20))
    copy[:] = -2
    assert np.array_equal(download(uploaded), np.arange(20))


def test_shapes_and_types():
    assert type(upload(mi.UInt32, [1, 2])) is mi.UInt32
    assert download(mi.Point3f([1, 2, 3, 4], 0, 1)).shape == (4, 3)
    assert len(upload(mi.Float, np.zeros((0, 3)))) == 0
