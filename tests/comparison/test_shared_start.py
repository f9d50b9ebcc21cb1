"""Passes of a render by `manylights` share the pilot of the first pass."""

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison.checkpoint import Checkpoint
from comparison.rendering import Passes, Progressive
from comparison.single_pass import SharedStart, render_pass
from tests.support.rendering import plugin_with_model, render
from tests.support.scenes import area_light, closed_box
from tests.support.statistics import assert_same_mean

FIRST = 4, 7  # samples per pixel, seed


@pytest.fixture(autouse=True)
def lights():
    """Let virtual lights pay in small images."""
    with plugin_with_model(pays_below=1e30, fewest_light_paths=2000):
        yield


def plugin():
    return mi.load_dict({"type": "manylights", "max_depth": 4})


def scene(size=16):
    return mi.load_dict(closed_box({"lamp": area_light(), "sky": {"type": "constant"}}, size))


def test_a_render_has_a_single_pilot_and_lights_for_each_pass():
    _, took = manylights.render(scene(), plugin(), spp=24, pass_spp=8)
    assert took.passes == 3 and took.statistics["pilots"] == 1
    assert took.statistics["light_paths"] == 3 * 2000


@pytest.mark.parametrize(("rays", "size"), [(0, 256), (8192, 512), (10**6, 1024)])
def test_long_renders_have_larger_pilots(rays, size):
    shared = SharedStart(rays=rays)
    # A pilot has at most the rays of the first pass
    render_pass(scene(), 0, plugin(), *FIRST, shared=shared)
    assert len(shared.start.pilot.radiance) == size


@pytest.mark.parametrize(
    ("limits", "rays", "learning"),
    [
        ({}, 0, 0), ({"spp": 8}, 0, 0), ({"seconds": 2.0}, 200_000, 1_200_000),
        ({"seconds": 2.0, "spp": 8}, 8 * 16 * 16, 8 * 16 * 16),
    ],
)  # fmt: skip
def test_limits_of_a_render_determine_the_rays_of_the_start(limits, rays, learning):
    progressive = Progressive(scene(), 0, integrator=plugin(), **limits)
    for _ in range(2):
        assert (progressive._shared.rays, progressive._shared.learning) == (rays, learning)
        progressive.restart()


@pytest.mark.parametrize(("learning", "size"), [(0, 16 * 16 * 16), (10**5, 10**5)])
def test_long_renders_learn_emitters_for_all_of_their_rays(learning, size):
    """Their pilots do not grow with these rays."""
    shared = SharedStart(learning=learning)
    render_pass(scene(), 0, plugin(), *FIRST, shared=shared)
    assert shared.start.paths == size
    assert len(shared.start.pilot.radiance) == 256


@pytest.mark.parametrize(("with_checkpoint", "rays"), [(False, 8 * 16 * 16), (True, 0)])
def test_the_start_of_a_checkpoint_does_not_depend_on_the_limit_of_time(with_checkpoint, rays, tmp_path, monkeypatch):
    made, usual = [], Progressive.restart

    def restart(self):
        usual(self)
        made.append(self._shared.rays)

    monkeypatch.setattr(Progressive, "restart", restart)
    checkpoint = Checkpoint(tmp_path / "a.checkpoint", {}) if with_checkpoint else None
    manylights.render(scene(), plugin(), spp=8, time=60, checkpoint=checkpoint)
    assert set(made) == {rays}


def test_passes_are_weighted_by_their_expected_precision():
    box, shared, images = scene(), SharedStart(), []
    passes = Passes(0)
    # Only the larger pass has lights
    with plugin_with_model(fewest_light_paths=500, fixed_cost=2e3, ray_cost=0.02, pays_below=4.0):
        integrator = plugin()
        for spp, seed in (FIRST, (256, 8)):
            images.append(render_pass(box, 0, integrator, spp, seed, FIRST, shared))
            passes.add(images[-1])
    few, many = (image.taken for image in images)
    assert not few.has_lights and many.has_lights
    # A sample beside lights has less variance
    assert many.weight / many.spp > few.weight / few.spp > 0
    weights = [few.weight, many.weight]
    expected = np.average([image.planes for image in images], axis=0, weights=weights)
    np.testing.assert_allclose(passes.image, expected, rtol=1e-6)


def test_passes_of_other_integrators_are_weighted_by_their_samples():
    image = render_pass(scene(), 0, mi.load_dict({"type": "path", "max_depth": 2}), 8, 0)
    assert image.taken.weight == image.taken.spp == 8 and image.taken.start_seconds is None


def test_a_black_image_has_a_weight():
    dark = mi.load_dict(closed_box({}, 8))
    image = render_pass(dark, 0, plugin(), 4, 0)
    assert image.taken.weight == image.taken.statistics["precision"] == 4 and not image.planes[..., :3].any()


def test_a_second_render_has_a_pilot_of_its_own():
    integrator, box = plugin(), scene()
    for _ in range(2):
        _, took = manylights.render(box, integrator, spp=16, pass_spp=8)
        assert took.statistics["pilots"] == 1
    mi.render(box, integrator=integrator, spp=4)
    assert integrator.statistics["pilots"] == 1


def test_a_pass_is_the_same_wherever_the_first_pass_was_rendered():
    """As on a worker that has rendered neither the first pass nor others; large passes learn emitters once more."""
    box, here, shared = scene(24), plugin(), SharedStart()
    first = render_pass(box, 0, here, *FIRST, FIRST, shared)
    assert first.taken.statistics["pilots"] == 1
    render_pass(box, 0, here, 1024, 9, FIRST, shared)
    for spp, later in ((16, [3]), (128, [2, 3])):
        expected = render_pass(box, 0, here, spp, 8, FIRST, shared)
        assert shared.start.learned and sorted(shared.start.later) == later
        assert expected.taken.statistics["pilots"] == 0
        found = render_pass(box, 0, plugin(), spp, 8, FIRST)
        np.testing.assert_allclose(found.planes, expected.planes, rtol=1e-4, atol=1e-5)
        alone = render_pass(box, 0, plugin(), spp, 8)
        assert np.abs(alone.planes - expected.planes).max() > 1e-3


def test_a_later_pass_has_the_mean_of_path():
    box = scene()

    def pair(seed):
        found = render_pass(box, 0, plugin(), 256, 1000 + seed, (4, seed))
        return found.planes[..., :3].astype(np.float64), render(box, "path", 256, 1000 + seed, max_depth=4)

    assert_same_mean(pair, 8)


def test_a_missing_start_is_an_error():
    integrator = plugin()
    with integrator.pass_of(SharedStart(), False) as is_missing, pytest.raises(RuntimeError) as error:
        assert is_missing
        mi.render(scene(8), integrator=integrator, spp=4)
    causes, cause = [], error.value
    while cause is not None:
        causes.append(str(cause))
        cause = cause.__cause__
    assert any("start of the first pass is missing" in text for text in causes)


def test_a_part_of_the_image_without_vertices_keeps_the_counters_of_the_others():
    """The image has two parts, and the lower one sees nothing."""
    description = closed_box({"lamp": area_light()}, 512)
    for name in ("floor", "left", "right", "front", "back"):
        del description[name]
    description["ball"] = {"type": "sphere", "center": [0, 0.7, -0.3], "radius": 0.2}
    description["sensor"]["film"]["height"] = 1024
    integrator = plugin()
    mi.render(mi.load_dict(description), integrator=integrator, spp=1)
    assert integrator.statistics["gather_points"] > 0
