"""Textures under filters that are wider than a pixel, by plugins that share samples among the rays of a pixel."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.scenes import sensor, wall
from vpl.direct.adaptive import _BatchLight

SIZE = 16


def rgb(value):
    return {"type": "rgb", "value": value}


def chequered(rfilter, material="diffuse"):
    """A checkerboard wall across the image, with checks of two pixels shifted by half a pixel; a lamp and some sky."""
    camera, half = sensor(SIZE, 1), 4 * float(np.tan(np.deg2rad(20)))
    camera["film"]["rfilter"] = {"type": rfilter}
    checks = {
        "type": "checkerboard", "color0": rgb(0.02), "color1": rgb(0.9),
        "to_uv": mi.ScalarTransform4f().translate([0.13, 0.21, 0]).scale([SIZE / 4, SIZE / 4, 1]),
    }  # fmt: skip
    bsdf = {"type": material, "reflectance" if material == "diffuse" else "diffuse_reflectance": checks}
    return {
        "type": "scene", "sensor": camera, "wall": wall([0, 0, 0], [0, 1, 0], 0, half, bsdf=bsdf),
        "bulb": {"type": "point", "position": [0.3, 0.4, 2], "intensity": rgb(20.0)},
        "sky": {"type": "constant", "radiance": 0.5},
    }  # fmt: skip


pytestmark = pytest.mark.usefixtures("lights_cost_nothing")


# With the largest error of a pixel of the mean image; half of it is noise
@pytest.mark.parametrize(
    ("plugin", "material", "allowed"),
    [
        ("unoccludeddirect", "diffuse", 0.25), ("lightcuts", "diffuse", 0.2), ("mdlightcuts", "diffuse", 0.2),
        ("adaptivedirect", "roughplastic", 0.35),
        *stress(("adaptivedirect", "diffuse", 0.2), ("manylights", "diffuse", 0.2)),
    ],
)  # fmt: skip
def test_textures_stay_sharp_under_mitsubas_usual_filter(plugin, material, allowed):
    scene, more = mi.load_dict(chequered("gaussian", material)), {"max_depth": 2}
    if plugin == "lightcuts":
        more["direct"] = "adaptive"
    if plugin == "unoccludeddirect":
        more |= {"error": 0.1, "max_samples": 800}
    ours = np.mean([render(scene, plugin, 64, seed, **more) for seed in range(6)], axis=(0, 3))
    expected = np.mean([render(scene, "path", 1024, seed, max_depth=2) for seed in range(4)], axis=(0, 3))
    assert expected.min() < 0.2 * expected.max()
    assert np.abs(ours / expected - 1).max() < allowed


@pytest.mark.parametrize("plugin", ["manylights", *stress("mdlightcuts")])
def test_textures_lit_by_other_surfaces_stay_sharp(plugin):
    scene = chequered("gaussian")
    scene["back"] = wall([0, 0, 6], [0, 1, 0], 180, 6.0, (0.8, 0.8, 0.8))
    scene = mi.load_dict(scene)
    ours = np.mean([render(scene, plugin, 64, seed, max_depth=3) for seed in range(6)], axis=(0, 3))
    expected = np.mean([render(scene, "path", 1024, seed, max_depth=3) for seed in range(4)], axis=(0, 3))
    assert np.abs(ours / expected - 1).max() < 0.2


@pytest.mark.parametrize("plugin", ["adaptivedirect", "unoccludeddirect"])
def test_under_a_box_filter_pixels_hold_what_was_estimated_for_their_points(plugin, monkeypatch):
    scene, more = mi.load_dict(chequered("box")), {"error": 0.3, "max_samples": 200}
    sharp = render(scene, plugin, 16, 0, **more)
    monkeypatch.setattr(_BatchLight, "_own_reflectance", lambda light: 1)
    assert np.allclose(sharp, render(scene, plugin, 16, 0, **more), rtol=1e-4)
