"""Plain paths, those of large images without virtual lights: the paths of other images, in a smaller kernel."""

import itertools
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import plugin_with_model, render
from tests.support.rooms import many_kinds, sunny, veiled_room
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import assert_same_mean
from vpl.split import estimator, path_tracer
from vpl.split.emitters import emitter_sampler
from vpl.split.emitters.tree_emitters import TreeEmitters
from vpl.split.emitters.uniform import UniformEmitters

# Plain paths in images of any size, at the usual cost, and in none
PLAIN, RECORDING = {"plain_per_material": 0, "plain_cost": 1.0}, {"plain_per_material": 1e30}


def below(sky):
    """Two walls below a sky."""
    return {"type": "scene", "sensor": sensor(16), "floor": wall([0, -1, 0], [1, 0, 0], -90), **sky,
            "back": wall([0, 0, -1], [0, 1, 0], 0)}  # fmt: skip


def with_alpha(description):
    description["sensor"]["film"] |= {"pixel_format": "rgba", "width": 16, "height": 16}
    return description


SCENES = {
    "an emitter": lambda: closed_box({"lamp": area_light()}),
    "gloss and some emitters": many_kinds,
    "masks": veiled_room,
    "constant sky": lambda: below({"sky": {"type": "constant"}}),
    "black sky": lambda: below({"sky": {"type": "constant", "radiance": 0.0}, "bulb": {"type": "point"}}),
    "sun": lambda: below(sunny()),
}


def rendered(scene, constants, most=1, seed=3, spp=16, **parameters):
    """An image without virtual lights, with up to ``most`` emitter samples at a vertex, and its statistics."""
    with plugin_with_model(most_emitter_samples=most, **constants):
        plugin = mi.load_dict({"type": "manylights", "virtual_lights": False, **parameters})
        return render(scene, plugin, spp=spp, seed=seed), plugin.statistics


def traced_settings(scene, constants, **given):
    """The image, its statistics, and the settings of its paths, the same for all of its parts."""
    settings, real = [], estimator.trace_camera_rays

    def spy(view, lane, these, *stream, **more):
        settings.append(these)
        return real(view, lane, these, *stream, **more)

    with mock.patch.object(estimator, "trace_camera_rays", spy):
        pixels, statistics = rendered(scene, constants, **given)
    assert len({(one.plain, one.several) for one in settings}) == 1
    return pixels, statistics, settings[0]


def assert_same_paths(scene, **given):
    """Plain and other paths are the same, but for paths that rounding lets miss an edge."""
    # Contributions are drawn by other numbers, so that plain paths, which draw none, have the numbers of other paths
    with mock.patch.object(path_tracer, "_draw", lambda sampler, settings: mi.Float(0.5)):
        (plain, one, few), (other, _, many) = (traced_settings(scene, x, **given) for x in (PLAIN, RECORDING))
    assert few.plain and one["plain"] and not many.plain and one["dropped"] == 0
    assert few.several == (float(one["emitter_samples"]) > 1)
    assert plain.shape == other.shape and other[..., :3].mean() > 0
    equal = np.isclose(plain, other, rtol=1e-3, atol=1e-5 * np.abs(other).max()).all(-1)
    assert equal.mean() > 0.97 and np.allclose(plain.mean((0, 1)), other.mean((0, 1)), rtol=0.01)
    return one


SCENES_AND_SAMPLES = list(itertools.product(SCENES, [1, 4]))
SLOW = list(itertools.product(["constant sky", "black sky", "sun"], [4]))


@pytest.mark.parametrize(("scene", "most"), [*(one for one in SCENES_AND_SAMPLES if one not in SLOW), *stress(*SLOW)])
def test_plain_paths_are_the_paths_of_other_images(scene, most):
    statistics = assert_same_paths(mi.load_dict(with_alpha(SCENES[scene]())), most=most)
    if most == 1:
        assert statistics["emitter_samples"] == "1"
    elif scene == "gloss and some emitters":
        assert float(statistics["emitter_samples"]) > 1.5


@pytest.mark.parametrize("hide_emitters", [True, *stress(False)])
def test_hidden_emitters_layers_and_groups(hide_emitters):
    lamp = {"type": "sphere", "radius": 0.3, "emitter": {"type": "area", "radiance": 2.0}}
    scene = mi.load_dict(closed_box({"lamp": lamp, "bulb": {"type": "point", "position": [0, 0.8, 0]}}, 16))
    layers = {"layers": "emission, direct, indirect", "light_groups": "lamps=AreaLight"}
    assert_same_paths(scene, hide_emitters=hide_emitters, **layers)
    sky = mi.load_dict(with_alpha(below({"sky": {"type": "constant"}})))
    assert_same_paths(sky, hide_emitters=hide_emitters, light_groups="sky=ConstantBackgroundEmitter")


