"""The integrators through Mitsuba's interface: against ``path``, in each way of calling plugins."""

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import ODD_SCENES
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import assert_same_mean

EXACT = {"clamping": 0.0, "vpl_count": 2000}


def assert_mean_of_path(scene, integrator, spp, max_depth, seeds=8, finds=0.015, **more):
    def pair(seed):
        found = render(scene, integrator, spp, seed, max_depth=max_depth, **more)
        return found, render(scene, "path", spp, seed, max_depth=max_depth)

    assert_same_mean(pair, seeds, finds)


LIGHTS = {
    "area": lambda: {"lamp": area_light()},
    "point": lambda: {
        "bulb": {"type": "point", "position": [0.2, 0.6, 0.1], "intensity": {"type": "rgb", "value": 1.0}}
    },
    "spot": lambda: {
        "spot": {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([0, 0.8, 0], [0.3, -1, 0], [0, 0, 1]),
            "cutoff_angle": 50.0,
            "intensity": {"type": "rgb", "value": [3.0, 2.0, 1.0]},
        }
    },
    "sphere": lambda: {
        "ball": {
            "type": "sphere",
            "center": [0.3, 0.2, 0],
            "radius": 0.2,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [2.0, 3.0, 4.0]}},
        }
    },
}


WITH_LIGHTS = ("vpl", "lightcuts", "mdlightcuts", "lightslice")
QUICK_PAIRS = [pair for pair in zip(WITH_LIGHTS, LIGHTS, strict=True) if pair[0] != "lightslice"]
OTHER_PAIRS = [pair for pair in itertools.product(WITH_LIGHTS, LIGHTS) if pair not in QUICK_PAIRS]


@pytest.mark.parametrize(("integrator", "light"), [*QUICK_PAIRS, *stress(*OTHER_PAIRS)])
def test_energy_equals_path_in_closed_diffuse_scenes(integrator, light):
    scene = mi.load_dict(closed_box(LIGHTS[light]()))
    assert_mean_of_path(scene, integrator, 8, 5, **EXACT)


QUICK_DIRECT = [("envmap", "nee"), ("area", "vpl")]
ALL_DIRECT = itertools.product(("envmap", "area", "constant", "directional"), ("nee", "vpl"))


@pytest.mark.parametrize(
    ("kind", "direct"), [*QUICK_DIRECT, *stress(*(one for one in ALL_DIRECT if one not in QUICK_DIRECT))]
)
def test_direct_light_equals_path(kind, direct):
    rng = np.random.default_rng(0)
    sky = mi.Bitmap(rng.uniform(0, 2, (8, 16, 3)).astype(np.float32) ** 3)
    emitter = {
        "envmap": lambda: {"sky": {"type": "envmap", "bitmap": sky}},
        "constant": lambda: {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}},
        "directional": lambda: {"sun": {"type": "directional", "direction": [0.3, -1, -0.4]}},
        "area": lambda: {"lamp": area_light()},
    }[kind]()
    scene = mi.load_dict(
        {
            "type": "scene", "sensor": sensor(32, 4), "floor": wall([0, -1, 0], [1, 0, 0], -90, 2.0),
            "ball": {"type": "sphere", "radius": 0.5, "center": [0, -0.5, 0], "bsdf": {"type": "diffuse"}}, **emitter,
        }
    )  # fmt: skip
    assert_mean_of_path(scene, "lightcuts", 16, 2, direct=direct, direct_count=512, clamping=0.0)


@pytest.mark.parametrize("max_depth", [2, 3, *stress(-1)])
def test_max_depth_counts_the_same_edges_as_path(max_depth):
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    assert_mean_of_path(scene, "lightcuts", 8, max_depth, **EXACT)


@pytest.mark.parametrize("max_depth", [0, 1])
def test_emitters_alone_are_seen_as_by_path(max_depth):
    """Camera rays are the same with the same seed, and nothing else is random."""
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    found, expected = (render(scene, name, 4, 3, max_depth=max_depth) for name in ("lightcuts", "path"))
    assert (expected.max() > 0) == (max_depth > 0)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("integrator", ["lightcuts", "adaptivedirect", "manylights"])
def test_no_light_of_an_environment_enters_a_closed_room(integrator):
    """Mitsuba's bounding box ignores rectangles of equal materials, so the environment lies close to the ball."""
    ball = {"type": "sphere", "radius": 0.1, "center": [0.3, -0.5, 0]}
    box = closed_box({"sky": {"type": "constant"}}, ball=ball)
    for side in ("left", "right"):
        box[side]["bsdf"] = box["floor"]["bsdf"]
    scene = mi.load_dict(box)
    assert render(scene, "path", max_depth=2).mean() > 0.005
    assert render(scene, integrator, max_depth=2).max() == 0


def test_no_light_path_is_traced_when_light_cannot_bounce():
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    plugin = mi.load_dict({"type": "lightcuts", "max_depth": 2})
    render(scene, plugin)
    assert plugin.statistics["lights"] == {} and plugin.statistics["light_paths"] == 0


