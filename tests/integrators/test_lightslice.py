"""The integrator ``lightslice``: images against ``vpl``, statistics and properties."""

from functools import partial
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.properties import assert_properties_are_shown, assert_property_is_refused
from tests.support.rendering import render, render_with_statistics
from tests.support.rooms import glossy_room, many_kinds
from tests.support.scenes import area_light, closed_box, wall
from tests.support.statistics import assert_same_mean, relative_error

NAME = "lightslice"

rendered = partial(render_with_statistics, NAME)


# ---- Against the sum of all lights


@pytest.mark.parametrize("spp", [9, *stress(1)])
def test_the_error_falls_as_columns_are_added_and_vanishes_when_all_are_there(spp):
    scene = glossy_room()
    given = {"vpl_count": 300, "max_depth": 5, "direct": "vpl", "direct_count": 64, "slices": 40}
    expected = render(scene, "vpl", spp, **given_to_all(given))
    errors = [relative_error(rendered(scene, spp, columns=n, **given)[0], expected) for n in (4, 16, 64, 100_000)]
    assert errors[0] > 1.3 * errors[1] > 1.3**2 * errors[2] and errors[3] < 1e-4


def given_to_all(given):
    return {name: value for name, value in given.items() if name not in ("slices", "columns", "shared_columns")}


def dark_corners():
    """A box whose floor is shaded by a shelf from half of ten red and green emitters: most rows see few lights."""
    bulbs = {}
    for k in range(10):
        color = {"type": "rgb", "value": [1.0, 0.05, 0.1] if k % 2 else [0.05, 1.0, 0.1]}
        place = [0.18 * k - 0.8, 0.6 if k < 5 else -0.6, 0.1 * (k % 3)]
        bulbs[f"bulb{k}"] = {"type": "point", "position": place, "intensity": color}
    return closed_box(bulbs, size=24, shelf=wall([0, -0.2, 0], [1, 0, 0], -90, 0.8))


@pytest.mark.parametrize("make", [dark_corners, *stress(glossy_room, many_kinds)])
def test_the_mean_over_seeds_is_that_of_all_lights(make):
    """With the same seeds both methods see the same lights: what is left is the noise of the choice.

    With few slices, columns and representative rows, no row has seen much of the arriving light.
    """
    scene = make()
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    given = {"vpl_count": 300, "max_depth": 4, "direct": "vpl", "direct_count": 64}
    coarse = {"slices": 12, "columns": 16, "shared_columns": 40, "neighbours": 2}

    def pair(seed):
        return rendered(scene, 4, seed, **coarse, **given)[0], render(scene, "vpl", 4, seed, **given)

    assert_same_mean(pair, 16, 0.02)


def test_samples_of_a_pixel_take_turns_with_the_lights_of_a_cluster():
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=24))
    given = {"vpl_count": 3000, "max_depth": 5, "slices": 20, "columns": 30}
    expected = render(scene, "vpl", 16, **given_to_all(given))
    errors = [relative_error(rendered(scene, 16, sets=sets, **given)[0], expected) for sets in (1, 16)]
    assert errors[1] < 0.5 * errors[0]


def test_candidates_make_gloss_less_noisy():
    scene, given = glossy_room(), {"vpl_count": 2000, "max_depth": 4, "direct": "none"}
    expected = render(scene, "vpl", 4, **given)
    few, many = (rendered(scene, 4, candidates=count, slices=30, columns=20, **given)[0] for count in (1, 8))
    assert np.square(many - expected).mean() < 0.7 * np.square(few - expected).mean()


@pytest.mark.parametrize(("samples", "sets"), [(1, 16), (4, 16), (4, 3), (16, 16), (1, 1)])
def test_pixels_of_a_block_and_their_samples_take_all_sets(samples, sets):
    plugin = mi.load_dict({"type": NAME, "sets": sets})
    grid = SimpleNamespace(samples=samples, width=12)
    job = SimpleNamespace(ray=dr.arange(mi.UInt32, 12 * 8 * samples), grid=grid)
    turn = plugin._light_sets(job).reshape(8, 12, samples)
    assert all(len(np.unique(of_pixel)) == min(samples, sets) for of_pixel in turn.reshape(-1, samples))
    blocks = turn.reshape(2, 4, 3, 4, samples).transpose(0, 2, 1, 3, 4).reshape(6, -1)
    assert all(np.array_equal(np.unique(block), np.arange(min(sets, 16 * samples))) for block in blocks)
    counts = np.stack([np.bincount(block, minlength=sets) for block in blocks])
    assert counts.max() - counts.min() <= 1


