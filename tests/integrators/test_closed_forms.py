"""Images that a formula knows: emitters over a plane, two parallel disks, a furnace whose walls glow."""

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.catalogue import PLUGINS, plugin
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.scenes import closed_box, rgb, sensor, wall

pytestmark = pytest.mark.usefixtures("lights_cost_nothing")
SEEDS = 12
QUICK = ("manylights", "lightcuts", "adaptivedirect")
DIRECT = ("adaptivedirect", "unoccludeddirect")


def all_plugins(*left_out):
    """Parameters for names of plugins; most are for the stress run."""
    names = [name for name in PLUGINS if name not in left_out]
    return [pytest.param(name, marks=() if name in QUICK else pytest.mark.stress) for name in names]


def few_lights(name, count):
    """Properties of a plugin for the given number of lights, without clamping."""
    return {} if name == "manylights" else {"clamping": 0.0, "vpl_count": count}


def assert_mean(name, scene, expected, spp=16, tolerance=2e-3, **more):
    """The mean over an image, over seeds: a t test at 0.1%, and a tolerance for what cuts and clusters may err."""
    integrator = mi.load_dict(plugin(name, **{"error": 0.002, **more} if name in ("lightcuts",) else more))
    means = np.array([render(scene, integrator, spp, seed).mean() for seed in range(SEEDS)])
    width = stats.t.ppf(0.9995, SEEDS - 1) * means.std(ddof=1) / SEEDS**0.5
    assert abs(means.mean() - expected) < width + tolerance * expected, (means.mean(), expected, width)
    # The tolerance must be small against the mean
    assert width < 0.05 * expected


def floor_seen_from(eye, half_size=20.0, kind="rectangle"):
    """A diffuse floor of reflectance 1/2, of which a camera at ``eye`` sees hardly more than the origin."""
    camera = sensor(8, 16) | {
        "to_world": mi.ScalarTransform4f().look_at(eye, [0, 0, 0], [0, 0, 1]), "fov": 0.5, "near_clip": 1e-5,
    }  # fmt: skip
    floor = wall([0, 0, 0], [1, 0, 0], -90, half_size) | {"type": kind}
    return {"type": "scene", "sensor": camera, "floor": floor}


def facing_down(kind, height, radius, radiance):
    transform = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], 90).scale(radius)
    grey = {"type": "diffuse", "reflectance": rgb(0.5)}
    return {"type": kind, "to_world": transform, "bsdf": grey, "emitter": {"type": "area", "radiance": rgb(radiance)}}


@pytest.mark.parametrize("name", all_plugins())
@pytest.mark.parametrize("height", [1.01, *stress(2.0, 5.0)])
def test_a_glowing_ball_over_a_plane(name, height):
    """Right below a ball of radius r at height h the irradiance is pi L (r / h)²."""
    ball = {
        "type": "sphere",
        "center": [0, height, 0],
        "radius": 1.0,
        "emitter": {"type": "area", "radiance": rgb(3.0)},
    }
    scene = floor_seen_from([1e-3, 1e-3, 0]) | {"ball": ball}
    assert_mean(name, mi.load_dict(scene), 0.5 * 3.0 / height**2, max_depth=2, tolerance=4e-3)


@pytest.mark.parametrize("name", all_plugins())
def test_a_disk_over_a_plane(name):
    """Below the middle of a disk of radius r at height h the irradiance is pi L r² / (r² + h²)."""
    scene = floor_seen_from([0.3, 0.5, 0]) | {"disk": facing_down("disk", 1.5, 1.0, 2.0)}
    assert_mean(name, mi.load_dict(scene), 0.5 * 2.0 / (1 + 1.5**2), max_depth=2)


@pytest.mark.stress
@pytest.mark.parametrize("name", all_plugins(*DIRECT))
@pytest.mark.parametrize("depth", [4, *stress(2)])
def test_light_between_two_disks(name, depth):
    """A glowing disk over another one, each reflecting half of what comes: radiosity of both by quadrature over rings.

    ``transport``: share of the light that leaves each ring of one disk and arrives at each ring of the other.
    """
    radius, rings = 2.0, 400
    r = (np.arange(rings) + 0.5) * radius / rings
    turn = np.cos((np.arange(400) + 0.5) * 2 * np.pi / 400)
    distance2 = r[:, None, None] ** 2 + r[:, None] ** 2 - 2 * r[:, None, None] * r[:, None] * turn + 1
    transport = (2 / distance2**2).mean(2) * r * radius / rings
    bounce = 0.5 * transport
    lit = bounce @ np.ones(rings)
    expected = lit[0] + (0 if depth == 2 else (bounce @ (bounce @ lit))[0])
    scene = floor_seen_from([0.2, 0.3, 0], radius, "disk") | {"ceiling": facing_down("disk", 1.0, radius, 1.0)}
    more = few_lights(name, 2000)
    assert_mean(name, mi.load_dict(scene), expected, tolerance=5e-3, max_depth=depth, **more)


@pytest.mark.parametrize("name", all_plugins(*DIRECT))
@pytest.mark.parametrize("depth", [3, *stress(2, 5)])
def test_a_furnace_whose_walls_glow(name, depth):
    """Inside a closed box whose walls emit L and reflect a share a of it, n edges carry L (1 + a + ... + a^(n-1))."""
    glow = {"emitter": {"type": "area", "radiance": rgb(1.0)}}
    scene = closed_box({}, 8)
    for part in scene.values():
        if isinstance(part, dict) and part["type"] == "rectangle":
            part |= glow | {"bsdf": {"type": "diffuse", "reflectance": rgb(0.5)}}
    expected = sum(0.5**k for k in range(depth))
    more = few_lights(name, 1000)
    assert_mean(name, mi.load_dict(scene), expected, tolerance=5e-3, max_depth=depth, **more)
