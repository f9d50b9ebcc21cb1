"""Different numbers of camera rays in pixels: the numbers, the places of rays, and what depends on them."""

import itertools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tests.support.marks import stress
from tests.support.properties import examples
from vpl.core.arrays import upload
from vpl.split.gather_vertices import GatherVertices, LitVertices, drawn_later
from vpl.split.lattice import Lattice
from vpl.split.pixel_rays import Continued, PixelRays, RayNumbers

RNG = np.random.default_rng(0)
ONE_BRIGHT, ONE_DARK = np.full(77, 1e-3), np.full(77, 5.0)
ONE_BRIGHT[30], ONE_DARK[11] = 1e4, 1e-4
DENSITIES = {
    "constant": np.full(64, 0.3),
    "random": RNG.uniform(0.1, 5, 1001),
    "random in rows": RNG.exponential(size=(9, 13)).astype(np.float32) + np.float32(1e-6),
    "one pixel is bright": ONE_BRIGHT,
    "all pixels but one are bright": ONE_DARK,
    "half of the pixels are bright": np.repeat([1.0, 3.0], 500),
    "three of two kinds": np.array([1.0, 3.0, 3.0]),
    "a huge range": 10.0 ** RNG.uniform(-140, 140, 503),
    "powers of two": 2.0 ** RNG.integers(-3, 4, 999),
    "roots of powers of two": 2.0 ** (RNG.integers(-6, 7, 999) / 2),
    "two pixels": np.array([1.0, 1e9]),
    "one pixel": np.array([1e-9]),
}

densities = pytest.mark.parametrize("density", [pytest.param(x, id=name) for name, x in DENSITIES.items()])


def usual_rays(pixels=120, mean=16, seed=1):
    """Rays of pixels with all five numbers, from a quarter of the mean to four times."""
    rays = PixelRays.by_density(10.0 ** np.random.default_rng(seed).uniform(-1.5, 1.5, pixels), mean)
    assert np.bincount(rays.level, minlength=5).min() > 0
    return rays


LAYOUTS = {
    "all numbers": lambda: usual_rays(),
    "few numbers": lambda: PixelRays.by_density(np.repeat([1.0, 2.0, 3.0], [7, 1, 13]), 8),
    "one pixel": lambda: PixelRays.by_density(np.ones(1), 4),
    "equal numbers": lambda: PixelRays.uniform(11, 3),
}

layouts = pytest.mark.parametrize("layout", LAYOUTS)


def places_one_by_one(rays):
    """(Pixel, number in the pixel, level) of every ray, by counting."""
    return np.array([
        (pixel, number, rays.level[pixel])
        for pixel in range(rays.pixels)
        for number in range(rays.sizes[rays.level[pixel]])
    ])  # fmt: skip


# ---------------------- Numbers of rays ----------------------


