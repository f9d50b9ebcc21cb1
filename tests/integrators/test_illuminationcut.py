"""The integrator ``illuminationcut``: against ``vpl`` with equal lights, and its own features."""

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.pairs import prepared
from tests.support.rendering import render
from tests.support.rooms import GLOSSY, ODD_SCENES, glossy_room, many_kinds
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import assert_same_mean, relative_error
from vpl.core.arrays import download, upload

NAME = "illuminationcut"
COUNTED = ("shadow_rays", "bound_computations", "cut_size")


def rendered(scene, spp=1, seed=0, **more):
    """An image and the statistics of its render."""
    plugin = mi.load_dict({"type": NAME, **more})
    return render(scene, plugin, spp, seed), plugin.statistics


def counts(statistics):
    return np.array([statistics[name] for name in COUNTED], np.float64)


def assert_same(one, other):
    """Whether two (image, statistics) are the same but for rounding: it may let a pair or two pass the threshold."""
    assert relative_error(one[0], other[0]) < 2e-5
    assert np.allclose(counts(one[1]), counts(other[1]), rtol=2e-4)


def open_floor(size=64, lamps=60):
    """A floor below a ring of point emitters: nothing is in the way of any light."""
    bulbs = {}
    for k in range(lamps):
        position = [math.cos(k), math.sin(k), 1 - 0.01 * k]
        bulbs[f"bulb{k}"] = {"type": "point", "position": position, "intensity": 0.1 + 0.01 * k}
    return {"type": "scene", "sensor": sensor(size), "floor": wall([0, 0, -1], [0, 1, 0], 0, 4.0), **bulbs}


@pytest.mark.parametrize(("direct", "phase_one_error"), [("vpl", 0.0), *stress(("nee", 0.2), ("vpl", 5.0))])
def test_error_zero_is_the_sum_of_all_lights(direct, phase_one_error):
    scene = glossy_room()
    settings = {"vpl_count": 300, "max_depth": 5, "direct": direct, "direct_count": 64}
    cut, _ = rendered(scene, error=0.0, max_cut=0, phase_one_error=phase_one_error, **settings)
    assert np.allclose(cut, render(scene, "vpl", 1, **settings), rtol=1e-4, atol=1e-5 * cut.mean())


@pytest.mark.parametrize(("direct", "visibility"), [("nee", "all"), ("vpl", "adaptive"), *stress(("vpl", "all"))])
def test_the_error_of_the_image_follows_the_bound(direct, visibility):
    scene = glossy_room()
    settings = {"vpl_count": 5000, "max_depth": 5, "direct": direct, "direct_count": 256}
    expected = render(scene, "vpl", 1, **settings)
    found = [rendered(scene, error=error, visibility=visibility, **settings) for error in (0.015, 0.1, 0.5)]
    errors = [relative_error(image, expected) for image, _ in found]
    assert errors[0] < 0.02 and errors[0] < 0.7 * errors[1] and errors[1] < 0.7 * errors[2]
    sizes = [statistics["cut_size"] for _, statistics in found]
    assert sizes == sorted(sizes, reverse=True)


@pytest.mark.stress
def test_adaptive_visibility_traces_fewer_rays_for_about_the_same_image():
    scene = many_kinds()
    scene["sensor"]["film"] |= {"width": 128, "height": 128}
    scene = mi.load_dict(scene)
    settings = {"vpl_count": 2000, "max_depth": 5}
    expected = render(scene, "vpl", 1, **settings)
    every, adaptive = (rendered(scene, visibility=name, error=0.02, **settings) for name in ("all", "adaptive"))
    assert adaptive[1]["shadow_rays"] < 0.7 * every[1]["shadow_rays"]
    assert adaptive[1]["bound_computations"] == every[1]["bound_computations"]
    assert relative_error(adaptive[0], expected) < 1.3 * relative_error(every[0], expected) < 0.02


@pytest.mark.stress
def test_adaptive_visibility_changes_nothing_where_nothing_is_in_the_way():
    scene = mi.load_dict(open_floor())
    every, adaptive = (rendered(scene, 4, visibility=name, error=0.05) for name in ("all", "adaptive"))
    assert relative_error(adaptive[0], every[0]) < 2e-5
    assert np.isclose(adaptive[1]["cut_size"], every[1]["cut_size"], rtol=2e-4)
    assert adaptive[1]["shadow_rays"] < 0.7 * every[1]["shadow_rays"]


