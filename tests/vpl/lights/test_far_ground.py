"""A room on a much larger ground plane: lights and their clamping distance suit the room."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import lamp_behind_the_camera
from tests.support.scenes import closed_box, rgb, wall
from tests.support.statistics import assert_same_mean
from vpl.core.arrays import download
from vpl.core.sampling import independent_sampler
from vpl.lights.emission import ParallelRays, bounding_sphere
from vpl.lights.emitters import read_emitters
from vpl.lights.focus import Focus, spacing
from vpl.lights.tracing import LightPathSettings, trace_lights

LIGHTS = {
    "lamp": lamp_behind_the_camera,
    "sun": lambda: {"sun": {"type": "directional", "direction": [0.8, -0.6, 0.1], "irradiance": rgb(3.0)}},
    "envmap": lambda: EMITTERS["envmap"](),
}


def room_on_a_plane(light, size):
    """A room that is open on one side, on a square plane of half-size ``size``."""
    box = closed_box(LIGHTS[light](), 16)
    del box["left"]
    # Mitsuba 3.9.1 omits rectangles from the scene's box, which limits its shadow rays: use a cube
    flat = mi.ScalarTransform4f().translate([0, -1.02, 0]).scale([size, 0.01, size])
    box["ground"] = {"type": "cube", "to_world": flat, "bsdf": {"type": "diffuse"}}
    return mi.load_dict(box)


@pytest.mark.parametrize(
    ("light", "size"),
    [("lamp", 1e4), ("sun", 1e2), *stress(("envmap", 1e4), ("lamp", 1e2), ("sun", 1e4), ("envmap", 1e2))],
)
def test_a_far_ground_takes_no_light_from_a_room(light, size):
    scene = room_on_a_plane(light, size)
    more = {"max_depth": 5}

    def pair(seed):
        found = render(scene, "lightcuts", 4, seed, clamping=0.0, vpl_count=10_000, **more)
        return found, render(scene, "path", 256, 1000 + seed, **more)

    # Some lights far out on the plane stand for much: from infinity, light has tails that no t test of few seeds bears
    certain = light == "lamp" or size < 1e3
    expected = np.mean([render(scene, "path", 256, 2000 + seed, **more) for seed in range(4)])
    if certain:
        assert_same_mean(pair, 8, 0.02)
    else:
        assert np.mean([pair(seed)[0] for seed in range(8)]) == pytest.approx(expected, rel=0.2)
    clamped = np.mean([render(scene, "lightcuts", 4, seed, vpl_count=10_000, **more) for seed in range(4)])
    assert clamped == pytest.approx(expected, rel=0.05 if certain else 0.2)


@pytest.mark.parametrize("name", ["vpl", "illuminationcut", *stress("mdlightcuts", "lightslice", "matrixrecovery")])
def test_in_all_plugins_with_lights(name):
    scene = room_on_a_plane("lamp", 1e4)
    images = [render(scene, name, 8, seed, max_depth=3, vpl_count=2000) for seed in range(3)]
    expected = [render(scene, "path", 256, 1000 + seed, max_depth=3) for seed in range(3)]
    assert np.mean(images) == pytest.approx(np.mean(expected), rel=0.05)


@pytest.mark.parametrize("count", [500, 20_000])
def test_lights_are_clamped_by_their_distance_from_each_other(count):
    """The spacing ignores distant surroundings, and equals the spacing of a square grid of equal density."""
    rng = np.random.default_rng(0)
    lights = rng.uniform([-1, 0, -1], [1, 0, 1], (count, 3))
    places = rng.uniform([-0.8, 0, -0.8], [0.8, 0, 0.8], (1000, 3))
    found = spacing(lights, places)
    assert found == pytest.approx(2 / np.sqrt(count), rel=0.3)
    beyond = np.concatenate([lights, rng.uniform([-1e4, 0, -1e4], [1e4, 0, 1e4], (count, 3))])
    assert spacing(beyond, places) == pytest.approx(found, rel=0.1)
    assert spacing(1e3 * lights, 1e3 * places) == pytest.approx(1e3 * found)


def test_the_spacing_of_few_or_no_lights():
    assert spacing(np.zeros((0, 3)), np.zeros((5, 3))) == spacing(np.zeros((5, 3)), np.zeros((0, 3))) == 0
    assert spacing(np.zeros((5, 3)), np.zeros((5, 3))) == 0
    assert spacing(np.array([[0.0, 0, 0]]), np.array([[2.0, 0, 0]])) == pytest.approx(2 * np.sqrt(np.pi))


def focus_on_a_small_part():
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 100}})
    places = np.random.default_rng(0).normal(0, 0.5, (1000, 3)) + [30, 40, 0]
    return Focus.of(places, bounding_sphere(scene)), bounding_sphere(scene)


def test_rays_around_a_focus_stand_for_their_area():
    """The weights add up to the area of the crossed region, near or far."""
    focus, sphere = focus_on_a_small_part()
    np.testing.assert_allclose(focus.center, [30, 40, 0], atol=0.1)
    assert 1 < focus.radius < 3
    count = 1 << 20
    direction = mi.Vector3f(0, 0, 1)
    ray, area = ParallelRays(sphere, focus).through(direction, independent_sampler(0, count).next_2d())
    place, area = download(ray.o), np.broadcast_to(download(area), count) / count
    assert place[:, 2].max() < -100
    for center, radius in (((30, 40), 0.5 * focus.radius), ((30, 40), 10), ((0, 0), 100), ((-50, 0), 20)):
        inside = np.linalg.norm(place[:, :2] - center, axis=1) < radius
        assert area[inside].sum() == pytest.approx(np.pi * radius**2, rel=0.03)


@pytest.mark.parametrize("places", [np.zeros((0, 3)), np.zeros((4, 3)), [[-9, 0, 0], [9, 0, 0], [0, 9, 0]]])
def test_no_focus_where_nothing_or_nearly_all_is_seen(places):
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 10}})
    assert Focus.of(np.array(places), bounding_sphere(scene)) is None


@pytest.mark.parametrize("wide", [False, True])
def test_a_warning_names_how_few_lights_matter(wide, monkeypatch):
    """The warning appears under a lamp of the size of the plane, not under a lamp in the room."""
    logged = []
    monkeypatch.setattr(mi, "Log", lambda level, text: logged.append(text))
    lamp = {"lamp": {"type": "point", "position": [0, 0.5, 0], "intensity": rgb(1.0)}}
    if wide:
        lamp["lamp"] = wall([0, 50, 0], [1, 0, 0], 90, 1e4) | {"emitter": {"type": "area", "radiance": rgb(1.0)}}
    scene = mi.load_dict({"type": "scene", "ground": wall([0, -1, 0], [1, 0, 0], -90, 1e4), **lamp})
    focus = Focus.of(np.random.default_rng(0).uniform(-1, 1, (100, 3)), bounding_sphere(scene))
    found = trace_lights(scene, read_emitters(scene), 20_000, 0, LightPathSettings(3, 5, 1.0), focus).lights
    assert bool(logged) == wide
    if wide:
        assert f"of {found.count} virtual lights are effective" in logged[0] and "vpl_count" in logged[0]
