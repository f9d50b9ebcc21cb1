"""The integrator ``matrixrecovery``: predictors, and images against ``vpl``."""

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.separated_light import light_of_entries
from comparison.scene_files import SceneFile
from tests.support.marks import stress
from tests.support.pairs import batch_of
from tests.support.paths import ROOT
from tests.support.properties import assert_properties_are_shown, assert_property_is_refused
from tests.support.rendering import render, render_with_statistics
from tests.support.rooms import glossy_room, many_kinds
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import relative_error
from vpl.core.arrays import download
from vpl.matrix import recovery as matrix_recovery
from vpl.matrix.reduced_matrix import MatrixRows
from vpl.matrix.separation import Separation
from vpl.points.point_clusters import PointClusters
from vpl.points.slice_rows import build_row_slices

NAME = "matrixrecovery"
PREDICTED = "nearest,linear,bayes"
SMALL = {"max_depth": 4, "vpl_count": 3000, "direct": "vpl"}
# Every light a column of its own, every row traced
EXACT = {"alpha": 0.0, "max_columns": 100_000, "sampling": 9.0}

rendered = partial(render_with_statistics, NAME)


# ---- Images


def scenes():
    room = closed_box({"lamp": area_light()}, size=24)
    return {
        "room": mi.load_dict(room),
        "kinds": mi.load_dict(many_kinds()),
        "gloss": glossy_room(),
    }


@pytest.mark.parametrize("name", ["room", *stress("kinds", "gloss")])
def test_with_a_column_for_every_light_and_every_row_traced_it_is_the_sum_of_all_lights(name):
    scene = scenes()[name]
    settings = SMALL | {"vpl_count": 200, "direct_count": 60}
    expected = render(scene, "vpl", 1, **settings)
    image, found = rendered(scene, **settings, **EXACT, steps=PREDICTED)
    assert relative_error(image, expected) < 1e-5
    assert found["failed_slices"] == 0


def dark_error(image, expected):
    """Relative error of all but the brightest tenth of the values, where shadows are."""
    dark = expected < np.quantile(expected, 0.9)
    return relative_error(image[dark], expected[dark])


@pytest.fixture(scope="module")
def shadows():
    """A room with a plate below the area emitter: half of it is in shadow."""
    plate = wall([0, 0.4, 0], [1, 0, 0], -90, 0.55)
    return mi.load_dict(closed_box({"lamp": area_light()}, size=48, plate=plate))


def test_most_entries_are_predicted_and_the_image_is_that_of_all_lights(shadows):
    expected = render(shadows, "vpl", 4, **SMALL)
    image, found = rendered(shadows, 4, **SMALL)
    assert dark_error(image, expected) < 0.15
    rays = sum(found[f"{stage}_rays"] for stage in ("columns", "prediction", "correction"))
    assert rays < 0.3 * found["entries"]
    assert rays == pytest.approx(found["shadow_rays"], rel=1e-3)


def test_the_error_falls_with_alpha(shadows):
    """Larger clusters lead to more traced clusters."""
    expected, settings = render(shadows, "vpl", 1, **SMALL), SMALL | {"steps": f"{PREDICTED},separation,correction"}
    errors = [dark_error(rendered(shadows, 1, **settings, alpha=alpha)[0], expected) for alpha in (0.05, 0.005, 0.0005)]
    assert errors[2] < 0.7 * errors[0] and errors[1] < errors[0]


@pytest.mark.stress
def test_the_bias_of_prediction_is_small_and_falls_with_sampling(shadows):
    """With the same seeds, and so the same lights; clusters alone have none."""
    expected = np.mean([render(shadows, "vpl", 1, seed, **SMALL) for seed in range(6)], axis=0)
    dark = expected < np.quantile(expected, 0.9)

    def bias(**more):
        mean = np.mean([rendered(shadows, 1, seed, **SMALL, **more)[0] for seed in range(6)], axis=0)
        return mean[dark].sum() / expected[dark].sum() - 1

    assert abs(bias()) < 0.05
    assert abs(bias(sampling=9.0, steps=PREDICTED)) < 0.01


