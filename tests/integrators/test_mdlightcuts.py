"""The integrator ``mdlightcuts``: cuts through the product of trees against ``vpl``."""

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.pairs import batch_of
from tests.support.properties import assert_properties_are_shown, assert_property_is_refused
from tests.support.rendering import render
from tests.support.rooms import glossy_room, many_kinds
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import assert_same_mean, relative_error
from vpl.core.arrays import download, upload
from vpl.cuts.pixel_cuts import PixelCuts
from vpl.cuts.product_cuts import Pairs
from vpl.points.gather_tree import build_gather_tree
from vpl.points.point_clusters import PointClusters

NAME = "mdlightcuts"


def rendered(scene, spp=1, seed=0, **more):
    """An image and the statistics of its render."""
    plugin = mi.load_dict({"type": NAME, **more})
    return render(scene, plugin, spp, seed), plugin.statistics


# ---- Against the sum of all lights


@pytest.mark.parametrize(("direct", "spp"), [("nee", 1), ("vpl", 1), ("vpl", 4)])
def test_error_zero_is_the_sum_of_all_lights(direct, spp):
    scene = glossy_room()
    given = {"vpl_count": 200, "max_depth": 5, "direct": direct, "direct_count": 64}
    cut, _ = rendered(scene, spp, error=0.0, max_cut=0, leaf_points=1, **given)
    assert np.allclose(cut, render(scene, "vpl", spp, **given), rtol=1e-4, atol=1e-5 * cut.mean())


@pytest.mark.parametrize("spp", [1, *stress(9)])
def test_the_error_of_the_image_follows_the_bound(spp):
    scene = glossy_room()
    given = {"vpl_count": 5000, "max_depth": 5, "direct": "vpl", "direct_count": 256}
    expected = render(scene, "vpl", spp, **given)
    found = [rendered(scene, spp, error=error, **given) for error in (0.01, 0.1, 0.5)]
    errors = [relative_error(image, expected) for image, _ in found]
    assert errors[0] < 0.03 and errors[0] < 0.7 * errors[1] and errors[1] < 0.9 * errors[2]
    sizes = [statistics["cut_size"] for _, statistics in found]
    assert sizes == sorted(sizes, reverse=True)


def tinted_mirrors():
    """A box seen by way of three mirrors of different colours, and directly: points of a pixel differ in weight."""
    scene = closed_box({"lamp": area_light()}, size=24)
    scene["sensor"]["fov"] = 60
    for k, tint in enumerate(([0.9, 0.2, 0.1], [0.1, 0.8, 0.3], [0.2, 0.3, 0.9])):
        mirror = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": tint}}
        scene[f"mirror{k}"] = {"type": "sphere", "center": [0.3 * k - 0.3, -0.2, -0.2], "radius": 0.12, "bsdf": mirror}
    return scene


@pytest.mark.parametrize("make", [tinted_mirrors, *stress(many_kinds, glossy_room)])
def test_the_mean_over_seeds_is_that_of_all_lights(make):
    """With the same seeds both methods see the same lights: what is left is the noise of the representatives."""
    scene = make()
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    given = {"vpl_count": 400, "max_depth": 4, "direct": "vpl", "direct_count": 64}
    # A coarse cut, so representatives of points and of lights matter everywhere
    cut = {"error": 0.3, **given}

    def pair(seed):
        return rendered(scene, 16, seed, **cut)[0], render(scene, "vpl", 16, seed, **given)

    assert_same_mean(pair, 12, 0.02)


