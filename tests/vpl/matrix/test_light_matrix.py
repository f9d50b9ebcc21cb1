"""Columns of the light matrix: forests of columns, sampled rows, weights and costs, and drawn lights."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from tests.support.marks import stress
from tests.support.pairs import prepared
from tests.support.properties import examples
from tests.support.rooms import glossy_room
from vpl.core import arrays
from vpl.core.arrays import download, upload
from vpl.matrix import light_matrix
from vpl.matrix.column_forest import ColumnForest, split_threshold
from vpl.matrix.light_matrix import ColumnWeights, DeviceForest, NearRows, SampledRows
from vpl.matrix.slice_columns import _Chosen, _drawn_lights, fine_forest, slice_lights
from vpl.points.point_clusters import PointClusters
from vpl.points.slices import build_slices


def random_escape(rng, leaves):
    """A random binary tree in preorder, as escape indices."""

    def below(first, count):
        if count == 1:
            return [first + 1]
        left = int(rng.integers(1, count))
        return [first + 2 * count - 1, *below(first + 1, left), *below(first + 2 * left, count - left)]

    return np.array(below(0, leaves))


def costs_of(forest, columns, rng):
    """(Σ n)² − ‖Σ x‖² of every node, for columns x of a few rows."""
    values = rng.random((3, columns)) ** 4 * (rng.random(columns) < 0.7)
    sums = np.concatenate([np.zeros((3, 1)), np.cumsum(values, axis=1)], axis=1)
    norms = np.concatenate([[0], np.cumsum(np.linalg.norm(values, axis=0))])
    total = sums[:, forest.last] - sums[:, forest.first[:-1]]
    return np.maximum((norms[forest.last] - norms[forest.first[:-1]]) ** 2 - (total**2).sum(0), 0)


@given(
    seed=st.integers(0, 2**32 - 1),
    trees=st.lists(st.integers(1, 60), min_size=1, max_size=3),
    most=st.integers(0, 80),
    kind=st.sampled_from(["columns", "equal", "zero"]),
)
@settings(max_examples=examples(80), deadline=None)
def test_pruned_forests_hold_every_column_once_and_split_what_costs_most(seed, trees, most, kind):
    rng = np.random.default_rng(seed)
    forest = ColumnForest.joined([ColumnForest.of_tree(random_escape(rng, n), k) for k, n in enumerate(trees)])
    assert len(forest.columns) == sum(trees) and len(forest.roots) == len(trees)
    cost = costs_of(forest, sum(trees), rng)
    cost = {"columns": cost, "equal": np.ones(forest.size), "zero": np.zeros(forest.size)}[kind]
    pruned = forest.pruned(cost, most)
    assert len(pruned.columns) <= max(most, len(trees))
    kept = {(group, node): k for k, (group, node) in enumerate(zip(forest.group, forest.node, strict=True))}
    whole = [kept[key] for key in zip(pruned.group[pruned.columns], pruned.node[pruned.columns], strict=True)]
    assert np.array_equal(forest.first[whole], np.append(0, forest.last[whole][:-1]))
    assert forest.last[whole][-1] == sum(trees)
    if kind == "columns" and most > len(trees):
        split = [kept[key] for key in zip(pruned.group[pruned.inner], pruned.node[pruned.inner], strict=True)]
        left = np.setdiff1d(whole, forest.columns)
        assert len(split) == 0 or len(left) == 0 or cost[split].min() >= cost[left].max()
        # The largest number that fits, except for nodes of equal cost
        costliest = np.sort(cost[forest.inner])[::-1]
        worthwhile = costliest[costliest > 0][: most - len(trees)]
        first_left = costliest[most - len(trees)] if most - len(trees) < len(costliest) else 0
        assert len(split) >= np.count_nonzero(worthwhile > first_left * (1 + 1e-9))


@pytest.mark.parametrize("unit_of_radiance", [1e-30, 1.0, 1e30])
def test_splits_do_not_depend_on_the_unit_of_radiance(unit_of_radiance):
    cost = np.random.default_rng(0).random((4, 50))
    chosen = cost > split_threshold(cost, 20)[:, None]
    scaled = cost * unit_of_radiance
    assert np.array_equal(chosen, scaled > split_threshold(scaled, 20)[:, None]) and (chosen.sum(1) == 20).all()


def test_more_splits_than_columns_that_differ_end():
    assert split_threshold(np.zeros((2, 5)), 3).tolist() == [0, 0]
    assert split_threshold(np.array([[0.0, 2.0, 0.0]]), 3).tolist() == [0]
    # None of some equal ones rather than more than there is room for
    assert split_threshold(np.ones((1, 5)), 3).tolist() == [1]


def sampled(job, slices, shared=10**9):
    """Slices of a job's points, and rows at one point of each."""
    clusters = PointClusters(job.batch, lambda position, normal: build_slices(position, normal, slices))
    forest = DeviceForest(fine_forest(job.lights, shared), job.lights)
    points = clusters.tree.first[clusters.tree.leaves].astype(np.int64)
    return clusters, SampledRows(job.transport, clusters.batch, forest, points), points


