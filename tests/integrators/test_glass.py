"""Panes, lenses and bulbs of glass: shadow rays of ``manylights`` pass them, and the mean stays that of ``path``."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.integrators.test_light_groups import LENGTHS, assert_sums, layers_of
from tests.support.marks import not_on_cuda, stress
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.scenes import area_light, closed_box, image, rgb, sensor, wall
from tests.support.statistics import assert_same_mean
from vpl.split.emitters.uniform import UniformEmitters

pytestmark = not_on_cuda("kernels trace rays in one scene only")

GLASS = {"type": "dielectric"}
MASK = {"type": "mask", "opacity": 0.4, "n": {"type": "diffuse"}}


def pane(height=0.6, thickness=0.1, turn=0.0, half=1.2):
    """A slab of glass across the room."""
    placed = mi.ScalarTransform4f().translate([0, height, 0]).rotate([0, 0, 1], turn)
    return {"type": "cube", "to_world": placed.scale([half, 0.5 * thickness, half]), "bsdf": GLASS}


def tiles(number=9):
    """Square lamps below the ceiling, enough for a tree of emitters."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(0.07)
    places = [[x, 0.9, z] for x in np.linspace(-0.8, 0.8, number) for z in np.linspace(-0.8, 0.8, number)]
    return {
        f"tile{index}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate(place) @ turned,
            "emitter": {"type": "area", "radiance": rgb(2.0)},
        }
        for index, place in enumerate(places)
    }


