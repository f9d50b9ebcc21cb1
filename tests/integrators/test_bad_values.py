"""NaN, infinity, negative and huge numbers in all that a scene can hold: no bad pixel, no crash, no dark image."""

import gc
import math

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import MATERIALS, PLUGINS, one_of, plugin, stage
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box, image, rgb, wall

BAD = {"nan": math.nan, "inf": math.inf, "negative": -1.0, "huge": 3e38, "big": 1e29, "tiny": 1e-38, "denormal": 1e-42}
QUICK = ("nan", "negative")


def texture(value):
    """An image with two bad texels."""
    texels = np.full((4, 8, 3), 0.5, np.float32)
    texels[1, 2] = texels[2, 5] = value
    return texels


def lit(lights=None, **objects):
    """A closed box with a valid emitter: a black or too dark image reveals damage by the bad value."""
    return closed_box({"good": area_light(), **(lights or {})}, 16, **objects)


def panel(**bsdf):
    """The same with a panel of some material before the back wall."""
    return lit(panel=wall([0, 0, -0.9], [0, 1, 0], 0, 0.5, bsdf=bsdf))


def mesh(vertices, faces, normals=None, emitter=None):
    """A mesh in which anything may be wrong."""
    properties = mi.Properties()
    if emitter is not None:
        properties["emitter"] = mi.load_dict(emitter)
    made = mi.Mesh("bad", len(vertices), len(faces), properties, has_vertex_normals=normals is not None)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.float32(vertices).ravel()
    parameters["faces"] = np.uint32(faces).ravel()
    if normals is not None:
        parameters["vertex_normals"] = np.float32(normals).ravel()
    parameters.update()
    return made


TRIANGLES = [[0, 1, 2], [0, 1, 3]]

LIGHTS = {
    "point intensity": lambda v: lit({"bad": {"type": "point", "intensity": rgb(v)}}),
    "point channel": lambda v: lit({"bad": {"type": "point", "intensity": rgb(v, 1e-3, 1e-3)}}),
    "point position": lambda v: lit({"bad": {"type": "point", "position": [v, 0, 0], "intensity": rgb(1e-3)}}),
    "spot intensity": lambda v: lit({"bad": {"type": "spot", "intensity": rgb(v)}}),
    "sun irradiance": lambda v: lit({"bad": {"type": "directional", "direction": [0, -1, 0], "irradiance": rgb(v)}}),
    "sun direction": lambda v: lit({"bad": {"type": "directional", "direction": [v, -1, 0]}}),
    "area radiance": lambda v: lit({
        "bad": {"type": "sphere", "radius": 0.1, "emitter": {"type": "area", "radiance": rgb(v)}}
    }),
    "area texture": lambda v: lit({
        "bad": {
            "type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.2),
            "emitter": {"type": "area", "radiance": image(texture(v))},
        }
    }),
}  # fmt: skip
MATTER = {
    "reflectance": lambda v: panel(type="diffuse", reflectance=image(texture(v))),
    "roughness": lambda v: panel(type="roughconductor", alpha=image(texture(v))),
    "plastic": lambda v: panel(type="roughplastic", diffuse_reflectance=image(texture(v))),
    "bump": lambda v: panel(type="bumpmap", bump=image(texture(v)[..., :1]), nested={"type": "diffuse"}),
    "normal map": lambda v: panel(type="normalmap", normalmap=image(texture(v)), nested={"type": "diffuse"}),
    "opacity": lambda v: panel(type="mask", opacity=image(texture(v)[..., :1]), nested={"type": "diffuse"}),
    "vertex normal": lambda v: lit(
        bad=mesh([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0], [0.5, 0, 0.3]], TRIANGLES,
                 [[0, 0, 1], [v, 0, 1], [0, 0, 1], [0, 0, 1]])
    ),
}  # fmt: skip


def assert_renders_well(description, name, least=0.1, lowest=0.0):
    """Render by a plugin of the catalogue: finite, not negative, and hardly darker than the good emitter makes it."""
    found = render(mi.load_dict(description), mi.load_dict(plugin(name, max_depth=3)), 2)
    assert np.isfinite(found).all()
    assert found.min() >= lowest
    assert found.mean() > least


def _cases(sources, values):
    return [(source, value) for source in sources for value in values]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("number", "case"), list(enumerate(_cases(LIGHTS | MATTER, QUICK))))
def test_a_bad_value_spoils_nothing_else(number, case):
    """Two plugins take turns; the stress run has every plugin with every case."""
    source, value = case
    assert_renders_well((LIGHTS | MATTER)[source](BAD[value]), ("lightcuts", "adaptivedirect")[number % 2])


@pytest.mark.stress
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("source", "value"), _cases(LIGHTS | MATTER, BAD))
@pytest.mark.parametrize("name", PLUGINS)
def test_no_bad_value_spoils_any_plugin(name, source, value):
    # `manylights` and `path` show negative light of surfaces with negative reflectance
    lowest = -0.2 if name == "manylights" and source in MATTER and value == "negative" else 0
    assert_renders_well((LIGHTS | MATTER)[source](BAD[value]), name, lowest=lowest)


