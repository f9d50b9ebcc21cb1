"""Means around pixels, from values at a few: `vpl.split.pilot`."""

import numpy as np
import pytest

from vpl.split.chosen_pilot import is_certain_rise
from vpl.split.cost_model import CostModel
from vpl.split.pilot import means_of_others, pixel_means, relative_variance

MODEL = CostModel()


def both_means(values, at, width, count):
    """Means around all pixels and all values."""
    others, priors = means_of_others(values, at, width, count, MODEL)
    return pixel_means(values, at, width, count, priors), others


def cells_around(pixel: int, width: int, count: int) -> list[set]:
    """The pixels of each cell that a pixel is in, from the whole image down to the pixel alone."""
    height = -(-count // width)
    side = next(2**k for k in range(32) if 2**k >= max(width, height))
    found = []
    while side:
        x, y = pixel % width // side * side, pixel // width // side * side
        rows, columns = range(y, y + side), range(x, min(x + side, width))
        found.append({row * width + column for row in rows for column in columns})
        side //= 2
    return found


def slow_means(values, at, width, count):
    """The same, pixel by pixel and value by value."""
    number = len(values)
    targets = [(pixel, ()) for pixel in range(count)] + [(at[i], (i, i ^ 1)) for i in range(number)]
    chains = [cells_around(pixel, width, count)[1:] for pixel, _ in targets]
    means = np.array([np.mean(np.delete(values, list(without))) for _, without in targets])
    for level in range(len(chains[0])):
        prior = relative_variance(values, means[count:], MODEL) / MODEL.brightness_spread
        means = np.array(
            [
                (sum(values[k] for k in inside) + prior * mean) / (len(inside) + prior) if len(inside) + prior else mean
                for mean, inside in (
                    (mean, [k for k in range(number) if at[k] in chain[level] and k not in without])
                    for mean, chain, (_, without) in zip(means, chains, targets, strict=True)
                )
            ]
        )
    return means[:count], means[count:]


@pytest.mark.parametrize(("width", "count"), [(1, 1), (5, 5), (1, 9), (7, 21), (6, 64), (16, 90)])
def test_means_are_those_of_the_cells_around(width, count):
    rng = np.random.default_rng(width * count)
    at = np.sort(rng.integers(0, count, 30))
    values = rng.exponential(1 + at / count)
    expected = slow_means(values, at, width, count)
    for found, wanted in zip(both_means(values, at, width, count), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_without_noise_edges_are_where_values_show_them():
    image = np.where(np.arange(64 * 64) % 64 < 21, 100.0, 1.0)
    at = np.arange(64 * 64).repeat(2)
    around, others = both_means(image[at], at, 64, 64 * 64)
    np.testing.assert_allclose(around, image)
    # The surroundings predict a value without the value and its neighbour
    assert np.mean(np.abs(others / image[at] - 1) < 0.01) > 0.9


@pytest.mark.parametrize("shape", [0.3, 1, 10])
def test_means_are_better_than_those_of_a_pixel_and_that_of_all(shape):
    rng, at = np.random.default_rng(1), np.arange(32 * 32).repeat(2)
    truth = np.where(np.arange(32 * 32) % 32 < 16, 2.0, 1.0)
    values = truth[at] * rng.gamma(shape, 1 / shape, len(at))
    around, others = both_means(values, at, 32, 32 * 32)
    of_pixel, of_all = values.reshape(-1, 2).mean(1), np.mean(values)
    best = min(np.std(of_pixel / truth), np.std(of_all / truth))
    assert np.std(around / truth) < 0.9 * best and np.std(others / truth[at]) < 0.9 * best


def test_a_value_and_its_neighbour_have_no_say_in_what_is_around_them():
    rng, at = np.random.default_rng(2), np.arange(16 * 16).repeat(2)
    values = rng.exponential(1.0, len(at))
    before = means_of_others(values, at, 16, 256, MODEL)[0]
    # Permuted values of a pixel leave the noise and all results unchanged
    values[[100, 101]] = values[[101, 100]]
    np.testing.assert_array_equal(means_of_others(values, at, 16, 256, MODEL)[0][[100, 101]], before[[100, 101]])
    # One that is far too bright is not thought to be in a bright place
    values[100] = 1e6
    around = means_of_others(values, at, 16, 256, MODEL)[0]
    assert max(around[100], around[101]) < np.max(np.delete(values, [100, 101])) < around[102]


@pytest.mark.parametrize("value", [0.0, 1e-300, 3.0, 1e30])
def test_where_nothing_is_noisy_all_is_alike(value):
    for means in both_means(np.full(8, value), np.arange(8), 4, 12):
        np.testing.assert_allclose(means, value)


def test_values_that_cancel_give_means_that_are_numbers():
    values = np.array([1.0, -1.0, 1e-200, -1e-200])
    for means in both_means(values, np.arange(4), 2, 4):
        assert np.all(np.isfinite(means))


@pytest.mark.parametrize(
    ("rays", "size", "raw_size"),
    [
        (0, 0, 0),
        (1600, 100, 100),
        (1 << 16, 1 << 12, 1 << 12),
        (36 << 13, 1 << 13, 36 << 9),
        (3 << 19, 1 << 15, 1 << 15),
        (1 << 21, 1 << 15, 1 << 15),
        (1 << 23, 1 << 16, 1 << 16),
        (1 << 40, 1 << 18, 1 << 18),
    ],
)
def test_sizes_of_pilots(rays, size, raw_size):
    assert MODEL.pilot_size(rays) == size
    raw = MODEL.without_denoiser().pilot_size(rays)
    assert raw == raw_size >= size


def test_a_rise_is_certain_beyond_its_standard_error():
    rng = np.random.default_rng(0)
    before = rng.exponential(size=10_000)
    other = rng.exponential(size=10_000)
    assert is_certain_rise(before, 1.2 * other, MODEL) and not is_certain_rise(before, 0.8 * other, MODEL)
    few = slice(0, 20)
    assert not is_certain_rise(before[few], 0.9 * other[few], MODEL)
    # A single pair does not decide
    other[3] = 1e6
    assert not is_certain_rise(before, 0.8 * other, MODEL)