def under_the_sky(size=12):
    """A room whose ceiling is a pane, below a sky with a sun."""
    pixels = np.full((16, 32, 3), 0.3, np.float32)
    pixels[3, 6] = 200
    room = closed_box({"sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)}}, size)
    del room["ceiling"]
    return room | {"pane": pane(0.9)}


def textured_light():
    pixels = np.zeros((4, 4, 3), np.float32)
    pixels[::2, ::2] = 16
    light = area_light()
    light["emitter"]["radiance"] = image(pixels)
    return light


def thin_lamp():
    """A closed mesh: the straight line meets its front, and its back a little behind."""
    placed = mi.ScalarTransform4f().translate([0, 0.9, 0]).scale([0.3, 2e-5, 0.3])
    return {"type": "cube", "to_world": placed, "emitter": {"type": "area", "radiance": rgb(4.0)}}


def thin_lamps(number=9):
    """Thin meshes, enough for a tree of emitters."""
    lamps = {}
    for index, (x, z) in enumerate(
        (x, z) for x in np.linspace(-0.8, 0.8, number) for z in np.linspace(-0.8, 0.8, number)
    ):
        placed = mi.ScalarTransform4f().translate([x, 0.9, z]).scale([0.07, 2e-5, 0.07])
        lamps[f"lamp{index}"] = {"type": "cube", "to_world": placed, "emitter": {"type": "area", "radiance": rgb(2.0)}}
    return lamps


def back_to_back():
    """Two lamps close together that shine up and down."""
    up = mi.ScalarTransform4f().translate([0, 0.8001, 0]).rotate([1, 0, 0], -90).scale(0.3)
    down = mi.ScalarTransform4f().translate([0, 0.8, 0]).rotate([1, 0, 0], 90).scale(0.3)
    return {
        name: {"type": "rectangle", "to_world": placed, "emitter": {"type": "area", "radiance": rgb(level)}}
        for name, placed, level in (("up", up, 8.0), ("down", down, 2.0))
    }


def open_cylinder():
    """A lamp whose inside is dark: lines to it may meet the inside or the outside first."""
    emission = {"type": "area", "radiance": rgb(4.0)}
    return {"type": "cylinder", "p0": [-0.4, 0.75, 0.3], "p1": [0.4, 0.75, 0], "radius": 0.2, "emitter": emission}


def bulb():
    lamp = {"type": "sphere", "center": [0, 0.3, 0], "radius": 0.1, "emitter": {"type": "area", "radiance": rgb(20.0)}}
    return {"lamp": lamp, "bulb": {"type": "sphere", "center": [0, 0.3, 0], "radius": 0.25, "bsdf": GLASS}}


def instanced():
    group = {"type": "shapegroup", "slab": pane(0.0), "post": wall([0.5, 0.2, 0], [0, 1, 0], 90, 0.1)}
    placed = mi.ScalarTransform4f().translate([0, 0.6, 0])
    return {"group": group, "one": {"type": "instance", "to_world": placed, "0": {"type": "ref", "id": "group"}}}


ROOMS = {
    "pane": lambda: closed_box({"light": area_light()}, 12, pane=pane()),
    "wedge": lambda: closed_box({"light": area_light()}, 12, pane=pane(0.4, 0.2, 20, 0.7), pane2=pane(0.7, 0.02)),
    "sky": lambda: under_the_sky(),
    "tiles": lambda: closed_box(tiles(), 12, pane=pane()),
    "textured": lambda: closed_box({"light": textured_light()}, 12, pane=pane()),
    "lens": lambda: closed_box(
        {"light": area_light(), "lens": {"type": "sphere", "center": [0, 0.3, 0], "radius": 0.4, "bsdf": GLASS}}, 12
    ),
    "bulb": lambda: closed_box(bulb(), 12, plastic=wall([0, -0.9, 0], [1, 0, 0], -90, 0.9, bsdf={"type": "plastic"})),
    "mask": lambda: closed_box(
        {"light": area_light()}, 12, pane=pane(0.5), mask=wall([0.3, 0.7, 0], [1, 0, 0], -90, 0.6, bsdf=MASK),
        low=wall([-0.3, 0.1, 0], [1, 0, 0], -90, 0.6, bsdf=MASK),
    ),
    "two lamps": lambda: closed_box(
        {"light": area_light(), "low": area_light(0.4) | {"bsdf": {"type": "diffuse"}}},
        12,
        pane=pane(),
        low_pane=pane(0.1),
        gloss={"type": "sphere", "center": [0, -0.6, -0.2], "radius": 0.35, "bsdf": {"type": "roughconductor"}},
    ),
    "thin lamp": lambda: closed_box({"light": thin_lamp()}, 12, pane=pane()),
    "thin lamps": lambda: closed_box(thin_lamps(), 12, pane=pane()),
    "back to back": lambda: closed_box(back_to_back(), 12, pane=pane(0.5)),
    "cylinder": lambda: closed_box({"light": open_cylinder()}, 12, pane=pane(0.3, 0.3, 10, 0.8)),
    "glowing glass": lambda: closed_box(
        {"light": area_light()},
        12,
        pane=pane(0.4) | {"emitter": {"type": "area", "radiance": rgb(0.5)}},
        low_pane=pane(0.1),
    ),
    "instance": lambda: closed_box({"light": area_light()} | instanced(), 12),
}  # fmt: skip


@pytest.fixture
def always_refracts(monkeypatch):
    """``manylights`` whose shadow rays pass glass wherever there is some, and without relays."""
    monkeypatch.setattr("vpl.split.chosen_pilot._LEFT", np.inf)
    with plugin_with_model(relayed_noise=0.0, glass_cost=0.0, relay_cost=1e9):
        yield


ALONE = {"virtual_lights": False, "max_depth": 5}
CASES = [
    ("pane", {}), ("sky", ALONE), ("tiles", {}), ("mask", ALONE), ("instance", ALONE), ("wedge", {}),
    ("thin lamp", ALONE), ("thin lamps", ALONE), ("back to back", ALONE), ("cylinder", ALONE), ("glowing glass", {}),
    *stress(
        ("pane", ALONE), ("sky", {}), ("tiles", ALONE), ("textured", {}), ("lens", {}),
        ("lens", ALONE), ("bulb", {}), ("mask", {}), ("two lamps", {}), ("two lamps", ALONE), ("instance", {}),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "more"), CASES)
def test_mean_is_that_of_path(name, more, always_refracts):
    scene = mi.load_dict(ROOMS[name]())
    passed = []

    def pair(seed):
        found, statistics = render_with_statistics("manylights", scene, 64, seed, **more)
        passed.append("glass" in statistics)
        return found, render(scene, "prb", 1024, seed + 100, max_depth=more.get("max_depth", -1))

    assert_same_mean(pair, 8, finds=0.03)
    assert np.mean(passed) > 0.5


def test_little_noise_of_a_sun_behind_a_pane():
    scene = mi.load_dict(under_the_sky(32))
    found = [render_with_statistics("manylights", scene, 64, seed) for seed in range(6)]
    assert all(statistics.get("glass") == "passed" for _, statistics in found)
    with plugin_with_model(relayed_noise=1e9):
        others = [render_with_statistics("manylights", scene, 64, seed) for seed in range(6)]
    assert not any("glass" in statistics for _, statistics in others)
    noise, before = (np.mean(np.var([image for image, _ in each], axis=0, ddof=1)) for each in (found, others))
    assert noise < 0.2 * before


def test_a_pane_dims_the_sky_by_its_transmittance(always_refracts):
    """Light from straight above passes two surfaces, each of which reflects 4%."""
    pixels = np.zeros((64, 128, 3), np.float32)
    pixels[:1] = 1000
    scene = {
        "type": "scene",
        "sensor": sensor(16, 4, fov=10)
        | {"to_world": mi.ScalarTransform4f().look_at([0, 0.5, 0], [0, 0, 0], [0, 0, 1])},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)},
        "floor": wall([0, 0, 0], [1, 0, 0], -90, 5.0, (0.5, 0.5, 0.5)),
    }

    def lit(**more):
        image, statistics = render_with_statistics("manylights", mi.load_dict(scene | more), 256, max_depth=4)
        return image.mean(), "glass" in statistics

    through, passed = lit(pane=pane(1.0, half=20.0))
    assert passed
    np.testing.assert_allclose(through / lit()[0], 0.96**2, rtol=0.01)


