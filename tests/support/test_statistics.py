"""The statistical test finds the declared bias, and accepts equal means."""

import numpy as np
import pytest

from tests.support import statistics


def noisy_images(seed, bias=0.0, spread=0.1, size=8):
    rng = np.random.default_rng(seed)
    return (1 + rng.normal(bias, spread, (size, size, 3)), 1 + rng.normal(0, spread, (size, size, 3)))


def test_equal_means_pass_as_often_as_the_level_says():
    p_values = np.array([
        statistics.compare_means([noisy_images(100 * test + seed) for seed in range(8)]).p_value for test in range(400)
    ])  # fmt: skip
    assert np.mean(p_values < statistics.SCREENING) == pytest.approx(statistics.SCREENING, abs=0.025)


@pytest.mark.parametrize("seeds", [4, 8, 16])
def test_the_detectable_bias_is_found_nine_times_in_ten(seeds):
    standard_error = 0.1 * np.sqrt(2 / (8 * 8 * 3) / seeds)
    bias = statistics.detectable_shift(seeds, 1 - (1 - statistics.SCREENING) ** 0.5) * standard_error
    found = [
        statistics.compare_means([noisy_images(1000 * test + seed, bias) for seed in range(seeds)])
        for test in range(400)
    ]
    assert np.mean([result.detectable**2 for result in found]) == pytest.approx(bias**2, rel=0.15)
    # Tests of tiles add a little
    assert 0.87 < np.mean([result.p_value <= statistics.SCREENING for result in found]) < 0.99


def test_a_biased_image_fails_and_one_that_is_too_noisy_fails_by_name():
    with pytest.raises(AssertionError, match="p value"):
        statistics.assert_same_mean(lambda seed: noisy_images(seed, 0.02), 8, finds=0.02)
    with pytest.raises(AssertionError, match="would go unseen"):
        statistics.assert_same_mean(lambda seed: noisy_images(seed), 8, finds=0.001)
    statistics.assert_same_mean(lambda seed: noisy_images(seed), 8, finds=0.02)


def test_a_bias_of_one_tile_is_found():
    def pair(seed):
        found, expected = noisy_images(seed, spread=0.02)
        found[:2, :2] += 0.05
        return found, expected

    with pytest.raises(AssertionError, match="p value"):
        statistics.assert_same_mean(pair, 16, finds=0.02)


def test_images_without_variance_are_equal_to_rounding():
    image = noisy_images(0)[0]
    result = statistics.compare_means([(image * (1 + 1e-7), image)] * 4)
    assert result == statistics.Comparison(1.0, 0.0)
    with pytest.raises(AssertionError, match="difference without variance"):
        statistics.compare_means([(image * (1 + 1e-4), image)] * 4)
