"""Sites and groups of gather points, and bounds of groups."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.directions import DOWN, SEEDS, UP, random_unit
from tests.support.properties import examples
from vpl.direct.sites import BLOCK, bound_groups, find_groups, find_sites, normal_class

# ---- Classes and groups


def test_normal_class_is_the_face_of_a_cube():
    axes = np.repeat(np.eye(3), 2, axis=0) * np.tile([1, -1], 3)[:, None]
    assert normal_class(axes).tolist() == [0, 1, 2, 3, 4, 5]
    assert normal_class(axes.astype(np.float32)).tolist() == [0, 1, 2, 3, 4, 5]
    nearly = np.array([[0.6, -0.5, 0.5], [-0.6, 0.5, 0.5], [0.5, 0.6, -0.5], [-0.5, -0.6, 0.5], [0.1, 0.2, 0.9]])
    assert normal_class(nearly).tolist() == [0, 1, 2, 3, 4]


def test_ties_between_axes_go_to_the_first():
    ties = np.array([[1, 1, 1], [-1, 1, 1], [0, -1, 1], [0, 1, -1], [1, 0, -1], [-1, -1, -1.0]])
    assert normal_class(ties).tolist() == [0, 1, 3, 2, 0, 1]


def pixels(width, height, samples):
    """Pixel and position of every sample, on a plane of one unit per pixel, samples on a regular grid: (n, 2)."""
    side = int(np.sqrt(samples))
    pixel = np.repeat(np.arange(width * height), side * side)
    inner = (np.tile(np.arange(side * side), width * height)[:, None] // (1, side) % side + 0.5) / side
    return pixel, np.stack([pixel % width, pixel // width], 1) + inner


def refines(fine, coarse):
    """Whether every part of one partition lies in one part of another."""
    return len(np.unique(np.stack([fine, coarse], 1), axis=0)) == len(np.unique(fine))


def same_partition(a, b):
    return refines(a, b) and refines(b, a)


@pytest.mark.parametrize(("width", "height"), [(8, 8), (9, 7), (20, 17), (3, 40)])
def test_groups_of_a_plane_are_blocks_times_classes(width, height):
    pixel, plane = pixels(width, height, 16)
    position = np.column_stack([plane, 0.3 * plane[:, 0]])
    normal = np.where((np.arange(len(pixel)) % 2 == 0)[:, None], (0.1, 0.2, 0.9), (0.1, -0.9, 0.2))
    group = find_groups(pixel, width, position, normal)
    x, y = pixel % width // BLOCK, pixel // width // BLOCK
    expected = (x + 1000 * y) * 6 + normal_class(normal)
    assert same_partition(group, expected)
    assert np.array_equal(np.unique(group), np.arange(len(np.unique(expected))))


@given(seed=SEEDS, width=st.integers(1, 40), count=st.integers(1, 400), scale=st.sampled_from([1e-6, 1.0, 1e6]))
@settings(max_examples=examples(60), deadline=None)
def test_groups_never_mix_blocks_or_classes(seed, width, count, scale):
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, 40 * width, count)
    normal = random_unit(rng, count).astype(np.float32)
    position = (scale * rng.normal(size=(count, 3)) ** 3).astype(np.float32)
    group = find_groups(pixel, width, position, normal)
    assert group.shape == (count,)
    assert np.array_equal(np.unique(group), np.arange(group.max() + 1))
    block = pixel % width // BLOCK + 1000 * (pixel // width // BLOCK)
    assert refines(group, block * 6 + normal_class(normal))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("walls", [1, 2, 3])
def test_parallel_walls_far_apart_are_groups_of_their_own(axis, walls):
    rng = np.random.default_rng(axis)
    pixel, plane = pixels(8, 8, 16)
    which = rng.integers(0, walls, len(pixel))
    position = np.roll(np.column_stack([plane, 100.0 * which]), axis + 1, axis=1)
    normal = np.roll(np.tile(UP, (len(pixel), 1)), axis + 1, axis=1)
    assert same_partition(find_groups(pixel, 8, position, normal), which)


def test_a_step_much_smaller_than_the_group_does_not_divide_it():
    pixel, plane = pixels(8, 8, 16)
    position = np.column_stack([plane, (plane[:, 0] > 4) * 1.0])
    assert find_groups(pixel, 8, position, np.tile(UP, (len(pixel), 1))).max() == 0


@given(seed=SEEDS)
@settings(max_examples=examples(30), deadline=None)
def test_tilted_planes_are_not_divided(seed):
    rng = np.random.default_rng(seed)
    pixel, plane = pixels(8, 8, 16)
    along, across = random_unit(rng, 2)
    position = (plane[:, :1] * along + plane[:, 1:] * across + rng.normal(size=3)).astype(np.float32)
    normal = np.tile(np.cross(along, across), (len(pixel), 1))
    assert find_groups(pixel, 8, position, normal).max() == 0


def test_coincident_points_are_one_group_and_one_point_is_a_group():
    pixel = np.arange(64)
    position, normal = np.ones((64, 3), np.float32), np.tile(UP, (64, 1))
    assert find_groups(pixel, 8, position, normal).max() == 0
    assert find_groups(np.array([77]), 10, position[:1], normal[:1]).tolist() == [0]


# ---- Sites


@given(seed=SEEDS, count=st.integers(1, 300), groups=st.integers(1, 20), size=st.sampled_from([1, 10, 10**8]))
@settings(max_examples=examples(60), deadline=None)
def test_sites_are_the_pairs_of_group_and_pixel(seed, count, groups, size):
    rng = np.random.default_rng(seed)
    group = np.unique(rng.integers(0, groups, count), return_inverse=True)[1]
    pixel = rng.integers(0, size, count)
    sites = find_sites(group, pixel)
    assert np.array_equal(sites.group[sites.point_site], group)
    assert np.array_equal(sites.pixel[sites.point_site], pixel)
    pairs = np.stack([sites.group, sites.pixel], 1).tolist()
    assert pairs == sorted(pairs)
    assert len(set(map(tuple, pairs))) == sites.count == len(set(zip(group.tolist(), pixel.tolist(), strict=True)))
    assert sorted(sites.order.tolist()) == list(range(count))
    assert sites.first[0] == 0
    assert sites.first[-1] == count
    assert (sites.points >= 1).all()
    for site in range(sites.count):
        members = sites.order[sites.first[site] : sites.first[site + 1]]
        assert (sites.point_site[members] == site).all()
    assert len(sites.group_first) == group.max() + 2
    assert sites.group_first[-1] == sites.count
    for g in range(group.max() + 1):
        assert (sites.group[sites.group_first[g] : sites.group_first[g + 1]] == g).all()
        assert sites.group_first[g] < sites.group_first[g + 1]


# ---- Bounds


def bounds(group, position, normal, two_sided=None):
    group = np.asarray(group)
    sites = find_sites(group, np.arange(len(group))[::-1])
    two_sided = np.zeros(len(group), bool) if two_sided is None else np.asarray(two_sided)
    return bound_groups(sites, position, normal, two_sided)


@given(seed=SEEDS, count=st.integers(1, 200), spread=st.sampled_from([0.0, 1e-4, 0.5, 100.0]))
@settings(max_examples=examples(60), deadline=None)
def test_groups_contain_their_points_and_normals(seed, count, spread):
    rng = np.random.default_rng(seed)
    group = np.unique(rng.integers(0, 5, count), return_inverse=True)[1]
    position = (100 * rng.normal(size=(count, 3))).astype(np.float32)
    normal = random_unit(rng, 5)[group] + spread * rng.normal(size=(count, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    found = bounds(group, position, normal)
    assert found.count == group.max() + 1
    assert found.low.dtype == found.high.dtype == found.axis.dtype == found.cone_cos.dtype == np.float64
    assert np.allclose(np.linalg.norm(found.axis, axis=1), 1, atol=1e-6)
    cosine = np.einsum("ij,ij->i", normal.astype(float), found.axis[group])
    assert (cosine >= found.cone_cos[group]).all()
    for g in range(found.count):
        inside = position[group == g].astype(float)
        assert np.array_equal(found.low[g], inside.min(0))
        assert np.array_equal(found.high[g], inside.max(0))
        # The narrowest cone around this axis
        assert found.cone_cos[g] == pytest.approx(max(cosine[group == g].min(), -1), abs=3e-5)
    if spread < 1e-3:
        assert (found.cone_cos > 0.999).all()


def test_opposite_normals_fill_the_whole_cone():
    found = bounds([0, 0, 1], np.zeros((3, 3)), np.array([UP, DOWN, UP]))
    assert found.cone_cos[0] == -1
    assert np.linalg.norm(found.axis[0]) == pytest.approx(1)
    assert found.cone_cos[1] == pytest.approx(1, abs=3e-5)


def test_one_two_sided_point_opens_the_cone_of_its_group_alone():
    group = [2, 0, 1, 1, 0, 2]
    found = bounds(group, np.zeros((6, 3)), np.tile(UP, (6, 1)), [False, False, True, False, False, False])
    assert found.cone_cos[1] == -1
    assert (found.cone_cos[[0, 2]] > 0.99).all()
