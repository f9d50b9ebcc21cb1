"""The integrator ``matrixrecovery``: slices, columns, predictors, separation, and images against ``vpl``."""

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.separated_light import light_of_entries
from comparison.scene_files import SceneFile
from tests.support.pairs import batch_of
from tests.support.paths import ROOT
from tests.support.properties import assert_properties_are_shown, assert_property_is_refused, examples, unit_vectors
from tests.support.rendering import render, render_with_statistics
from tests.support.rooms import glossy_room, many_kinds
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import relative_error
from vpl.core.arrays import download, upload
from vpl.matrix import recovery as matrix_recovery
from vpl.matrix.reduced_columns import _nearby
from vpl.matrix.reduced_matrix import MatrixRows
from vpl.matrix.separation import Separation, SeparationLimits, separate, sketch
from vpl.points.point_clusters import PointClusters
from vpl.points.slice_rows import build_row_slices, golden_steps, rows_of, tangent_places

NAME = "matrixrecovery"
PREDICTED = "nearest,linear,bayes"
SMALL = {"max_depth": 4, "vpl_count": 3000, "direct": "vpl"}
# Every light a column of its own, every row traced
EXACT = {"alpha": 0.0, "max_columns": 100_000, "sampling": 9.0}

rendered = partial(render_with_statistics, NAME)


# ---- Slices of rows


@given(
    seed=st.integers(0, 2**32 - 1),
    pixels=st.integers(1, 200),
    samples=st.integers(1, 5),
    most=st.integers(1, 70),
    shape=st.sampled_from(["spread", "one place", "line", "one far away"]),
)
@settings(max_examples=examples(60), deadline=None)
def test_every_point_is_in_one_slice_whose_rows_are_few_enough_and_whole(seed, pixels, samples, most, shape):
    rng = np.random.default_rng(seed)
    pixel = rng.permutation(np.repeat(np.arange(pixels), samples))
    position, normal = rng.random((len(pixel), 3)).astype(np.float32), unit_vectors(rng, len(pixel))
    if shape == "one place":
        position[:], normal[:] = position[0], normal[0]
    elif shape == "line":
        position[:, 1:] = 0
    elif shape == "one far away":
        position[0] = 1e6
    tree = build_row_slices(pixel, most, position, normal)
    assert np.array_equal(np.sort(tree.order), np.arange(len(pixel)))
    leaves = tree.leaves
    assert np.array_equal(tree.first[leaves], np.cumsum(tree.count[leaves]) - tree.count[leaves])
    begin = rows_of(pixel[tree.order], tree.leaf)
    for leaf in leaves:
        inside = pixel[tree.order][tree.leaf == leaf]
        rows = np.flatnonzero((begin[:-1] >= tree.first[leaf]) & (begin[:-1] < tree.first[leaf] + tree.count[leaf]))
        assert len(rows) == len(np.unique(inside)) <= most


def test_slices_that_must_be_divided_are_halved():
    rng = np.random.default_rng(0)
    position = rng.random((4096, 3)).astype(np.float32)
    tree = build_row_slices(np.arange(4096), 100, position, np.tile(np.float32([0, 0, 1]), (4096, 1)))
    assert (tree.count[tree.leaves] == 64).all()


def test_bad_row_slices_are_refused_by_name():
    position, normal = np.zeros((3, 3), np.float32), np.tile(np.float32([0, 0, 1]), (3, 1))
    with pytest.raises(ValueError, match="most must be at least 1, got 0"):
        build_row_slices(np.arange(3), 0, position, normal)
    position[1, 2] = np.inf
    with pytest.raises(ValueError, match="position must be finite, but row 1"):
        build_row_slices(np.arange(3), 2, position, normal)


def test_places_in_the_plane_of_a_slice_keep_distances():
    rng = np.random.default_rng(1)
    position = rng.random((50, 3))
    position[:, 0] = 3
    places = tangent_places(position, np.tile([1.0, 0, 0], (50, 1)), np.array([0]), np.zeros(50, int))
    extent = (position[:, 1:].max(0) - position[:, 1:].min(0)).max()
    between = np.linalg.norm(position[:, None] - position, axis=2) / extent
    assert np.allclose(np.linalg.norm(places[:, :, None] - places[:, None], axis=0), between, atol=1e-9)
    assert places.min() == 0 and places.max() == pytest.approx(1)


def test_steps_of_samples_visit_every_row_once():
    counts = np.arange(1, 1100)
    steps = golden_steps(counts)
    for count, step in zip(counts, steps, strict=True):
        assert len(np.unique(np.arange(count) * step % count)) == count


def test_neighbours_lend_each_other_only_within_their_segment():
    values = np.array([1.0, 5, 2, 0, 0, 7, 0, 3])
    segment = np.array([0, 0, 0, 0, 0, 1, 1, 2])
    assert _nearby(np.maximum, values, segment).tolist() == [5, 5, 5, 5, 2, 7, 7, 3]
    assert _nearby(np.add, values, segment).tolist() == [8, 8, 8, 7, 2, 7, 7, 3]


# ---- Separation