def environment_only(value, kind):
    sky = {
        "envmap": lambda: {"type": "envmap", "bitmap": mi.Bitmap(texture(value))},
        "constant": lambda: {"type": "constant", "radiance": rgb(value)},
    }[kind]()
    return mi.load_dict(stage({"sky": sky}, one_of(MATERIALS["diffuse"]()), 16))


def error_of(scene, name, **more):
    """Return the message of a refused render and of its cause."""
    with pytest.raises(RuntimeError) as error:
        render(scene, mi.load_dict(plugin(name, **more)), 2)
    said = f"{error.value} {error.value.__cause__}"
    del error, scene
    gc.collect()  # frames of the error would keep shapes alive that cannot be sampled
    return said


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
@pytest.mark.parametrize("value", ["nan", "inf", "huge"])
def test_an_environment_map_that_cannot_be_sampled_is_refused_by_name(name, value):
    said = error_of(environment_only(BAD[value], "envmap"), name)
    assert 'environment map "sky" has 2 texel(s)' in said and "row 1 and column 2" in said


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
def test_negative_texels_of_an_environment_are_black(name):
    found, black = (
        render(environment_only(value, "envmap"), mi.load_dict(plugin(name, max_depth=2)), 64) for value in (-1.0, 0.0)
    )
    assert found.min() >= 0
    assert found.mean() < black.mean() * 1.02


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
@pytest.mark.parametrize("value", ["nan", "negative", "huge"])
def test_a_bad_constant_environment_is_dropped_and_counted(name, value):
    integrator = mi.load_dict(plugin(name))
    assert render(environment_only(BAD[value], "constant"), integrator, 2).max() == 0
    assert integrator.statistics["dropped"] == 1


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
def test_a_scene_without_a_finite_size_is_refused(name):
    corners = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0], [math.inf, 0, 0.3]]
    assert "its size must be finite" in error_of(mi.load_dict(lit(bad=mesh(corners, TRIANGLES))), name)
    for kind in ("disk", "rectangle"):
        nowhere = {"type": kind, "to_world": mi.ScalarTransform4f().scale(math.nan)}
        assert "its size must be finite" in error_of(mi.load_dict(lit(bad=nowhere)), name)


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
@pytest.mark.parametrize("shape", ["sdfgrid", "ellipsoids"])
def test_area_emitters_on_shapes_that_cannot_be_sampled_are_refused(name, shape):
    odd = {
        "sdfgrid": lambda: {"grid": mi.TensorXf(np.linspace(-1, 1, 64, dtype=np.float32).reshape(4, 4, 4, 1))},
        "ellipsoids": lambda: {
            "centers": mi.TensorXf([[0, 0, 0]]), "scales": mi.TensorXf([[0.1, 0.1, 0.1]]),
            "quaternions": mi.TensorXf([[0, 0, 0, 1]]), "opacities": mi.TensorXf([[1]]),
        },
    }[shape]()  # fmt: skip
    lamp = {"type": shape, "emitter": {"type": "area"}, **odd}
    assert 'shape "lamp" (' in error_of(mi.load_dict(closed_box({"lamp": lamp})), name)


def test_an_environment_that_mitsuba_cannot_evaluate_is_refused_by_name():
    said = error_of(mi.load_dict(stage({"sky": {"type": "timed_sunsky"}}, {}, 8)), "lightcuts")
    assert '"sky" (TimedSunskyEmitter) is not supported' in said


def pane(scale):
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(scale),
        "emitter": {"type": "area"},
    }


DEGENERATE = {
    "flattened": lambda: pane([1, 0, 1]),
    "without thickness": lambda: pane([1, 1, 0]),
    "a thread": lambda: pane([0.3, 1e-20, 1]),
    "sphere of no size": lambda: {"type": "sphere", "radius": 0.0, "emitter": {"type": "area"}},
    "speck": lambda: {"type": "sphere", "radius": 1e-20, "emitter": {"type": "area"}},
    "mesh without area": lambda: mesh(
        [[-0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0.5, 0]], [[0, 1, 2], [0, 0, 0]], emitter={"type": "area"}
    ),
    "sliver": lambda: mesh(
        [[-0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0.5 + 1e-7, 0]], [[0, 1, 2]], emitter={"type": "area"}
    ),
    "normals of length 0": lambda: mesh(
        [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0]], [[0, 1, 2]], np.zeros((3, 3))
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
@pytest.mark.parametrize("shape", DEGENERATE)
def test_shapes_of_no_size_do_no_harm(name, shape):
    assert_renders_well(lit({"bad": DEGENERATE[shape]()}), name)


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("shape", DEGENERATE)
def test_shapes_of_no_size_do_no_harm_in_any_plugin(name, shape):
    assert_renders_well(lit({"bad": DEGENERATE[shape]()}), name)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect", "vpl"])
def test_a_lamp_whose_area_overflows_is_dropped_and_counted(name):
    """Its extent does not overflow."""
    matrix = np.array([[1, 0, 3e4, 0], [0, 6e14, 0, 0], [-3e4, 0, 1, 0], [0, 0, 0, 1.0]])
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix)}
    lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    integrator = mi.load_dict(plugin(name, max_depth=2))
    assert np.isfinite(render(mi.load_dict(lit(bad=lamp)), integrator, 2)).all()
    assert integrator.statistics["dropped"] == 1
