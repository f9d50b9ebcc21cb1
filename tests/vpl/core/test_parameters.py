"""Reading the parameters of scene objects, compared with ``mitsuba.traverse``."""

import mitsuba as mi
import numpy as np
import pytest

from vpl.core.parameters import fingerprint_without_camera, matrix_of, numbers, parameters_of
from vpl.lights.emitters import read_emitters

NAMES = ("point", "spot", "directional", "constant", "sphere", "lamp", "mesh")


def placed():
    return mi.ScalarTransform4f().translate([1, 2, 3]).rotate([1, 1, 0], 40).scale([2, 3, 4])


def load(name):
    looking = mi.ScalarTransform4f().look_at([1, 2, 3], [4, 0, 1], [0, 0, 1])
    objects = {
        "point": {"type": "point", "position": [1, 2, 3], "intensity": {"type": "rgb", "value": [1, 2, 3]}},
        "spot": {"type": "spot", "to_world": looking},
        "directional": {"type": "directional", "direction": [1, 2, -1]},
        "constant": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
        "sphere": {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([1, 2, 3]).scale(2)},
        "lamp": {"type": "rectangle", "to_world": placed(), "emitter": {"type": "area"}, "bsdf": {"type": "diffuse"}},
        "mesh": {"type": "cube", "to_world": placed()},
    }
    return mi.load_dict(objects[name])


@pytest.mark.parametrize("name", NAMES)
def test_names_and_values_are_those_that_mitsuba_lists(name):
    node = load(name)
    found, expected = parameters_of(node), mi.traverse(node)
    assert sorted(found) == sorted(key for key, _ in expected)
    for key, value in expected:
        assert np.array_equal(np.array(found[key]), np.array(value)), key


def test_objects_below_can_be_left_out():
    lamp = load("lamp")
    assert "bsdf.reflectance.value" in parameters_of(lamp)
    assert "to_world" in parameters_of(lamp, below=False)
    assert not any("." in name for name in parameters_of(lamp, below=False))


def test_numbers_of_all_kinds_of_values():
    assert numbers(2) == [2.0] and numbers(0.5) == [0.5]
    assert numbers(mi.Float(0.5)) == [0.5]
    assert numbers(mi.Point3f(1, 2, 3)) == [1, 2, 3]
    assert numbers(mi.ScalarPoint3f(1, 2, 3)) == [1, 2, 3]
    assert numbers(mi.Float([0.25]) + 1) == [1.25]


def test_matrices():
    expected = np.array(placed().matrix)
    lamp = parameters_of(load("lamp"))
    assert np.allclose(matrix_of(placed()), expected, atol=1e-6)
    assert np.allclose(matrix_of(lamp["to_world"]), expected, atol=1e-6)
    assert matrix_of(lamp["to_world"]).dtype == np.float64
    np.testing.assert_array_equal(matrix_of(placed(), (3, 1)), matrix_of(placed())[:, [3, 1]])


def test_a_mesh_attribute_as_radiance_is_refused_by_name():
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_glow"}})
    mesh = mi.Mesh("glowing", 3, 1, props=props, has_vertex_normals=False, has_vertex_texcoords=False)
    mesh.add_attribute("vertex_glow", 3, [1.0] * 9)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [0.0, 0, 0, 1, 0, 0, 0, 1, 0]
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    scene = mi.load_dict({"type": "scene", "glowing": mesh})
    with pytest.raises(ValueError, match=r"glowing.*mesh attribute.*not supported"):
        read_emitters(scene)


@pytest.mark.parametrize("far", [0.0, 1e4, 1e6])
def test_a_small_move_far_from_the_origin_changes_the_fingerprint(far):
    def scene(x):
        ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([x, 0, 0])}
        return mi.load_dict({"type": "scene", "ball": ball})

    one, same, moved = (fingerprint_without_camera(scene(x)) for x in (far, far, far + 1e-6 * max(far, 1.0)))
    assert one == same != moved