@pytest.mark.stress
@pytest.mark.parametrize("visibility", ["all", "adaptive"])
def test_work_in_parts_gives_the_same_image(visibility, monkeypatch):
    scene = glossy_room()
    settings = {"visibility": visibility, "error": 0.1, "vpl_count": 500, "max_depth": 5}
    whole = rendered(scene, 4, **settings)
    for name, value in (
        ("vpl.cuts.product_cuts._FRONTIER", 1000), ("integrators.illuminationcut._PAIRS_HELD", 900),
        ("vpl.cuts.phase_one._PAIRS_PER_KERNEL", 700), ("vpl.cuts.adaptive_visibility._PROBES_PER_KERNEL", 1100),
    ):  # fmt: skip
        monkeypatch.setattr(name, value)
    assert_same(rendered(scene, 4, **settings), whole)


def test_the_largest_cut_is_about_kept():
    """At most points: some take after a neighbour that is lit in another way."""
    scene = many_kinds()
    scene["sensor"]["film"] |= {"width": 64, "height": 64}
    scene = mi.load_dict(scene)
    settings = {"vpl_count": 3000, "max_depth": 5, "error": 1e-3, "aovs": "cut_size"}
    (free, counted), (loose, more) = (rendered(scene, max_cut=limit, **settings) for limit in (0, 10**6))
    assert np.median(free[..., 3]) > 600 and np.array_equal(free[..., 3], loose[..., 3])
    assert more["bound_computations"] > counted["bound_computations"], "trying costs bounds as well"
    for limit in (60, 200):
        cut = rendered(scene, max_cut=limit, **settings)[0][..., 3]
        assert 0.5 * limit < np.median(cut) < 1.6 * limit and np.percentile(cut, 90) < 2 * limit


@pytest.mark.stress
def test_dark_points_are_refined_as_if_they_had_the_floor():
    scene, settings = mi.load_dict(many_kinds()), {"vpl_count": 1000, "max_depth": 4, "error": 0.05, "aovs": "cut_size"}
    cuts = [rendered(scene, dark_floor=floor, **settings)[0] for floor in (0.0, 0.5, 3.0)]
    level = cuts[0][..., :3].mean(2)
    dark, bright = level < 0.3 * level.mean(), level > 6 * level.mean()
    for coarse, fine in ((1, 0), (2, 1)):
        assert cuts[coarse][dark, 3].mean() < 0.95 * cuts[fine][dark, 3].mean()
    assert bright.any() and np.allclose(cuts[1][bright, 3].mean(), cuts[0][bright, 3].mean(), rtol=0.2)


@pytest.mark.parametrize("clamping", [0.0, 0.01])
def test_a_largest_cut_below_the_number_of_kinds_ends(clamping):
    image, statistics = rendered(glossy_room(), vpl_count=300, max_cut=1, clamping=clamping)
    assert np.isfinite(image).all() and image.max() > 0
    assert statistics["cut_size"] < 20 * statistics["gather_points"]


@pytest.mark.parametrize("settings", [{"error": 0.0}, {"dark_floor": 0.0}], ids=str)
def test_the_largest_cut_is_kept_where_the_threshold_is_zero(settings):
    """Points that Phase I found black have a threshold of zero if there is no floor; so have all with an error of 0."""
    scene = mi.load_dict(many_kinds())
    image, _ = rendered(scene, vpl_count=1000, max_depth=4, max_cut=60, aovs="cut_size", **settings)
    assert image[..., 3].max() < 300


def test_an_infinite_threshold_is_a_number():
    """Without clamping the bounds of clusters around a point are infinite, and so are thresholds for a tiny cut."""
    image, _ = rendered(mi.load_dict(many_kinds()), vpl_count=300, max_depth=4, error=0.0, max_cut=1, clamping=0.0)
    assert np.isfinite(image).all() and image.max() > 0


def test_energy_is_that_of_all_lights():
    """Means over trees against the sum over the very same lights: no choice may favour bright representatives."""
    scene = mi.load_dict(closed_box({"lamp": area_light(radiance=[4.0, 1.0, 0.2])}, size=16))
    settings = {"vpl_count": 300, "max_depth": 5, "clamping": 0.0}

    def pair(seed):
        ours, _ = rendered(scene, 1, seed, error=0.3, dark_floor=0.0, **settings)
        return ours, render(scene, "vpl", 1, seed, **settings)

    assert_same_mean(pair, 24, 0.005, tiles=2)


