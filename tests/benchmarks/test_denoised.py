"""The denoised error of the benchmark: unbiased, with one reference of known noise or with two references."""

import numpy as np
import pytest

from benchmarks.denoised import Truth


@pytest.mark.parametrize(("two", "noise"), [(False, 0.05), (True, 0.3)])
def test_the_noise_of_references_is_not_in_the_error(two, noise):
    draw, exact = np.random.default_rng(0), np.full((100, 100, 3), 2.0)
    first, second = (exact + noise * draw.standard_normal(exact.shape) for _ in range(2))
    truth = Truth(first, second) if two else Truth(first, first, np.full(exact.shape, noise))
    images = [exact + 0.1 * draw.standard_normal(exact.shape) for _ in range(4)]
    assert truth.error(images) == pytest.approx(0.01 / 4.04, rel=0.1)
    assert abs(truth.error([exact])) < 0.0003
