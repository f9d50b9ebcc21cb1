"""The tree over gather points: structure, reductions, propagation and bounds."""

import re
from dataclasses import replace
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.properties import examples
from vpl.core.arrays import download, upload
from vpl.points.point_clusters import NodeBounds
from vpl.points.point_tree import build_point_tree, point_codes


def random_unit(rng, count):
    vector = rng.normal(size=(count, 3))
    return (vector / np.linalg.norm(vector, axis=1, keepdims=True)).astype(np.float32)


def random_points(rng, count):
    return rng.uniform(-1, 1, (count, 3)).astype(np.float32), random_unit(rng, count)


def holds(tree):
    """Whether each node holds each of the caller's points: (m, n)."""
    result = np.zeros((tree.size, len(tree.order)), bool)
    for node in range(tree.size):
        result[node, tree.order[tree.first[node] : tree.first[node] + tree.count[node]]] = True
    return result


def check_codes(codes, position, normal):
    """Assert that the cells of codes hold their points, normals first."""
    normal = normal.astype(np.float64)
    for axis in range(3):
        bits = [(codes >> np.uint64(3 * bit + axis)).astype(np.int64) & 1 for bit in range(19)]
        place = sum(bit << k for k, bit in enumerate(bits[:16]))
        facing = sum(bit << k for k, bit in enumerate(bits[16:]))
        along = np.argsort(position[:, axis], kind="stable")
        assert (np.diff(place[along]) >= 0).all(), "cells follow the positions"
        assert (np.abs((normal[:, axis] + 1) * 3.5 - (facing + 0.5)) <= 0.5 + 1e-5).all()


def check_structure(tree, position, normal, leaf_size):
    n, m = len(position), tree.size
    columns = tree.order, tree.first, tree.count, tree.child, tree.parent, tree.leaf
    assert [(column.dtype, len(column)) for column in columns] == [(np.uint32, k) for k in (n, m, m, m, m, n)]
    order, first, count, child, parent, leaf = (column.tolist() for column in columns)
    assert sorted(order) == list(range(n))
    codes = point_codes(position, normal)
    check_codes(codes, position, normal)
    words = [format(code, "063b") for code in codes[order].tolist()]
    assert words == sorted(words)
    assert (first[0], count[0], parent[0]) == (0, n, 0)
    depth, reached = [0] * m, [0]
    for node in range(m):
        a, b = child[node], child[node] + 1
        begin, end = first[node], first[node] + count[node]
        if a == 0:
            assert 1 <= count[node] <= leaf_size
            assert set(leaf[begin:end]) == {node}
            continue
        reached += [a, b]
        assert count[node] > leaf_size
        assert parent[a] == parent[b] == node
        assert (first[a], first[b], first[b] + count[b]) == (begin, begin + count[a], end)
        depth[a] = depth[b] = depth[node] + 1
        halves = set(words[begin : first[b]]), set(words[first[b] : end])
        common = next((k for k in range(63) if words[begin][k] != words[end - 1][k]), 63)
        if common == 63:
            assert abs(count[a] - count[b]) <= 1
        else:
            assert [{word[common] for word in half} for half in halves] == [{"0"}, {"1"}]
    # Every node is reached once, and siblings follow each other level by level.
    assert reached == list(range(m))
    assert depth == sorted(depth)
    assert tree.levels.tolist() == [depth.index(level) for level in range(depth[-1] + 1)] + [m]
    assert depth[-1] <= 63 + np.ceil(np.log2(n))
    leaves = tree.leaves.tolist()
    assert set(leaves) == {node for node in range(m) if child[node] == 0}
    assert [k for node in leaves for k in range(first[node], first[node] + count[node])] == list(range(n))