@densities
@pytest.mark.parametrize("mean", [4, 16, 100])
def test_the_image_has_exactly_the_mean_number_of_rays(density, mean):
    rays = PixelRays.by_density(density, mean)
    assert rays.pixels == density.size and rays.mean == mean
    assert rays.count == rays.numbers.sum() == mean * density.size
    assert set(rays.numbers) <= {mean // 4, mean // 2, mean, 2 * mean, 4 * mean}


@settings(max_examples=examples(100), deadline=None)
@given(st.integers(0, 2**31))
def test_the_image_has_exactly_the_mean_number_of_rays_whatever_the_density(seed):
    rng = np.random.default_rng(seed)
    exponents = rng.uniform(-1, 1, int(rng.integers(1, 60))) * 10.0 ** rng.uniform(-2, 2)
    # Many pixels of the same density
    density = 10.0 ** (np.round(exponents) if rng.random() < 0.5 else exponents)
    rays = PixelRays.by_density(density, 8)
    assert rays.count == 8 * len(density) and rays.numbers.min() >= 2 and rays.numbers.max() <= 32


@densities
def test_no_pixel_has_fewer_rays_than_a_darker_one(density):
    rays = PixelRays.by_density(density, 16)
    sorted_numbers = rays.numbers[np.lexsort([rays.numbers, density.reshape(-1)])]
    assert (np.diff(sorted_numbers) >= 0).all()


@densities
def test_numbers_follow_the_density_up_to_rounding(density):
    """With a common factor, all numbers are within a root of two of the density, limited to five levels."""
    rays = PixelRays.by_density(density, 4)
    wanted, level = np.log2(density.reshape(-1).astype(np.float64)), np.log2(rays.numbers / 4)
    exact = level - wanted
    constants = np.concatenate([exact - 0.5, exact, exact + 0.5])[:, None]
    outside = np.abs(np.clip(wanted + constants, -2, 2) - level) > 0.5 + 1e-9
    # Where rounding leaves fewer rays than a step of the next pixel, at most 8 of the smallest unit, others get them
    assert outside.sum(1).min() <= 7


@densities
def test_relative_numbers_have_the_same_numbers(density):
    first = PixelRays.by_density(density, 4)
    for mean in (4, 32):
        again = PixelRays.by_density(first.numbers / 4, mean)
        assert (again.numbers * 4 == first.numbers * mean).all()


def test_a_constant_density_has_equal_numbers():
    assert (PixelRays.by_density(np.full((5, 7), 1e-8), 12).numbers == 12).all()


@pytest.mark.parametrize("samples", [0, -4, 1, 2, 3, 6, 15])
def test_samples_that_have_no_quarter_are_refused(samples):
    with pytest.raises(ValueError, match=f"multiple of 4, got {samples}$"):
        PixelRays.by_density(np.ones(8), samples)


# ---------------------- Places of rays ----------------------


@layouts
def test_rays_are_in_the_pixels_that_counting_finds(layout):
    rays = LAYOUTS[layout]()
    pixel, number, level = places_one_by_one(rays).T
    assert rays.count == len(pixel)
    assert (rays.numbers == np.bincount(pixel)).all()
    assert (rays.first[:-1] == np.flatnonzero(number == 0)).all()
    # Neither sorted nor all of them
    chosen = np.random.default_rng(0).integers(0, rays.count, 200)
    assert (rays.pixel_of(chosen) == pixel[chosen]).all()
    for lane in (np.arange(rays.count), chosen):
        places = rays.places(upload(mi.UInt32, lane))
        found = [np.array(x) for x in (places.pixel, places.number, places.level)]
        assert (np.array(found) == [pixel[lane], number[lane], level[lane]]).all()


@layouts
@pytest.mark.parametrize("rays_of_part", [1, 5, 64, 200, 10**6])
def test_parts_hold_every_pixel_once_and_about_as_many_rays_as_asked(layout, rays_of_part):
    rays = LAYOUTS[layout]()
    parts = rays.parts(rays_of_part)
    assert [pixel for first, last in parts for pixel in range(first, last)] == list(range(rays.pixels))
    assert min(last - first for first, last in parts) >= 1
    for first, last in parts:
        part = rays.part(first, last)
        assert part.mean == rays.mean and part.sizes == rays.sizes
        assert (part.numbers == rays.numbers[first:last]).all()
        # A pixel is never divided
        assert part.count < rays_of_part + max(rays.sizes)
    counts = [rays.part(*part).count for part in parts]
    assert min(counts[:-1], default=rays_of_part) > rays_of_part - max(rays.sizes)


@pytest.mark.parametrize("most", [1, 2, 5, 16, 100])
def test_as_large_a_fraction_of_all_pixels_is_lit(most):
    rays = usual_rays(mean=16)
    kept = min(most, 16)
    for size, lit in zip(rays.sizes, rays.lit(most), strict=True):
        assert 1 <= lit <= size and isinstance(lit, int)
        assert lit == 1 or abs(lit - size * kept / 16) <= 0.5
    assert rays.lit(most)[rays.sizes.index(16)] == kept


# ---------------------- Lattices ----------------------


def lattice_numbers(rays, seed, vertex):
    """Numbers of all rays at a vertex, (6, rays)."""
    numbers = Lattice(rays.places(dr.arange(mi.UInt32, rays.count)), rays.sizes, seed).at(mi.UInt32(vertex))
    return np.concatenate([np.array(x).reshape(-1, rays.count) for x in numbers])


@pytest.mark.parametrize("mean", [4, 12, *stress(64)])
def test_numbers_of_every_pixel_are_one_in_each_stratum(mean):
    rays = usual_rays(2**16 // mean, mean)
    numbers = lattice_numbers(rays, 7, 3)
    pixel = places_one_by_one(rays)[:, 0]
    assert numbers.min() >= 0 and numbers.max() < 1
    for dimension in numbers:
        ordered = dimension[np.lexsort([dimension, pixel])]
        for size in rays.sizes:
            own = ordered[rays.numbers[pixel] == size].reshape(-1, size)
            # A random shift and then a point in each stratum: all gaps are equal
            gaps = np.diff(own, axis=1, append=1 + own[:, :1])
            assert gaps * size == pytest.approx(np.ones_like(gaps), abs=1e-3)
            assert stats.kstest(own[:, 0] * size, "uniform").pvalue > 1e-4
            # Each ray of a pixel has a uniform number
            unsorted = dimension[rays.numbers[pixel] == size].reshape(-1, size)
            for ray in (0, -1):
                assert stats.kstest(unsorted[:, ray], "uniform").pvalue > 1e-4


def test_numbers_of_a_pixel_are_those_of_an_image_with_equal_numbers():
    rays = usual_rays()
    numbers, pixel = lattice_numbers(rays, 7, 3), places_one_by_one(rays)[:, 0]
    for size in rays.sizes:
        expected = lattice_numbers(PixelRays.uniform(rays.pixels, size), 7, 3).reshape(6, rays.pixels, size)
        own = rays.numbers == size
        assert (numbers[:, own[pixel]].reshape(6, -1, size) == expected[:, own]).all()


@pytest.mark.parametrize("earlier", [None, 0, 64])
@pytest.mark.parametrize("cells", [1, 4, 16])
def test_numbers_of_every_cell_and_of_every_pixel_are_one_in_each_stratum(cells, earlier):
    """Of 64 rays of a pixel; ``earlier``: rays of the pixel in earlier passes, None for a lattice of the pass alone."""
    pixels, size = 512, 64
    places = RayNumbers.of_lanes(dr.arange(mi.UInt32, pixels * size), size)
    cell = np.array(places.in_cells(mi.UInt32(cells))[0]).reshape(pixels, size)
    lattice = Lattice(places, (size,), 7, None if earlier is None else (earlier,), cells)
    # Without the second numbers of pairs: their strata in parts of the extensible lattice are not equal
    numbers = [np.array(x).reshape(-1, pixels, size)[0] for x in lattice.at(mi.UInt32(3))]
    for dimension in numbers:
        order = np.lexsort([dimension, cell])
        of_cells = np.take_along_axis(dimension, order, axis=1).reshape(pixels * cells, size // cells)
        for own in (np.sort(dimension, axis=1), of_cells):
            gaps = np.diff(own, axis=1, append=1 + own[:, :1])
            assert np.allclose(gaps * own.shape[1], 1, atol=1e-3)
        # Each ray has a uniform number
        assert all(stats.kstest(dimension[:, ray], "uniform").pvalue > 1e-4 for ray in (0, -1))


def test_the_points_of_a_cell_are_spread_in_two_dimensions():
    """In a box of a half by a half: the variance of counts over that of random points."""
    pixels, size, found = 4096, 64, {}
    places = RayNumbers.of_lanes(dr.arange(mi.UInt32, pixels * size), size)
    cell = np.array(places.in_cells(mi.UInt32(4))[0]).reshape(pixels, size)
    for cells in (1, 4):
        pair = np.array(Lattice(places, (size,), 7, None, cells).at(mi.UInt32(3))[1]).reshape(2, pixels, size)
        inside = (np.abs(pair - 0.5) < 0.25).all(0) & (cell == 2)
        found[cells] = inside.sum(1).var() / (16 * (1 / 4) * (3 / 4))
    assert found[4] < 0.2 and found[1] > 0.6, found


def test_orders_of_pixels_and_dimensions_are_independent():
    """Pixels of any number: the first two rays of neighbours, and of two dimensions of a pixel."""
    rays = usual_rays(20_000, 8)
    first = rays.first[:-1]
    numbers = np.concatenate([lattice_numbers(rays, *key)[:, first] for key in ((1, 0), (1, 1), (2, 0))])
    columns = np.concatenate([numbers[:, :-1], numbers[:, 1:]])
    correlation = np.corrcoef(columns)
    assert np.abs(correlation - np.eye(len(correlation))).max() < 0.05


# ---------------------- Lit vertices ----------------------


def vertices(weight):
    """Gather vertices of weights (n, 3)."""
    places = [dr.zeros(kind, len(weight)) for kind in (mi.Point3f, mi.Normal3f, mi.Normal3f)]
    light = mi.UnpolarizedSpectrum(*(upload(mi.Float, x) for x in weight.T))
    return GatherVertices(*places, light, dr.full(mi.UInt32, 1, len(weight)))


def random_weights(rng, count, share):
    """Weights of vertices, some negative; a fraction ``share`` of the rays has a vertex."""
    weight = rng.exponential(size=(count, 3)) * (rng.random((count, 1)) < share)
    return np.where(rng.random((count, 1)) < 0.2, -weight, weight)


@pytest.mark.parametrize("most", [1, 3, 8, 20])
def test_so_many_first_vertices_of_each_pixel_are_lit_as_many_of_each_half(most):
    rays = usual_rays(mean=8)
    pixel, number, level = places_one_by_one(rays).T
    lit = LitVertices.of(vertices(np.ones((rays.count, 3))), vertices(np.zeros((rays.count, 3))), rays, most, 1)
    assert lit.alone == 0
    chosen, kept = np.array(lit.rays), np.array(rays.lit(most))
    assert (np.bincount(pixel[chosen], minlength=rays.pixels) == kept[rays.level]).all()
    of_chosen = np.array(rays.sizes)[level[chosen]] / kept[level[chosen]]
    np.testing.assert_allclose(np.array(lit.vertices.weight), np.tile(of_chosen, (3, 1)), rtol=1e-6)
    for place in range(rays.pixels):
        of_first = np.count_nonzero(number[chosen][pixel[chosen] == place] % 2 == 0)
        share = kept[rays.level[place]] / rays.numbers[place]
        assert abs(of_first - share * -(-rays.numbers[place] // 2)) < 1


@pytest.mark.parametrize("most", [1, 2, 6, 16, *stress(4, 8)])
def test_every_cell_and_half_has_as_many_lit_vertices_and_no_ray_is_preferred(most):
    rays, seeds = replace(PixelRays.uniform(5, 16), cells=4), 500
    cells, turns = (np.array(x) for x in rays.places(dr.arange(mi.UInt32, rays.count)).in_cells(mi.UInt32(4)))
    ones, zeros = (vertices(np.full((rays.count, 3), x)) for x in (1.0, 0.0))
    often = np.zeros(rays.count)
    for seed in range(seeds):
        chosen = np.array(LitVertices.of(ones, zeros, rays, most, seed).rays)
        often[chosen] += 1
        for group, size in ((cells, 4), (turns % 2, 2)):
            number = np.bincount(size * (chosen // 16) + group[chosen], minlength=5 * size)
            assert number.max() - number.min() <= 1
    # A pixel that is lit as often in each seed has the least variance; that of independent draws bounds it
    share = most / 16
    assert np.abs(often / seeds - share).max() <= 5 * np.sqrt(share * (1 - share) / seeds)


@pytest.mark.parametrize("most", [2, 20])
def test_lit_vertices_stand_for_all_vertices(most):
    """In the mean over the orders of a pixel's rays and over seeds, in each pixel."""
    rng, rays, seeds = np.random.default_rng(4), usual_rays(60, 8), 400
    pixel = places_one_by_one(rays)[:, 0]
    weights = [random_weights(rng, rays.count, share) for share in (0.6, 0.4)]
    expected = np.array([np.bincount(pixel, (weights[0] + weights[1])[:, k]) for k in range(3)])
    found, levels = np.zeros((seeds, *expected.shape)), np.abs(weights).mean(2)
    for seed in range(seeds):
        order = np.lexsort([rng.random(rays.count), pixel])
        lit = LitVertices.of(*(vertices(x[order]) for x in weights), rays, most, seed)
        of_pixel, weight = pixel[np.array(lit.rays)], np.array(lit.vertices.weight)
        found[seed] = [np.bincount(of_pixel, x, rays.pixels) for x in weight]
    # Rare draws may not have happened: the variance of as many draws as expected, at least
    of_draw = np.bincount(pixel, levels.sum(0)) / np.array(rays.lit(most))[rays.level]
    variance = np.maximum(found.var(0, ddof=1), of_draw * np.bincount(pixel, levels[1]))
    assert (np.abs(found.mean(0) - expected) <= 5 * np.sqrt(variance / seeds) + 1e-4).all()
    # Of the whole image, and of the pixels of each number
    for size in (None, *rays.sizes):
        own = (rays.numbers == size) if size else slice(None)
        sums = found[:, :, own].sum(2)
        error = sums.std(0, ddof=1) / seeds**0.5
        assert (np.abs(sums.mean(0) - expected[:, own].sum(1)) < 4.5 * error + 1e-3).all()


def test_later_vertices_of_pixels_with_any_number_stand_for_all_of_them():
    rng, rays, most, seeds = np.random.default_rng(2), usual_rays(50, 8), 3, 4000
    pixel = places_one_by_one(rays)[:, 0]
    weights = [random_weights(rng, rays.count, share) for share in (0.5, 0.3)]
    first, later = (vertices(weight) for weight in weights)
    kept, mean = np.array(rays.lit(most))[rays.level], np.zeros(rays.count)
    for seed in range(seeds):
        ray, factor = (np.array(x) for x in drawn_later(first, later, rays, most, seed))
        assert (np.diff(ray.astype(int)) >= 0).all()
        assert (np.bincount(pixel[ray], minlength=rays.pixels) <= kept).all()
        np.add.at(mean, ray, factor / seeds)
    levels = np.abs(weights).mean(2)
    drawn = levels[1] > 0
    assert (mean[~drawn] == 0).all()
    # Systematic sampling: a count is right on average, with a variance below the variance of one draw
    of_draw = np.bincount(pixel, levels.sum(0)) / kept
    share = levels[1] / np.where(of_draw > 0, of_draw, 1)[pixel]
    spread = (np.maximum(share, 1e-9) / seeds) ** 0.5
    assert (np.abs(mean - 1)[drawn] * share[drawn] < 5 * spread[drawn]).all()


def continued_numbers(mean, passes, seed=7, vertex=3):
    """Numbers (6, pixels, rays of all passes) of the pixels with the mean number of rays, and with twice as many."""
    found = {1: [], 2: []}
    for number in range(passes):
        density = np.tile([1.0, 2.0, 0.5, 0.5], 512)
        rays = PixelRays.by_density(density, mean, Continued(number * mean, seed))
        places, own = rays.places(dr.arange(mi.UInt32, rays.count)), rays.numbers / mean
        numbers = Lattice(places, rays.sizes, seed, rays.earlier).at(mi.UInt32(vertex))
        numbers = np.concatenate([np.array(x).reshape(-1, rays.count) for x in numbers])
        for times, taken in found.items():
            pixels = np.flatnonzero(own == times)
            index = rays.first[pixels][:, None] + np.arange(times * mean)
            taken.append(numbers[:, index])
    return {times: np.concatenate(taken, axis=2) for times, taken in found.items()}


@pytest.mark.parametrize("passes", [1, 2, 4])
def test_passes_share_a_lattice(passes):
    """The numbers of all passes are one in each stratum, as those of a pass with as many rays."""
    for numbers in continued_numbers(4, passes).values():
        count = numbers.shape[2]
        gaps = np.diff(np.sort(numbers, axis=2), axis=2, append=1 + numbers.min(2, keepdims=True))
        assert np.allclose(gaps * count, 1, atol=1e-3)
        for ray in (0, -1):
            assert all(stats.kstest(dimension[:, ray], "uniform").pvalue > 1e-4 for dimension in numbers)


def test_passes_pair_the_numbers_of_different_dimensions_anew():
    """Otherwise a pass would repeat the paths of the pass before, moved a little."""
    numbers = continued_numbers(16, 4)[1]
    signs = np.where(numbers < 0.5, 1, -1)
    for one, other in itertools.combinations(signs[[0, 1, 3, 4]], 2):
        assert (one * other).mean(1).var() * numbers.shape[2] < 1.3


def test_lattices_of_passes_with_other_seeds_are_independent():
    one, other = (continued_numbers(16, 1, seed)[1].reshape(6, -1) for seed in (1, 2))
    assert np.abs(np.corrcoef(one, other)[:6, 6:]).max() < 0.05
