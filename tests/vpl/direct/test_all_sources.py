"""Sums over all sources, and the table of an environment: what many points of a pixel and a sharp sun ask of them."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.rendering import render
from tests.support.scenes import closed_box, sensor, wall
from tests.support.statistics import relative_error
from vpl.direct.environment_regions import EnvironmentRegions
from vpl.lights.emission import solid_angle_radiance


def checkered():
    """A box lit by one point, before whose back wall stands a fine checkerboard."""
    board = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale(40)}}
    bulb = {"type": "point", "position": [0.2, 0.6, 0.1], "intensity": {"type": "rgb", "value": 1.0}}
    return mi.load_dict(closed_box({"bulb": bulb}, 16, board=wall([0, 0, -0.9], [0, 1, 0], 0, 0.9, bsdf=board)))


@pytest.mark.parametrize("name", ["adaptivedirect", "unoccludeddirect"])
def test_pixels_lit_by_few_points_show_all_of_what_they_hold(name):
    """One sum over the sources is exact for a point, not for a pixel of many points."""
    scene = checkered()
    expected = render(scene, "direct", 256)
    assert relative_error(render(scene, name, 64), expected) < 0.06


def test_one_ray_a_light_is_enough_for_one_point_a_pixel():
    scene = checkered()
    plugin = mi.load_dict({"type": "adaptivedirect"})
    render(scene, plugin, 1)
    assert plugin.statistics["shadow_rays"] <= plugin.statistics["gather_points"]


@pytest.mark.parametrize("direction", [[0.3, 0.4, 0.8], [0.0, 0.7, 0.7], [0.9, 0.2, 0.1]])
def test_the_table_of_an_environment_holds_the_edge_of_the_sun(direction):
    """Evaluations may all miss the part of the sun in a cell; then nearly no sample would ever go there."""
    sun = {"type": "sunsky", "sky_scale": 0.0, "sun_direction": direction}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "ball": {"type": "sphere"}, "sun": sun})
    environment = scene.environment()
    regions = EnvironmentRegions(environment, 50)
    whole = solid_angle_radiance(environment, [0, 0, 0], 1 << 18)
    assert abs(regions.irradiance.sum() / whole - 1) < 0.03
    count, drawn = 1 << 17, 0.0
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    for region in range(regions.count):
        index = mi.UInt32(np.full(count, region, np.uint32))
        _, value, _ = regions.sample(index, sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
        drawn += np.array(value, np.float64).mean()
    assert abs(drawn / whole - 1) < 0.03