@pytest.mark.stress
def test_mirrors_glass_and_masks_seen_by_the_camera_are_followed():
    objects = {
        "mirror": wall([-0.4, 0, -0.5], [0, 1, 0], 20, 0.35, bsdf={"type": "conductor"}),
        "pane": wall([0.4, 0, 0.2], [0, 1, 0], 0, 0.3, bsdf={"type": "thindielectric"}),
        "veil": wall(
            [0, -0.5, 0.3], [0, 1, 0], 0, 0.2, bsdf={"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}}
        ),
        "plastic": {"type": "sphere", "radius": 0.2, "center": [0.5, -0.6, 0], "bsdf": {"type": "plastic"}},
    }
    scene = mi.load_dict(closed_box({"lamp": area_light()}, **objects))
    ours = np.array([render(scene, "lightcuts", 64, k, max_depth=6, clamping=0.0, vpl_count=5000) for k in range(4)])
    reference = np.array([render(scene, "path", 256, 100 + k, max_depth=6) for k in range(4)])
    # Caustics are left out by design: close, not equal; nothing black, nothing leaking
    ours, reference = (x.mean((0, 3)).reshape(8, 4, 8, 4).mean((1, 3)) for x in (ours, reference))
    assert 0.93 < ours.mean() / reference.mean() < 1.01
    assert (ours / reference).min() > 0.8 and (ours / reference).max() < 1.1


def test_same_seed_same_image_and_other_seed_other_image():
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    first, again, other = (render(scene, "lightcuts", 2, seed, vpl_count=3000) for seed in (3, 3, 4))
    assert np.allclose(first, again, rtol=1e-5, atol=0)
    assert not np.allclose(first, other, rtol=1e-2)


@pytest.mark.parametrize("threads", [1, 2])
def test_thread_count_does_not_change_the_image(threads):
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    expected = render(scene, "lightcuts", 2, 0, vpl_count=3000)
    before = dr.thread_count()
    dr.set_thread_count(threads)
    try:
        assert np.allclose(render(scene, "lightcuts", 2, 0, vpl_count=3000), expected, rtol=1e-5)
    finally:
        dr.set_thread_count(before)


# Below 1e-2 the absolute part of Mitsuba's own ray offsets becomes visible, in ``path`` as well
@pytest.mark.parametrize("scale", [1e-2, 1e4])
def test_scale_of_the_scene_does_not_matter(scale):
    expected, scaled = (
        render(mi.load_dict(closed_box({"lamp": area_light(s)}, scale=s)), "lightcuts", 4, 0, vpl_count=2000)
        for s in (1.0, scale)
    )
    assert np.mean(np.abs(scaled - expected)) < 0.02 * expected.mean()


def test_scale_of_the_radiance_does_not_matter():
    expected, scaled = (
        render(mi.load_dict(closed_box({"lamp": area_light(1.0, [r] * 3)})), "lightcuts", 4, 0, vpl_count=2000) / r
        for r in (1.0, 1e-6)
    )
    assert np.mean(np.abs(scaled - expected)) < 1e-3 * expected.mean()


def test_moment_and_aov_can_wrap_it():
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    nested = {"type": "lightcuts", "vpl_count": 1000, "aovs": "shadow_rays,upper_bounds,cut_size"}
    moment = render(scene, mi.load_dict({"type": "moment", "nested": nested}), 2)
    assert np.isfinite(moment).all() and moment.shape[2] > 6
    depth = render(scene, mi.load_dict({"type": "aov", "aovs": "dd:depth", "nested": nested}), 2)
    assert np.isfinite(depth).all()


def test_aovs_count_what_statistics_count():
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    plugin = mi.load_dict({"type": "lightcuts", "vpl_count": 3000, "aovs": "shadow_rays,cut_size,upper_bounds"})
    image = render(scene, plugin, 1)
    rays, cut, bounds = image[..., 3:].sum((0, 1))
    found = plugin.statistics
    assert (rays, cut, bounds) == (found["shadow_rays"], found["cut_size"], found["bound_computations"])
    assert 0 < found["shadow_rays"]


def test_films_and_sensors():
    base = closed_box({"lamp": area_light()}, size=24)
    base["sensor"]["film"] |= {"crop_offset_x": 4, "crop_offset_y": 2, "crop_width": 10, "crop_height": 6}
    assert render(mi.load_dict(base), "lightcuts", 2, vpl_count=500).shape == (6, 10, 3)
    base["sensor"]["film"] = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "luminance"}
    assert render(mi.load_dict(base), "lightcuts", 2, vpl_count=500).shape == (8, 8, 1)
    base["sensor"] = base["sensor"] | {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 1.0}
    assert np.isfinite(render(mi.load_dict(base), "lightcuts", 2, vpl_count=500)).all()


