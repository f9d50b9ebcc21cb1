"""Detail of the raw image in denoised images."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import detail
from comparison.convergence import smoothed
from comparison.denoising import Denoiser
from comparison.rendering import Passes
from tests.comparison.cluster.test_cluster import pass_of
from tests.support.scenes import area_light, closed_box, cornell

SIZE = 96
STRIPES = 1 + 0.5 * (np.arange(SIZE) % 4 < 2) * (np.arange(SIZE) < SIZE // 2)
# Stripes in the left half, which a blur removes, and none in the right half
EXACT = np.broadcast_to(STRIPES[None, :, None], (SIZE, SIZE, 3))


def blurred(image):
    """A made-up denoiser."""
    return np.stack([smoothed(image[..., channel]) for channel in range(3)], axis=-1)


def images_of(noise, denoise=blurred, share=0.5, seed=0):
    """(Denoised image, image with detail), where the image has the standard error `noise`."""
    rng = np.random.default_rng(seed)
    halves = [EXACT + noise / part**0.5 * rng.normal(size=EXACT.shape) for part in (share, 1 - share)]
    raw = share * halves[0] + (1 - share) * halves[1]
    denoised = denoise(raw)
    return denoised, detail.restored(denoised, raw, halves, [denoise(half) for half in halves], share)


def error(image, columns):
    """Mean squared error in some columns, without those near the end of the stripes."""
    return np.mean(np.square(image - EXACT)[:, columns])


LEFT, RIGHT = slice(0, 36), slice(60, SIZE)


@pytest.mark.parametrize("share", [0.5, 0.4])
@pytest.mark.parametrize(("noise", "left"), [(0.02, 0.02), (0.1, 0.25), (0.3, 0.95), (2.0, 1.05)])
def test_detail_returns_where_noise_is_less_than_the_error_of_the_denoiser(noise, left, share):
    denoised, found = images_of(noise, share=share)
    assert error(found, LEFT) < left * error(denoised, LEFT)
    # Where the denoiser is right, little noise returns
    assert error(found, RIGHT) < 1.2 * error(denoised, RIGHT)


def test_the_fraction_of_the_raw_image_is_that_of_the_least_error():
    """Noise of the variance of the stripes: about half of both."""
    noise = 0.25 * np.sqrt(1 - 1 / 25)
    found = [images_of(noise, seed=seed) for seed in range(8)]
    raw = [images_of(noise, denoise=lambda image: image, seed=seed)[0] for seed in range(8)]

    def error_with(fraction):
        mixed = [denoised + fraction * (one - denoised) for (denoised, _), one in zip(found, raw, strict=True)]
        return np.mean([error(image, LEFT) for image in mixed])

    best = min(error_with(fraction) for fraction in np.linspace(0, 1, 21))
    assert best < 0.8 * min(error_with(0), error_with(1))
    assert np.mean([error(image, LEFT) for _, image in found]) < 1.1 * best


def test_a_perfect_denoiser_stays():
    for noise in (0.02, 0.5):
        _, found = images_of(noise, denoise=lambda image: EXACT)
        assert error(found, slice(None)) < 0.02 * noise**2


def test_pixels_that_are_not_finite_stay_denoised():
    rng = np.random.default_rng(1)
    halves = [EXACT + 0.02 * rng.normal(size=EXACT.shape) for _ in range(2)]
    halves[0][3, 5, 1], halves[1][7, 9, 0] = np.nan, np.inf
    halves[0][8, 8, 2] = halves[1][8, 8, 2] = np.inf
    raw = 0.5 * (halves[0] + halves[1])
    denoised = [blurred(np.nan_to_num(image, nan=1.0, posinf=1.0)) for image in (raw, *halves)]
    found = detail.restored(denoised[0], raw, halves, denoised[1:], 0.5)
    assert np.isfinite(found).all()
    for pixel in ((3, 5), (7, 9), (8, 8)):
        np.testing.assert_array_equal(found[pixel], denoised[0][pixel])
    assert error(found, LEFT) < 0.1 * error(denoised[0], LEFT)


@pytest.mark.parametrize("share", [0.4, 0.5, 0.6])
@pytest.mark.parametrize("half", [0, 1])
def test_fireflies_stay_denoised(share, half):
    rng = np.random.default_rng(3)
    halves = [EXACT + 0.02 * rng.normal(size=EXACT.shape) for _ in range(2)]
    halves[half][20, 20] += 10
    halves[half][70, 70] += 10
    exact = [EXACT, EXACT, EXACT]
    raw = share * halves[0] + (1 - share) * halves[1]
    # A denoiser that knows fireflies, and blurs stripes
    denoised = [blurred(image) for image in exact]
    found = detail.restored(denoised[0], raw, halves, denoised[1:], share)
    np.testing.assert_array_equal(found[[20, 70], [20, 70]], denoised[0][[20, 70], [20, 70]])
    # Also beside the fireflies
    assert error(found, LEFT) < 0.1 * error(denoised[0], LEFT) and error(found, RIGHT) < 1e-3


def test_a_dark_part_beside_a_bright_one():
    """Products of squared brightness: fifteen orders of magnitude."""
    rng, noise = np.random.default_rng(4), np.full((SIZE, SIZE, 1), 1e-9)
    noise[:, :12] = 0.05
    halves = [EXACT + noise * rng.normal(size=EXACT.shape) for _ in range(2)]
    denoised = [blurred(half) if k else EXACT + 0.9 * (noise > 1e-3) for k, half in enumerate([EXACT, *halves])]
    found = detail.restored(denoised[0], 0.5 * (halves[0] + halves[1]), halves, denoised[1:], 0.5)
    assert np.isfinite(found).all() and np.abs(found - EXACT)[:, 24:].max() < 1e-8


@pytest.mark.parametrize("size", [1, 5])
def test_the_smallest_images_stay_denoised(size):
    """Few pixels do not tell the noise."""
    rng = np.random.default_rng(5)
    halves = [1 + 0.1 * rng.normal(size=(size, size, 3)) for _ in range(2)]
    denoised = [1 + 0.05 * rng.normal(size=(size, size, 3)) for _ in range(3)]
    found = detail.restored(denoised[0], 0.5 * (halves[0] + halves[1]), halves, denoised[1:], 0.5)
    assert np.isfinite(found).all() and np.abs(found - denoised[0]).max() < 0.1


def test_a_black_image():
    black = np.zeros((8, 8, 3))
    np.testing.assert_array_equal(detail.restored(black, black, [black, black], [black, black], 0.5), black)


def test_passes_belong_to_two_halves_of_similar_weight():
    passes, values = Passes(0), (1.0, 2.0, 4.0, 8.0, 16.0)
    passes.keeps_halves = True
    for value in values:
        passes.add(pass_of(value))
    weight = passes.passes[0].weight
    assert passes.half_weights == [3 * weight, 2 * weight]
    first, second = (half.mean() for half in passes.fine_halves)
    assert (first, second) == pytest.approx((7.0, 5.0)) and passes.image.mean() == pytest.approx(np.mean(values))


@pytest.mark.parametrize(
    ("weights", "spp", "suited"),
    [([9, 9], 200, True), ([9, 9], 199, False), ([4, 6], 400, True), ([39, 61], 400, False), ([1, 0], 9999, False)],
)
def test_few_samples_and_unequal_halves_do_not_suit(weights, spp, suited):
    passes = SimpleNamespace(half_weights=weights, spp=spp, has_halves=True)
    assert detail.suits(passes) is suited
    passes.has_halves = False
    assert not detail.suits(passes)


@pytest.mark.parametrize(("spp", "has_detail"), [(64, False), (512, True)])
def test_renders_of_many_samples_have_detail(spp, has_detail, monkeypatch):
    told, original = [], detail.restored
    monkeypatch.setattr(detail, "restored", lambda *arguments: told.append(arguments) or original(*arguments))
    parts = closed_box({"lamp": area_light()}, size=16)
    parts["sensor"]["film"]["pixel_format"] = "rgba"
    scene, plugin = mi.load_dict(parts), mi.load_dict({"type": "path", "max_depth": 2})
    image, took = manylights.render(scene, plugin, spp=spp, pass_spp=spp // 4, denoise=True)
    assert len(told) == has_detail == took.denoiser["denoise_detail"] and np.isfinite(image.numpy()).all()
    np.testing.assert_array_equal(image.numpy()[..., 3], took.raw.numpy()[..., 3])
    if has_detail:
        denoised, raw, halves, left, share = told[0]
        np.testing.assert_allclose(raw, took.raw.numpy()[..., :3], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(0.5 * (halves[0] + halves[1]), raw, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(image.numpy()[..., :3], original(*told[0]), rtol=1e-6)
        assert share == 0.5 and {one.shape for one in (denoised, *left)} == {(16, 16, 3)}


@pytest.mark.parametrize(("spp", "restores"), [(199, False), (200, True), (None, True)])
def test_images_of_few_samples_keep_no_halves(spp, restores):
    assert Denoiser(cornell(16).load(), spp=spp, parts=1).restores is restores


@pytest.mark.parametrize(("seconds", "restores"), [(0.01, True), (0.03, False)])
def test_detail_takes_a_hundredth_of_the_time_at_most(seconds, restores, monkeypatch):
    """Where "high" takes 0.03 s, "fast" takes 0.007 s for each half of the passes."""
    monkeypatch.setattr(Denoiser, "_expected", lambda self, quality: seconds)
    found = Denoiser(cornell(16).load(), time_limit=1, parts=1)
    assert found.restores is restores
    assert not Denoiser(cornell(16).load(), spp=199, time_limit=1, parts=1).restores
    assert found.expected_seconds == pytest.approx(found.copies * seconds + (0.0046875 if restores else 0))
