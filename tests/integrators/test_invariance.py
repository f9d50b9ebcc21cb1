"""Invariance of images: scale, position and orientation of the scene, units of light, order of shapes and lights."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import PLUGINS, plugin
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box, rgb
from tests.support.statistics import relative_error

QUICK = ("lightcuts", "adaptivedirect")


def emitters():
    """One emitter of each kind with a position."""
    ball = {"type": "sphere", "center": [0.4, -0.3, 0.2], "radius": 0.15, "bsdf": {"type": "roughplastic"}}
    bulbs = {
        f"bulb{k}": {"type": "point", "position": [0.3 * k - 0.6, 0.3, 0.1], "intensity": rgb(0.1 + 0.1 * k)}
        for k in range(5)
    }
    return {"lamp": area_light(), "ball": ball, **bulbs}


def moved(transform, factor=1.0):
    """The closed box with its emitters and camera, each moved; intensities grow with the square of a scale."""
    scene = closed_box(emitters(), 16)
    for part in scene.values():
        if not isinstance(part, dict):
            continue
        if part["type"] == "sphere":
            part["to_world"] = mi.ScalarTransform4f().translate(part.pop("center")).scale(part.pop("radius"))
        if part["type"] == "point":
            part["position"] = transform @ mi.ScalarPoint3f(part["position"])
            part["intensity"] = rgb(part["intensity"]["value"][0] * factor**2)
        if part["type"] == "perspective":
            # Cameras take no scale
            origin, target = (transform @ mi.ScalarPoint3f(0, 0, z) for z in (0.95, 0))
            up = transform @ mi.ScalarVector3f(0, 1, 0)
            part["to_world"] = mi.ScalarTransform4f().look_at(origin, target, up)
            part |= {"near_clip": 1e-3 * factor, "far_clip": 1e3 * factor}
        elif "to_world" in part:
            part["to_world"] = transform @ part["to_world"]
    return mi.load_dict(scene)


def change(name, transform, factor=1.0):
    """How far an image is from the one of the scene that was not moved, with the same lights in both."""
    expected, found = (
        render(scene, mi.load_dict(plugin(name, max_depth=3)), 16)
        for scene in (moved(mi.ScalarTransform4f()), moved(transform, factor))
    )
    assert np.isfinite(found).all() and found.min() >= 0
    return relative_error(found, expected)


def scaled(factor):
    return mi.ScalarTransform4f().scale(factor)


# Mitsuba's own offsets of rays have an absolute part: 0.2% of the image at a scale of 1e-2, 3% at 1e-4, in ``path`` as
# well
@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize(("factor", "tolerance"), [(1e-2, 0.01), (1e4, 1e-3), *stress((1e-4, 0.06))])
def test_scale(name, factor, tolerance):
    assert change(name, scaled(factor), factor) < tolerance


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("factor", [1e-4, 1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 1e4])
def test_scale_of_any_plugin(name, factor):
    reference = relative_error(*(render(moved(scaled(f), f), "path", 256, max_depth=3) for f in (factor, 1.0)))
    assert change(name, scaled(factor), factor) < 0.05 + reference


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("angle", [0.1, 33.0, 90.0, 179.9])
def test_rotation_of_any_plugin(name, angle):
    """Frames about normals turn otherwise than the scene does, so that few lights lie elsewhere."""
    assert change(name, mi.ScalarTransform4f().rotate([0.3, 0.8, -0.5], angle)) < 0.1


@pytest.mark.parametrize("name", QUICK)
def test_rotation(name):
    assert change(name, mi.ScalarTransform4f().rotate([0.3, 0.8, -0.5], 33)) < 0.06


# Single precision resolves 6e-5 of the box's half size at 1000 half sizes from the origin, 6e-3 at 100 000, where half
# of the light is lost, in ``path`` as well
@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize(("distance", "tolerance"), [(100.0, 0.01), (1000.0, 0.02), (10_000.0, 0.06)])
def test_place(name, distance, tolerance):
    assert change(name, mi.ScalarTransform4f().translate([distance, -distance, 0.5 * distance])) < tolerance


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("distance", [1e5, 1e6, 1e7, 1e12])
def test_places_where_nothing_is_resolved_do_no_harm(name, distance):
    """The image has little to do with the scene, in ``path`` as well; it is still finite."""
    assert np.isfinite(change(name, mi.ScalarTransform4f().translate([distance, -distance, 0.5 * distance])))


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_unit_of_light(name, unit):
    """Radiances over 24 decades: the image is the same in another unit, to rounding where no random choice flips."""

    def image(unit):
        lights = {
            "lamp": area_light(radiance=[4 * unit] * 3),
            "bulb": {"type": "point", "position": [0.2, 0.4, 0], "intensity": rgb(unit)},
        }
        integrator = mi.load_dict(plugin(name, max_depth=3))
        return render(mi.load_dict(closed_box(lights, 16)), integrator, 4) / unit

    assert relative_error(image(unit), image(1.0)) < 0.02


@pytest.mark.parametrize("name", QUICK)
def test_order_of_shapes_and_lights(name):
    """Emitters and shapes listed the other way round give the same image: lights are sorted before anything random."""
    scene = closed_box(emitters(), 16)
    parts = list(scene.items())
    integrator = mi.load_dict(plugin(name, max_depth=3))
    first, second = (
        render(mi.load_dict(dict(listed), parallel=False), integrator, 4)
        for listed in (parts, parts[:2] + parts[:1:-1])
    )
    assert relative_error(second, first) < 0.02


@pytest.mark.stress
@pytest.mark.parametrize("count", [1, 2, 3, 10, 1000, 100_000, 2_000_000])
@pytest.mark.parametrize("name", ["lightcuts", "mdlightcuts", "illuminationcut", "illuminationcut-adaptive"])
def test_numbers_of_virtual_lights(name, count):
    """From one to two million; more lights are another estimate of the same image."""
    scene = mi.load_dict(closed_box(emitters(), 16))
    found = render(scene, mi.load_dict(plugin(name, vpl_count=count, max_depth=4)), 4)
    expected = render(scene, mi.load_dict(plugin("lightcuts", vpl_count=20_000, max_depth=4)), 4)
    assert np.isfinite(found).all() and found.min() >= 0
    # With a few thousand paths, the mean is known to some percent
    assert abs(found.mean() / expected.mean() - 1) < (0.1 if count >= 1000 else 1.0)


LAYOUTS = {
    "at one place": lambda k: [0.1, 0.2, 0.3],
    "on a line": lambda k: [0.015 * k - 0.6, 0.2, 0.3],
    "on a plane": lambda k: [0.1 * (k % 9) - 0.4, 0.2, 0.1 * (k // 9) - 0.4],
    "on a wall": lambda k: [0.1 * (k % 9) - 0.4, -1.0, 0.1 * (k // 9) - 0.4],
    "almost at one place": lambda k: [0.1 + 1e-7 * k, 0.2, 0.3],
}


@pytest.mark.parametrize("name", ["illuminationcut", "mdlightcuts", "lightslice", *QUICK])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_lights(name, layout):
    """80 lights, of intensities over 12 decades, in places that leave boxes, cones or distances without extent."""
    lights = {
        f"bulb{k}": {"type": "point", "position": LAYOUTS[layout](k), "intensity": rgb(10.0 ** (-12 + 12 * k / 79))}
        for k in range(80)
    }
    scene = mi.load_dict(closed_box(lights, 16))
    expected, found = (render(scene, mi.load_dict(plugin(which, max_depth=2)), 16) for which in ("vpl", name))
    assert np.isfinite(found).all() and found.min() >= 0
    assert abs(found.mean() / expected.mean() - 1) < 0.05