def test_hide_emitters():
    scene = mi.load_dict(closed_box({"lamp": area_light(radiance=[50.0] * 3)}))
    shown, hidden = (render(scene, "lightcuts", 4, 0, vpl_count=500, hide_emitters=hide) for hide in (False, True))
    assert shown.max() > 40 and hidden.max() < 40


@pytest.mark.usefixtures("restore_variant")
def test_mono_variant_renders_the_same_luminance():
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    ours, path = (
        render(scene, name, 16, 0, max_depth=4, **more) for name, more in (("lightcuts", EXACT), ("path", {}))
    )
    assert abs(ours.mean() / path.mean() - 1) < 0.05


@pytest.mark.usefixtures("restore_variant")
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral"])
def test_other_variants_are_refused_by_name(variant):
    mi.set_variant(variant)
    with pytest.raises(RuntimeError, match=f'does not support the variant "{variant}"'):
        mi.load_dict({"type": "lightcuts"})


BAD = [
    ("vpl_count", 0), ("vpl_count", -3), ("vpl_count", 1.5), ("vpl_count", "many"), ("clamping", -1.0),
    ("clamping", math.nan), ("direct", "both"), ("max_depth", -2), ("max_depth", 2.5), ("rr_depth", 0),
    ("error", -0.1), ("error", "x"), ("max_cut", -1), ("aovs", "shadow_rays,colour"), ("lobe_limit", math.inf),
    ("emitter_samples", True), ("dark_floor", -1.0),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD, ids=[f"{name}={value}" for name, value in BAD])
def test_bad_properties_are_named_with_their_value(name, value):
    with pytest.raises((ValueError, RuntimeError), match=f'property "{name}" must be'):
        mi.load_dict({"type": "lightcuts", name: value})


def test_unknown_properties_are_refused():
    with pytest.raises(RuntimeError, match='unknown property "vpl_cuont"; did you mean "vpl_count"'):
        mi.load_dict({"type": "lightcuts", "vpl_cuont": 5})


@pytest.mark.parametrize("of", ["the scene", "a group"])
def test_a_medium_is_refused_by_name(of, capfd):
    scene = closed_box({"lamp": area_light()})
    scene["fog"] = {
        "type": "sphere", "radius": 0.3, "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "albedo": 0.5}
    }  # fmt: skip
    if of == "a group":
        scene |= {"group": {"type": "shapegroup", "fog": scene.pop("fog")}}
        scene["instance"] = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    with pytest.raises(RuntimeError) as error:
        render(mi.load_dict(scene), "lightcuts")
    said = '("fog", Sphere) bounds a participating medium'
    assert said in str(error.value.__cause__)
    # `mi.render` raises a different error, without the cause
    assert said in "".join(capfd.readouterr())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("integrator", ["vpl", "lightcuts", "mdlightcuts", "lightslice", "matrixrecovery"])
@pytest.mark.parametrize("name", ODD_SCENES)
def test_odd_scenes_render_without_nan(integrator, name):
    image = render(mi.load_dict(ODD_SCENES[name]()), integrator, 2, vpl_count=500, max_depth=4)
    assert np.isfinite(image).all()
    if name in ("no emitters", "nothing at all", "zero-power lights", "camera sees nothing", "light in a closed box"):
        assert image.max() == 0
    else:
        assert image.max() > 0


@pytest.mark.stress
@pytest.mark.parametrize("integrator", ["lightcuts", *stress("lightslice", "mdlightcuts", "matrixrecovery")])
def test_no_kernel_reads_or_writes_outside_of_an_array(integrator, capfd):
    """Dr.Jit's debug mode checks every index; a mirror and a pane give camera paths of several waves."""
    objects = {
        "mirror": wall([-0.4, 0, -0.5], [0, 1, 0], 20, 0.35, bsdf={"type": "conductor"}),
        "pane": wall([0.4, 0, 0.2], [0, 1, 0], 0, 0.3, bsdf={"type": "thindielectric"}),
    }
    scene = mi.load_dict(closed_box(LIGHTS["point"]() | LIGHTS["spot"]() | {"lamp": area_light()}, **objects))
    coarse = {
        "lightslice": {"columns": 20, "slices": 30, "shared_columns": 50}, "matrixrecovery": {"slice_rows": 100},
    }.get(integrator, {"max_cut": 50})  # fmt: skip
    plugin = mi.load_dict({"type": integrator, "vpl_count": 300, "max_depth": 5, **coarse})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1024)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, sampler.next_2d(), mi.Point2f(0.5))
    with dr.scoped_set_flag(dr.JitFlag.Debug, True):
        radiance, _, _ = plugin.sample(scene, sampler, mi.Ray3f(ray))
        # The check itself works
        dr.eval(radiance, dr.gather(mi.Float, mi.Float(1, 2, 3), dr.opaque(mi.UInt32, 99, 2)))
        dr.sync_thread()
    reports = [line for line in capfd.readouterr().err.splitlines() if "out-of-bounds" in line]
    assert len(reports) == 1 and "99" in reports[0], reports
