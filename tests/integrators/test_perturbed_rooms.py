"""Rooms with bump and normal maps: virtual lights carry the light of surfaces, and the mean stays that of ``path``."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.rooms import smooth_octahedron
from tests.support.scenes import area_light, closed_box, image, rgb, wall
from tests.support.statistics import assert_same_mean

GREY = {"type": "diffuse", "reflectance": rgb(0.7, 0.6, 0.5)}


def relief():
    """Heights (32, 32): random, and smooth over a few texels."""
    heights = np.kron(np.random.default_rng(0).random((8, 8)), np.ones((4, 4)))
    for axis in (0, 1):
        heights = (heights + np.roll(heights, 1, axis) + np.roll(heights, -1, axis)) / 3
    return heights


def normalmap(nested, strength=2.0, **more):
    """Normals some 20 degrees from those of the surface."""
    heights = strength * relief()
    slopes = [np.roll(heights, 1, axis) - np.roll(heights, -1, axis) for axis in (1, 0)]
    normals = np.stack([*slopes, np.ones_like(heights)], -1)
    colours = 0.5 + 0.5 * normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return {"type": "normalmap", "normalmap": image(colours), "nested": nested, **more}


def two_sided(nested):
    return {"type": "twosided", "nested": nested}


MATERIALS = {
    "diffuse": lambda: two_sided(normalmap(GREY)),
    "rough plastic": lambda: two_sided(normalmap({"type": "roughplastic", "alpha": 0.2})),
    "steep": lambda: two_sided(normalmap(GREY, 8.0)),
    "never turned round": lambda: two_sided(
        normalmap(GREY, 4.0, flip_invalid_normals=False, use_shadowing_function=False)
    ),
    "bumps": lambda: two_sided({"type": "bumpmap", "bump": image(relief()[..., None]), "scale": 0.3, "nested": GREY}),
    "principled": lambda: normalmap({"type": "principled", "roughness": 0.5, "specular": 0.5}),
    "of several textures": lambda: two_sided(
        normalmap({"type": "blendbsdf", "weight": 0.5, "a": GREY, "b": {"type": "diffuse", "reflectance": rgb(0.0)}})
    ),
    "mask": lambda: {"type": "mask", "opacity": 0.7, "nested": two_sided(normalmap(GREY))},
}


def room(material, size=16):
    """The closed box with a floor, a back wall, a cushion and a thin shelf of the material: light of one side of the
    shelf is above the perturbed normals of the other, and the cushion has three normals everywhere."""
    surfaces = {
        "floor": wall([0, -1, 0], [1, 0, 0], -90, bsdf=material),
        "back": wall([0, 0, -1], [0, 1, 0], 0, bsdf=material),
        "shelf": wall([0, -0.1, 0], [1, 0, 0], -90, 0.7, bsdf=material),
        "cushion": smooth_octahedron(mi.load_dict(material), [0.3, -0.6, -0.2]),
    }
    return mi.load_dict(closed_box({"light": area_light()}, size) | surfaces)


@pytest.mark.parametrize("name", ["diffuse", "rough plastic", *stress(*list(MATERIALS)[2:])])
def test_mean_is_that_of_path(name, lights_cost_nothing):
    scene = room(MATERIALS[name]())

    def pair(seed):
        found, statistics = render_with_statistics("manylights", scene, 64, seed)
        assert "lights" in statistics
        return found, render(scene, "prb", 512, seed, max_depth=-1)

    assert_same_mean(pair, 8, finds=0.02)


def test_virtual_lights_carry_the_light_of_surfaces_with_maps(lights_cost_nothing):
    scene = room(MATERIALS["diffuse"]())
    found = [render(scene, "manylights", 64, seed) for seed in range(6)]
    with plugin_with_model(pays_below=0.0):
        traced = [render(scene, "manylights", 64, seed) for seed in range(6)]
    carried, whole = (np.median(np.var(images, axis=0, ddof=1)) for images in (found, traced))
    assert carried < 0.6 * whole
