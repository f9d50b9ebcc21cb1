"""Scenes of many emitters and materials: means are those of ``path``."""

import mitsuba as mi
import numpy as np

from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box, rgb
from tests.support.statistics import assert_same_mean

PLACES = np.random.default_rng(1).uniform(-0.9, 0.9, (8, 3)).tolist()


def bulbs(count):
    """The given number of point emitters at eight positions, of constant total power."""
    power = rgb(4.0 / count)
    return {
        f"bulb{i}": {"type": "point", "position": PLACES[i % len(PLACES)], "intensity": power} for i in range(count)
    }


def balls(count):
    """Small balls, each of a material of its own."""
    kinds = ("diffuse", "roughplastic", "roughconductor", "principled")
    objects = {}
    for i, center in enumerate(np.random.default_rng(2).uniform(-0.8, 0.8, (count, 3)).tolist()):
        bsdf = {"type": kinds[i % len(kinds)]}
        objects[f"ball{i}"] = {"type": "sphere", "center": center, "radius": 0.5 / count**0.5, "bsdf": bsdf}
    return objects


def assert_mean_of_path(scene, expected_scene, finds):
    def pair(seed):
        return (
            render(scene, "manylights", 256, seed, max_depth=4),
            render(expected_scene, "path", 512, 100 + seed, max_depth=4),
        )

    assert_same_mean(pair, 8, finds)


def test_many_emitters():
    """The oracle has eight: in ``path`` thousands take minutes."""
    scene, few = (mi.load_dict(closed_box(bulbs(number), 16)) for number in (2000, len(PLACES)))
    assert_mean_of_path(scene, few, 0.01)


def test_many_materials():
    description = closed_box({"light": area_light()}, 16)
    scene = mi.load_dict({"type": "scene", **balls(100), **description})
    assert_mean_of_path(scene, scene, 0.025)