def planted(seed, shape, rank, errors):
    """Visibility of low rank: (what it is, the same with a share of entries wrong)."""
    rng = np.random.default_rng(seed)
    count, n, m = shape
    columns = rng.random((count, n, rank)).argmax(2)
    patterns = rng.random((count, rank, m)) < 0.6
    true = np.take_along_axis(patterns, columns[:, :, None], 1).astype(np.float32)
    wrong = rng.random(shape) < errors
    return true, np.where(wrong, 1 - true, true)


def separated(matrices, free=None, weight=None, **limits):
    """Z and the rest of what is found, for matrices (s, n, m)."""
    matrices = np.asarray(matrices, np.float32)
    free = np.ones(matrices.shape, bool) if free is None else free
    weight = np.ones_like(matrices) if weight is None else weight
    mask = upload(mi.UInt32, free) == 1
    arrays = [upload(mi.Float, values) for values in (matrices, weight)]
    dr.eval(mask)
    found = separate(arrays[0], mask, arrays[1], matrices.shape, SeparationLimits(**limits))
    return download(found.error).reshape(matrices.shape), found


def test_sparse_errors_are_told_from_low_rank():
    true, wrong = planted(0, (3, 60, 90), 4, 0.04)
    error, found = separated(wrong, residual=0.01, progress=-1.0, relative=0.12)
    assert not found.failed.any() and (found.rank == 4).all()
    corrected = wrong - np.round(error)
    assert (corrected != true).mean() < 0.1 * (wrong != true).mean()


def test_entries_that_were_traced_are_never_wrong():
    _, wrong = planted(1, (2, 40, 50), 3, 0.05)
    free = np.random.default_rng(2).random(wrong.shape) < 0.5
    error, _ = separated(wrong, free)
    assert (error[~free] == 0).all() and (error[free] != 0).any()


def test_errors_are_of_the_sign_and_size_that_entries_allow():
    _, wrong = planted(3, (2, 40, 50), 3, 0.1)
    weight = np.random.default_rng(4).random(wrong.shape).astype(np.float32) * 5
    error, _ = separated(wrong * weight, None, weight)
    rest = wrong * weight - error
    assert (rest > -1e-4).all() and (rest < weight + 1e-4).all()


def test_the_sketch_has_the_leading_singular_values():
    rng = np.random.default_rng(5)
    matrix = (rng.random((80, 6)) @ rng.random((6, 120)) + 1e-3 * rng.random((80, 120))).astype(np.float32)
    values, vectors = sketch(matrix, rng.standard_normal((120, 14)).astype(np.float32))
    exact = np.linalg.svd(matrix, compute_uv=False)
    assert np.allclose(values[:4], exact[:4], rtol=1e-2)
    assert np.allclose(np.linalg.norm(vectors, axis=1)[:4], values[:4], rtol=1e-3)


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 30), (2, 30, 1), (3, 2, 2), (1, 50, 40)])
@pytest.mark.parametrize("kind", ["zero", "one", "random", "single", "bright", "no weight", "rank one"])
def test_hostile_matrices_stay_finite(shape, kind):
    rng = np.random.default_rng(6)
    matrices = {
        "zero": np.zeros(shape), "one": np.ones(shape), "random": rng.random(shape).round(),
        "single": np.zeros(shape), "bright": rng.random(shape), "no weight": rng.random(shape).round(),
        "rank one": rng.random((shape[0], shape[1], 1)) * rng.random((shape[0], 1, shape[2])),
    }[kind]  # fmt: skip
    weight = np.ones(shape)
    if kind in ("single", "bright"):
        matrices[0, 0, 0] = 1e12 if kind == "bright" else 1
    if kind == "no weight":
        # One over E is infinite here
        weight[:, :, ::2] = 0
        matrices *= weight
    error, found = separated(matrices, None, np.maximum(weight, matrices))
    assert np.isfinite(error).all() and len(found.residual) <= 20
    assert (error[weight == 0] == 0).all()
    if kind in ("zero", "one"):
        assert not found.failed.any() and np.abs(error).max() < 1e-3


def test_values_that_are_not_finite_make_their_matrix_fail_alone():
    _, wrong = planted(7, (3, 30, 40), 3, 0.05)
    wrong[1, 4, 5] = np.nan
    _, found = separated(wrong)
    assert found.failed.tolist() == [False, True, False]


# ---- Images


def scenes():
    room = closed_box({"lamp": area_light()}, size=24)
    return {
        "room": mi.load_dict(room),
        "kinds": mi.load_dict(many_kinds()),
        "gloss": glossy_room(),
    }


@pytest.mark.parametrize("name", ["room", "kinds", "gloss"])
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


def test_the_bias_of_prediction_is_small_and_falls_with_sampling(shadows):
    """With the same seeds, and so the same lights; clusters alone have none."""
    expected = np.mean([render(shadows, "vpl", 1, seed, **SMALL) for seed in range(6)], axis=0)
    dark = expected < np.quantile(expected, 0.9)

    def bias(**more):
        mean = np.mean([rendered(shadows, 1, seed, **SMALL, **more)[0] for seed in range(6)], axis=0)
        return mean[dark].sum() / expected[dark].sum() - 1

    assert abs(bias()) < 0.05
    assert abs(bias(sampling=9.0, steps=PREDICTED)) < 0.01


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
