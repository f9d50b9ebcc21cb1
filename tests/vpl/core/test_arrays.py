"""Uploads never read beyond NumPy's memory, and never share it; chunks, and orders along a Morton curve."""

import ctypes
import mmap

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from vpl.core.arrays import chunks, download, even_chunks, upload
from vpl.core.morton import interleave, morton_order


def array_before_guard_page(count: int) -> np.ndarray:
    """A float32 array that ends at the end of a page, before a page without read permission."""
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


def test_chunks_hold_as_many_rows_as_fit_and_at_least_one():
    assert list(chunks(np.array([3, 4, 3, 20, 0, 0, 9, 1]), 10)) == [(0, 3), (3, 4), (4, 8)]
    assert list(chunks(np.zeros(0), 10)) == []


@pytest.mark.parametrize(("rows", "width"), [(7, 3), (9, 3), (1, 50), (4, 10), (0, 3)])
def test_even_chunks_are_chunks_of_equal_rows(rows, width):
    assert list(even_chunks(rows, width, 10)) == list(chunks(np.full(rows, width), 10))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_morton_order_follows_the_codes_of_the_cells(dtype):
    cells = np.random.default_rng(1).permutation(16**3)[:500]
    cells = np.stack([cells % 16, cells // 16 % 16, cells // 256], axis=1)
    cells[0], cells[1] = 0, 15
    order = morton_order((2 * cells - 5).astype(dtype), bits=4)
    codes = interleave(cells)[order]
    assert (codes[1:] >= codes[:-1]).all() and sorted(order.tolist()) == list(range(500))


@pytest.mark.parametrize("extent", [0.0, 1e-45, 1e-39])
def test_points_next_to_each_other_keep_their_order(extent):
    """An extent with an infinite inverse counts as no extent."""
    points = np.float32([[extent, 0, 0], [0, 0, 0], [extent, 0, 0]])
    assert morton_order(points, bits=10).tolist() == [0, 1, 2]
