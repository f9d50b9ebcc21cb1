"""Lights of `manylights` that are kept for further images of a scene: unbiased, and new after a change of the scene."""

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import images
from comparison.scene_files import SceneFile
from tests.support.catalogue import EMITTERS
from tests.support.marks import stress
from tests.support.scenes import area_light, closed_box, image, rgb, sensor
from tests.support.statistics import assert_same_mean
from vpl.core.parameters import fingerprint, fingerprint_without_camera
from vpl.split import estimator

pytestmark = pytest.mark.usefixtures("lights_cost_nothing")


@pytest.fixture
def made(monkeypatch):
    """Number of lines of each drawing of lights."""
    original, counts = estimator.surface_lights, []

    def surface_lights(view, sampler, count, *more):
        counts.append(count)
        return original(view, sampler, count, *more)

    monkeypatch.setattr(estimator, "surface_lights", surface_lights)
    return counts


def looking(origin, target, size=16, **more):
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])
    return sensor(size, 32) | {"fov": 60, "to_world": to_world, "near_clip": 1e-3, **more}


def two_views(**more):
    """The closed box, a corner of which is seen by the first camera and the opposite one by the second."""
    box = closed_box({"lamp": area_light()}, **more)
    del box["sensor"]
    box["first"] = looking([0.3, 0.3, 0.3], [-1, -1, -1], fov=20)
    box["second"] = looking([-0.3, -0.3, -0.3], [1, 0.4, 1])
    return box


def keeping(**more):
    return mi.load_dict({"type": "manylights", "max_depth": 5, "keep_lights": True, **more})


def lit(scene, integrator, camera=0, seed=0, spp=8):
    return np.array(mi.render(scene, integrator=integrator, sensor=camera, seed=seed, spp=spp))


# ---------------------- Other cameras ----------------------


def two_rooms():
    """Two closed rooms, each with a bulb and a camera: no light gets from one to the other."""
    scene = {"type": "scene"}
    for number, (name, x) in enumerate((("first", 0.0), ("second", 3.0))):
        grey = 0.5 + 0.2 * number
        scene[name] = looking([x + 0.3, 0.2, 0.8], [x - 0.2, -0.3, -1])
        scene[f"{name}_room"] = {
            "type": "cube", "flip_normals": True, "to_world": mi.ScalarTransform4f().translate([x, 0, 0]),
            "bsdf": {"type": "diffuse", "reflectance": rgb(grey, grey, 0.3)},
        }  # fmt: skip
        scene[f"{name}_bulb"] = {"type": "point", "position": [x, 0.6, 0.2], "intensity": rgb(1.0)}
    return scene


@pytest.mark.stress
@pytest.mark.parametrize("views", [two_rooms, *stress(two_views)])
def test_a_second_camera_sees_the_image_of_path_by_the_lights_of_the_first(made, views):
    scene = mi.load_dict(views())

    def pair(seed):
        integrator = keeping()
        lit(scene, integrator, 0, seed)
        found = lit(scene, integrator, 1, seed, 32)
        assert len(made) == seed + 1 and integrator.statistics["light_paths"] == 0
        assert integrator.statistics["lights"]["surface"] > 100 and integrator.statistics["shadow_rays"] > 0
        return found, lit(scene, mi.load_dict({"type": "path", "max_depth": 5}), 1, 1000 + seed, 128)

    assert_same_mean(pair, 16, 0.055)


def test_lights_are_made_once_for_each_seed_and_depth(made):
    scene, integrator = mi.load_dict(two_views()), keeping()
    for camera, seed in ((0, 0), (1, 0), (0, 0), (0, 1), (1, 1), (1, 0)):
        lit(scene, integrator, camera, seed)
    assert len(made) == 2
    integrator.max_depth = 4
    lit(scene, integrator)
    assert len(made) == 3
    lit(scene, keeping())
    assert len(made) == 4, "another integrator has lights of its own"


def test_without_the_property_nothing_is_kept(made):
    scene, integrator = mi.load_dict(two_views()), mi.load_dict({"type": "manylights", "max_depth": 5})
    expected = lit(scene, integrator)
    lit(scene, integrator)
    assert len(made) == 2 and integrator._kept.count == 0
    # The first image with kept lights is the same
    np.testing.assert_allclose(lit(scene, keeping()), expected, rtol=1e-4, atol=1e-5)


def test_lights_are_kept_only_as_far_as_memory_allows(made):
    scene, integrator = mi.load_dict(two_views()), keeping()
    lit(scene, integrator)
    integrator._kept.most = integrator._kept.count + 10
    for seed in (1, 1, 0):
        lit(scene, integrator, seed=seed)
    assert len(made) == 3


def test_passes_of_an_image_have_lights_of_their_own_and_the_next_image_has_them_again(made):
    scene = mi.load_dict(two_views())
    (_, first), (_, second) = manylights.render(scene, keeping(), "all", spp=24, pass_spp=8)
    assert len(made) == 3 == first.passes and second.passes == 3
    assert first.statistics["light_paths"] == sum(made) and second.statistics["light_paths"] == 0


# ---------------------- Other scenes ----------------------


