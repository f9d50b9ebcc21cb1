"""Surface interactions, against those of Mitsuba."""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.paths import ROOT
from tests.support.scenes import cornell, sensor
from vpl.core import interactions
from vpl.core.arrays import download
from vpl.core.interactions import Interactions
from vpl.core.sampling import independent_sampler

RAYS = 20_000
SHARED = ROOT.parent / "shared" / "scenes"


def mesh(name, flip=False, normals=True, coordinates=True, seed=0, shift=0.0):
    """Triangles in a cube around ``shift``; coordinates of the first lie on a line, those of the second in a point."""
    random, count = np.random.default_rng(seed), 30
    props = mi.Properties()
    props["flip_normals"] = flip
    made = mi.Mesh(name, 3 * count, count, props, normals, coordinates)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = (random.uniform(-1, 1, 9 * count) + shift).tolist()
    parameters["faces"] = list(range(3 * count))
    if normals:
        parameters["vertex_normals"] = random.normal(size=9 * count).tolist()
    if coordinates:
        places = random.uniform(-2, 2, (count, 3, 2))
        places[0, :, 0], places[1] = 0.25, 0.5
        parameters["vertex_texcoords"] = places.ravel().tolist()
    parameters.update()
    return made


def transform(seed):
    # The axis is not a unit vector: the normals that Mitsuba gives instances are then not perpendicular to the surface
    turn = mi.ScalarTransform4f().rotate([1, 2, 3], 40.0 * seed)
    return mi.ScalarTransform4f().translate([0.2 * seed, -0.1, 0.3]) @ turn @ mi.ScalarTransform4f().scale([1, 0.5, 2])


def copies(*groups):
    """An instance of each of the ``groups``, in different places."""
    return {
        f"copy{k}": {"type": "instance", "to_world": transform(k), "of": {"type": "ref", "id": group}}
        for k, group in enumerate(groups)
    }


MESHES = {
    "bare": lambda: {"mesh": mesh("bare", normals=False, coordinates=False)},
    "with normals": lambda: {"mesh": mesh("smooth", coordinates=False)},
    "with coordinates": lambda: {"mesh": mesh("mapped", normals=False)},
    "flipped": lambda: {"mesh": mesh("flipped", flip=True)},
    "flipped without normals": lambda: {"mesh": mesh("turned", flip=True, normals=False)},
    "several": lambda: {f"mesh{k}": mesh(f"m{k}", k == 1, k != 2, k != 1, k, 0.5 * k) for k in range(3)},
    "rectangles and cubes": lambda: {
        f"{kind}{flip}": {"type": kind, "flip_normals": flip, "to_world": transform(flip + 2 * len(kind))}
        for kind in ("rectangle", "cube") for flip in (False, True)
    },
}  # fmt: skip
OTHERS = {
    "spheres": lambda: {f"ball{k}": {"type": "sphere", "center": [k - 0.5, 0, 0], "radius": 0.6} for k in range(2)},
    "many spheres": lambda: {
        f"ball{k}": {"type": "sphere", "center": [0.2 * k - 1, 0.1 * k, 0], "radius": 0.3} for k in range(12)
    },
    "cylinder and disk": lambda: {
        "tube": {"type": "cylinder", "radius": 0.4}, "disk": {"type": "disk", "to_world": transform(3)}
    },
    "instances of triangles and of others": lambda: {
        "first": {"type": "shapegroup", "plate": {"type": "rectangle"}, "mesh": mesh("inside", flip=True),
                  "cube": {"type": "cube", "to_world": transform(2)}},
        "second": {"type": "shapegroup", "mesh": mesh("bare", normals=False, coordinates=False, seed=2)},
        "unused": {"type": "shapegroup", "mesh": mesh("unused", seed=4)},
        "mixed": {"type": "shapegroup", "mesh": mesh("other", seed=3), "ball": {"type": "sphere", "radius": 0.5}},
        **copies("first", "second", "mixed", "first"),
    },
    "mirrored instance": lambda: {
        "group": {"type": "shapegroup", "mesh": mesh("inside"), "plate": {"type": "rectangle"}},
        "copy": {"type": "instance", "to_world": transform(1) @ mi.ScalarTransform4f().scale([1, -1, 0.5]),
                 "of": {"type": "ref", "id": "group"}},
    },
    "ellipsoids": lambda: {
        "drops": {
            "type": "ellipsoidsmesh", "centers": mi.TensorXf([[0, 0, 0.4]]), "scales": mi.TensorXf([[0.3, 0.2, 0.2]]),
            "quaternions": mi.TensorXf([[0, 0, 0, 1]]), "opacities": mi.TensorXf([[1]]),
        }
    },
    "grid of distances": lambda: {
        "grid": {"type": "sdfgrid", "grid": mi.TensorXf(np.linspace(-1, 1, 64).reshape(4, 4, 4, 1))},
    },
    "instances": lambda: {
        "group": {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.5}, "plate": {"type": "rectangle"}},
        **copies("group", "group"),
    },
}  # fmt: skip


def rays():
    sampler = independent_sampler(5, RAYS)
    origin = mi.warp.square_to_uniform_sphere(sampler.next_2d()) * 4
    ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(1.5 * mi.warp.square_to_uniform_sphere(sampler.next_2d()) - origin))
    ray.time = sampler.next_1d()
    dr.eval(ray)
    return ray, sampler.next_1d() < 0.9