@pytest.mark.parametrize("visibility", ["all", "adaptive"])
def test_aovs_count_what_statistics_count_and_leave_the_image_alone(visibility):
    scene = glossy_room()
    settings = {"vpl_count": 2000, "max_depth": 5, "visibility": visibility}
    plain = rendered(scene, 4, **settings)
    image, found = rendered(scene, 4, aovs="shadow_rays,upper_bounds,cut_size", **settings)
    assert_same((image[..., :3], found), plain)
    assert np.allclose(4 * image[..., 3:].sum((0, 1)), counts(found), rtol=1e-6)
    assert image[..., 4].min() > 0 and image[..., 4].std() > 0


def test_phase_one_is_a_rough_copy_of_the_image():
    """Without area emitters: the image shows them, the first phase estimates only what a surface reflects."""
    scene = many_kinds()
    del scene["lamp"]
    image, _ = rendered(mi.load_dict(scene), 4, vpl_count=2000, max_depth=5, aovs="phase_one")
    assumed, seen = image[..., 3], image[..., :3].mean(2)
    assert (assumed > 0)[seen > 0].all()
    assert 0.25 * seen.min() < assumed.min() and abs(assumed.mean() / seen.mean() - 1) < 0.2
    ratio = assumed[seen > 0] / seen[seen > 0]
    assert np.percentile(ratio, 2) > 1 / 3 and np.percentile(ratio, 98) < 3
    assert np.corrcoef(assumed.reshape(-1), seen.reshape(-1))[0, 1] > 0.9


SMALL = {
    "one point": lambda scene: scene["sensor"]["film"].update(width=1, height=1),
    "crop of one pixel": lambda scene: scene["sensor"]["film"].update(
        crop_offset_x=20, crop_offset_y=9, crop_width=1, crop_height=1
    ),
    "one light": lambda scene: (
        [scene.pop(name) for name in list(scene) if "point" in name or "spot" in name]
        + [scene.update(lamp={"type": "point", "intensity": 0.3})]
    ),
    "all points in one place": lambda scene: scene["sensor"].update(fov=1e-5),
}


@pytest.mark.parametrize("name", SMALL)
def test_small_things_are_lit_as_by_all_lights(name):
    scene = many_kinds()
    SMALL[name](scene)
    scene, settings = mi.load_dict(scene), {"vpl_count": 500, "max_depth": 2 if name == "one light" else 4}
    for spp in (1, 16):
        expected = render(scene, "vpl", spp, **settings)
        ours, _ = rendered(scene, spp, visibility="adaptive", error=1e-3, **settings)
        assert np.abs(ours - expected).mean() < 0.03 * expected.mean() and expected.mean() > 0


@pytest.mark.parametrize("integrator", ["vpl", NAME])
def test_a_single_gather_point_gives_no_warning(integrator):
    scene = closed_box({"lamp": area_light()}, size=1)
    assert render(mi.load_dict(scene), integrator, 1, vpl_count=50).max() > 0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("visibility", ["all", "adaptive"])
@pytest.mark.parametrize("name", ODD_SCENES)
def test_odd_scenes_render_as_by_all_lights(name, visibility):
    scene, settings = mi.load_dict(ODD_SCENES[name]()), {"vpl_count": 500, "max_depth": 4}
    image, _ = rendered(scene, 2, visibility=visibility, error=1e-3, **settings)
    assert np.isfinite(image).all()
    expected = render(scene, "vpl", 2, **settings)
    assert np.abs(image - expected).mean() <= 0.1 * expected.mean()


