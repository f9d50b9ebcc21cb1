"""Plain paths, those of large images without virtual lights: the paths of other images, in a smaller kernel."""

from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.rendering import plugin_with_model, render
from tests.support.rooms import glossy_room, sunny, veiled_room
from tests.support.scenes import closed_box, cornell, sensor, wall
from vpl.split import path_tracer
from vpl.split.emitters import emitter_sampler
from vpl.split.emitters.uniform import UniformEmitters

# Plain paths in images of any size, and in none
PLAIN, RECORDING = {"plain_from": 0}, {"plain_from": 1 << 40}


def open_room():
    """Two walls below a sky with a sun."""
    return {"type": "scene", "sensor": sensor(16), "floor": wall([0, -1, 0], [1, 0, 0], -90), **sunny(),
            "back": wall([0, 0, -1], [0, 1, 0], 0)}  # fmt: skip


SCENES = {
    "cornell": lambda: cornell(16).load(),
    "gloss and many emitters": glossy_room,
    "masks": lambda: mi.load_dict(veiled_room()),
    "sky": lambda: mi.load_dict(open_room()),
}


def rendered(scene, constants, most=1, **parameters):
    """An image without virtual lights, with up to ``most`` emitter samples at a vertex, and the numbers of operations
    of its kernels."""
    with plugin_with_model(most_emitter_samples=most, **constants), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        plugin = mi.load_dict({"type": "manylights", "virtual_lights": False, **parameters})
        dr.kernel_history_clear()
        pixels = render(scene, plugin, spp=16, seed=3)
        kernels = {one["operation_count"] for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT}
    return pixels, kernels


def assert_same_paths(scene, **given):
    """Plain and other paths are the same, but for paths that rounding lets miss an edge."""
    # Contributions are drawn by other numbers, so that plain paths, which draw none, have the numbers of other paths
    with mock.patch.object(path_tracer, "_draw", lambda sampler, settings: mi.Float(0.5)):
        (plain, few), (other, many) = (rendered(scene, constants, **given) for constants in (PLAIN, RECORDING))
    assert plain.shape == other.shape and other[..., :3].mean() > 0
    differs = ~np.isclose(plain, other, rtol=1e-3, atol=1e-5 * np.abs(other).max()).all(-1)
    assert differs.mean() < 0.03
    # The pilots of both have the same kernel, the images have not
    assert max(few - many) < max(many)


@pytest.mark.parametrize("most", [1, 4])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_plain_paths_are_the_paths_of_other_images(scene, most):
    assert_same_paths(scene(), most=most)


def test_hidden_emitters_and_layers():
    lamp = {"type": "sphere", "radius": 0.3, "emitter": {"type": "area", "radiance": 2.0}}
    scene = mi.load_dict(closed_box({"lamp": lamp, "bulb": {"type": "point", "position": [0, 0.8, 0]}}, 16))
    assert_same_paths(scene, hide_emitters=True, layers="emission, direct, indirect", light_groups="lamps=AreaLight")


def test_small_images_have_the_kernel_of_the_pilot():
    scene = cornell(16).load()
    assert rendered(scene, {})[1] == rendered(scene, RECORDING)[1] != rendered(scene, PLAIN)[1]


def test_the_simplest_sampler_is_that_of_mitsuba_if_nothing_was_learned_about_a_single_emitter():
    sky, rng = mi.load_dict(open_room()), np.random.default_rng(0)
    emitters = emitter_sampler(sky, 1000)
    assert isinstance(emitters.simplest(), UniformEmitters)
    position = np.stack([rng.uniform(-1, 1, 100), np.full(100, -1.0), rng.uniform(-1, 1, 100)], 1)
    assert emitters.learn(position, np.tile([0.0, 1.0, 0.0], (100, 1)), 10_000, 0)
    assert emitters.simplest() is emitters
    emitters.forget()
    assert isinstance(emitters.simplest(), UniformEmitters)
    two = mi.load_dict(closed_box({"one": {"type": "point"}, "two": {"type": "point", "position": [0, 0.5, 0]}}))
    emitters = emitter_sampler(two, 1000)
    assert emitters.simplest() is emitters