def assert_equal_interactions(scene, ray, active):
    """All fields are those of Mitsuba, but for rays that hit a triangle nearly edge-on; some of Mitsuba's are NaN."""
    numbers = [*("t", "time", "p", "n", "uv", "prim_index", "wi"), *("dp_du", "dp_dv", "dn_du", "dn_dv", "duv_dx"),
               *("duv_dy", "sh_frame.s", "sh_frame.t", "sh_frame.n")]  # fmt: skip
    expected = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
    found = Interactions(scene).meet(ray, active)
    # Together: otherwise, every field would compile kernels of its own
    dr.eval(expected, found)
    hit = download(expected.is_valid())
    assert 0.02 * len(hit) < hit.sum() < len(hit)
    np.testing.assert_array_equal(download(found.is_valid()), hit)
    for name in ("shape", "instance"):
        pointers = (dr.reinterpret_array(mi.UInt32, getattr(si, name)) for si in (found, expected))
        np.testing.assert_array_equal(*(np.broadcast_to(download(x), hit.shape) for x in pointers))
    for name in numbers:
        values = []
        for value in (found, expected):
            for part in name.split("."):
                value = getattr(value, part)
            rows = np.atleast_2d(np.array(value, np.float64))
            values.append(np.broadcast_to(rows, (len(rows), len(hit)))[:, hit])
        size = 1 + np.nanmax(np.abs(values[1]), axis=0, initial=0)
        equal = np.isclose(*values, rtol=0, atol=1e-3 * size, equal_nan=True).all(0)
        assert equal.mean() > 0.999, name
    np.testing.assert_array_equal(np.array(found.wi)[:, ~hit], -np.array(ray.d)[:, ~hit])
    assert np.isinf(download(found.t)[~hit]).all() and (np.array(found.p)[:, ~hit] == 0).all()


@pytest.mark.parametrize("shapes", MESHES.values(), ids=MESHES)
def test_meshes(shapes):
    scene = mi.load_dict({"type": "scene", **shapes()})
    assert_equal_interactions(scene, *rays())


SLOW = ("grid of distances", "beside meshes")
PLACES = [one for one in itertools.product(OTHERS, ("alone", "beside meshes")) if one != SLOW]


@pytest.mark.parametrize(("name", "place"), [*PLACES, *stress(SLOW)])
def test_other_shapes_beside_meshes_and_alone(name, place):
    meshes = MESHES["several"]() if place == "beside meshes" else {}
    assert_equal_interactions(mi.load_dict({"type": "scene", **OTHERS[name](), **meshes}), *rays())


def test_very_many_other_shapes_are_called_by_pointer(monkeypatch):
    monkeypatch.setattr(interactions, "_MOST_SWITCHED", 5)
    monkeypatch.setattr(dr, "switch", None)
    assert_equal_interactions(mi.load_dict({"type": "scene", **OTHERS["many spheres"]()}), *rays())


def test_a_scene_of_nothing():
    scene = mi.load_dict({"type": "scene", "sensor": sensor(4)})
    ray, active = rays()
    found = Interactions(scene).meet(ray, active, mi.Bool(True))
    assert not download(found.is_valid()).any() and (np.array(found.p) == 0).all()


def test_an_edited_scene():
    scene = mi.load_dict({"type": "scene", "plate": {"type": "rectangle"}})
    parameters = mi.traverse(scene)
    parameters["plate.to_world"] = mi.ScalarTransform4f().rotate([0, 1, 0], 50).scale(1.5)
    parameters.update()
    assert_equal_interactions(scene, *rays())


def test_an_edited_instance():
    scene = mi.load_dict({"type": "scene", **OTHERS["mirrored instance"]()})
    parameters = mi.traverse(scene)
    parameters["copy.to_world"] = mi.ScalarTransform4f().rotate([0, 1, 0], 50).scale(1.5)
    parameters.update()
    assert_equal_interactions(scene, *rays())


def test_places_in_the_registry_and_numbers_of_equal_shapes_add_no_code():
    """Spheres and instances name themselves by their index in Mitsuba's registry."""

    def balls(number):
        return {f"ball{k}": {"type": "sphere", "center": [0.1 * k, 0, 0]} for k in range(number)}

    def instances(number):
        return {"group": {"type": "shapegroup", "mesh": mesh("inside")}, **copies(*["group"] * number)}

    def operations(before, shapes):
        others = [mi.load_dict({"type": "sphere"}) for _ in range(before)]
        scene = mi.load_dict({"type": "scene", **shapes, **MESHES["several"]()})
        ray, active = rays()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(Interactions(scene).meet(ray, active))
            kernels = [one for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT]
        assert len(others) == before
        longest = max(kernels, key=lambda one: one["operation_count"])
        return longest["operation_count"], longest["hash"]

    assert operations(0, balls(3)) == operations(5, balls(3))
    assert operations(0, balls(10))[0] == operations(0, balls(3))[0]
    assert operations(0, instances(1)) == operations(5, instances(9))


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/scenes")
@pytest.mark.parametrize("name", ["living_room", "classroom"])
def test_scenes_of_other_people(name):
    """Some triangles have coordinates of textures on a line."""
    scene = mi.load_file(str(SHARED / name / "scene.xml"))
    sampler = independent_sampler(3, RAYS)
    ray, _ = scene.sensors()[0].sample_ray(0, 0, sampler.next_2d(), mi.Point2f(0.5))
    first = scene.ray_intersect(ray)
    onward = first.spawn_ray(mi.warp.square_to_uniform_sphere(sampler.next_2d()))
    dr.eval(onward)
    assert_equal_interactions(scene, onward, first.is_valid())


def test_cornell():
    assert_equal_interactions(cornell(4).load(), *rays())
