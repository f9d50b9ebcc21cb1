"""Regions of the environment emitter: sampling and shares of light."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.sources import (
    COUNT,
    SKIES,
    assert_mostly,
    colours,
    interactions,
    mean_and_error,
    sky,
    smooth_map,
    tilted,
)
from vpl.core.arrays import download, upload
from vpl.core.sampling import independent_sampler
from vpl.direct.environment_regions import EnvironmentRegions
from vpl.direct.sources import Sources
from vpl.lights.emitters import read_emitters


def environment(plugin):
    ball = {"type": "sphere", "radius": 0.1}
    return mi.load_dict({"type": "scene", "sky": plugin, "ball": ball}).environment()


def grid_directions(height=1024):
    """Directions in the middle of all cells of a grid, and their solid angles."""
    width = 2 * height
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    theta = (np.arange(height) + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    sine, ones = np.sin(theta), np.ones(width)
    unit = np.stack([np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)), np.outer(np.cos(theta), ones)], -1)
    angle = np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / width, width)
    return mi.Vector3f(*(upload(mi.Float, unit[..., k]) for k in range(3))), angle


def draw_regions(regions, index, seed=0):
    """(Direction, value, density) with every region of ``index`` in turn."""
    sampler = independent_sampler(seed, len(index))
    return regions.sample(upload(mi.UInt32, index), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))


def mitsubas_light(env):
    """Samples of the light of all directions by Mitsuba's own routine, (COUNT, 3)."""
    sample = independent_sampler(5, COUNT).next_2d()
    return colours(env.sample_direction(interactions([[0, 0, 0]], COUNT), sample)[1], COUNT)


@pytest.mark.parametrize("name", SKIES)
@pytest.mark.parametrize("count", [1, 40])
def test_directions_are_found_in_the_region_they_were_drawn_from(name, count):
    regions = EnvironmentRegions(environment(SKIES[name]()), count)
    assert 1 <= regions.count <= count
    index = np.repeat(np.arange(regions.count), COUNT // regions.count)
    direction, value, density = draw_regions(regions, index)
    unit = download(direction)
    assert np.allclose(np.linalg.norm(unit, axis=1), 1, atol=1e-5)
    region, again = regions.find(direction, mi.Bool(True))
    assert_mostly(download(region) == index, 0.999)
    assert_mostly(np.abs(download(again) / download(density) - 1) < 1e-4, 0.998)
    cosine = np.einsum("ij,ij->i", unit, regions.axis[index])
    assert (cosine >= regions.cone_cos[index] - 1e-5).all()
    radiance = colours(regions.radiance(direction, mi.Bool(True)), len(index))
    assert np.allclose(colours(value, len(index)) * download(density)[:, None], radiance, rtol=1e-4)


@pytest.mark.parametrize("name", SKIES)
def test_regions_share_out_all_light(name):
    env = environment(SKIES[name]())
    regions = EnvironmentRegions(env, 30)
    direction, angle = grid_directions()
    region, density = regions.find(direction, mi.Bool(True))
    region, radiance = download(region), colours(regions.radiance(direction, mi.Bool(True)), len(angle))
    assert np.allclose(np.bincount(region, angle * download(density), regions.count), 1, atol=1e-3)
    light = np.stack([np.bincount(region, angle * radiance[:, k], regions.count) for k in range(3)], 1)
    assert np.allclose(regions.irradiance, light.mean(1), rtol=0.03)
    per_region = 4000
    drawn = colours(
        draw_regions(regions, np.repeat(np.arange(regions.count), per_region))[1], regions.count * per_region
    )
    drawn = drawn.reshape(regions.count, per_region, 3)
    mean, error = drawn.mean(1), drawn.std(1) / np.sqrt(per_region)
    assert (np.abs(mean - light) < 5 * error + 5e-3 * light + 1e-12).all()
    # Within a region the weights hardly differ, thanks to the table
    assert (drawn.std(1) < 0.5 * mean).all()
    expected, expected_error = mean_and_error(mitsubas_light(env))
    assert np.allclose(light.sum(0), expected, rtol=5e-3, atol=5 * expected_error.max())


@pytest.mark.parametrize("name", SKIES)
def test_successive_regions_and_cells_are_neighbours(name):
    """So that well spread numbers draw directions that are spread over the sky."""
    regions = EnvironmentRegions(environment(SKIES[name]()), 100)
    if regions.count > 10:
        rng = np.random.default_rng(0)
        successive, random = (
            np.einsum("ij,ij->i", axis[:-1], axis[1:]).mean() for axis in (regions.axis, rng.permutation(regions.axis))
        )
        assert 1 - successive < 0.6 * (1 - random)
    numbers = np.tile((np.arange(64) + 0.5) / 64, regions.count)
    index = upload(mi.UInt32, np.repeat(np.arange(regions.count), 64))
    place = mi.Point2f(0.5)
    unit = download(regions.sample(index, upload(mi.Float, numbers), place, mi.Bool(True))[0]).reshape(-1, 64, 3)
    successive = np.linalg.norm(np.diff(unit, axis=1), axis=2).mean()
    random = np.linalg.norm(np.diff(unit[:, np.random.default_rng(1).permutation(64)], axis=1), axis=2).mean()
    assert successive < 0.6 * random


def test_regions_of_a_constant_environment_fill_the_sphere():
    regions = EnvironmentRegions(environment(SKIES["constant"]()), 50)
    assert regions.count == 50
    assert regions.irradiance.sum() == pytest.approx(4 * np.pi * 2, rel=1e-4)


def test_a_black_environment_gives_nothing_and_no_nan():
    for plugin in (sky(np.zeros((8, 16, 3))), {"type": "constant", "radiance": 0.0}):
        regions = EnvironmentRegions(environment(plugin), 10)
        assert regions.count >= 1
        assert regions.irradiance.sum() == 0
        assert np.isfinite(regions.axis).all()
        direction, value, density = draw_regions(regions, np.zeros(1000, int))
        assert np.isfinite(download(direction)).all()
        assert colours(value, 1000).max() == 0
        assert download(density).min() > 0
        scene = mi.load_dict({"type": "scene", "sky": plugin, "ball": {"type": "sphere"}})
        assert Sources(scene, read_emitters(scene), 10).count == 0


@pytest.mark.parametrize("shape", [(32, 64), (256, 512), (1024, 2048)], ids=str)
def test_a_single_very_bright_texel_is_found(shape):
    pixels = np.full((*shape, 3), 1e-3)
    pixels[shape[0] // 3, shape[1] // 5] = 1e9
    env = environment(sky(pixels, tilted()))
    regions = EnvironmentRegions(env, 20)
    brightest = int(np.argmax(regions.irradiance))
    assert regions.irradiance[brightest] > 0.1 * regions.irradiance.sum()
    index = np.arange(COUNT) % regions.count
    _, value, density = draw_regions(regions, index)
    value = colours(value, COUNT)[:, 0]
    total = np.array([value[index == region].mean() for region in range(regions.count)])
    assert total.sum() == pytest.approx(mitsubas_light(env)[:, 0].mean(), rel=0.1)
    assert np.mean(value[index == brightest] * download(density)[index == brightest] > 1) > 0.8


def test_texels_that_are_not_finite_count_as_black():
    pixels = smooth_map()
    pixels[10, 10], pixels[20, 50] = np.nan, np.inf
    regions = EnvironmentRegions(environment(sky(pixels)), 10)
    assert np.isfinite(regions.irradiance).all()
    value = colours(draw_regions(regions, np.arange(COUNT) % regions.count)[1], COUNT)
    assert np.isfinite(value).all()
    assert value.max() > 0
