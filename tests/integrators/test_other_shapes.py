"""Area emitters beside shapes on which no point can be sampled: curves, ellipsoids, instances."""

import gc

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS, stage
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box, rgb, sensor, wall
from tests.support.statistics import relative_error


@pytest.fixture(autouse=True)
def only_scenes_of_one_test():
    """A live shape that cannot be sampled breaks calls of emitters in any scene with many emissive shapes."""
    yield
    gc.collect()


def curve(folder):
    path = folder / "curve.txt"
    path.write_text("".join(f"{x:.3f} {0.3 * np.sin(3 * x):.3f} 0.4 0.15\n" for x in np.linspace(-1, 1, 8)))
    return str(path)


OTHERS = {
    "curve": lambda folder: {"hair": {"type": "bsplinecurve", "filename": curve(folder)}},
    "ellipsoids": lambda folder: {
        "drops": {
            "type": "ellipsoids", "centers": mi.TensorXf([[0, 0, 0.4]]), "scales": mi.TensorXf([[0.3, 0.2, 0.2]]),
            "quaternions": mi.TensorXf([[0, 0, 0, 1]]), "opacities": mi.TensorXf([[1]]),
        }
    },
    "instance": lambda folder: {
        "group": {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.4}},
        "copy": {
            "type": "instance", "to_world": mi.ScalarTransform4f().translate([0.3, 0, 0.3]),
            "of": {"type": "ref", "id": "group"},
        },
    },
}  # fmt: skip


@pytest.mark.parametrize("name", ["adaptivedirect", *stress("lightcuts")])
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("lamp", [pytest.param("rectangle", marks=pytest.mark.stress), "cylinder"])
def test_area_emitters_light_them_as_in_path(name, other, lamp, tmp_path):
    lamps = EMITTERS[lamp]() | {"second": {"type": "sphere", "center": [1, 1.2, 1], "radius": 0.1,
                                           "emitter": {"type": "area"}}}  # fmt: skip
    scene = mi.load_dict(stage(lamps, OTHERS[other](tmp_path), 16))
    expected, found = (
        render(scene, plugin, spp, max_depth=2, hide_emitters=True, **more)
        for plugin, spp, more in (("path", 1024, {}), (name, 256, {}))
    )
    assert abs(found.mean() / expected.mean() - 1) < 0.01
    assert relative_error(found, expected) < 0.12
    if name == "lightcuts":
        for direct in ("vpl", "adaptive"):
            found = render(scene, name, 4, max_depth=3, direct=direct, direct_count=500)
            assert np.isfinite(found).all() and found.mean() > 0.5 * expected.mean()


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
def test_another_scene_is_lit_while_a_curve_is_alive(name, tmp_path):
    """Dr.Jit records calls on pointers for the shapes of all scenes."""
    alive = mi.load_dict(stage({}, OTHERS["curve"](tmp_path), 8))
    scene = mi.load_dict(closed_box({"lamp": area_light()}, 8))
    found, expected = (render(scene, plugin, 256, max_depth=2, hide_emitters=True).mean() for plugin in (name, "path"))
    assert found == pytest.approx(expected, rel=0.03)
    assert len(alive.shapes()) == 3


@pytest.mark.parametrize("name", ["manylights", "lightcuts"])
def test_a_scene_in_memory_with_instances_does_not_disturb_another_one(tmp_path, name):
    other = mi.load_dict(closed_box({"lamp": area_light()}, 8, **OTHERS["instance"](tmp_path)))
    lamps = {f"lamp{i}": wall([0.02 * i - 0.7, 0.9, 0], [1, 0, 0], 90, 0.008) for i in range(70)}
    lamps = {key: lamp | {"emitter": {"type": "area", "radiance": rgb(50.0)}} for key, lamp in lamps.items()}
    box = closed_box(lamps, 8)
    found, expected = (render(mi.load_dict(box), plugin, 64, max_depth=2) for plugin in (name, "path"))
    assert other is not None and found.mean() == pytest.approx(expected.mean(), rel=0.05)


@pytest.mark.parametrize("name", ["manylights", "vpl", "adaptivedirect"])
def test_balls_behind_hidden_emitters_keep_their_place(name):
    """The distance to the ball is that from the camera, not from the hidden lamp."""
    bulb = {"type": "point", "position": [3, 3, 3], "intensity": rgb(20.0)}
    scene = {"type": "scene", "sensor": sensor(12, 4, fov=40), "ball": {"type": "sphere", "radius": 0.8}, "bulb": bulb}
    lamp = wall([0, 0, 1.5], [0, 1, 0], 0, 0.3) | {"emitter": {"type": "area", "radiance": rgb(1e-6)}}
    plugin = mi.load_dict({"type": name, "max_depth": 2, "hide_emitters": True})
    found, expected = (render(mi.load_dict(one), plugin, 64) for one in (scene | {"lamp": lamp}, scene))
    assert relative_error(found, expected) < 0.1
