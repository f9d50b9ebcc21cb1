"""Cameras that benchmarks put into scenes at random."""

import itertools

import mitsuba as mi
import numpy as np
import pytest

from benchmarks.views import move_cameras


def box(target):
    """The Cornell box, seen by two cameras in front of it, the first of which looks at ``target``."""
    scene = mi.cornell_box()
    view = mi.ScalarTransform4f().look_at([0, 0, 3.9], target, [0, 1, 0])
    scene["other"] = scene["sensor"] | {"film": {"type": "hdrfilm", "width": 16, "height": 16}}
    scene["sensor"] = scene["other"] | {"to_world": view}
    return mi.load_dict(scene)


def camera(scene):
    return np.array(mi.traverse(scene.sensors()[0])["to_world"].matrix).reshape(4, 4)


def test_all_cameras_are_put_where_they_see_something_the_same_every_time():
    own, found = camera(box([0, 0, 0])), []
    for number in (1, 1, 2, 3):
        scene = box([0, 0, 0])
        move_cameras(scene, number)
        first, second = scene.sensors()
        np.testing.assert_array_equal(camera(scene), np.array(mi.traverse(second)["to_world"].matrix).reshape(4, 4))
        ray, _ = first.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
        assert scene.ray_intersect(mi.Ray3f(ray)).is_valid()[0]
        found.append(camera(scene))
    np.testing.assert_array_equal(found[0], found[1])
    for one, other in itertools.combinations([own, *found[1:]], 2):
        assert np.abs(one - other).max() > 0.01


def test_a_camera_that_sees_nothing_is_refused():
    with pytest.raises(RuntimeError, match="sees no surface"):
        move_cameras(box([0, 0, 10]), 1)
