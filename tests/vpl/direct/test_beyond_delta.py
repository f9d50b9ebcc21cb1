"""Emission that rays find through mirrors, glass and masks."""

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.path_limits import PathLimits
from vpl.core.sampling import independent_sampler
from vpl.direct.emitter_sampling import emission_beyond_delta
from vpl.lights.emitters import read_emitters
from vpl.points.camera_paths import scene_traits

MIRROR = {"type": "conductor", "material": "none"}


def emission(rectangles, max_depth, count=100_000):
    """Mean emission along a ray upwards from the origin."""
    scene = mi.load_dict({"type": "scene", **rectangles})
    traits = scene_traits(scene)
    ray = mi.Ray3f(mi.Point3f(dr.zeros(mi.Float, count), 0, 0), mi.Vector3f(0, 0, 1))
    hit = traits.interactions.meet(ray, mi.Bool(True))
    limits, sampler = PathLimits.of(max_depth, 5), independent_sampler(0, count)
    found = emission_beyond_delta(
        read_emitters(scene), traits, hit, mi.UInt32(1), limits, sampler, dr.full(mi.Bool, True, count)
    )
    return np.array(found)[0].mean()


def sheet(height, facing, **more):
    transform = mi.ScalarTransform4f().translate([0, 0, height])
    if facing < 0:
        transform = transform @ mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    return {"type": "rectangle", "to_world": transform, **more}


def test_a_ray_between_parallel_mirrors_ends():
    mirrors = {"above": sheet(1, -1, bsdf=MIRROR), "below": sheet(-1, 1, bsdf=MIRROR)}
    lamp = {"lamp": {"type": "point", "position": [5, 0, 0]}}
    assert emission(mirrors | lamp, np.inf) == 0


def test_roulette_keeps_the_mean_of_light_behind_many_panes():
    masks = {
        f"mask{number}": sheet(number, -1, bsdf={"type": "mask", "opacity": 0.2, "nested": {"type": "diffuse"}})
        for number in range(1, 10)
    }
    lamp = sheet(20, -1, emitter={"type": "area", "radiance": {"type": "rgb", "value": 1.0}})
    found = emission(masks | {"lamp": lamp}, np.inf)
    expected = 0.8**9
    assert abs(found - expected) < 5 * np.sqrt(expected / 0.95**5 / 100_000)
