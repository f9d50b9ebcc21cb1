"""Slices of a bounded number of pixels, and the order of their samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.properties import examples, unit_vectors
from vpl.matrix.reduced_columns import _nearby
from vpl.points.slice_rows import build_row_slices, golden_steps, rows_of, tangent_places


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