def broken_normals():
    """A square with vertex normals of length zero, a common export error: shading normals are NaN."""
    mesh = mi.Mesh("square", 4, 2, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    corners = np.array([[-1, -1, -1.5], [1, -1, -1.5], [1, 1, -1.5], [-1, 1, -1.5]], np.float32) * 0.5
    parameters["vertex_positions"] = upload(mi.Float, corners)
    parameters["vertex_normals"] = upload(mi.Float, np.zeros(12))
    parameters["faces"] = upload(mi.UInt32, [0, 1, 2, 0, 2, 3])
    parameters.update()
    return mesh


def test_points_without_a_normal_are_black_as_in_the_other_methods():
    scene = mi.load_dict(closed_box({"lamp": area_light()}, square=broken_normals()))
    assert np.isfinite(render(scene, "lightcuts", 1, vpl_count=300)).all()
    assert np.isfinite(rendered(scene, vpl_count=300)[0]).all()


@pytest.mark.parametrize("visibility", ["adaptive", *stress("all")])
def test_same_seed_same_image_and_other_seed_other_image(visibility):
    scene = glossy_room()
    settings = {"vpl_count": 1000, "max_depth": 4, "visibility": visibility}
    first, again, other = (rendered(scene, 4, seed, **settings) for seed in (3, 3, 4))
    assert_same(first, again)
    assert not np.allclose(first[0], other[0], rtol=1e-2)


@pytest.mark.stress
def test_the_order_in_which_materials_were_loaded_does_not_matter():
    """Mitsuba loads in parallel: the order can change from run to run."""
    scene = many_kinds()
    settings = {"vpl_count": 2000, "max_depth": 5}
    one, other = (
        rendered(mi.load_dict({key: scene[key] for key in keys}), **settings) for keys in (scene, reversed(scene))
    )
    assert_same(one, other)


@pytest.mark.stress
@pytest.mark.usefixtures("restore_variant")
@pytest.mark.parametrize("visibility", ["all", "adaptive"])
def test_mono_variant_renders_as_all_lights_do(visibility):
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(open_floor(32) | {"ball": {"type": "sphere", "radius": 0.4, "bsdf": GLOSSY}})
    settings = {"max_depth": 3, "vpl_count": 500}
    expected = render(scene, "vpl", 4, **settings)
    image, statistics = rendered(scene, 4, visibility=visibility, **settings)
    assert relative_error(image, expected) < 0.02
    exact, every = rendered(scene, 4, error=0.0, max_cut=0, **settings)
    assert np.allclose(exact, expected, rtol=1e-4, atol=1e-5 * expected.mean())
    assert statistics["shadow_rays"] < every["shadow_rays"]


def test_a_render_that_is_cancelled_ends_before_the_second_phase_is_evaluated():
    plugin = mi.load_dict({"type": NAME})
    job = prepared(glossy_room())[1][0]
    whole, stopped = (plugin.shade(replace(job, stopped=lambda answer=answer: answer)) for answer in (False, True))
    assert download(whole.radiance).max() > 0 == download(stopped.radiance).max()
    assert 0 < download(stopped.shadow_rays).sum() < 0.5 * download(whole.shadow_rays).sum()


BAD = [
    ("error", -1.0), ("error", math.nan), ("error", "x"), ("visibility", "some"), ("max_cut", 1.5), ("max_cut", -1),
    ("dark_floor", -1.0), ("phase_one_error", -0.1), ("phase_one_error", math.inf),
    ("aovs", "phase_two"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD, ids=[f"{name}={value}" for name, value in BAD])
def test_bad_properties_are_named_with_their_value(name, value):
    with pytest.raises((ValueError, RuntimeError), match=f'{NAME}: property "{name}" must be'):
        mi.load_dict({"type": NAME, name: value})


def test_properties_are_shown_with_their_defaults():
    text = str(mi.load_dict({"type": NAME, "visibility": "adaptive"}))
    for line in ("visibility = adaptive", "error = 0.01", "max_cut = 1000"):
        assert line in text
    assert "error = 0.015" in str(mi.load_dict({"type": NAME}))


@pytest.mark.stress
def test_no_kernel_reads_or_writes_outside_of_an_array(capfd):
    """Dr.Jit's debug mode checks every index."""
    scene = glossy_room()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1024)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, sampler.next_2d(), mi.Point2f(0.5))
    plugin = mi.load_dict(
        {"type": NAME, "vpl_count": 300, "max_depth": 5, "max_cut": 50, "visibility": "adaptive"}
        | {"aovs": "upper_bounds,phase_one"}
    )
    with dr.scoped_set_flag(dr.JitFlag.Debug, True):
        radiance, _, aovs = plugin.sample(scene, sampler, mi.Ray3f(ray))
        # The check itself works
        dr.eval(radiance, aovs, dr.gather(mi.Float, mi.Float(1, 2, 3), dr.opaque(mi.UInt32, 99, 2)))
        dr.sync_thread()
    reports = [line for line in capfd.readouterr().err.splitlines() if "out-of-bounds" in line]
    assert len(reports) == 1 and "99" in reports[0], reports