@pytest.mark.parametrize("black", [False, True])
def test_representatives_stand_for_points_of_all_weights_and_colours(black):
    rng = np.random.default_rng(5)
    count, draws = 12, 1 << 16
    weight = rng.uniform(0, 1, (count, 3)).astype(np.float32) ** 3
    weight[3] = 0
    if black:
        weight[:, 1] = 0
    arriving, albedo = rng.uniform(0, 5, (count, 3)), rng.uniform(0, 1, (count, 3)).astype(np.float32)
    pixel = np.repeat([0, 1], 6)
    normal = np.tile(np.float32([0, 0, 1]), (count, 1))
    position = rng.random((count, 3)).astype(np.float32)
    batch = batch_of(position, normal)
    batch.surfaces.albedo = mi.Color3f(*(upload(mi.Float, column / np.pi) for column in albedo.T))
    clusters = PointClusters(batch, partial(build_gather_tree, pixel, 2, 1))
    tree = clusters.tree
    along = mi.Color3f(*(upload(mi.Float, column) for column in weight[tree.order].T))
    cuts = PixelCuts(clusters, pixel[tree.order], along, 6, 0)
    for node in range(tree.size):
        inside = tree.order[tree.first[node] : tree.first[node] + tree.count[node]]
        chosen = dr.opaque(mi.UInt32, node, draws)
        point, factor = cuts._representative(Pairs(chosen, chosen))
        found = download(factor).reshape(-1, 3) * arriving[tree.order[download(point)]] * np.ones((draws, 1))
        found = found.mean(0)
        strength = (weight * albedo)[inside]
        total = strength.sum(0)
        mean = (strength * arriving[inside]).sum(0) / np.where(total > 0, total, 1)
        assert np.allclose(found, mean, rtol=0.03, atol=1e-6)
        assert np.isclose(cuts._fraction[node], weight[inside].sum(0).max() / 6, rtol=1e-5)


def test_a_pixel_with_many_samples_takes_hardly_more_pairs_than_with_one():
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=32))
    given = {"vpl_count": 20000, "max_depth": 5, "error": 0.02}
    one, many = (rendered(scene, spp, **given)[1] for spp in (1, 16))
    assert many["cut_size"] < 2 * one["cut_size"]
    assert many["gather_points"] == 16 * one["gather_points"]


def test_max_cut_bounds_pairs_about():
    scene = glossy_room()
    given = {"vpl_count": 20000, "max_depth": 5, "error": 0.002, "direct": "vpl"}
    limited, free = (rendered(scene, 4, max_cut=most, **given)[1] for most in (100, 0))
    # Pixels that see diffuse and glossy surfaces have two cuts
    pixels = limited["gather_points"] / 4
    assert limited["cut_size"] < 250 * pixels < free["cut_size"] / 2


# ---- What every plugin has to bear


def test_the_same_seed_gives_the_same_image_and_another_one_another():
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=16))
    given = {"vpl_count": 500, "max_depth": 4, "error": 0.1}
    first, again, other = (rendered(scene, 4, seed, **given)[0] for seed in (3, 3, 4))
    assert np.allclose(first, again, rtol=1e-5)
    assert relative_error(other, first) > 1e-3


def test_samples_of_a_pixel_are_found_in_passes_crops_and_wrappers():
    """Light is shared among samples: far fewer pairs than with a tree for every sample."""
    given = {"vpl_count": 2000, "max_depth": 4, "error": 0.05}
    scene = closed_box({"lamp": area_light()}, size=24)
    alone = rendered(mi.load_dict(scene), 1, **given)[1]["cut_size"]
    film = scene["sensor"]["film"] | {"crop_offset_x": 4, "crop_offset_y": 8, "crop_width": 16, "crop_height": 8}
    crop = mi.load_dict(scene | {"sensor": scene["sensor"] | {"film": film}})
    whole, cropped = rendered(mi.load_dict(scene), 16, **given), rendered(crop, 16, **given)
    assert whole[1]["cut_size"] < 2 * alone and cropped[1]["cut_size"] < 2 * alone * 128 / 576
    assert np.abs(cropped[0] - whole[0][8:16, 4:20]).mean() < 0.1 * whole[0].mean()
    passes, counted = rendered(mi.load_dict(scene), 16, samples_per_pass=8, **given)
    assert counted["cut_size"] < 2 * alone
    assert relative_error(passes, whole[0]) < 0.1
    plugin = mi.load_dict({"type": NAME, "aovs": "cut_size", **given})
    named = mi.load_dict({"type": "aov", "aovs": "depth:depth", "image": plugin})
    channels = np.array(mi.render(mi.load_dict(scene), integrator=named, spp=16, seed=0))
    assert channels.shape[2] > 4 and np.isfinite(channels).all()
    assert plugin.statistics["cut_size"] < 2 * alone


