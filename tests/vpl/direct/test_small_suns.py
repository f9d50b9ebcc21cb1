"""Environment maps in which most of the light is in a single texel."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import sunny
from tests.support.scenes import sensor, wall
from vpl.core.arrays import download, upload
from vpl.core.sampling import independent_sampler
from vpl.direct.environment_regions import EnvironmentRegions

COUNT = 200_000
# Rows and columns of an image, and the texel of the sun
SKIES = [((64, 128), (20, 30)), ((250, 500), (80, 123)), ((1024, 2048), (300, 700)), ((1024, 4096), (150, 700))]


def floor_under(sky):
    return {"type": "scene", "sensor": sensor(16, 1), "floor": wall([0, -1, 0], [1, 0, 0], -90, 30.0), **sky}


@pytest.mark.parametrize("turn", [25.0, *stress(0.0, 77.3)])
@pytest.mark.parametrize(("shape", "sun"), SKIES, ids=str)
def test_directions_are_drawn_nearly_by_the_light_of_a_single_texel(shape, sun, turn):
    environment = mi.load_dict({"type": "scene", **sunny(shape, sun, turn=turn)}).environment()
    regions = EnvironmentRegions(environment, 300)
    ds, _ = environment.sample_direction(dr.zeros(mi.Interaction3f, COUNT), independent_sampler(0, COUNT).next_2d())
    radiance, drawn = (download(x).astype(float) for x in (regions.radiance(ds.d, mi.Bool(True)).x, ds.pdf))
    region, density = (download(x) for x in regions.find(ds.d, mi.Bool(True)))
    density = density.astype(float) * regions.irradiance[region] / regions.irradiance.sum()
    total = (radiance / drawn).mean()
    assert regions.irradiance.sum() == pytest.approx(total, rel=0.02)
    # 1 for a density that is proportional to the radiance
    assert (radiance**2 / density / drawn).mean() / total**2 < 1.6


@pytest.mark.parametrize(("aperture", "light", "spread"), [(0.5358, 0.01, 0.5), (0.1, 0.2, 4.0)])
@pytest.mark.parametrize(
    "direction",
    [[0.3, 0.4, 0.8], [0.5, 0.6, 0.3], [0.9, -0.1, 0.05], [-0.2, 0.5, 0.1], [0.5, 0.0, 0.2], [0.0, 0.06, 0.9]],
)
def test_directions_are_drawn_nearly_by_the_light_of_a_sun_smaller_than_a_cell(direction, aperture, light, spread):
    sky = {"type": "sunsky", "sun_direction": direction, "sun_aperture": aperture}
    environment = mi.load_dict({"type": "scene", "sky": sky, "ball": {"type": "sphere"}}).environment()
    regions = EnvironmentRegions(environment, 256, 512)
    _, own = environment.sample_direction(dr.zeros(mi.Interaction3f, COUNT), independent_sampler(0, COUNT).next_2d())
    assert regions.irradiance.sum() == pytest.approx(download(own).astype(float).mean(), rel=light + 0.05)
    probability, numbers = regions.irradiance / regions.irradiance.sum(), independent_sampler(0, COUNT)
    drawn = np.random.default_rng(0).choice(regions.count, COUNT, p=probability)
    value = regions.sample(upload(mi.UInt32, drawn), numbers.next_1d(), numbers.next_2d(), mi.Bool(True))[1]
    weight = download(value).astype(float).mean(1) / probability[drawn]
    assert regions.irradiance.sum() == pytest.approx(weight.mean(), rel=light)
    assert weight.std() < spread * weight.mean()


@pytest.mark.parametrize("plugin", ["adaptivedirect", *stress("manylights", "unoccludeddirect", "lightcuts")])
def test_a_sun_of_one_texel_gives_its_light_without_fireflies(plugin):
    scene = mi.load_dict(floor_under(sunny()))
    more = {
        "adaptivedirect": {"error": 0.02}, "unoccludeddirect": {"error": 0.1},
        "lightcuts": {"direct": "adaptive", "max_depth": 2}, "manylights": {"max_depth": 2},
    }[plugin]  # fmt: skip
    lit, samples = (slice(10, None), slice(None)), 512 if plugin == "manylights" else 1
    ours = np.array([render(scene, plugin, samples, seed, **more)[lit] for seed in range(8)])
    expected = np.mean([render(scene, "path", 512, seed, max_depth=2)[lit] for seed in range(8)])
    means = ours.mean((1, 2, 3))
    error = np.hypot(means.std(ddof=1) / len(means) ** 0.5, 0.002 * expected)
    assert abs(means.mean() - expected) < 3 * error
    assert ours.max() < 1.6 * np.median(ours) and ours.mean() == pytest.approx(expected, rel=0.01)


def test_manylights_is_less_noisy_than_path_under_a_sun_of_one_texel():
    """Within the texel, what the regions of the environment draw is not in proportion to its light."""
    scene = mi.load_dict(floor_under(sunny()))
    noise = [
        np.var([render(scene, name, 64, seed, max_depth=2)[10:] for seed in range(6)], axis=0).mean()
        for name in ("manylights", "path")
    ]
    assert noise[0] < 0.5 * noise[1]
