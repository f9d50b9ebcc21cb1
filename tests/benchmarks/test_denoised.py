"""The denoised error of the benchmark is unbiased, whatever noise its two references have."""

import numpy as np
import pytest

from benchmarks.denoised import Truth, longer
from comparison.denoising import FALL


@pytest.mark.parametrize("noises", [(0.05, 0.3), (0.3, 0.3)])
def test_the_noise_of_references_is_not_in_the_error(noises):
    draw, exact = np.random.default_rng(0), np.full((100, 100, 3), 2.0)
    truth = Truth(*(exact + noise * draw.standard_normal(exact.shape) for noise in noises))
    images = [exact + 0.1 * draw.standard_normal(exact.shape) for _ in range(4)]
    assert truth.error(images) == pytest.approx(0.01 / 4.04, rel=0.1)
    assert abs(truth.error([exact])) < 0.0003


@pytest.mark.parametrize(("fall", "expected"), [(2.0, 2.0), (FALL, 2 ** (1 / np.log2(FALL))), (0.9, None)])
def test_half_of_the_error_takes_as_long_as_it_falls(fall, expected):
    """An error that does not fall has the fall of many scenes."""
    expected = expected or longer(0.2, 0.1, FALL)
    assert longer(0.2, 0.1, fall) == pytest.approx(expected)


@pytest.mark.parametrize(("error", "goal"), [(0.1, 0.03), (0.03, 0.1)])
@pytest.mark.parametrize("fall", [1.1, 1.3, 1.6, 3.0])
def test_the_fall_of_a_scene_makes_no_factor_larger(error, goal, fall):
    assert longer(error, goal, fall) <= longer(error, goal, FALL)
