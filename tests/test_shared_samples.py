"""Gather points that stand for others of their pixel: which ones, and what light they all get."""

from dataclasses import replace

import mitsuba as mi
import numpy as np

from vpl.core.arrays import download
from vpl.direct.shared_samples import share_samples
from vpl.points.point_tree import build_point_tree

from .conftest import area_light, closed_box, render, wall
from .test_illuminationcut import NAME, rendered
from .test_integrators import assert_same_expectation, passes
from .test_lightcuts import prepared
from .test_pairs import glossy_room


def test_shared_samples_have_the_mean_of_all_of_them():
    texture = mi.Bitmap(np.random.default_rng(0).uniform(0, 1, (32, 32, 3)).astype(np.float32))
    painted = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "filter_type": "nearest"}}
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=8, back=wall([0, 0, -1], [0, 1, 0], 0, bsdf=painted)))
    settings = {"vpl_count": 100, "max_depth": 3, "error": 0.2, "phase_one_error": 2.0}
    shared, single = (passes(scene, NAME, 32, 4, 100 * s, share_samples=s == 0, **settings) for s in (0, 1))
    assert_same_expectation(shared, single)
    rays = [rendered(scene, 4, share_samples=share, **settings)[1]["shadow_rays"] for share in (True, False)]
    assert rays[0] < 0.7 * rays[1]
    alone = [rendered(scene, 1, share_samples=share, **settings)[0] for share in (True, False)]
    assert np.allclose(*alone, rtol=1e-5)


def test_the_light_of_a_point_is_that_of_one_of_its_pixel():
    """Here four neighbouring rays are taken for samples of one pixel."""
    for job in prepared(glossy_room(), vpl_count=100, max_depth=3)[1]:
        job, settings = replace(job, grid=replace(job.grid, samples=4)), {"type": NAME, "error": 0.0, "max_cut": 0}
        own, shown = (
            download(mi.load_dict({**settings, "share_samples": share}).shade(job).radiance) for share in (False, True)
        )
        pixel = download(job.ray) // 4
        distance = np.abs(shown[:, None] - own[None]).max(2) / own.max()
        assert np.where(pixel[:, None] == pixel[None], distance, np.inf).min(1).max() < 1e-5
        assert np.diagonal(distance).max() > 1e-3, "some take over light that is not their own"


def test_samples_of_a_pixel_are_known_to_each_other_on_any_film():
    def rays(share, wrapper=None, **film):
        scene = closed_box({"lamp": area_light()}, size=16)
        scene["sensor"]["film"] |= film
        plugin = mi.load_dict({"type": NAME, "vpl_count": 200, "max_depth": 3, "share_samples": share})
        render(mi.load_dict(scene), mi.load_dict({**wrapper, "nested": plugin}) if wrapper else plugin, 16)
        return plugin.statistics["shadow_rays"]

    for more in (
        {}, {"wrapper": {"type": "moment"}}, {"rfilter": {"type": "gaussian"}, "sample_border": True},
        {"crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 7, "crop_height": 9},
    ):  # fmt: skip
        assert rays(True, **more) < 0.25 * rays(False, **more)


def test_points_stand_for_others_of_their_pixel_nearby_and_all_as_often():
    rng, samples = np.random.default_rng(0), 4
    pixel = np.repeat(np.arange(100), samples)
    position = np.stack([pixel % 10, pixel // 10, np.zeros(400)], 1) + rng.uniform(0, 0.9, (400, 3)) * [1, 1, 0]
    # One sample of the first pixels lies elsewhere
    position[: 20 * samples : samples, 2] = 500
    tree = build_point_tree(position.astype(np.float32), np.tile(np.float32([0, 0, 1]), (400, 1)), 1)
    pixel, position, chosen = pixel[tree.order], position[tree.order], np.zeros(400)
    for _ in range(400):
        rows, stands_for = share_samples(tree, pixel, samples, rng)
        assert len(np.unique(rows)) == len(rows) and set(stands_for) == set(range(len(rows)))
        assert np.array_equal(pixel[rows[stands_for]], pixel) and np.array_equal(stands_for[rows], np.arange(len(rows)))
        assert np.array_equal(position[rows[stands_for], 2], position[:, 2])
        chosen[rows] += 1
    size = np.bincount(stands_for)[stands_for]
    assert 100 < len(rows) < 300 and (size > 1).any()
    assert np.abs(chosen / 400 - 1 / size).max() < 5 * 0.5 / 20, "all members of a group are drawn alike"