def test_a_sensor_outside_of_the_scene_is_lit_as_one_of_it():
    given, scene = {"vpl_count": 500, "max_depth": 4}, closed_box({"lamp": area_light()}, size=16)
    camera = mi.load_dict(scene["sensor"])
    scene["sensor"]["film"] = scene["sensor"]["film"] | {"width": 20}
    other = mi.load_dict(scene)
    found, sizes = [], []
    for view in (camera, mi.load_dict(scene["sensor"]), 0):
        plugin = mi.load_dict({"type": NAME, **given})
        found.append(np.array(mi.render(other, sensor=view, integrator=plugin, spp=16, seed=0)))
        sizes.append(plugin.statistics["cut_size"] / found[-1].size)
    np.testing.assert_allclose(found[1], found[2], rtol=1e-5)
    assert sizes[0] < 1.2 * sizes[1]
    plugin = mi.load_dict({"type": "vpl", **given})
    assert relative_error(found[0], np.array(mi.render(other, sensor=camera, integrator=plugin, spp=16, seed=0))) < 0.03


def test_below_a_wrapper_a_sensor_outside_of_the_scene_is_lit_ray_by_ray():
    """The plugin receives rays without pixels."""
    scene = closed_box({"lamp": area_light()}, size=16)
    other = mi.load_dict(scene["sensor"])
    scene["sensor"]["film"] = scene["sensor"]["film"] | {"width": 20}
    scene, images = mi.load_dict(scene), []
    for kind in (NAME, "vpl"):
        plugin = {"type": "aov", "aovs": "depth:depth", "image": {"type": kind, "vpl_count": 500, "max_depth": 4}}
        images.append(np.array(mi.render(scene, sensor=other, integrator=mi.load_dict(plugin), spp=4, seed=0)))
    assert relative_error(*(image[..., :3] for image in images)) < 0.03


def test_wide_filters_see_about_the_same_image():
    scene = closed_box({"lamp": area_light()}, size=24)
    scene["sensor"]["film"] = scene["sensor"]["film"] | {"rfilter": {"type": "gaussian"}}
    scene, given = mi.load_dict(scene), {"vpl_count": 500, "max_depth": 4}
    image, _ = rendered(scene, 16, error=0.01, **given)
    assert relative_error(image, render(scene, "vpl", 16, **given)) < 0.02


def test_monochrome(restore_variant):
    mi.set_variant("llvm_ad_mono")
    scene, given = mi.load_dict(closed_box({"lamp": area_light()}, size=16)), {"vpl_count": 300, "max_depth": 4}
    image, _ = rendered(scene, 4, error=0.0, max_cut=0, leaf_points=1, **given)
    assert np.allclose(image, render(scene, "vpl", 4, **given), rtol=1e-4, atol=1e-5 * image.mean())


def test_one_point_and_one_light():
    scene = closed_box({"bulb": {"type": "point", "position": [0.2, 0.3, 0], "intensity": 1.0}}, size=1)
    scene, given = mi.load_dict(scene), {"max_depth": 2}
    image, _ = rendered(scene, 1, **given)
    assert np.allclose(image, render(scene, "vpl", 1, **given), rtol=1e-5) and image.max() > 0


def test_a_lens_is_sampled_like_everything_else():
    scene = {
        "type": "scene",
        "sensor": sensor(24, type="thinlens", aperture_radius=0.2, focus_distance=3.0),
        "floor": wall([0, 0, -1], [0, 1, 0], 0, 4.0),
        "near": wall([0, 0, 1], [0, 1, 0], 0, 0.3, (0.8, 0.2, 0.1)),
        "bulb": {"type": "point", "position": [0.5, 0.5, 2], "intensity": 1.0},
    }
    scene = mi.load_dict(scene)
    given = {"vpl_count": 2000, "max_depth": 3}
    image, counted = rendered(scene, 16, error=0.005, **given)
    assert relative_error(image, render(scene, "vpl", 16, **given)) < 0.03
    every = mi.load_dict({"type": "lightcuts", "error": 0.005, **given})
    render(scene, every, 16)
    assert counted["cut_size"] < every.statistics["cut_size"] / 3


BAD = [
    ("error", -0.1),
    ("error", "x"),
    ("dark_floor", -1.0),
    ("max_cut", -1),
    ("max_cut", 2.5),
    ("vpl_count", 0),
    ("leaf_points", 0),
    ("leaf_points", 1.5),
]


@pytest.mark.parametrize(("name", "value"), BAD, ids=[f"{name}={value}" for name, value in BAD])
def test_bad_properties_are_named_with_their_value(name, value):
    assert_property_is_refused(NAME, name, value)


def test_properties_are_shown():
    given = {"error": 0.25, "dark_floor": 0.75, "max_cut": 77, "leaf_points": 3}
    assert_properties_are_shown(NAME, given)
