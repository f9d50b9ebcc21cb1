"""Shared code of shapes: kernels do not grow with the number of rectangles, and rectangles keep their identity."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.scenes import area_light, closed_box
from vpl.core.shared_code import share_code


@pytest.fixture
def scene_of():
    """Return a function that builds a closed box with the given number of lamps of different sizes and positions."""
    # Kernels hold the code of all live scenes
    gc.collect()

    def make(count):
        lamps = {f"lamp{k}": area_light() | {"to_world": placed(k)} for k in range(count)}
        return mi.load_dict(closed_box(lamps))

    return make


def placed(k):
    """Where lamp ``k`` hangs below the ceiling of the box."""
    transform = mi.ScalarTransform4f()
    place, turn = transform.translate([0.2 * k - 1, 0, 0.9]), transform.rotate([1, 0.1 * k, 0], 180)
    return place @ turn @ transform.scale(0.1 + k)


def lamp(scene, k=0):
    return next(shape for shape in scene.shapes() if shape.id() == f"lamp{k}")


def operations(scene):
    """Length of a kernel that samples points on shapes."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        shape = dr.gather(mi.ShapePtr, scene.shapes_dr(), dr.opaque(mi.UInt32, 0, 10))
        dr.eval(shape.sample_position(0.0, mi.Point2f(dr.opaque(mi.Float, 0.3, 10)), True))
        return max(one["operation_count"] for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT)


def test_kernels_do_not_grow_with_rectangles(scene_of):
    lengths = []
    for count in (2, 9):
        scene = scene_of(count)
        before = operations(scene)
        share_code(scene)
        lengths.append((before, operations(scene)))
        del scene
    (few, few_shared), (many, many_shared) = lengths
    # If this fails, Mitsuba shares code itself, and the module is obsolete
    assert many > few
    assert many_shared == few_shared


def test_rectangles_stay_where_they_are(scene_of):
    scene = scene_of(2)
    before = [np.array(mi.traverse(lamp(scene, k))["to_world"].matrix) for k in range(2)]
    share_code(scene)
    share_code(scene)
    for k, matrix in enumerate(before):
        np.testing.assert_array_equal(np.array(mi.traverse(lamp(scene, k))["to_world"].matrix), matrix)


def test_a_rectangle_can_be_moved_afterwards(scene_of):
    scene = scene_of(1)
    share_code(scene)
    parameters = mi.traverse(scene)
    parameters["lamp0.to_world"] = mi.Transform4f().translate([0, 0, 0.5])
    parameters.update()
    share_code(scene)
    found = lamp(scene).sample_position(0.0, mi.Point2f(0.5), True)
    np.testing.assert_allclose(np.array(found.p).ravel(), [0, 0, 0.5], atol=1e-6)


def test_gradients_pass_what_is_shared(scene_of):
    scene = scene_of(1)
    parameters = mi.traverse(scene)
    place = mi.Float(0.5)
    dr.enable_grad(place)
    parameters["lamp0.to_world"] = mi.Transform4f().translate([0, 0, place])
    parameters.update()
    with dr.suspend_grad():
        share_code(scene)
    found = lamp(scene).sample_position(0.0, mi.Point2f(0.5), True)
    dr.backward(found.p.z)
    assert place.grad == 1
