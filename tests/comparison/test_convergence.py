"""The estimated error of an image matches the true error, also if a render ends by it."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from comparison.convergence import LEAST_PASSES, ErrorEstimate, ErrorGoal

SIZE = 48
Y, X = np.mgrid[:SIZE, :SIZE] / SIZE
MEAN = 1 + X
DEVIATION = np.exp(2 * np.sin(3 * X + 1) * np.cos(4 * Y)) * np.exp(0.3 * np.random.default_rng(5).normal(size=X.shape))


def of_each_pixel(rng, spp):
    return rng.normal(size=X.shape) / np.sqrt(spp)


def with_outliers(rng, spp):
    """A few samples in a hundred carry all the light."""
    shape = 0.05 * spp
    return (rng.gamma(shape, size=X.shape) - shape) / np.sqrt(shape * spp)


def of_the_whole_image(rng, spp):
    return np.full(X.shape, rng.normal() / np.sqrt(spp))


def of_lights(rng, spp):
    """Each pass has new virtual lights, regardless of its number of samples."""
    return 0.3 * rng.normal(size=X.shape)


def of_lights_for_all(rng, spp):
    """The same, but all pixels have the same error."""
    return np.full(X.shape, 0.3 * rng.normal())


def grey(plane):
    return np.repeat(plane[..., None], 3, axis=-1)


def simulate(noise, error, seed):
    """Passes of growing sizes until the error is reached: (estimated error, true error, image, passes)."""
    rng = np.random.default_rng(seed)
    estimate, goal, weights, total, spp = ErrorEstimate(), ErrorGoal(error), [], 0.0, 4
    while True:
        if sum(weights) >= 16 * spp and spp < 64:
            spp *= 2
        image = MEAN + DEVIATION * noise(rng, spp)
        estimate.add(grey(image), spp)
        weights.append(spp)
        total = total + spp * image
        if goal.is_due(SimpleNamespace(estimate=estimate, spp=sum(weights))):
            found = estimate.relative()
            if goal.is_reached(found):
                break
    share = np.array(weights) / sum(weights)
    each = 0.3 * np.ones(len(weights)) if noise in (of_lights, of_lights_for_all) else 1 / np.sqrt(weights)
    scale = np.sqrt(MEAN**2 + (0.1 * MEAN.mean()) ** 2)
    truth = DEVIATION * np.sqrt(np.sum((share * each) ** 2))
    return found, np.percentile(truth / scale, 95), (total / sum(weights) - MEAN) / truth, len(weights)


@pytest.mark.parametrize(
    ("noise", "error", "least", "most"),
    [
        (of_each_pixel, 0.3, 1.0, 1.3),
        (of_each_pixel, 0.1, 1.0, 1.15),
        (with_outliers, 0.3, 0.95, 1.2),
        (with_outliers, 0.1, 0.95, 1.15),
        (of_the_whole_image, 0.1, 0.9, 1.1),
        (of_lights, 0.3, 1.0, 1.3),
        (of_lights_for_all, 0.3, 0.75, 1.0),
    ],
)
def test_reported_error_is_the_true_one_though_the_render_ended_by_it(noise, error, least, most):
    """On average over renders; too high rather than too low, but for the last. Nor does the ending shift the image."""
    runs = [simulate(noise, error, seed) for seed in range(40)]
    assert all(found <= error and passes >= LEAST_PASSES for found, _, _, passes in runs)
    assert least < np.mean([found / truth for found, truth, _, _ in runs]) < most
    shift = np.array([of_image.mean() for _, _, of_image, _ in runs])
    bound = 0.6 if noise is of_lights_for_all else max(4 * shift.std() / np.sqrt(len(runs)), 0.02)
    assert abs(shift.mean()) < bound


def test_standard_error_of_equal_passes_is_the_textbooks():
    planes = np.random.default_rng(0).random((5, 4, 6, 3))
    estimate = ErrorEstimate()
    for plane in planes:
        estimate.add(plane, 16)
    expected = planes.mean(-1).std(0, ddof=1) / np.sqrt(5)
    np.testing.assert_allclose(estimate.standard_error, expected, rtol=1e-12)


def test_variance_of_unequal_passes_is_right_on_average():
    rng, found, weights = np.random.default_rng(1), [], [1, 2, 4, 4, 8]
    estimate = ErrorEstimate()
    for weight in weights:
        estimate.add(grey(7 + rng.normal(size=(300, 300)) / np.sqrt(weight)), weight)
    found = np.square(estimate.standard_error).mean()
    assert found == pytest.approx(1 / sum(weights), rel=0.02)


def test_small_noise_on_bright_pixels_does_not_cancel():
    rng, estimate = np.random.default_rng(2), ErrorEstimate()
    for _ in range(10):
        estimate.add(grey(1e6 + 1e-3 * rng.normal(size=(100, 100))), 4)
    assert np.square(estimate.standard_error).mean() == pytest.approx(1e-7, rel=0.05)


def test_pixels_that_are_not_finite_are_left_out():
    rng, clean, spoilt = np.random.default_rng(3), ErrorEstimate(), ErrorEstimate()
    for number in range(4):
        image = grey(1 + 0.1 * rng.normal(size=(64, 64)))
        clean.add(image, 4)
        image[5, 7] = np.nan
        image[20, 30] = np.inf if number == 2 else 1
        spoilt.add(image, 4)
    assert spoilt.relative() == pytest.approx(clean.relative(), rel=0.02)


def test_error_is_unknown_of_one_pass_and_zero_of_a_black_image():
    estimate = ErrorEstimate()
    assert estimate.relative() is None
    estimate.add(np.zeros((3, 2, 3)), 4)
    assert estimate.relative() is None
    estimate.add(np.zeros((3, 2, 3)), 4)
    assert estimate.relative() == 0


def test_passes_of_little_weight_do_not_count_for_a_look():
    goal, estimate = ErrorGoal(0.1), ErrorEstimate()
    for _ in range(8):
        estimate.add(np.zeros((1, 1, 3)), 1)
    for passes in range(1, 9):
        estimate.add(np.zeros((1, 1, 3)), 100)
        assert goal.is_due(SimpleNamespace(estimate=estimate, spp=12 * passes)) == (passes == 8)


def test_looks_are_few():
    goal, looks, estimate = ErrorGoal(0.1), [], ErrorEstimate()
    for passes in range(1, 101):
        estimate.add(np.zeros((1, 1, 3)), 4)
        if goal.is_due(SimpleNamespace(estimate=estimate, spp=4 * passes)):
            looks.append(passes)
    assert looks[0] == LEAST_PASSES
    assert all(after >= 1.25 * before for before, after in pairwise(looks))