def column_of_each_light(forest, every):
    """For every light along the trees, the column of a coarser forest that holds it."""
    place = {(group, node): k for k, (group, node) in enumerate(zip(every.group, every.node, strict=True))}
    whole = [place[key] for key in zip(forest.group[forest.columns], forest.node[forest.columns], strict=True)]
    return np.repeat(np.arange(len(whole)), every.last[whole] - every.first[whole])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_value_that_is_not_finite_counts_as_none(monkeypatch, bad):
    """The value spoils no row."""
    job = prepared(glossy_room(), vpl_count=100)[1][0]
    good = sampled(job, 6)[1]
    evaluate, calls = light_matrix.evaluate_pairs, []

    def spoilt(*given):
        value, traced = evaluate(*given)
        calls.append(0)
        lane = dr.arange(mi.UInt32, dr.width(value))
        return dr.select(lane == 5, mi.UnpolarizedSpectrum(bad, 0.5, 0.5), value), traced

    monkeypatch.setattr(light_matrix, "evaluate_pairs", spoilt)
    clusters, rows, _ = sampled(job, 6)
    assert calls
    near, leaves = NearRows.nearest(np.random.default_rng(0).random((6, 6)), 3), upload(mi.UInt32, clusters.tree.leaves)
    weights = ColumnWeights(rows, near, clusters, leaves, 1.0)
    assert all(np.isfinite(download(x)).all() for x in (rows.values, rows.sums, weights.cumulative, weights.cost))
    ratio = download(rows.values) / rows.scale - download(good.values) / good.scale
    assert np.count_nonzero(np.abs(ratio) > 1e-5 * np.abs(download(good.values)).max()) <= 2 * len(calls)


def test_weights_and_costs_are_what_they_are_said_to_be(monkeypatch):
    monkeypatch.setattr(arrays, "ENTRIES", 4000)  # so that there are several chunks
    job = prepared(glossy_room(), vpl_count=300, direct="vpl", direct_count=64)[1][0]
    clusters, rows, _ = sampled(job, 7)
    forest, unseen = rows.forest.forest, 0.3
    near = NearRows.nearest(np.random.default_rng(0).random((7, 6)), 3)
    weights = ColumnWeights(rows, near, clusters, upload(mi.UInt32, clusters.tree.leaves), unseen)
    values = download(rows.values).reshape(7, -1).astype(np.float64)
    assert np.isclose(values.sum(1).mean(), 1)
    sums = np.concatenate([np.zeros((7, 1)), np.cumsum(values, axis=1)], axis=1)
    sums = sums[:, forest.last] - sums[:, forest.first[:-1]]
    assert np.allclose(download(rows.sums).reshape(7, -1), sums, rtol=1e-4, atol=1e-7)
    cumulative = download(weights.cumulative)
    found = np.diff(cumulative).reshape(7, -1)
    cost = download(weights.cost).reshape(7, -1)
    for k in range(7):
        told = near.relevance[k][:, None]
        norm = np.sqrt((told * values[near.rows[k]] ** 2).sum(0))
        assert np.isclose(found[k].sum(), 1)
        extra = (1 + unseen) * norm.sum() * found[k] - norm
        assert np.isclose(extra.sum(), unseen * norm.sum(), rtol=1e-3) and (extra > -1e-6 * norm.max()).all()
        total = np.concatenate([[0], np.cumsum(found[k])])
        total = total[forest.last] - total[forest.first[:-1]]
        scale = 1 / ((1 + unseen) * norm.sum())
        expected = np.maximum(total**2 - (told * (scale * sums[near.rows[k]]) ** 2).sum(0), 0)
        assert np.allclose(cost[k], expected, rtol=1e-3, atol=1e-5 * expected.max())


