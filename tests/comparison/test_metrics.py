"""Errors of images against references."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from comparison import metrics
from tests.support.properties import examples

ERRORS = ("relative_l1", "rmse", "relmse", "relmse_trimmed", "bias")


@pytest.fixture
def reference():
    return np.random.default_rng(1).lognormal(0, 1, (64, 48, 3))


def test_equal_images_have_no_error(reference):
    result = metrics.compare(reference, reference)
    assert [result[name] for name in ERRORS] == [0] * 5
    assert result["below_noise"] == []
    assert result["bad_pixels"] == 0


def test_values_by_hand():
    reference = np.full((10, 10, 3), 2.0)
    image = reference.copy()
    image[0, 0] = 4.0
    result = metrics.compare(image, reference)
    assert result["relative_l1"] == pytest.approx(0.01)
    assert result["bias"] == pytest.approx(0.01)
    assert result["rmse"] == pytest.approx(np.sqrt(4 / 100))
    assert result["relmse"] == pytest.approx(1 / (1 + metrics.EPSILON) / 100)


def test_trimming_removes_single_outliers_only(reference):
    image = reference.copy()
    image[5, 7] = 1e6
    result = metrics.compare(image, reference)
    assert result["relmse"] > 1e3
    assert result["relmse_trimmed"] == 0
    assert metrics.compare(1.1 * reference, reference)["relmse_trimmed"] > 0.005


@given(scale=st.floats(1e-6, 1e6))
@settings(max_examples=examples(100), deadline=None)
def test_relative_errors_do_not_depend_on_scale(scale):
    random = np.random.default_rng(2)
    reference = random.lognormal(0, 1, (16, 16, 3))
    image = reference * random.lognormal(0, 0.2, (16, 16, 3))
    plain, scaled = metrics.compare(image, reference), metrics.compare(scale * image, scale * reference)
    for name in ("relative_l1", "relmse", "relmse_trimmed", "bias"):
        assert scaled[name] == pytest.approx(plain[name], rel=1e-9)
    assert scaled["rmse"] == pytest.approx(scale * plain["rmse"], rel=1e-9)


def test_noise_of_the_reference_is_taken_off(reference):
    random, truth = np.random.default_rng(3), reference
    error = 0.2 * truth
    noisy = truth + random.normal(size=truth.shape) * error
    exact = metrics.compare(truth, noisy, error)
    assert set(exact["below_noise"]) == {"relative_l1", "rmse", "relmse", "relmse_trimmed"}
    # The image has an error of its own of twice the noise; the excess equals this error.
    image = truth + random.normal(size=truth.shape) * 2 * error
    result = metrics.compare(image, noisy, error)
    assert result["below_noise"] == []
    assert result["rmse"] == pytest.approx(np.sqrt(np.mean((image - truth) ** 2)), rel=0.05)
    assert metrics.compare(image, noisy)["rmse"] > 1.05 * result["rmse"]
    assert exact["relative_l1"] == pytest.approx(exact["noise"]["relative_l1"], rel=0.05)


def test_relative_l1_of_exact_images_is_hidden_by_the_noise():
    """The excess over a known noise: unbiased, so it scatters about the true error."""
    random, truth = np.random.default_rng(4), np.full((16, 16, 3), 2.0)
    for _ in range(20):
        result = metrics.compare(truth, truth + random.normal(size=truth.shape) * 0.1, np.full(truth.shape, 0.1))
        assert "relative_l1" in result["below_noise"]
        assert result["relative_l1"] < metrics.detection_threshold("relative_l1", result["noise"])
    image = truth + random.normal(size=truth.shape) * 0.2
    assert metrics.compare(image, truth, np.full(truth.shape, 0.1))["below_noise"] == []


def test_pixels_that_are_not_finite_count_as_black(reference):
    image = reference.copy()
    image[0, 0, 1] = np.nan
    image[3, 3, 0] = np.inf
    black = reference.copy()
    black[0, 0] = black[3, 3] = 0
    result = metrics.compare(image, reference)
    assert result["bad_pixels"] == 2
    assert result["relmse"] == metrics.compare(black, reference)["relmse"] > 0


def test_wrong_sizes_and_black_references_are_refused(reference):
    with pytest.raises(ValueError, match="48x64 pixels, the reference 24x64"):
        metrics.compare(reference, reference[:, :24])
    with pytest.raises(ValueError, match="black"):
        metrics.compare(reference, np.zeros_like(reference))


def test_relative_error_image():
    reference = np.ones((2, 2, 3))
    image = reference.copy()
    image[0, 1] = 1.5
    error = metrics.relative_error(image, reference)
    assert error.shape == (2, 2)
    assert error[0, 1] == pytest.approx(0.5 / 1.01)
    assert error.sum() == error[0, 1]


def test_distance_is_euclidean_over_channels():
    reference = np.ones((2, 3, 3))
    image = reference.copy()
    image[1, 2] += (3, 0, 4)
    distance = metrics.distance(image, reference)
    assert distance.shape == (2, 3) and distance[1, 2] == 5 and distance.sum() == 5


def test_flip_sees_differences_and_nothing_else(reference):
    values, mean, settings = metrics.flip(reference, reference)
    assert values.shape == reference.shape[:2] and mean == 0 and settings["ppd"] == pytest.approx(67, abs=0.1)
    image = reference.copy()
    image[20:30, 10:20] *= 3
    values, mean, same = metrics.flip(image, reference)
    assert same == settings  # they depend on the reference alone
    assert values[20:30, 10:20].mean() > 10 * values[45:].mean() and mean == pytest.approx(values.mean(), rel=1e-3)
    image[0, 0], image[1, 1] = np.nan, -1
    assert np.isfinite(metrics.flip(image, reference)[0]).all()


@pytest.mark.parametrize("scale", [1e-30, 1e-8, 1.0, 1e12])
def test_flip_does_not_depend_on_the_scale(reference, scale):
    image = 1.2 * reference
    _, mean, settings = metrics.flip(image, reference)
    _, scaled, exposures = metrics.flip(scale * image, scale * reference)
    assert scaled == pytest.approx(mean, rel=1e-3) and mean > 0.01
    assert exposures["startExposure"] == pytest.approx(settings["startExposure"] - np.log2(scale), abs=1e-3)
    assert exposures["stopExposure"] == pytest.approx(settings["stopExposure"] - np.log2(scale), abs=1e-3)