def test_plain_paths_by_a_tree_of_emitters():
    """There, plain paths take other random numbers than paths of which virtual lights may carry a part."""
    bulbs = {f"bulb{k}": {"type": "point", "position": [0.1 * (k % 9) - 0.4, 0.2, 0.1 * (k // 9) - 0.4],
                          "intensity": 0.01 * (1 + k % 5)} for k in range(81)}  # fmt: skip
    scene = mi.load_dict(closed_box(bulbs, 16))
    assert isinstance(emitter_sampler(scene, 1000), TreeEmitters)

    def pair(seed):
        (plain, statistics), (other, _) = (rendered(scene, x, seed=seed, spp=64) for x in (PLAIN, RECORDING))
        assert statistics["plain"]
        return plain, other

    assert_same_mean(pair, 8, 0.03)


@pytest.mark.parametrize("scene", [SCENES["masks"], SCENES["sun"]], ids=["masks", "sun"])
def test_the_image_is_that_of_path(scene):
    scene = mi.load_dict(scene())

    def pair(seed):
        plain, statistics = rendered(scene, PLAIN, most=4, seed=seed, spp=64, max_depth=6)
        assert statistics["plain"]
        return plain, render(scene, mi.load_dict({"type": "prb", "max_depth": 6}), spp=64, seed=seed)

    assert_same_mean(pair, 8, 0.06)


def test_paths_are_plain_from_a_number_of_rays_for_each_material():
    """The image has 16 × 16 pixels, and the box four materials: its walls differ in colour alone."""
    scene = mi.load_dict(closed_box({"lamp": area_light()}, 16))
    materials = len(emitter_sampler(scene, 1000).traits.materials.bsdfs)
    assert materials == 4
    for rays, plain in ((16 * 16 * 16 / materials, True), (16 * 16 * 16 / materials + 1, False)):
        assert rendered(scene, {"plain_per_material": rays})[1]["plain"] == plain
    assert not rendered(scene, {})[1]["plain"]


def operations(plugin, scene):
    """Number of operations of the longest kernel of the paths of an image."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        render(scene, plugin, spp=16)
        kernels = [one for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT]
    return max(one["operation_count"] for one in kernels if one["size"] == 32 * 32 * 16)


def test_kernels_of_plain_paths_are_smaller_most_of_all_with_single_samples():
    """Enough emitters for several samples."""
    scene, counts = mi.load_dict(many_kinds()), []
    for constants, most in ((PLAIN, 1), (PLAIN, 4), (RECORDING, 4)):
        with plugin_with_model(most_emitter_samples=most, **constants):
            counts.append(operations(mi.load_dict({"type": "manylights", "virtual_lights": False}), scene))
    assert counts[0] < counts[1] < 0.9 * counts[2]


def test_a_black_sky_alone():
    """Mitsuba's density of its directions is NaN."""
    black = mi.Bitmap(np.zeros((4, 8, 3), np.float32))
    scene = mi.load_dict(below({"sky": {"type": "envmap", "bitmap": black}}))
    pixels, statistics, settings = traced_settings(scene, PLAIN)
    assert settings.plain and statistics["dropped"] == 0 and not pixels.any()


def test_the_simplest_sampler_is_that_of_mitsuba_if_nothing_was_learned_about_a_single_emitter():
    sky, rng = mi.load_dict(below(sunny())), np.random.default_rng(0)
    emitters = emitter_sampler(sky, 1000)
    assert isinstance(emitters.simplest(), UniformEmitters) and emitters.simplest().traits is emitters.traits
    position = np.stack([rng.uniform(-1, 1, 100), np.full(100, -1.0), rng.uniform(-1, 1, 100)], 1)
    assert emitters.learn(position, np.tile([0.0, 1.0, 0.0], (100, 1)), 10_000, 0)
    assert emitters.simplest() is emitters
    emitters.forget()
    assert isinstance(emitters.simplest(), UniformEmitters)
    two = mi.load_dict(closed_box({"one": {"type": "point"}, "two": {"type": "point", "position": [0, 0.5, 0]}}))
    emitters = emitter_sampler(two, 1000)
    assert emitters.simplest() is emitters