@pytest.mark.parametrize(
    ("clamping", "shared", "batch"),
    [
        (0.01, 30, 0), (0.01, 10**9, 1), (0.0, 30, 1), (0.0, 10**9, 0),
        *stress((0.01, 30, 1), (0.01, 10**9, 0), (0.0, 30, 0), (0.0, 10**9, 1)),
    ],
)  # fmt: skip
def test_no_column_that_can_arrive_has_a_weight_of_zero(batch, shared, clamping):
    """Whatever rows saw: here something, and then nothing."""
    job = prepared(glossy_room(), vpl_count=300, direct="vpl", direct_count=64, clamping=clamping)[1][batch]
    clusters, rows, _ = sampled(job, 5, shared)
    every = DeviceForest(fine_forest(job.lights, 10**9), job.lights)
    near = NearRows.nearest(np.random.default_rng(0).random((5, 6)), 2)
    leaves = upload(mi.UInt32, clusters.tree.leaves)
    points = np.arange(0, clusters.count, clusters.count // 40)
    light = [
        download(SampledRows(job.transport, clusters.batch, every, points[k : k + 1]).values)
        for k in range(len(points))
    ]
    column = column_of_each_light(rows.forest.forest, every.forest)
    slice_of = np.repeat(np.arange(5), clusters.tree.count[clusters.tree.leaves])[points]
    for seen in (1.0, 0.0):
        rows.values *= seen
        rows.sums *= seen
        rows.dark = seen == 0
        weights = ColumnWeights(rows, near, clusters, leaves, 0.01)
        found = np.diff(download(weights.cumulative)).reshape(5, -1)
        assert np.isfinite(found).all()
        assert all((found[s][column[values > 0]] > 0).all() for s, values in zip(slice_of, light, strict=True))


@pytest.mark.parametrize("direct", ["nee", "vpl"])
def test_lights_are_drawn_as_often_as_their_scale_says(direct):
    """Every cluster's lights, each counted with its scale, are on average the whole cluster."""
    job = prepared(glossy_room(), vpl_count=60, direct=direct, direct_count=32)[1][0]
    clusters, rows, _ = sampled(job, 2, shared=30)
    forest, draws = rows.forest, 1 << 12
    near = NearRows.nearest(np.random.default_rng(0).random((2, 6)), 2)
    weights = ColumnWeights(rows, near, clusters, upload(mi.UInt32, clusters.tree.leaves), 0.2)
    found = _Chosen(2, max(12, len(forest.forest.roots)), draws)
    found.choose(forest, weights, 12, 0)
    found.draw_columns(forest, weights, 0, 1)
    used = np.arange(found.most) < download(found.used)[:, None]
    assert used.any(1).all()
    chosen, node = np.nonzero(used)[0], download(found.node)[used.reshape(-1)]
    column, scale = (download(x).reshape(draws, -1)[:, used.reshape(-1)] for x in (found.column, found.scale))
    weight = np.diff(download(weights.cumulative)).reshape(2, -1)
    first, last = forest.forest.first[node], forest.forest.last[node]
    assert (column >= first).all() and (column < last).all()
    for k in range(len(node)):
        inside = weight[chosen[k], first[k] : last[k]]
        count = np.bincount(column[:, k] - first[k], minlength=len(inside))
        assert (count[inside == 0] == 0).all()
        assert np.allclose(scale[:, k], inside.sum() / inside[column[:, k] - first[k]], rtol=1e-3)
        assert np.allclose(count / draws, inside / inside.sum(), atol=5 / np.sqrt(draws))


@pytest.mark.parametrize("place", [0.0, 1 - 2.0**-48, None])
def test_a_light_of_a_node_is_drawn_by_intensity(place):
    rng, job = np.random.default_rng(0), prepared(glossy_room(), vpl_count=100)[1][0]
    group, draws = max(job.lights.groups, key=lambda one: one.count), 1 << 15
    escape = download(group.tree.escape(dr.arange(mi.UInt32, group.tree.count)))
    for node in (0, 1, int(np.flatnonzero(escape == np.arange(len(escape)) + 1)[0])):
        sample = rng.random(draws) if place is None else np.full(draws, place)
        light, total = _drawn_lights(
            group.tree, dr.opaque(mi.UInt32, node, draws), upload(dr.float64_array_t(mi.Float), sample)
        )
        below = np.arange(node, escape[node])
        below = below[escape[below] == below + 1]
        inside = download(group.tree.representative(upload(mi.UInt32, below)))
        intensity = group.lights.scalar_intensity[inside]
        assert np.allclose(download(total), intensity.sum(), rtol=1e-5)
        found = np.bincount(download(light), minlength=group.count)
        assert found[inside].sum() == draws
        if place is None:
            assert np.allclose(found[inside] / draws, intensity / intensity.sum(), atol=5 / np.sqrt(draws))
        else:
            assert found[inside[0 if place == 0 else -1]] == draws


def test_near_rows_are_the_nearest_and_their_own(monkeypatch):
    monkeypatch.setattr(arrays, "ENTRIES", 300_000)  # so that there are several chunks
    places = np.random.default_rng(0).random((1100, 6))
    near = NearRows.nearest(places, 5)
    distance = cdist(places, places)
    assert np.array_equal(np.sort(near.rows, axis=1), np.sort(np.argsort(distance, axis=1)[:, :5], axis=1))
    own = near.rows == np.arange(1100)[:, None]
    assert (own.sum(1) == 1).all() and np.allclose(near.relevance[own], 1)
    assert np.allclose(np.sort(near.relevance, axis=1)[:, -2], 0.5)
    assert NearRows.nearest(np.ones((3, 6)), 9).relevance.tolist() == [[1, 1, 1]] * 3
    assert NearRows.nearest(np.ones((1, 6)), 1).rows.tolist() == [[0]]


def test_no_light_is_drawn_for_another_kind_and_all_lights_stand_for_all_of_their_kind():
    """For any cut, the expected sum of scale times intensity over a kind is the intensity of all its lights."""
    job = prepared(glossy_room(), vpl_count=60, direct="vpl", direct_count=32)[1][0]
    clusters, rows, _ = sampled(job, 2, shared=30)
    near, sets = NearRows.nearest(np.random.default_rng(0).random((2, 6)), 2), 1 << 12
    found = slice_lights(rows, near, clusters, 12, 0.2, sets, 3)
    assert [one.group.kind for one in found] == [group.kind for group in job.lights.groups]
    for one in found:
        first, last = (download(ends).astype(int) for ends in (one.first, one.last))
        light, scale = download(one.light), download(one.scale)
        inside = np.concatenate([np.arange(low, high) for low, high in zip(first, last, strict=True)]).astype(int)
        assert (light[inside] < one.group.count).all()
        total = (scale * one.group.lights.scalar_intensity[np.minimum(light, one.group.count - 1)])[inside].sum()
        assert np.isclose(total / (2 * sets), one.group.lights.scalar_intensity.sum(), rtol=0.1)
