"""The contribution of a virtual light against Mitsuba's own emitters and against double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.rendering import render
from tests.support.scenes import rgb, sensor, wall
from vpl.core.arrays import download, upload
from vpl.lights.emitters import read_emitters
from vpl.lights.virtual_lights import DeviceLights, VirtualLights, geometry

SPOT = {
    "type": "spot",
    "to_world": lambda: mi.ScalarTransform4f().look_at([0.3, 1, 0.2], [0, -1, 0.4], [0, 0, 1]),
    "cutoff_angle": 35.0,
    "beam_width": 20.0,
    "intensity": {"type": "rgb", "value": [1.0, 2.0, 3.0]},
}
POINT = {"type": "point", "position": [0.1, 0.7, -0.4], "intensity": {"type": "rgb", "value": [3.0, 2.0, 1.0]}}
SUN = {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": {"type": "rgb", "value": [1.0, 0.5, 2.0]}}


def scene_with(emitter):
    emitter = {key: value() if callable(value) else value for key, value in emitter.items()}
    return mi.load_dict({"type": "scene", "emitter": emitter, "shape": {"type": "sphere", "radius": 0.1}})


def scaled_spot(scale):
    return SPOT | {"to_world": lambda: SPOT["to_world"]() @ mi.ScalarTransform4f().scale(scale)}


@pytest.mark.parametrize("emitter", [SPOT, scaled_spot(3), POINT, SUN], ids=["spot", "scaled", "point", "directional"])
def test_flat_lights_equal_mitsubas_emitters(emitter):
    scene = scene_with(emitter)
    emitters = read_emitters(scene)
    lights = next(x for x in (emitters.points, emitters.spots, emitters.directional) if x.count)
    positions = np.random.default_rng(1).uniform(-1, 1, (2000, 3)).astype(np.float32)
    reference = dr.zeros(mi.SurfaceInteraction3f, len(positions))
    reference.p = mi.Point3f(*(upload(mi.Float, positions[:, k]) for k in range(3)))
    ds, expected = scene.emitters()[0].sample_direction(reference, mi.Point2f(0.5))
    light = DeviceLights(lights).gather(dr.zeros(mi.UInt32, len(positions)))
    to_light, factor = geometry(lights.kind, reference.p, light, 0.0)
    expected = np.broadcast_to(download(expected), positions.shape)
    assert expected.max() > 0
    np.testing.assert_allclose(download(light.intensity * factor), expected, rtol=2e-4, atol=1e-5 * expected.max())
    lit = expected.sum(1) > 0
    directions = [np.broadcast_to(download(vector), positions.shape)[lit] for vector in (to_light, ds.d)]
    np.testing.assert_allclose(*directions, atol=1e-5)


def test_spots_with_an_oval_cone_are_left_to_mitsuba():
    emitters = read_emitters(scene_with(scaled_spot([2, 1, 1])))
    assert emitters.spots.count == 0 and [name for name, _ in emitters.others] == ["SpotLight"]


@pytest.mark.parametrize("name", ["vpl", "adaptivedirect", "manylights"])
@pytest.mark.parametrize("lamps", [1, 70])
def test_the_scale_of_a_directional_emitter_counts_as_in_path(name, lamps):
    """With many lamps, `manylights` has no emitters of Mitsuba."""
    turned = mi.ScalarTransform4f().look_at([0, 0, 0], [0.2, -1, -0.3], [0, 0, 1]).scale(2)
    sun = {"sun": {"type": "directional", "to_world": turned, "irradiance": rgb(1.0)}}
    dim = {f"lamp{i}": POINT | {"position": [0.1 * i, 1, 0], "intensity": rgb(1e-6)} for i in range(lamps)}
    scene = {"type": "scene", "sensor": sensor(8, 4), "floor": wall([0, 0, 0], [1, 0, 0], -60), **sun}
    expected = render(mi.load_dict(scene), "path", 64, max_depth=2).mean()
    found = render(mi.load_dict(scene | dim), name, 64, max_depth=2).mean()
    assert found == pytest.approx(expected, rel=0.02) and expected > 0


def oriented(position, direction):
    return DeviceLights(VirtualLights.of("oriented", [position], [direction], [[1, 1, 1]], 1))


def factor_at(position, light_position, direction, clamp):
    light = oriented(light_position, direction).gather(mi.UInt32(0))
    return float(geometry("oriented", mi.Point3f(*position), light, clamp)[1][0])


def test_oriented_lights_fall_off_with_cosine_and_distance():
    assert factor_at([0, 0, 2], [0, 0, 0], [0, 0, 1], 0.0) == pytest.approx(0.25)
    tilted = [np.sin(0.5), 0, np.cos(0.5)]
    assert factor_at([0, 0, 2], [0, 0, 0], tilted, 0.0) == pytest.approx(0.25 * np.cos(0.5), rel=1e-5)
    assert factor_at([0, 0, 2], [0, 0, 0], [0, 0, -1], 0.0) == 0


def test_clamping_replaces_short_distances_only():
    assert factor_at([0, 0, 0.01], [0, 0, 0], [0, 0, 1], 0.1) == pytest.approx(100)
    assert factor_at([0, 0, 0.2], [0, 0, 0], [0, 0, 1], 0.1) == pytest.approx(25)


@pytest.mark.parametrize("clamp", [0.0, 0.1])
def test_light_on_the_shaded_point_gives_nothing_and_no_nan(clamp):
    assert factor_at([0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0, 0, 1], clamp) == 0


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_factor_scales_with_the_scene(scale):
    factor = factor_at([0, 0.3 * scale, 2 * scale], [0, 0, 0], [0, 0, 1], 0.05 * scale)
    assert factor * scale**2 == pytest.approx(factor_at([0, 0.3, 2], [0, 0, 0], [0, 0, 1], 0.05), rel=1e-5)


def test_bad_lights_are_dropped_and_counted():
    lights = VirtualLights.of(
        "point", np.zeros((4, 3)), np.zeros((4, 3)), [[1, 1, 1], [0, 0, 0], [np.nan, 1, 1], [1, -1, 1]]
    )
    kept, bad = lights.without_bad()
    assert (kept.count, bad) == (1, 2)
