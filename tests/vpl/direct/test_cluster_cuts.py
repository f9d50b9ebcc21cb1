"""Cuts of groups of points through the light clusters, against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.directions import DOWN, SEEDS, UP, around, random_unit
from tests.support.properties import examples
from vpl.direct.cluster_cuts import GroupCuts, PointGroups, cut_clusters, has_wide_source
from vpl.direct.emitter_clusters import build_cluster_forest
from vpl.direct.sources import Nodes


def nodes_of(center, radius, axis, cone_cos, infinite_axis=(), infinite_cos=(), intensity=1.0):
    """Nodes over sources at finite positions and at infinity, numbered like :class:`vpl.direct.sources.Sources`."""
    count = len(radius)
    forest = build_cluster_forest(
        np.reshape(center, (count, 3)), radius, np.reshape(axis, (count, 3)), cone_cos, np.full(count, intensity)
    )
    more = len(infinite_cos)
    size, nothing = len(forest.radius), np.zeros((more, 3))
    ranks = (count + np.arange(more)).astype(np.uint32)
    joined = [
        (forest.center, nothing), (forest.radius, -np.ones(more)),
        (forest.axis, np.reshape(infinite_axis, (more, 3))), (forest.cone_cos, np.asarray(infinite_cos, float)),
        (forest.intensity, np.ones(more)), (forest.centroid, nothing),
        (forest.escape, (size + np.arange(more) + 1).astype(np.uint32)), (forest.first, ranks),
        (forest.last, ranks + np.uint32(1)), (np.zeros(size, np.int64), np.ones(more, np.int64)),
    ]  # fmt: skip
    return Nodes(*(np.concatenate(pair) for pair in joined))


def random_nodes(rng, finite=40, infinite=6):
    radius = rng.uniform(0, 0.1, finite) * (rng.random(finite) < 0.5)
    cosine = np.where(rng.random(finite) < 0.5, 1, rng.uniform(-0.9, 1, finite))
    cosine[rng.random(finite) < 0.3] = -1
    center = rng.uniform(-1, 1, (finite, 3))
    # Some on top of each other
    center[: finite // 8] = center[0] if finite else 0
    return nodes_of(
        center, radius, random_unit(rng, finite), cosine, random_unit(rng, infinite), rng.uniform(-1, 1, infinite)
    )


def random_groups(rng, count=8):
    middle = rng.uniform(-1.5, 1.5, (count, 3))
    extent = rng.uniform(0, 1, (count, 3)) * 10.0 ** rng.uniform(-3, 0, (count, 1)) * rng.integers(0, 2, (count, 3))
    cosine = np.where(rng.random(count) < 0.3, 1, rng.uniform(-1, 1, count))
    cosine[rng.random(count) < 0.2] = -1
    return PointGroups(middle - extent / 2, middle + extent / 2, random_unit(rng, count), cosine)


def group_of(low, high=None, axis=UP, cone_cos=1.0):
    low = np.array([low], float)
    return PointGroups(low, low if high is None else np.array([high], float), np.array([axis], float),
                       np.array([cone_cos], float))  # fmt: skip


def points_in(rng, groups, group, count):
    """Points in a group's box, including its corners."""
    share = rng.random((count, 3))
    share[: count // 2] = rng.integers(0, 2, (count // 2, 3))
    return groups.low[group] + share * (groups.high[group] - groups.low[group])


def leaves_of(nodes):
    """The node of every source, by rank."""
    single = np.flatnonzero(nodes.escape == np.arange(nodes.count) + 1)
    assert np.array_equal(nodes.first[single], np.arange(len(single)))
    return single


def lighting_sources(rng, nodes, groups, group, samples=300):
    """Ranks of sources that light a point with a normal of the group in random trials."""
    leaf = leaves_of(nodes)
    count = len(leaf)
    p = points_in(rng, groups, group, count * samples).reshape(count, samples, 3)
    axis, cosine = groups.axis[group][None], groups.cone_cos[group][None]
    n = around(rng, axis, cosine, count * samples).reshape(count, samples, 3)
    direction = around(rng, nodes.axis[leaf], nodes.cone_cos[leaf], samples)
    distance = nodes.radius[leaf, None] * np.where(rng.random((count, samples)) < 0.5, 1, rng.random((count, samples)))
    to_source = nodes.center[leaf, None] + distance[..., None] * random_unit(rng, count, samples) - p
    # An omnidirectional source has a cone of all directions, so half of the trials face the point
    facing = np.einsum("ijk,ijk->ij", direction, -to_source) > 0
    infinite = nodes.infinite[leaf]
    to_source[infinite], facing[infinite] = direction[infinite], True
    lit = (np.einsum("ijk,ijk->ij", n, to_source) > 0) & facing
    return np.flatnonzero(lit.any(1))


def leaf_cuts(nodes, groups):
    return cut_clusters(nodes, groups, 0.0)


def cut_of(cuts, group):
    return cuts.node[cuts.first[group] : cuts.first[group + 1]].astype(int)


def times_covered(nodes, cut):
    covered = np.zeros(len(leaves_of(nodes)), int)
    for node in cut:
        covered[nodes.first[node] : nodes.last[node]] += 1
    return covered


def fills(nodes, node, p):
    """Solid angle of a node's sphere from points; all directions from inside."""
    distance = np.linalg.norm(p - nodes.center[node], axis=1)
    sine = np.where(distance > nodes.radius[node], nodes.radius[node] / np.maximum(distance, 1e-300), 1)
    return 2 * np.pi * np.where(sine < 1, 1 - np.sqrt(1 - sine**2), 2)


def nearest_in_box(groups, group, p):
    return np.clip(p, groups.low[group], groups.high[group])[None]


@given(
    seed=SEEDS, solid_angle=st.sampled_from([0.0, 1e-3, 0.02, 0.3, 3.0, 7.0]), faint=st.sampled_from([0.0, 0.05, 1.0])
)
@settings(max_examples=examples(80), deadline=None)
def test_cuts_hold_every_source_that_lights_the_group_exactly_once(seed, solid_angle, faint):
    rng = np.random.default_rng(seed)
    nodes, groups = random_nodes(rng), random_groups(rng)
    cuts = cut_clusters(nodes, groups, solid_angle, faint)
    for group in range(groups.count):
        covered = times_covered(nodes, cut_of(cuts, group))
        assert covered.max(initial=0) <= 1
        assert (covered[lighting_sources(rng, nodes, groups, group)] == 1).all()


@given(seed=SEEDS, solid_angle=st.sampled_from([1e-3, 0.02, 0.3, 3.0, 6.0]))
@settings(max_examples=examples(40), deadline=None)
def test_cuts_are_fine_enough_from_every_point_and_no_finer(seed, solid_angle):
    rng = np.random.default_rng(seed)
    nodes, groups = random_nodes(rng), random_groups(rng)
    parent = np.full(nodes.count, -1)
    for node in range(nodes.count):
        if nodes.escape[node] > node + 1:
            parent[[node + 1, nodes.escape[node + 1]]] = node
    cuts = cut_clusters(nodes, groups, solid_angle)
    for group in range(groups.count):
        p = points_in(rng, groups, group, 200)
        for node in cut_of(cuts, group):
            if nodes.escape[node] > node + 1:
                assert fills(nodes, node, p).max() < solid_angle * (1 + 1e-9)
            if parent[node] >= 0:
                nearest = nearest_in_box(groups, group, nodes.center[parent[node]])
                assert fills(nodes, parent[node], nearest)[0] >= solid_angle * (1 - 1e-9)


def test_cuts_of_far_groups_are_short_and_of_near_ones_long():
    rng = np.random.default_rng(3)
    count = 500
    nodes = nodes_of(rng.uniform(-1, 1, (count, 3)), np.zeros(count), np.zeros((count, 3)), -np.ones(count))
    sizes = [cut_clusters(nodes, group_of([0, 0, -z]), 0.02).size[0] for z in (1000, 20, 5, 2)]
    assert sizes[0] == 1
    assert sizes[0] < sizes[1] < sizes[2] < sizes[3] < count


def test_faint_clusters_are_coarser_and_all_others_as_fine_as_ever():
    rng = np.random.default_rng(4)
    # Seen from the origin both clouds fill the same angle, but the second sends four times as much light
    clouds = rng.uniform(-0.5, 0.5, (2, 200, 3)) + [[[0, 0, 5]], [[0, 5, 0]]]
    nodes = nodes_of(
        clouds.reshape(-1, 3), np.zeros(400), np.zeros((400, 3)), -np.ones(400), intensity=np.repeat([1.0, 4.0], 200)
    )
    group = group_of([0, 0, 0], axis=[0, 0.6, 0.8])
    fine, coarse, mixed = (cut_of(cut_clusters(nodes, group, *how), 0) for how in ((0.005,), (0.3,), (0.005, 0.5)))

    def along(axis, cut):
        return cut[nodes.centroid[cut, axis] > 2.5].tolist()

    assert len(along(2, fine)) > len(along(2, coarse)) == 1
    assert along(2, mixed) == along(2, coarse)
    assert along(1, mixed) == along(1, fine)


@given(seed=SEEDS)
@settings(max_examples=examples(20), deadline=None)
def test_all_leaves_are_single_sources_even_where_they_coincide(seed):
    rng = np.random.default_rng(seed)
    nodes, groups = random_nodes(rng), random_groups(rng)
    leaves = leaf_cuts(nodes, groups)
    assert set(leaves.node.tolist()) <= set(leaves_of(nodes).tolist())
    coarse = cut_clusters(nodes, groups, 0.1)
    for group in range(groups.count):
        assert (np.diff(cut_of(leaves, group)) > 0).all()
        assert (np.diff(cut_of(coarse, group)) > 0).all()
        # What is left out of a fine cut may still be in a coarse one, not the other way round
        assert (times_covered(nodes, cut_of(coarse, group)) >= times_covered(nodes, cut_of(leaves, group))).all()


@given(seed=SEEDS)
@settings(max_examples=examples(20), deadline=None)
def test_leaves_of_chosen_groups_are_those_among_all_groups(seed):
    rng = np.random.default_rng(seed)
    nodes, groups = random_nodes(rng), random_groups(rng)
    chosen = np.flatnonzero(rng.random(groups.count) < 0.5)
    every, some = leaf_cuts(nodes, groups), leaf_cuts(nodes, groups.select(chosen))
    assert len(some.size) == len(chosen)
    for place, group in enumerate(chosen):
        assert cut_of(some, place).tolist() == cut_of(every, group).tolist()


def test_groups_without_a_cluster_can_be_given_the_first():
    cuts = GroupCuts(np.array([4, 7, 9], np.uint32), np.array([0, 0, 2, 2, 3, 3]))
    filled = cuts.without_empty()
    assert [cut_of(filled, group).tolist() for group in range(5)] == [[0], [4, 7], [0], [9], [0]]


def test_many_groups_are_cut_like_few():
    rng = np.random.default_rng(3)
    nodes = random_nodes(rng)
    groups = [random_groups(rng) for _ in range(3)]
    joined = PointGroups(*(np.concatenate([getattr(g, f) for g in groups]) for f in vars(groups[0])))
    few = np.concatenate([cut_clusters(nodes, g, 0.1).node for g in groups])
    assert np.array_equal(cut_clusters(nodes, joined, 0.1).node, few)


def lamps(center, axis, cone_cos=1.0, radius=0.0):
    count = len(center)
    return nodes_of(center, np.full(count, radius), np.tile(axis, (count, 1)), np.full(count, cone_cos))


@pytest.mark.parametrize("extent", [0.0, 0.5])
def test_sources_behind_the_surface_or_turned_away_are_left_out(extent):
    rng = np.random.default_rng(5)
    place = rng.uniform(-1, 1, (20, 3)) * (3, 3, 1)
    group = group_of([-extent, -extent, 0], [extent, extent, 0])
    for height, axis, cone_cos, count in [(5, DOWN, 1, 20), (5, UP, 1, 0), (-5, UP, 1, 0), (-5, UP, -1, 0),
                                          (5, UP, -1, 20), (5, UP, -0.5, 20)]:  # fmt: skip
        nodes = lamps(place + (0, 0, height), axis, cone_cos)
        assert leaf_cuts(nodes, group).size[0] == count
        two_sided = group_of(group.low[0], group.high[0], UP, -1)
        assert leaf_cuts(nodes, two_sided).size[0] == (20 if cone_cos < 1 or height * axis[2] < 0 else 0)


def test_lights_at_infinity_are_kept_where_they_come_from_in_front():
    axes, cosines = [UP, DOWN, DOWN, (1, 0, 0), (1, 0, -1)], [1, 1, -0.5, 0.99, 1]
    axes = np.array(axes, float) / np.linalg.norm(axes, axis=1, keepdims=True)
    nodes = nodes_of(np.zeros((0, 3)), [], np.zeros((0, 3)), [], axes, cosines)
    assert cut_of(cut_clusters(nodes, group_of([5, 5, 5]), 0.02), 0).tolist() == [0, 2, 3]
    assert cut_of(cut_clusters(nodes, group_of([5, 5, 5], axis=DOWN), 0.02), 0).tolist() == [1, 2, 3, 4]
    assert cut_of(cut_clusters(nodes, group_of([5, 5, 5], cone_cos=0.5), 0.02), 0).tolist() == [0, 2, 3, 4]
    assert cut_of(cut_clusters(nodes, group_of([5, 5, 5], cone_cos=-1), 0.02), 0).tolist() == [0, 1, 2, 3, 4]


def test_the_size_of_a_group_counts_for_sources_nearby():
    nodes = lamps([[0, 0, -0.1], [3, 0, 5]], UP, -1)
    assert leaf_cuts(nodes, group_of([0, 0, 0])).size[0] == 1
    # A point of the box lies below the first light
    assert leaf_cuts(nodes, group_of([0, 0, -0.2], [0, 0, 0])).size[0] == 2


def test_no_nodes_give_empty_cuts():
    nodes = nodes_of(np.zeros((0, 3)), [], np.zeros((0, 3)), [])
    groups = random_groups(np.random.default_rng(0), 3)
    for cuts in (cut_clusters(nodes, groups, 0.02), leaf_cuts(nodes, groups)):
        assert cuts.size.tolist() == [0, 0, 0]
        assert not has_wide_source(nodes, groups, cuts).any()


def test_cuts_of_one_group_do_not_depend_on_the_others():
    rng = np.random.default_rng(8)
    nodes, groups = random_nodes(rng), random_groups(rng, 20)
    cuts = cut_clusters(nodes, groups, 0.02)
    assert len(np.unique(cuts.size)) > 3
    for g in range(groups.count):
        assert cut_of(cut_clusters(nodes, groups.select([g]), 0.02), 0).tolist() == cut_of(cuts, g).tolist()


@pytest.mark.parametrize(("radius", "wide"), [(0.0, False), (0.15, False), (0.2, True)])
def test_wide_sources_fill_a_tenth_of_a_steradian_from_the_nearest_point(radius, wide):
    # pi r^2 is some 0.07 and 0.13 from one unit away
    nodes = lamps([[0, 0, 2]], DOWN, -1, radius)
    low = np.array([[0, 0, 0], [5, 5, -100], [0, 0, 2], [0, 0, 5.0]])
    high = np.array([[0, 0, 1], [9, 9, 0], [0, 0, 2], [0, 0, 5.0]])
    groups = PointGroups(low, high, np.array([UP] * 4), np.ones(4))
    cuts = leaf_cuts(nodes, groups)
    found = has_wide_source(nodes, groups, cuts).tolist()
    # Inside the source it is wide if it has an extent; behind the group it is in no cut
    assert found == [wide, False, radius > 0, False]
    assert cuts.size.tolist() == [1, 1, 1, 0]


def test_sources_at_infinity_are_never_wide():
    nodes = nodes_of(np.zeros((0, 3)), [], np.zeros((0, 3)), [], [UP, UP], [1, -1])
    groups = random_groups(np.random.default_rng(2), 50)
    cuts = leaf_cuts(nodes, groups)
    assert cuts.size.max() == 2
    assert has_wide_source(nodes, groups, cuts).tolist() == [False] * 50