@pytest.mark.stress
def test_small_lamps_do_not_lose_their_light():
    """The 900 lamps of the hall are local, and few traced rows are near a lamp."""
    file = SceneFile(str(ROOT / "scenes" / "hall.xml"), {"integrator": "path"})
    file.set_width(48)
    scene, settings, found, expected = file.load(), {"max_depth": 2, "emitter_samples": 1}, 0, 0
    for seed in range(3):
        image, statistics = rendered(scene, 1, seed, **settings, alpha=0.0)
        expected += render(scene, "vpl", 1, seed, **settings).sum()
        found += image.sum()
        # A lamp without lit samples shares no column
        assert statistics["cut_size"] > 700 * image[..., 0].size
    assert abs(found / expected - 1) < 0.02


def test_each_step_does_its_part(shadows, monkeypatch):
    monkeypatch.setattr(matrix_recovery, "DENSITY", 0.1)
    expected = render(shadows, "vpl", 1, **SMALL)
    everything, all_found = rendered(shadows, 1, **SMALL)
    without_correction, found = rendered(shadows, 1, **SMALL, steps=f"{PREDICTED},separation")
    assert found["correction_rays"] == 0 < all_found["correction_rays"]
    assert dark_error(everything, expected) < 0.8 * dark_error(without_correction, expected)
    plain, found = rendered(shadows, 1, **SMALL, steps=PREDICTED)
    assert found["correction_rays"] == 0 and not np.array_equal(plain, without_correction)
    blind, found = rendered(shadows, 1, **SMALL, steps="")
    # What is not predicted is taken to arrive
    assert found["prediction_rays"] == found["nearest_columns"] == 0 and dark_error(blind, expected) > 1


@pytest.mark.parametrize("kind", ["nearest", "linear", "bayes"])
def test_every_predictor_alone_sees_most_shadows(shadows, kind):
    expected = render(shadows, "vpl", 1, **SMALL)
    image, found = rendered(shadows, 1, **SMALL, steps=kind)
    blind, _ = rendered(shadows, 1, **SMALL, steps="")
    assert dark_error(image, expected) < 0.3 * dark_error(blind, expected)
    others = {"nearest", "linear", "bayes"} - {kind}
    assert found[f"{kind}_columns"] > 0 and all(found[f"{other}_columns"] == 0 for other in others)


def test_light_can_be_separated_as_in_the_paper(shadows, monkeypatch):
    _, usual_found = rendered(shadows, 1, **SMALL)
    monkeypatch.setattr(matrix_recovery, "whole_entries", light_of_entries)
    image, found = rendered(shadows, 1, **SMALL)
    assert found["correction_rays"] != usual_found["correction_rays"]
    assert (image >= 0).all() and dark_error(image, render(shadows, "vpl", 1, **SMALL)) < 1


def test_a_slice_that_fails_is_traced_whole_and_counted(shadows, monkeypatch):
    def fails(whole, free, weight, shape, limits, seed):
        ones, none = np.ones(shape[0], int), np.ones(shape[0], bool)
        return Separation(dr.full(mi.Float, np.nan, int(np.prod(shape))), ones, ones, none, [])

    monkeypatch.setattr(matrix_recovery, "separate", fails)
    settings = SMALL | {"steps": f"{PREDICTED},separation"}
    image, found = rendered(shadows, 1, **settings)
    assert found["failed_slices"] > 0 and found["correction_rays"] > 0
    monkeypatch.undo()
    # Each row of each column with different entries
    traced, _ = rendered(shadows, 1, **SMALL, sampling=9.0, steps=PREDICTED)
    assert relative_error(image, traced) < 0.01