def test_columns_are_counted_and_rays_include_those_of_rows():
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=24))
    given = {"vpl_count": 3000, "max_depth": 5, "columns": 30, "slices": 20, "shared_columns": 500}
    _, counted = rendered(scene, 1, **given)
    points = counted["gather_points"]
    assert 20 * points < counted["cut_size"] <= 30 * points
    assert counted["slices"] == 20
    assert counted["bound_computations"] > 20 * 400
    # A fair part of what is in a row arrives; the rows of the shared columns come on top
    assert counted["shadow_rays"] - counted["cut_size"] > 20 * 100


# ---- What every plugin has to bear


def test_the_same_seed_gives_the_same_image_and_another_one_another():
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=16))
    given = {"vpl_count": 500, "max_depth": 4, "slices": 30, "columns": 20, "shared_columns": 60}
    first, again, other = (rendered(scene, 4, seed, **given)[0] for seed in (3, 3, 4))
    assert np.allclose(first, again, rtol=1e-5)
    assert relative_error(other, first) > 1e-3


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_the_unit_of_radiance_does_not_matter(scale):
    given = {"vpl_count": 300, "max_depth": 4, "slices": 10, "columns": 20}
    images = [
        rendered(mi.load_dict(closed_box({"lamp": area_light(radiance=[4.0 * s] * 3)}, size=16)), 1, **given)[0] / s
        for s in (1, scale)
    ]
    assert np.allclose(images[1], images[0], rtol=1e-3, atol=1e-4 * images[0].mean())


def test_monochrome(restore_variant):
    mi.set_variant("llvm_ad_mono")
    scene, given = mi.load_dict(closed_box({"lamp": area_light()}, size=16)), {"vpl_count": 300, "max_depth": 4}
    image, _ = rendered(scene, 4, columns=10_000, **given)
    assert np.allclose(image, render(scene, "vpl", 4, **given), rtol=1e-3, atol=1e-4 * image.mean())


def test_one_point_and_one_light():
    scene = closed_box({"bulb": {"type": "point", "position": [0.2, 0.3, 0], "intensity": 1.0}}, size=1)
    scene, given = mi.load_dict(scene), {"max_depth": 2}
    image, _ = rendered(scene, 1, **given)
    assert np.allclose(image, render(scene, "vpl", 1, **given), rtol=1e-5) and image.max() > 0


def test_rows_that_see_nothing_leave_the_choice_to_bounds():
    """The only point emitter is behind a screen, seen from all but a sliver of the floor."""
    scene = closed_box({"bulb": {"type": "point", "position": [0, 0.9, 0], "intensity": 1.0}}, size=16)
    scene = mi.load_dict(scene | {"screen": wall([0, 0.85, 0], [1, 0, 0], -90, 0.97)})
    given = {"max_depth": 2}
    image, _ = rendered(scene, 4, slices=3, **given)
    assert np.allclose(image, render(scene, "vpl", 4, **given), rtol=1e-4)


BAD = [
    ("slices", 0),
    ("slices", 1.5),
    ("columns", 0),
    ("columns", "many"),
    ("shared_columns", 0),
    ("neighbours", 0),
    ("unseen", 0.0),
    ("unseen", -1.0),
    ("sets", 0),
    ("candidates", 0),
    ("vpl_count", 0),
]


@pytest.mark.parametrize(("name", "value"), BAD, ids=[f"{name}={value}" for name, value in BAD])
def test_bad_properties_are_named_with_their_value(name, value):
    assert_property_is_refused(NAME, name, value)


def test_properties_are_shown():
    given = {"slices": 17, "columns": 23, "shared_columns": 99, "neighbours": 3, "unseen": 0.25, "sets": 2}
    given["candidates"] = 3
    assert_properties_are_shown(NAME, given)
