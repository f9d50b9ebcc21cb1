"""Slices of gather points by position and normal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.pairs import batch_of
from tests.support.properties import examples, unit_vectors
from vpl.points.point_clusters import PointClusters
from vpl.points.slices import build_slices


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 400),
    slices=st.integers(1, 90),
    shape=st.sampled_from(["spread", "one place", "two places", "line", "tiny differences", "one far away"]),
    scale=st.sampled_from([1e-30, 1e-4, 1.0, 1e4, 1e30]),
)
@settings(max_examples=examples(80), deadline=None)
def test_every_point_is_in_one_slice_and_there_are_as_many_as_asked_for(seed, count, slices, shape, scale):
    rng = np.random.default_rng(seed)
    position, normal = rng.random((count, 3)), unit_vectors(rng, count)
    if shape in ("one place", "two places"):
        position = np.zeros((count, 3)) + (shape == "two places") * rng.integers(0, 2, (count, 1))
        normal[:] = normal[0]
    elif shape == "line":
        position[:, 1:] = 0
    elif shape == "tiny differences":
        position = 1 + rng.integers(0, 3, (count, 3)) * 2.0**-23
    elif shape == "one far away":
        position[0] = 1e6
    position = (position * scale).astype(np.float32)
    tree = build_slices(position, normal, slices)
    assert np.array_equal(np.sort(tree.order), np.arange(count))
    leaves = tree.leaves
    different = len(np.unique(np.concatenate([position, normal], axis=1), axis=0))
    assert len(leaves) == min(slices, different)
    assert (tree.count[leaves] > 0).all() and tree.count[leaves].sum() == count
    assert np.array_equal(tree.first[leaves], np.cumsum(tree.count[leaves]) - tree.count[leaves])
    inner = np.flatnonzero(tree.child)
    assert np.array_equal(tree.count[inner], tree.count[tree.child[inner]] + tree.count[tree.child[inner] + 1])
    assert np.array_equal(tree.parent[tree.child[inner]], inner)
    assert (np.diff(tree.child[inner].astype(int)) == 2).all()


def test_slices_do_not_mix_what_faces_away_from_each_other():
    rng = np.random.default_rng(0)
    facing = np.repeat(np.float32([[1, 0, 0], [0, 0, 1], [0, 0, -1]]), 200, axis=0)
    position = rng.random((600, 3)).astype(np.float32) * np.float32([1, 0, 0])
    tree = build_slices(position, facing, 32)
    assert all(len(np.unique(facing[tree.order[tree.leaf == leaf]], axis=0)) == 1 for leaf in tree.leaves)


def test_points_of_a_slice_can_be_ranked():
    rng = np.random.default_rng(0)
    rank = rng.integers(0, 4, 500)
    tree = build_slices(rng.random((500, 3)).astype(np.float32), unit_vectors(rng, 500), 9, rank=rank)
    assert all((np.diff(rank[tree.order[tree.leaf == leaf]]) >= 0).all() for leaf in tree.leaves)


def test_bad_slices_are_refused_by_name():
    position, normal = np.zeros((3, 3), np.float32), np.tile(np.float32([0, 0, 1]), (3, 1))
    with pytest.raises(ValueError, match="slices must be at least 1, got 0"):
        build_slices(position, normal, 0)
    position[1, 2] = np.nan
    with pytest.raises(ValueError, match="position must be finite, but row 1"):
        build_slices(position, normal, 2)


def test_points_that_coincide_are_one_slice():
    """Points without extent form one slice, for any requested number."""
    position, normal = np.zeros((50, 3), np.float32), np.tile(np.float32([0, 0, 1]), (50, 1))
    tree = PointClusters(batch_of(position, normal), lambda p, n: build_slices(p, n, 8)).tree
    assert tree.size == 1 and tree.count.tolist() == [50]