@pytest.mark.parametrize("case", ["dark", "open", "closed", "one pixel", "one light"])
def test_slices_where_nothing_or_everything_arrives(case):
    size = 1 if case == "one pixel" else 16
    lamp = {"type": "point", "position": [0, 0, 3], "intensity": {"type": "rgb", "value": 5.0}}
    scene = {"type": "scene", "sensor": sensor(size), "floor": wall([0, 0, 0], [0, 1, 0], 0, 3.0), "lamp": lamp}
    if case == "closed":
        scene["lid"] = wall([0, 0, 2.5], [0, 1, 0], 0, 3.0)
        scene["sensor"]["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 2.2], [0, 0, 0], [0, 1, 0])
    settings = SMALL | {"vpl_count": 1 if case == "one light" else 500, "max_depth": 1 if case == "dark" else 3}
    scene = mi.load_dict(scene)
    expected = render(scene, "vpl", 1, **settings)
    image, _ = rendered(scene, 1, **settings)
    assert np.isfinite(image).all()
    if case in ("dark", "closed"):
        assert image.max() == 0
    else:
        assert relative_error(image, expected) < 0.02


def test_the_same_seed_gives_the_same_image(shadows):
    first, second = (rendered(shadows, 2, 3, **SMALL)[0] for _ in range(2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, rendered(shadows, 2, 4, **SMALL)[0])


@pytest.mark.stress
def test_blocks_of_slices_and_chunks_of_entries_change_nothing(shadows, monkeypatch):
    from integrators import matrixrecovery

    settings = SMALL | EXACT | {"slice_rows": 100, "steps": PREDICTED, "vpl_count": 300}
    expected, _ = rendered(shadows, 1, **settings)
    monkeypatch.setattr(matrixrecovery, "ENTRIES", 50_000)
    assert np.array_equal(rendered(shadows, 1, **settings)[0], expected)
    monkeypatch.setattr(matrixrecovery, "_SLICES", 5)
    assert np.allclose(rendered(shadows, 1, **settings)[0], expected, rtol=1e-4)


def test_slices_have_no_more_columns_than_allowed(shadows):
    plugin = mi.load_dict({"type": NAME, **SMALL, "max_columns": 10, "aovs": "cut_size"})
    image = render(shadows, plugin, 1)
    assert 0 < image[..., -1].max() <= 10


def test_a_render_stops_between_blocks_of_slices(monkeypatch, shadows):
    from integrators import matrixrecovery

    monkeypatch.setattr(matrixrecovery, "ENTRIES", 50_000)
    plugin, asked = mi.load_dict({"type": NAME, **SMALL}), []
    monkeypatch.setattr(type(plugin), "should_stop", lambda self: asked.append(1) or len(asked) > 2)
    assert (render(shadows, plugin, 1) == 0).all(-1).any()


def test_normals_that_are_no_numbers_do_not_spoil_their_slice():
    position = np.random.default_rng(0).random((60, 3)).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (60, 1))
    normal[7] = np.nan
    clusters = PointClusters(batch_of(position, normal), lambda p, n: build_row_slices(np.arange(60), 100, p, n))
    rows = MatrixRows(clusters, np.arange(60), 0)
    assert all(np.isfinite(download(side)).all() for side in rows.places)


def test_masks_are_predicted_on_average():
    mask = {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse"}}
    veil = wall([0, 0.4, 0], [1, 0, 0], -90, 0.55, bsdf=mask)
    scene = mi.load_dict(closed_box({"lamp": area_light()}, size=24, veil=veil))
    expected = render(scene, "vpl", 1, **SMALL)
    for kind in ("nearest", "linear", "bayes"):
        image, _ = rendered(scene, 1, **SMALL, steps=kind)
        assert image.sum() == pytest.approx(expected.sum(), rel=0.03)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("slice_rows", 0), ("slice_rows", 65537), ("initial_columns", 0), ("max_columns", 0), ("alpha", -0.1),
        ("sampling", 0.0), ("prediction_error", -1.0), ("rounds", 0), ("steps", "nearest,wrong"),
        ("steps", "nearest,nearest"), ("steps", True),
    ],
)  # fmt: skip
def test_bad_properties_are_refused(name, value):
    assert_property_is_refused(NAME, name, value)


def test_properties_are_shown():
    assert_properties_are_shown(NAME, {"slice_rows": 512, "alpha": 0.01, "steps": "linear,separation"})
