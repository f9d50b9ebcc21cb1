"""Random scenes, from tame to absurd: no image has a bad pixel, and every draw of an emitter is one that shines."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.support.catalogue import PLUGINS, plugin
from tests.support.properties import examples
from tests.support.rendering import render
from tests.support.scenes import rgb, sensor
from vpl.core.arrays import LARGEST_VALUE, download, upload
from vpl.core.sampling import Choice
from vpl.lights.virtual_lights import VirtualLights

COORDINATES = st.one_of(st.floats(-1.5, 1.5, width=32), st.sampled_from([0.0, 1.0, -1.0, 1e-6, 1e-20, 1e6, -1e6, 1e20]))
SIZES = st.one_of(st.floats(0.0625, 2.0, width=32), st.sampled_from([0.0, 1e-20, 1e-6, 1e-3, 30.0, 1e6]))
LEVELS = st.one_of(st.floats(0.125, 8.0, width=32), st.sampled_from([0.0, 1e-30, 1e-12, 1e12, 1e25]))
BSDFS = st.sampled_from(["diffuse", "roughplastic", "dielectric", "conductor", "roughconductor"])


@st.composite
def shapes(draw, emits):
    """A shape of any size in any place, turned, stretched or flattened."""
    kind = draw(st.sampled_from(["rectangle", "disk", "sphere", "cube", "cylinder"]))
    place, turn = ([draw(COORDINATES) for _ in range(3)] for _ in range(2))
    axis = turn if np.linalg.norm(turn) > 0 else [0, 0, 1]
    size = [draw(SIZES) for _ in range(3)]
    if kind in ("sphere", "cylinder"):
        size = size[:1] * 3
    transform = mi.ScalarTransform4f().translate(place).rotate(axis, draw(st.floats(0, 360, width=32))).scale(size)
    shape = {"type": kind, "to_world": transform}
    if emits:
        return shape | {"emitter": {"type": "area", "radiance": rgb(draw(LEVELS))}}
    return shape | {"bsdf": {"type": draw(BSDFS)}}


@st.composite
def emitters(draw):
    """An emitter of any kind, place and strength."""
    kind = draw(st.sampled_from(["point", "spot", "directional", "constant", "area", "area"]))
    if kind == "area":
        return draw(shapes(True))
    if kind == "constant":
        return {"type": "constant", "radiance": rgb(draw(LEVELS))}
    if kind == "directional":
        down = [draw(st.floats(-1, 1, width=32)), -1.0, draw(st.floats(-1, 1, width=32))]
        return {"type": "directional", "direction": down, "irradiance": rgb(draw(LEVELS))}
    place = [draw(COORDINATES) for _ in range(3)]
    if kind == "point":
        return {"type": "point", "position": place, "intensity": rgb(draw(LEVELS))}
    angle = draw(st.floats(0.015625, 89, width=32))
    transform = mi.ScalarTransform4f().translate(place).rotate([1, 0.3, 0], 90)
    return {"type": "spot", "to_world": transform, "cutoff_angle": angle, "intensity": rgb(draw(LEVELS))}


@st.composite
def scenes(draw):
    """A visible floor, up to four shapes, and one to four emitters; at most one environment."""
    floor = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(2)
    scene = {"type": "scene", "sensor": sensor(8, 2), "floor": {"type": "rectangle", "to_world": floor}}
    for number, shape in enumerate(draw(st.lists(shapes(False), max_size=4))):
        scene[f"shape{number}"] = shape
    lights = draw(st.lists(emitters(), min_size=1, max_size=4))
    skies = [light for light in lights if light["type"] == "constant"]
    for number, light in enumerate([light for light in lights if light["type"] != "constant"] + skies[:1]):
        scene[f"light{number}"] = light
    return scene


@pytest.mark.filterwarnings("ignore")
@given(scene=scenes(), name=st.sampled_from(list(PLUGINS)), depth=st.integers(1, 4))
@settings(max_examples=examples(25, 1000), deadline=None, suppress_health_check=list(HealthCheck))
def test_random_scenes_have_no_bad_pixel(scene, name, depth):
    mi.set_log_level(mi.LogLevel.Error)
    try:
        loaded = mi.load_dict(scene)
    except RuntimeError:
        return  # Mitsuba refuses some scenes, e.g. a flattened sphere
    finally:
        mi.set_log_level(mi.LogLevel.Warn)
    try:
        found = render(loaded, mi.load_dict(plugin(name, max_depth=depth)), 2)
    except RuntimeError as error:
        assert "its size must be finite" in str(error.__cause__)
        return
    assert np.isfinite(found).all()
    assert found.min() >= 0


WEIGHTS = st.lists(
    st.one_of(st.just(0.0), st.floats(1e-300, 1e300), st.floats(0.1, 10)), min_size=1, max_size=60
).filter(lambda weights: sum(weights) > 0)


@given(weights=WEIGHTS, seed=st.integers(0, 2**32 - 1))
@example(weights=[0.0, 1.0, 0.0], seed=0)
@example(weights=[1e-300, 1e300, 0.0], seed=0)
@settings(max_examples=examples(100), deadline=None)
def test_a_choice_never_falls_on_nothing(weights, seed):
    """For any uniform number, including 0 and 1 - eps; the stated probabilities are exact and sum to one."""
    weights = np.array(weights)
    choice = Choice(weights)
    uniform = np.random.default_rng(seed).random(64, np.float32)
    uniform[:2] = 0, np.nextafter(np.float32(1), np.float32(0))
    row = choice.row(upload(mi.Float, uniform)) + dr.zeros(mi.UInt32, 64)
    assert (weights[download(row)] > 0).all()
    assert abs(choice.pmf.sum() - 1) < 1e-9
    # Probabilities are whole multiples of 2^-23, and none is 0 where the weight is not
    assert np.allclose(choice.pmf, weights / weights.sum(), atol=(len(weights) + 1) * 2.0**-23)


@given(
    intensity=st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=3, max_size=30),
    direction=st.floats(width=32),
)
@example(intensity=[0.0, np.inf, -np.inf], direction=0.0)
@example(intensity=[0.0, 0.0, 1e-45], direction=0.0)
@settings(max_examples=examples(300), deadline=None)
def test_lights_that_are_kept_are_usable(intensity, direction):
    rows = np.float32(intensity[: len(intensity) // 3 * 3]).reshape(-1, 3)
    lights = VirtualLights.of("oriented", np.zeros((len(rows), 3)), np.full((len(rows), 3), direction), rows)
    kept, dropped = lights.without_bad()
    # A third of the smallest number is 0 in single precision
    smallest = np.finfo(np.float32).smallest_subnormal
    black = np.isfinite(direction) & (rows >= 0).all(1) & (np.nan_to_num(rows).sum(1, dtype=np.float64) <= smallest)
    assert kept.count + dropped + np.count_nonzero(black) == lights.count
    assert (kept.intensity >= 0).all() and (kept.intensity <= LARGEST_VALUE).all()
    assert (kept.intensity > 0).any(1).all() and np.isfinite(kept.direction).all()