def check_sums(tree):
    rng, within = np.random.default_rng(tree.size), holds(tree)
    values = rng.normal(size=(len(tree.order), 3)).astype(np.float32)
    whole, flags = rng.integers(-9, 9, (len(tree.order), 2, 2)), rng.random(len(tree.order)) < 0.1
    for function, neutral in ((np.minimum, np.inf), (np.maximum, -np.inf)):
        expected = function.reduce(np.where(within[:, :, None], values, neutral), axis=1)
        assert (tree.reduce(values, function) == expected).all()
    assert (tree.reduce(whole, np.add) == np.einsum("mn,nij->mij", within.astype(int), whole)).all()
    np.testing.assert_allclose(tree.reduce(values.astype(np.float64), np.add), within @ values.astype(np.float64))
    assert (tree.reduce(flags, np.logical_or) == (within & flags).any(axis=1)).all()
    leaves = tree.leaves
    assert (tree.gather_up(tree.count[leaves], leaves, np.add) == tree.count).all()
    above = np.eye(tree.size, dtype=np.int64)
    for node in range(1, tree.size):
        above[node] += above[tree.parent[node]]
    values = rng.integers(-9, 9, (tree.size, 2))
    copy = values.copy()
    assert (tree.push_down(values) == above @ values).all()
    assert (values == copy).all()


def cones(tree, directions):
    """Axes and cosines of all nodes, found on the device."""
    columns = (upload(mi.Float, column) for column in directions[tree.order].T)
    return tuple(download(found) for found in NodeBounds(tree).cones(mi.Vector3f(*columns)))


def check_reductions(tree):
    values = np.random.default_rng(tree.size).normal(size=(len(tree.order), 3)).astype(np.float32)
    columns = mi.Vector3f(*(upload(mi.Float, column) for column in values[tree.order].T))
    for join, function in ((dr.minimum, np.minimum), (dr.maximum, np.maximum)):
        assert (download(NodeBounds(tree).reduce(columns, join)) == tree.reduce(values, function)).all()


def check_cones(tree, directions, axes, cosine):
    assert axes.dtype == cosine.dtype == np.float32
    axes, cosine = axes.astype(np.float64), cosine.astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-6)
    assert (np.abs(cosine) <= 1).all()
    within, directions = holds(tree), directions.astype(np.float64)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for vectors in (unit, directions):
        nearest = np.where(within, axes @ vectors.T, 1).min(axis=1)
        # No tolerance on this side, but that a cosine of -1 stands for the whole sphere.
        assert (cosine <= np.maximum(nearest, -1)).all()
    mean = within @ unit / tree.count[:, None]
    length = np.linalg.norm(mean, axis=1)
    assert (np.einsum("ij,ij->i", mean, axes) >= length * (1 - 1e-6))[length > 0.01].all()
    # Conversely, cones are as wide as their vectors or the cones of their children need.
    leaf = tree.child == 0
    nearest = np.where(within, axes @ unit.T, 1).min(axis=1)
    assert (cosine >= nearest - 1e-6)[leaf].all()
    reach = np.zeros((2, tree.size))
    for side, child in enumerate((tree.child, (tree.child + 1) % tree.size)):
        between = np.arccos(np.clip(np.einsum("ij,ij->i", axes, axes[child]), -1, 1))
        reach[side] = np.minimum(between + np.arccos(cosine[child]), np.pi)
    # The angle between axes in single precision is off by up to 4e-4 where it is small
    assert (cosine >= np.cos(reach.max(axis=0)) - 1e-3)[~leaf].all()


def build_checked(position, normal, leaf_size=8):
    """Build a tree and assert every invariant of it."""
    tree = build_point_tree(position, normal, leaf_size)
    check_structure(tree, position, normal, leaf_size)
    check_sums(tree)
    check_reductions(tree)
    check_cones(tree, normal, *cones(tree, normal))
    return tree


