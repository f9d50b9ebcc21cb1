"""A part of the light of virtual lights is spread over the camera rays of a pixel: sums, and what each ray gets."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from tests.support.properties import points
from vpl.core.arrays import download
from vpl.split.pixel_rays import PixelRays
from vpl.split.spread_light import spread


def generator():
    return np.random.default_rng(3)


DIFFERENT = PixelRays.by_density(10.0 ** generator().uniform(-1.5, 1.5, 60), 16)
LAYOUTS = {
    "equal numbers": replace(PixelRays.uniform(40, 12), cells=4),
    "one ray": PixelRays.uniform(5, 1),
    "different numbers": replace(DIFFERENT, cells=4),
    "different numbers, one cell": DIFFERENT,
}


def spectra(values):
    return mi.Color3f(points(values))


def spread_over(rays, light, weight, fraction):
    return download(spread(spectra(light), spectra(weight), rays, fraction)).astype(np.float64)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_sum_of_each_half_of_a_pixel_remains(layout, fraction):
    rng, rays = generator(), LAYOUTS[layout]
    light = rng.exponential(size=(rays.count, 3)) * (rng.random((rays.count, 1)) < 0.2)
    weight = rng.uniform(0.1, 1, (rays.count, 3)) * rng.choice([-1, 1], (rays.count, 1))
    moved = spread_over(rays, light, weight, fraction)
    pixel = rays.pixel_of(np.arange(rays.count))
    half = (np.arange(rays.count) - rays.first[pixel]) // rays.cells % 2
    sums = np.zeros((3, 2 * rays.pixels, 3))
    for total, values in zip(sums, (moved, light, np.abs(weight)), strict=True):
        np.add.at(total, 2 * pixel + half, values)
    np.testing.assert_allclose(sums[0], sums[1], rtol=1e-5)
    even = np.abs(weight) * (sums[1] / np.maximum(sums[2], 1e-9))[2 * pixel + half]
    np.testing.assert_allclose(moved, (1 - fraction) * light + fraction * even, rtol=1e-5, atol=1e-6)


def test_light_in_proportion_to_weight_remains():
    """Light of constant irradiance has the detail of the weights, which spreading keeps."""
    rng, rays = generator(), DIFFERENT
    weight = rng.uniform(0, 1, (rays.count, 3))
    light = weight * np.repeat(rng.exponential(size=(rays.pixels, 1)), rays.numbers, axis=0)
    np.testing.assert_allclose(spread_over(rays, light, weight, 1.0), light, rtol=1e-5, atol=1e-7)


def test_light_remains_in_channels_without_a_weight():
    rng, rays = generator(), replace(PixelRays.uniform(8, 4), cells=4)
    light, weight = rng.exponential(size=(rays.count, 3)), np.ones((rays.count, 3))
    weight[:, 1], weight[:4] = 0, 0
    moved = spread_over(rays, light, weight, 0.5)
    np.testing.assert_array_equal(moved[:, 1], light[:, 1].astype(np.float32))
    np.testing.assert_array_equal(moved[:4], light[:4].astype(np.float32))
    assert not np.allclose(moved[4:, 0], light[4:, 0])


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_a_weight_that_is_not_finite_takes_no_light(value):
    rng, rays = generator(), replace(PixelRays.uniform(2, 4), cells=4)
    light, weight = rng.exponential(size=(rays.count, 3)), np.ones((rays.count, 3))
    weight[1, 0] = value
    moved = spread_over(rays, light, weight, 0.5)
    np.testing.assert_allclose(moved[:4].sum(0), light[:4].sum(0), rtol=1e-5)
    np.testing.assert_allclose(moved[1, 0], 0.5 * light[1, 0], rtol=1e-5)
