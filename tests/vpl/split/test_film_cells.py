"""Cells of a film that is finer than the image, or has pixels with different numbers of rays."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from vpl.core.arrays import upload
from vpl.split.film_cells import FilmCells
from vpl.split.pixel_rays import PixelRays

RNG = np.random.default_rng(1)
# (Rays of pixels, parts, width in pixels)
LAYOUTS = {
    "all numbers": (PixelRays.by_density(10.0 ** RNG.uniform(-1.5, 1.5, 120), 16), 1, 12),
    "few numbers": (PixelRays.by_density(np.repeat([1.0, 2.0, 3.0], [7, 1, 13]), 8), 1, 7),
    "one pixel": (PixelRays.by_density(np.ones(1), 4), 1, 1),
    "equal numbers": (PixelRays.uniform(12, 3), 1, 4),
    "a fine film": (PixelRays.uniform(15, 8), 2, 5),
    "a fine film, odd numbers": (PixelRays.uniform(21, 12), 2, 3),
    "a fine film of one pixel": (PixelRays.uniform(1, 4), 2, 1),
    "a finer film": (PixelRays.uniform(6, 18), 3, 2),
    "a fine film, all numbers": (PixelRays.by_density(10.0 ** RNG.uniform(-1.5, 1.5, 120), 16), 2, 8),
}
layouts = pytest.mark.parametrize("layout", LAYOUTS)


def cells_of(layout):
    rays, parts, width = LAYOUTS[layout]
    return FilmCells(replace(rays, cells=parts**2), width)


def places(cells):
    """(Cell, number in the cell, pixel) of every ray, each (rays,)."""
    lane = dr.arange(mi.UInt32, cells.rays.count)
    found, pixel = cells.places(lane), cells.rays.places(lane).pixel
    return tuple(np.array(x).astype(int) for x in (found.pixel, found.number, pixel))


@layouts
def test_the_rays_of_a_pixel_are_divided_equally_between_its_cells(layout):
    cells = cells_of(layout)
    cell, number, pixel = places(cells)
    each = cells.rays.numbers // cells.parts**2
    assert np.bincount(cell, minlength=cells.count).size == cells.count
    row, column = np.divmod(cell, cells.width * cells.parts)
    assert (row // cells.parts * cells.width + column // cells.parts == pixel).all()
    assert (np.bincount(cell) == np.bincount(cell, each[pixel]) / np.bincount(cell)).all()
    # Each number once in a cell
    assert len(set(zip(cell, number, strict=True))) == cells.rays.count and (number < each[pixel]).all()
    assert set(each) == set(cells.sizes)


@layouts
def test_positions_are_those_of_the_cells_in_the_film(layout):
    cells = cells_of(layout)
    cell = np.arange(cells.count)
    found = np.array(cells.position(upload(mi.UInt32, cell)))
    np.testing.assert_array_equal(found, [cell % (cells.width * cells.parts), cell // (cells.width * cells.parts)])


@layouts
def test_even_values_have_the_means_of_cells(layout):
    cells = cells_of(layout)
    cell, *_ = places(cells)
    values = np.random.default_rng(1).normal(size=(3, cells.rays.count))
    expected = np.array([np.bincount(cell, x) / np.bincount(cell) for x in values])
    found = cells.evenly(mi.Color3f(*(upload(mi.Float, x) for x in values)))
    assert isinstance(found, mi.Color3f)
    np.testing.assert_allclose(np.array(found).reshape(3, cells.count, cells.mean).mean(-1), expected, atol=1e-5)
    single = cells.evenly(upload(mi.Float, values[0]))
    assert isinstance(single, mi.Float)
    np.testing.assert_array_equal(np.array(single), np.array(found)[0])


@layouts
def test_plain_cells_keep_the_order_of_rays(layout):
    cells = cells_of(layout)
    values = upload(mi.Float, np.arange(cells.rays.count))
    is_same = np.array_equal(np.array(cells.evenly(values)), np.array(values))
    assert cells.is_plain == (cells.parts == 1 and len(cells.rays.sizes) == 1) and is_same >= cells.is_plain


@layouts
def test_even_masks_have_the_fractions_of_cells(layout):
    cells = cells_of(layout)
    cell, _, pixel = places(cells)
    rng = np.random.default_rng(2)
    # Some pixels are covered fully, and some not at all
    mask = rng.random(cells.rays.count) < np.clip(rng.uniform(-0.5, 1.5, cells.rays.pixels), 0, 1)[pixel]
    even = np.array(cells.evenly_masked(mi.Bool(mask), 3)).reshape(cells.count, cells.mean).mean(1)
    fraction, number = np.bincount(cell, mask) / np.bincount(cell), np.bincount(cell)
    assert np.abs(even - fraction).max() < 1 / cells.mean
    # Without rounding where the fraction is a multiple of 1 / mean
    assert (even == fraction)[cells.mean % number == 0].all()


def test_the_order_of_cells_is_random_for_every_pixel_and_round():
    """A regular order would light a pattern of cells where few rays of a pixel are lit."""
    cells = FilmCells(replace(PixelRays.uniform(4096, 8), cells=4), 64)
    row, column = np.divmod(places(cells)[0], 128)
    part = (row % 2 * 2 + column % 2).reshape(4096, 8)
    for number in range(8):
        for pixels in (slice(None), slice(0, None, 2), slice(0, None, 4)):
            counts = np.bincount(part[pixels, number], minlength=4)
            assert stats.chisquare(counts).pvalue > 1e-4
    # Of one round and the next, and of a pixel and the next
    for one, other in ((part[:, 0], part[:, 4]), (part[1:, 0], part[:-1, 0])):
        assert stats.chisquare(np.bincount((one - other) % 4, minlength=4)).pvalue > 1e-4