@st.composite
def hostile_points(draw):
    """Coincident, flat or distant points, with many, few, or almost equal normals."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.one_of(st.integers(1, 8), st.integers(9, 60)))
    position, normal = random_points(rng, count)
    position = np.round(position * np.float32(draw(st.sampled_from([0, 1, 3, 2**24]))))
    position[:, : draw(st.integers(0, 3))] = draw(st.sampled_from([0.0, -7.5]))
    position *= np.float32(draw(st.sampled_from([1e-30, 1e-4, 1.0, 1e4, 1e18])))
    position += np.float32(draw(st.sampled_from([0.0, 100.0, -1e6])))
    match draw(st.sampled_from(["any", "walls", "parallel", "balanced", "curved"])):
        case "walls":
            normal = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1, 1], (count, 1))
            normal = (normal + rng.uniform(-1e-7, 1e-7, (count, 3))).astype(np.float32)
        case "parallel":
            normal[:] = normal[0] * rng.choice([draw(st.sampled_from([-1, 1])), 1], (count, 1))
        case "balanced":
            normal[1::2] = -normal[::2][: count // 2]
        case "curved":
            normal = normal[rng.integers(0, min(4, count), count)] + rng.normal(size=(count, 3)) * 3e-4
            normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    return position, normal, draw(st.sampled_from([1, 2, 8, 1000]))


@given(hostile_points())
@settings(max_examples=examples(300), deadline=None)
def test_every_invariant_holds_for_hostile_points(points):
    build_checked(*points)


@pytest.mark.parametrize(("count", "leaf_size"), [(1, 1), (2, 1), (3, 2), (8, 8), (9, 8), (400, 1), (700, 8), (9, 99)])
def test_sizes_around_the_smallest_and_the_leaf(count, leaf_size):
    tree = build_checked(*random_points(np.random.default_rng(count), count), leaf_size)
    assert (tree.size == 1) == (count <= leaf_size)


@pytest.mark.parametrize("column", ["order", "first", "count", "child", "parent", "levels", "leaf", "cosine"])
def test_the_checker_notices_corruption(column):
    position, normal = random_points(np.random.default_rng(0), 100)
    tree = build_point_tree(position, normal)
    axes, cosine = cones(tree, normal)
    values = cosine if column == "cosine" else getattr(tree, column)
    step = 1e-6 if column == "cosine" else 1
    for entry, change in product((len(values) // 2, len(values) - 1), (step, -1000 * step)):
        corrupted = values.copy()
        corrupted[entry] += np.array(change).astype(values.dtype)
        with pytest.raises((AssertionError, IndexError)):
            if column == "cosine":
                check_cones(tree, normal, axes, corrupted)
            else:
                check_structure(replace(tree, **{column: corrupted}), position, normal, 8)
    with pytest.raises(AssertionError):
        check_structure(replace(tree, order=tree.order[::-1]), position, normal, 8)


@pytest.mark.parametrize("leaf_size", [1, 8])
def test_each_wall_is_one_subtree_in_spite_of_the_rounding_of_its_normals(leaf_size):
    rng = np.random.default_rng(1)
    wall = np.repeat(np.arange(6), 60)
    normal = np.concatenate([np.eye(3), -np.eye(3)])[wall] + rng.uniform(-1e-7, 1e-7, (360, 3))
    tree = build_checked(random_points(rng, 360)[0], normal.astype(np.float32), leaf_size)
    for k in range(6):
        assert (holds(tree) == (wall == k)).all(axis=1).any()


@pytest.mark.parametrize("spread", [0, 1e4])
def test_points_are_parted_by_their_normals_wherever_they_are(spread):
    normal = np.array([corner for corner in product((-1, 0, 1), repeat=3) if any(corner)], np.float64)
    normal = np.tile(normal / np.linalg.norm(normal, axis=1, keepdims=True), (8, 1)).astype(np.float32)
    position = np.random.default_rng(2).choice([-1, 1], normal.shape).astype(np.float32)
    tree = build_checked(spread * position, normal, 8)
    for leaf in holds(tree)[tree.leaves]:
        assert (normal[leaf] == normal[leaf][0]).all()


@pytest.mark.parametrize("seed", range(5))
def test_cones_of_identical_normals_keep_their_axis(seed):
    rng = np.random.default_rng(seed)
    position, normal = rng.random((100, 3)).astype(np.float32), np.repeat(random_unit(rng, 1), 100, axis=0)
    axes, cosine = cones(build_checked(position, normal, 1), normal)
    np.testing.assert_allclose(axes, np.float64(normal[0]) + 0 * axes, atol=2e-7)
    assert (cosine > 1 - 1e-6).all()


@pytest.mark.parametrize("star", [[[0, 1]], [[0, 1], [1, 0]], [[0, -1], [0.75**0.5, 0.5], [-(0.75**0.5), 0.5]]])
def test_cones_of_normals_that_cancel_are_finite_and_hold_them(star):
    star = np.concatenate([star, -np.array(star)])
    for axis, leaf_size in product(range(3), (1, 4, 100)):
        normal = np.insert(np.tile(star, (10, 1)), axis, 0, axis=1).astype(np.float32)
        tree = build_checked(np.zeros_like(normal), normal, leaf_size)
        assert cones(tree, normal)[1][0] < 0.01


@pytest.mark.parametrize("seed", range(5))
def test_cones_hold_normals_that_rounding_made_too_long(seed):
    """The arc cosine of a product that is too great by 1e-7 is too small an angle by up to 4e-4."""
    normal = 3**-0.5 + 1e-4 * np.random.default_rng(seed).normal(size=(3000, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    longest = normal[np.argsort(-np.linalg.norm(normal.astype(np.float64), axis=1))[:8]]
    normal = np.concatenate([longest, np.tile(np.float32([0, 0, 1]), (8, 1))])
    build_checked(np.zeros_like(normal), normal, 8)


@pytest.mark.parametrize("leaf_size", [1, 8])
def test_coincident_points_make_a_balanced_tree(leaf_size):
    one = np.tile(np.float32([0, 0.6, 0.8]), (512, 1))
    tree = build_checked(7 * one, one, leaf_size)
    assert (tree.count[tree.child == 0] == leaf_size).all()
    assert len(tree.levels) - 2 == np.log2(512 // leaf_size)


@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 3, 0], [0, 1, 1], [1, 2, 3]])
def test_collinear_points_stay_in_order(direction):
    along = np.random.default_rng(3).permutation(300)
    position = np.outer(along, direction).astype(np.float32)
    tree = build_checked(position, np.tile(np.float32([0, 0, 1]), (300, 1)))
    assert along[tree.order].tolist() == list(range(300))


@pytest.mark.parametrize("axis", range(3))
def test_coplanar_points_are_halved_along_one_side_after_the_other(axis):
    side = np.indices((8, 8)).reshape(2, -1).T
    position = np.insert(side, axis, 5, axis=1).astype(np.float32)
    tree = build_checked(position, np.tile(np.float32([1, 0, 0]), (64, 1)), 1)
    for node in holds(tree):
        width, height = sorted(np.ptp(side[node], axis=0) + 1)
        assert width * height == node.sum()
        assert height <= 2 * width


@pytest.mark.parametrize(
    ("power", "offset"), [(-100, 0), (-13, 0), (13, 0), (100, 0), (0, [4096, 0, 0]), (0, [-8000, 77, 4096])]
)
def test_neither_the_unit_of_length_nor_the_origin_matters(power, offset):
    rng = np.random.default_rng(4)
    position, normal = rng.integers(0, 1024, (200, 3)).astype(np.float32) / 1024, random_unit(rng, 200)
    moved = position * np.float32(2.0**power) + np.float32(offset)  # exact in single precision
    tree, other = build_checked(position, normal, 2), build_checked(moved, normal, 2)
    for column in ("order", "first", "count", "child"):
        assert (getattr(tree, column) == getattr(other, column)).all()


POSITION, NORMAL = random_points(np.random.default_rng(0), 5)


@pytest.mark.parametrize(
    ("position", "normal", "leaf_size", "message"),
    [
        (np.where(POSITION == POSITION[2], np.nan, POSITION), NORMAL, 8, "position must be finite, but row 2"),
        (POSITION, np.where(NORMAL == NORMAL[4], np.inf, NORMAL), 8, "normal must be finite, but row 4"),
        (POSITION[:, :2], NORMAL, 8, "position must have the shape (n, 3)"),
        (POSITION, NORMAL[:, :2], 8, "normal must have the shape (n, 3)"),
        (POSITION, NORMAL[:4], 8, "normal must have the shape (n, 3)"),
        (POSITION[:0], NORMAL[:0], 8, "position must have the shape (n, 3) with one n > 0 for both, got (0, 3)"),
        (POSITION, NORMAL, 0, "leaf_size must be at least 1, got 0"),
    ],
)
def test_bad_points_are_refused_by_name(position, normal, leaf_size, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        build_point_tree(position, normal, leaf_size)
