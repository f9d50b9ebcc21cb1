"""Lamps in glass and before mirrors: paths of ``manylights`` go to the glass, and the mean stays that of ``path``."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.scenes import area_light, closed_box, rgb, wall
from tests.support.statistics import assert_same_mean
from vpl.split import chosen_pilot

CLEAR, FROSTED = {"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.3}
PLACES = ([0.45, 0.5, -0.1], [-0.5, 0.3, -0.4])


def ball(center, radius, **more):
    return {"type": "sphere", "center": center, "radius": radius, **more}


def lamp(center, radius, radiance=20.0):
    emission = {"type": "area", "radiance": rgb(radiance, 0.8 * radiance, 0.6 * radiance)}
    return ball(center, radius, emitter=emission)


def globes(glass, radius=0.1, share=0.5):
    """Lamps in balls of glass; ``share``: of the radius."""
    return {
        f"{kind}{number}": made
        for number, place in enumerate(PLACES)
        for kind, made in (("lamp", lamp(place, share * radius)), ("globe", ball(place, radius, bsdf=glass)))
    }


def behind_a_shade(mirror):
    """A lamp that a plate hides from most of the room, and a mirror on the wall behind."""
    plate = wall([0, 0.0, -0.45], [0, 1, 0], 0, 0.3, bsdf={"type": "twosided", "nested": {"type": "diffuse"}})
    return {
        "lamp": lamp([0, 0, -0.7], 0.2),
        "plate": plate,
        "mirror": wall([0, 0, -0.98], [0, 1, 0], 0, 0.5, bsdf=mirror),
    }


ROOMS = {
    "clear": lambda: closed_box(globes(CLEAR, 0.2, 0.7), 12),
    "frosted": lambda: closed_box(globes(FROSTED, 0.2, 0.7), 12),
    "mirror": lambda: closed_box(behind_a_shade({"type": "conductor"}), 12),
    "with a lamp": lambda: closed_box(
        globes(CLEAR, 0.2, 0.7) | {"light": area_light()},
        12,
        plastic=ball([0, -0.6, -0.2], 0.35, bsdf={"type": "plastic"}),
    ),
    "glossy": lambda: closed_box(
        globes(FROSTED, 0.2, 0.7),
        12,
        knob=ball([0, -0.6, -0.2], 0.35, bsdf={"type": "roughconductor", "alpha": 0.2}),
        plastic=ball([0.6, -0.7, 0.1], 0.25, bsdf={"type": "plastic"}),
    ),
    "blend": lambda: closed_box(
        globes(CLEAR, 0.2, 0.7),
        12,
        blend=ball(
            [0, -0.6, -0.2],
            0.4,
            bsdf={"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "conductor"}},
        ),
    ),
    "masks": lambda: closed_box(
        globes(CLEAR, 0.2, 0.7),
        12,
        mask=wall([0, 0.1, 0], [1, 0, 0], -90, 0.9, bsdf={"type": "mask", "opacity": 0.4, "n": {"type": "diffuse"}}),
    ),
}


@pytest.fixture
def always_relays(monkeypatch):
    """``manylights`` that takes relays wherever there are some."""
    monkeypatch.setattr("vpl.split.relays_found._LEAST_PART", 0.0)
    monkeypatch.setattr("vpl.split.relays_found._MOST_REACH", 10.0)
    with plugin_with_model(relayed_noise=0.0, relay_cost=0.0):
        yield


@pytest.mark.parametrize("name", ["frosted", "with a lamp", "masks", *stress("blend", "clear", "mirror", "glossy")])
def test_mean_is_that_of_path(name, always_relays):
    scene = mi.load_dict(ROOMS[name]())
    with_relays = []

    def pair(seed):
        found, statistics = render_with_statistics("manylights", scene, 64, seed)
        with_relays.append("relays" in statistics)
        return found, render(scene, "prb", 1024, seed, max_depth=-1)

    assert_same_mean(pair, 8, finds=0.03)
    # The pilots of some seeds may meet too little light by way of mirrors
    assert np.mean(with_relays) > 0.5


@pytest.mark.parametrize("glass", [CLEAR, FROSTED], ids=["clear", "frosted"])
def test_lamps_in_glass_make_little_noise(glass):
    scene = mi.load_dict(closed_box(globes(glass), 24))
    found = [render_with_statistics("manylights", scene, 64, seed) for seed in range(6)]
    assert all(int(statistics.get("relays", 0)) >= 1 for _, statistics in found)
    with plugin_with_model(relayed_noise=1e9):
        others = [render(scene, "manylights", 64, seed) for seed in range(6)]
    noise, before = (np.median(np.var(images, axis=0, ddof=1)) for images in ([image for image, _ in found], others))
    assert noise < 0.5 * before


def test_seeds_repeat_images():
    scene = mi.load_dict(closed_box(globes(CLEAR), 24))
    (first, statistics), (again, _), (other, _) = (
        render_with_statistics("manylights", scene, 64, seed) for seed in (1, 1, 2)
    )
    assert int(statistics.get("relays", 0)) >= 1
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_other_scenes_look_for_no_relays(monkeypatch):
    """Neither without glass, nor where little of the noise comes by way of glass."""
    monkeypatch.setattr(chosen_pilot, "find_relays", lambda *_: pytest.fail("looked for relays"))
    render(mi.load_dict(closed_box(area_light_and(None), 12)), "manylights", 16)
    render(mi.load_dict(closed_box(area_light_and(ball([0.5, -0.6, 0], 0.2, bsdf=CLEAR)), 12)), "manylights", 16)


def area_light_and(glass):
    return {"light": area_light()} | ({"glass": glass} if glass else {})


def test_layers_sum_to_the_image():
    scene = mi.load_dict(closed_box(globes(FROSTED), 24))
    image, statistics = render_with_statistics("manylights", scene, 64, 3, layers="emission,direct,indirect")
    assert int(statistics.get("relays", 0)) >= 1
    layers = image[..., 3:].reshape(*image.shape[:2], 3, 3).sum(2)
    assert np.allclose(layers, image[..., :3], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("max_depth, lights", [(4, {}), (6, {"pays_below": 1e30, "fewest_light_paths": 4000})])
def test_mean_with_few_edges_and_with_virtual_lights(max_depth, lights, always_relays):
    scene = mi.load_dict(ROOMS["with a lamp"]())

    def pair(seed):
        with plugin_with_model(relayed_noise=0.0, relay_cost=0.0, **lights):
            found, statistics = render_with_statistics("manylights", scene, 64, seed, max_depth=max_depth)
        assert "relays" in statistics and ("lights" in statistics or not lights)
        return found, render(scene, "prb", 1024, seed, max_depth=max_depth)

    assert_same_mean(pair, 6, finds=0.03)