def changes():
    """Name of a scene's parameter -> function to its new value."""
    return {
        "lamp.emitter.radiance.value": lambda value: value * 2,
        "mesh.bsdf.reflectance.value": lambda value: value * 0.5,
        "ball.to_world": lambda value: value @ mi.ScalarTransform4f().translate([0.1, 0, 0]),
        "sky.scale": lambda value: value * 2,
        "mesh.vertex_positions": lambda value: value + 1e-3,
        "back.bsdf.reflectance.data": lambda value: value * 0.9,
    }


@pytest.fixture
def varied():
    """A scene with a parameter of each kind."""
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0.4, -0.7, 0]).scale(0.2)}
    ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([-0.5, -0.7, 0]).scale(0.2)}
    box = two_views(mesh=cube, ball=ball, **EMITTERS["envmap"]())
    patches = np.random.default_rng(1).uniform(0.1, 0.9, (4, 4, 3))
    box["back"]["bsdf"] = {"type": "diffuse", "reflectance": image(patches)}
    return mi.load_dict(box)


@pytest.mark.parametrize("name", changes())
def test_a_scene_that_was_changed_has_lights_made_anew(varied, made, name):
    integrator, parameters = keeping(), mi.traverse(varied)
    lit(varied, integrator)
    parameters[name] = changes()[name](parameters[name])
    parameters.update()
    lit(varied, integrator, 1)
    assert len(made) == 2
    lit(varied, integrator, 0)
    assert len(made) == 2


def test_a_camera_that_moved_has_the_lights_that_there_were(varied, made):
    integrator, parameters = keeping(), mi.traverse(varied)
    lit(varied, integrator)
    parameters["first.to_world"] = mi.Transform4f().look_at([0.1, 0, 0], [-1, 0, -1], [0, 1, 0])
    parameters["first.x_fov"] = 70.0
    parameters.update()
    lit(varied, integrator)
    assert len(made) == 1


def test_fingerprints_tell_what_is_printed_and_not_only_parameters():
    def scene(distribution, **camera):
        metal = {"type": "roughconductor", "distribution": distribution}
        box = closed_box({"lamp": area_light()})
        box["back"]["bsdf"] = metal
        return mi.load_dict(box | camera)

    one, other = scene("ggx"), scene("beckmann")
    assert fingerprint_without_camera(one) != fingerprint_without_camera(other)
    alike = scene("ggx", sensor=looking([0, 0, 0.5], [0, 0, -1], 8), integrator={"type": "direct"})
    assert fingerprint_without_camera(one) == fingerprint_without_camera(alike)
    shapes = one.shapes()
    assert fingerprint(shapes) == fingerprint(shapes[::-1]) != fingerprint(shapes[1:])


# ---------------------- The command ----------------------

FRAMES = """
<scene version="3.0.0"><default name="x" value="0"/><default name="grey" value="0.5"/>
<integrator type="manylights"><boolean name="keep_lights" value="$keep"/><integer name="max_depth" value="4"/>
</integrator>
<shape type="cube"><boolean name="flip_normals" value="true"/>
<bsdf type="diffuse"><rgb name="reflectance" value="$grey"/></bsdf></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.2"/></transform></shape>
<shape type="rectangle"><transform name="to_world"><translate x="0.6" y="-0.5"/><scale value="0.2"/></transform></shape>
<emitter type="point"><point name="position" value="0, 0.5, 0"/></emitter>
<sensor type="perspective"><float name="fov" value="70"/>
<transform name="to_world"><lookat origin="$x, 0, 0.9" target="0, 0, -1" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor></scene>
"""


def rendered_frames(folder, *more):
    (folder / "a.xml").write_text(FRAMES)
    command = [
        str(folder / "a.xml"),
        "--frames",
        "0..2",
        "--spp",
        "4",
        "-o",
        str(folder / "{frame}.exr"),
        "-m",
        mi.variant(),
    ]
    status = manylights.main([*command, *more])
    return status, [images.read_exr(file)[0] for file in sorted(folder.glob("*.exr"))]


@pytest.mark.parametrize(
    ("more", "times"),
    [
        (["-D", "keep=true", "-D", "x=0.{frame}"], 1),
        (["-D", "keep=false", "-D", "x=0.{frame}"], 3),
        (["-D", "keep=true", "-D", "grey=0.{frame}5"], 3),
    ],
)
def test_frames_of_a_scene_that_stays_as_it_is_share_their_lights(tmp_path, made, more, times):
    status, found = rendered_frames(tmp_path, *more)
    assert status == 0 and len(made) == times
    assert len(found) == 3 and not np.array_equal(found[0], found[1])


def test_workers_keep_no_lights(tmp_path, capsys):
    status, found = rendered_frames(tmp_path, "-D", "keep=true", "--workers", "1")
    assert status == 1 and not found
    assert "keep_lights is for one process" in capsys.readouterr().err


def test_files_are_compared_with_or_without_their_cameras(tmp_path):
    (tmp_path / "a.xml").write_text(FRAMES)

    def prints(camera, **defines):
        return SceneFile(tmp_path / "a.xml", {"keep": "true"} | defines).fingerprint(camera)

    assert prints(False) == prints(False, x="0.5") and prints(True) != prints(True, x="0.5")
    assert prints(False) != prints(False, grey="0.4") and prints(False) != prints(False, keep="false")