def test_seeds_repeat_images_and_leave_the_scene_as_it_was():
    scene = mi.load_dict(under_the_sky(32))
    before = list(mi.traverse(scene).keys())
    (first, statistics), (again, _), (other, _) = (
        render_with_statistics("manylights", scene, 64, seed) for seed in (1, 1, 2)
    )
    assert statistics["glass"] == "passed"
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert list(mi.traverse(scene).keys()) == before


def test_rooms_without_such_light_are_not_tried(monkeypatch):
    monkeypatch.setattr(UniformEmitters, "through_glass", lambda _: pytest.fail("tried glass"))
    below = closed_box({"light": area_light()}, 12, pane=pane(-0.95, 0.02, half=0.03))
    render(mi.load_dict(below), "manylights", 64)


def test_layers_sum_to_the_image_and_keep_their_means(always_refracts):
    scene = mi.load_dict(ROOMS["pane"]() | {"low": area_light(0.3)})

    def layers(seed, refracts, **constants):
        with plugin_with_model(**constants):
            image, found, statistics = layers_of(scene, 64, seed, layers=LENGTHS, light_groups="low=low")
        assert_sums(image, found)
        assert ("glass" in statistics) == refracts
        return np.concatenate([found["direct"], found["indirect"]], -1)

    def pair(seed):
        found = layers(seed, True, relayed_noise=0.0, glass_cost=0.0, relay_cost=1e9)
        return found, layers(seed + 1000, False, relayed_noise=1e9)

    assert_same_mean(pair, 12, finds=0.03)


def test_edits_of_a_scene_count(always_refracts):
    """A pane that is moved out of the room dims nothing any more."""
    scene = mi.load_dict(ROOMS["pane"]())

    def lit():
        return np.mean([render(scene, "manylights", 256, seed).mean() for seed in range(4)])

    before, parameters = lit(), mi.traverse(scene)
    parameters["pane.vertex_positions"] = dr.ravel(
        dr.unravel(mi.Point3f, parameters["pane.vertex_positions"]) + mi.Vector3f(0, 5, 0)
    )
    parameters.update()
    bare = mi.load_dict(closed_box({"light": area_light()}, 12))
    expected = np.mean([render(bare, "manylights", 256, seed).mean() for seed in range(4)])
    np.testing.assert_allclose(lit(), expected, rtol=0.02)
    assert abs(before - expected) > 0.02 * expected
