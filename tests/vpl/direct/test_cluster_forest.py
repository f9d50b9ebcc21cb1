"""The light cluster trees: structure, spheres, cones and sums, and equality with the greedy pairing."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.properties import examples
from vpl.direct.emitter_clusters import ClusterForest, build_cluster_forest

DTYPES = {name: np.uint32 for name in ("escape", "first", "last", "depth", "roots", "leaf_order")}


def random_unit(rng, count):
    vector = rng.normal(size=(count, 3))
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


def random_lights(rng, count, omni=0.3, extent=0.05):
    """center, radius, axis, cone_cos and intensity of lights, a share of them omnidirectional, some with an extent."""
    radius = rng.uniform(0, extent, count) * (rng.random(count) < 0.5)
    cone_cos = np.where(rng.random(count) < 0.5, 1, rng.uniform(-0.99, 1, count))
    cone_cos[rng.random(count) < omni] = -1
    return rng.uniform(-1, 1, (count, 3)), radius, random_unit(rng, count), cone_cos, rng.uniform(0.1, 1, count)


def points(center, radius=None):
    """Omnidirectional lights of equal intensity at the given places."""
    count = len(center)
    radius = np.zeros(count) if radius is None else radius
    return np.asarray(center, float), radius, np.zeros((count, 3)), np.full(count, -1.0), np.ones(count)


def kind_of(axis, cone_cos):
    """Which tree a light belongs to, by plain comparison: 0, or 1 to 6 for +X, -X, +Y, -Y, +Z, -Z."""
    if cone_cos == -1:
        return 0
    signed = [component for value in axis for component in (value, -value)]
    return 1 + signed.index(max(signed))


def subtree(forest, node):
    """Lights below a node, found through the children alone, left to right."""
    lights, stack = [], [node]
    while stack:
        node = stack.pop()
        if forest.escape[node] == node + 1:
            lights.append(int(forest.leaf_order[forest.first[node]]))
        else:
            stack += [int(forest.escape[node + 1]), node + 1]
    return lights


def clusters(forest):
    return {frozenset(subtree(forest, node)) for node in range(len(forest.escape))}


def topology(forest):
    return forest.escape.tolist(), forest.leaf_order.tolist()


def check_structure(forest, lights):
    count, trees = len(lights[0]), len(forest.roots)
    size = 2 * count - trees
    for field in dataclasses.fields(forest):
        values = getattr(forest, field.name)
        assert values.dtype == DTYPES.get(field.name, np.float64)
        rows = {"roots": trees, "leaf_order": count}.get(field.name, size)
        assert values.shape == ((rows, 3) if field.name in ("center", "axis", "centroid") else (rows,))
    assert sorted(forest.leaf_order.tolist()) == list(range(count))
    kinds = [kind_of(axis, cosine) for axis, cosine in zip(lights[2], lights[3], strict=True)]
    assert trees == len(set(kinds))
    escape, node, found = forest.escape.astype(int), 0, []
    for root in forest.roots.tolist():
        assert root == node
        assert forest.depth[root] == 0
        found.append({kinds[light] for light in subtree(forest, root)})
        node = escape[root]
    assert node == size
    assert found == [{kind} for kind in sorted(set(kinds))]
    for node in range(size):
        assert forest.leaf_order[forest.first[node] : forest.last[node]].tolist() == subtree(forest, node)
        if escape[node] > node + 1:
            second = escape[node + 1]
            assert second < escape[node] == escape[second]
            assert forest.depth[node + 1] == forest.depth[second] == forest.depth[node] + 1


def check_spheres(forest, center, radius):
    """A node's sphere holds the spheres of its children and all its lights, without tolerance, and is minimal."""
    wide, reach = forest.center.astype(np.longdouble), forest.radius.astype(np.longdouble)

    def distance(first, second):
        return np.hypot(np.hypot(*(first - second).T[:2]), (first - second).T[2])

    for node, (begin, end) in enumerate(zip(forest.first, forest.last, strict=True)):
        lights = forest.leaf_order[begin:end]
        assert (distance(wide[node], center[lights].astype(np.longdouble)) + radius[lights] <= reach[node]).all()
        if end == begin + 1:
            assert forest.center[node].tolist() == center[lights[0]].tolist()
            assert forest.radius[node] == radius[lights[0]]
            continue
        first, second = node + 1, forest.escape[node + 1]
        for child in (first, second):
            assert distance(wide[node], wide[child]) + reach[child] <= reach[node]
        least = max(
            (distance(wide[first], wide[second]) + reach[first] + reach[second]) / 2, reach[first], reach[second]
        )
        # The centre is rounded, too
        assert reach[node] <= least * (1 + 1e-14) + 2.0**-51 * np.abs(wide[node]).max()


def check_cones(forest, axis, cone_cos):
    """A node's cone holds all its lights', without tolerance, and is no wider than need be."""

    def unit(vector):
        return vector / np.sqrt((vector**2).sum(axis=1, keepdims=True))

    np.testing.assert_allclose(np.linalg.norm(forest.axis, axis=1), 1, atol=4e-16)
    wide, normalised = unit(forest.axis.astype(np.longdouble)), axis / np.linalg.norm(axis, axis=1, keepdims=True)
    for node, (begin, end) in enumerate(zip(forest.first, forest.last, strict=True)):
        lights = forest.leaf_order[begin:end]
        if (cone_cos[lights] == -1).any():
            assert forest.axis[node].tolist() == [0, 0, 1]
            assert forest.cone_cos[node] == -1
            continue
        directions = unit(axis[lights].astype(np.longdouble))
        chord = np.sqrt(((directions - wide[node]) ** 2).sum(axis=1))
        angle = (2 * np.arcsin(chord / 2) + np.arccos(cone_cos[lights].astype(np.longdouble))).max()
        cosine = np.cos(min(angle, np.longdouble(np.pi)))
        if end == begin + 1:
            assert forest.cone_cos[node] == cone_cos[lights[0]]
            assert forest.axis[node].tolist() == normalised[lights[0]].tolist()
        else:
            assert cosine - 1e-14 <= forest.cone_cos[node] <= max(cosine, -1)


def check_sums(forest, center, intensity):
    tolerance = 1e-13 * np.ptp(center, axis=0).max() + 2.0**-48 * np.abs(center).max()
    for node, (begin, end) in enumerate(zip(forest.first, forest.last, strict=True)):
        lights = forest.leaf_order[begin:end]
        total = intensity[lights].sum()
        assert forest.intensity[node] == pytest.approx(total, rel=1e-12)
        mean = (center[lights].astype(np.longdouble) * (intensity[lights] / total)[:, None]).sum(axis=0)
        np.testing.assert_allclose(forest.centroid[node], mean.astype(float), rtol=0, atol=tolerance)


def check_forest(forest, lights):
    center, radius, axis, cone_cos, intensity = lights
    check_structure(forest, lights)
    check_spheres(forest, center, radius)
    check_cones(forest, axis, cone_cos)
    check_sums(forest, center, intensity)


# --- Invariants ---


@st.composite
def hostile_lights(draw):
    """Lights of any kind, with coincident places, few directions, large spheres and intensities over many decades."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.one_of(st.integers(1, 8), st.integers(9, 90), st.just(600)))
    omni, extent = draw(st.sampled_from([0, 0.3, 1])), draw(st.sampled_from([0, 0.05, 3]))
    center, radius, axis, cone_cos, intensity = random_lights(rng, count, omni, extent)
    grid = draw(st.sampled_from([None, 0, 1, 3]))
    if grid is not None:
        center = np.round(center * grid)
    center[:, : draw(st.integers(0, 3))] = draw(st.sampled_from([0.0, -7.5]))
    scale = draw(st.sampled_from([1e-200, 1e-4, 1.0, 1e4, 1e200]))
    center = center * scale + draw(st.sampled_from([0.0, 100.0])) * scale
    match draw(st.sampled_from(["any", "axes", "one"])):
        case "axes":
            axis = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1, 1], (count, 1))
        case "one":
            axis[:] = axis[0]
    if draw(st.booleans()):
        cone_cos[cone_cos > -1] = 1
    decades = draw(st.sampled_from([0, 12, 200]))
    return center, radius * scale, axis, cone_cos, intensity * 10.0 ** -rng.uniform(0, decades, count)


@pytest.mark.stress
@given(hostile_lights())
@settings(max_examples=examples(150), deadline=None)
def test_every_invariant_holds_for_hostile_lights(lights):
    check_forest(build_cluster_forest(*lights), lights)


@pytest.mark.parametrize("count", [1, 2, 256, 257, 3000])
def test_sizes_around_the_smallest_and_the_quadratic_ones(count):
    lights = random_lights(np.random.default_rng(count), count, omni=0.9)
    check_forest(build_cluster_forest(*lights), lights)


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(ClusterForest)])
def test_the_checker_notices_a_corrupted_node(field):
    lights = random_lights(np.random.default_rng(0), 60)
    forest = build_cluster_forest(*lights)
    values = getattr(forest, field).copy()
    node = int(np.argmax(forest.cone_cos > -1))  # the root of the first tree of oriented lights
    match field:
        case "center" | "centroid":
            values[node, 1] += 1e-9
        case "radius" | "cone_cos":
            values[node] -= 1e-12
        case "axis":
            values[node] = np.roll(values[node], 1)
        case "intensity":
            values[node] *= 1 + 1e-9
        case "leaf_order":
            values[[0, 1]] = values[[1, 0]]
        case "roots":
            values[1] += 1
        case _:
            values[node] += 1
    with pytest.raises((AssertionError, IndexError)):
        check_forest(dataclasses.replace(forest, **{field: values}), lights)


def test_the_walk_without_a_stack_reaches_every_light_of_every_tree():
    forest = build_cluster_forest(*random_lights(np.random.default_rng(1), 500))
    node, taken = 0, []
    while node < len(forest.escape):
        if forest.last[node] - forest.first[node] > 20:
            node += 1
        else:
            taken += subtree(forest, node)
            node = int(forest.escape[node])
    assert taken == forest.leaf_order.tolist()


def test_no_lights_no_trees():
    none = np.zeros(0)
    forest = build_cluster_forest(np.zeros((0, 3)), none, np.zeros((0, 3)), none, none)
    check_structure(forest, (np.zeros((0, 3)), none, np.zeros((0, 3)), none, none))
    assert len(forest.escape) == len(forest.roots) == len(forest.leaf_order) == 0


def test_one_light_is_its_own_tree():
    forest = build_cluster_forest([[1, 2, 3]], [0.5], [[0, 0, -1]], [0.25], [7])
    for name, value in {"center": [1, 2, 3], "centroid": [1, 2, 3], "axis": [0, 0, -1]}.items():
        assert getattr(forest, name).tolist() == [value]
    for name, value in {"radius": 0.5, "cone_cos": 0.25, "intensity": 7, "escape": 1, "first": 0, "last": 1}.items():
        assert getattr(forest, name).tolist() == [value]
    assert forest.depth.tolist() == forest.roots.tolist() == forest.leaf_order.tolist() == [0]


def test_two_lights_are_bounded_and_summed():
    center, radius = [[0, 0, 0], [4, 0, 0]], [0, 1]
    forest = build_cluster_forest(center, radius, [[0, 0.6, 0.8], [0, -0.6, 0.8]], [1, np.cos(0.1)], [3, 1])
    np.testing.assert_allclose(forest.center[0], [2.5, 0, 0], rtol=1e-15)
    np.testing.assert_allclose(forest.axis[0], [0, 0, 1], atol=1e-15)
    assert forest.radius[0] == pytest.approx(2.5, rel=1e-14)
    assert forest.cone_cos[0] == pytest.approx(np.cos(np.arccos(0.8) + 0.1), abs=1e-14)
    assert forest.intensity[0] == 4
    assert forest.centroid[0].tolist() == [1, 0, 0]


def test_a_sphere_inside_another_adds_nothing():
    rng = np.random.default_rng(2)
    for _ in range(50):
        center = rng.normal(size=(2, 3))
        forest = build_cluster_forest(*points(center, np.array([0.2, 9.0])))
        assert forest.center[0].tolist() == center[1].tolist()
        assert forest.radius[0] == 9


def test_cones_wider_than_all_directions_are_clamped():
    axis = [[1, 0, 0], [0.8, 0.6, 0]]
    forest = build_cluster_forest(np.eye(3)[:2], [0, 0], axis, [-0.99, -0.999], [1, 1])
    assert forest.cone_cos[0] == -1


# --- Classes ---


def test_ties_between_main_axes_go_to_the_first():
    ties = [[1, 1, 0], [-1, 1, 0], [1, -1, 1], [0, 1, 1], [0, -1, 1], [0, -1, -1], [0, 0, 1], [0, 0, -1], [0.1, 0, -1]]
    axis = np.array(ties) / np.linalg.norm(ties, axis=1, keepdims=True)
    count = len(ties)
    forest = build_cluster_forest(
        np.random.default_rng(0).random((count, 3)), [0] * count, axis, [1] * count, [1] * count
    )
    assert [sorted(subtree(forest, root)) for root in forest.roots] == [[0, 2], [1], [3], [4, 5], [6], [7, 8]]


def test_coincident_lights_of_all_kinds_stay_apart():
    axis = np.concatenate([np.eye(3), -np.eye(3), np.eye(3)])
    cone_cos = np.array([1.0] * 6 + [-1] * 3)
    forest = build_cluster_forest(np.ones((9, 3)), np.zeros(9), axis, cone_cos, np.ones(9))
    assert [sorted(subtree(forest, root)) for root in forest.roots] == [[6, 7, 8], [0], [3], [1], [4], [2], [5]]


def test_the_axis_of_lights_that_radiate_everywhere_is_ignored():
    center, radius, axis, cone_cos, intensity = points(np.eye(3))
    forest = build_cluster_forest(center, radius, np.full((3, 3), np.nan), cone_cos, intensity)
    assert topology(forest) == topology(build_cluster_forest(center, radius, axis, cone_cos, intensity))
    assert np.isfinite(forest.axis).all()


# --- Greedy pairing ---


def greedy(center, radius):
    """Pair the two clusters with the smallest common sphere, again and again: lights and radius of every cluster."""
    center, radius, count = center.copy(), radius.copy(), len(center)
    members = [frozenset([light]) for light in range(count)]
    found = dict(zip(members, radius.tolist(), strict=True))
    distance = np.linalg.norm(center[:, None] - center, axis=2)
    cost = np.maximum((distance + radius[:, None] + radius) / 2, np.maximum(radius[:, None], radius))
    np.fill_diagonal(cost, np.inf)
    for _ in range(count - 1):
        a, b = sorted(np.unravel_index(np.argmin(cost), cost.shape), key=lambda cluster: -radius[cluster])
        apart = np.linalg.norm(center[b] - center[a])
        if apart + radius[b] > radius[a]:
            center[a] += (center[b] - center[a]) * ((cost[a, b] - radius[a]) / apart)
            radius[a] = cost[a, b]
        members[a] |= members[b]
        found[members[a]] = radius[a]
        cost[b] = cost[:, b] = np.inf
        left = np.flatnonzero(np.isfinite(cost[a]))
        joint = (np.linalg.norm(center[left] - center[a], axis=1) + radius[left] + radius[a]) / 2
        cost[a, left] = cost[left, a] = np.maximum(joint, np.maximum(radius[left], radius[a]))
    return found


@given(st.integers(0, 2**32), st.integers(2, 100), st.sampled_from([0, 0.01, 0.1]))
@settings(max_examples=examples(60), deadline=None)
def test_small_trees_are_the_greedy_ones(seed, count, extent):
    rng = np.random.default_rng(seed)
    center, radius = rng.random((count, 3)), rng.uniform(0, extent, count)
    forest, expected = build_cluster_forest(*points(center, radius)), greedy(center, radius)
    np.testing.assert_allclose(np.sort(forest.radius), np.sort(list(expected.values())), rtol=1e-12)
    if extent < 0.1:  # a light inside another's sphere makes ties
        assert clusters(forest) == set(expected)


@pytest.mark.parametrize("extent", [0, 0.01])
def test_the_largest_quadratic_tree_is_the_greedy_one(extent):
    rng = np.random.default_rng(7)
    center, radius = rng.random((256, 3)), rng.uniform(0, extent, 256)
    assert clusters(build_cluster_forest(*points(center, radius))) == set(greedy(center, radius))


def test_larger_trees_are_nearly_as_tight_as_the_greedy_ones():
    rng = np.random.default_rng(8)
    center = rng.random((1500, 3))
    total = build_cluster_forest(*points(center)).radius.sum()
    assert total < 1.04 * sum(greedy(center, np.zeros(1500)).values())


# --- Depth ---


@pytest.mark.parametrize("growth", [1e12, 1e60, 1e300])
def test_chains_of_growing_distances_stay_shallow(growth):
    """The best partner of each light is its predecessor: the greedy tree is as deep as the number of lights."""
    center = np.zeros((100_000, 3))
    center[:, 1] = growth ** np.linspace(0, 1, len(center))
    forest = build_cluster_forest(*points(center))
    assert forest.depth.max() < 110
    assert np.isfinite(forest.radius).all()


def test_equal_lights_make_a_balanced_tree_of_points():
    forest = build_cluster_forest(*points(np.full((1 << 12, 3), 0.1)))
    assert forest.depth.max() == 12
    assert (forest.radius == 0).all()
    assert (forest.center == 0.1).all()


def test_equal_spheres_make_a_balanced_tree_of_equal_spheres():
    forest = build_cluster_forest(*points(np.full((200, 3), 0.1), np.full(200, 0.3)))
    assert forest.depth.max() <= 10
    assert (forest.radius == 0.3).all()


def test_a_radius_of_negative_zero_is_a_point():
    rng = np.random.default_rng(9)
    center, radius = rng.integers(0, 4, (600, 3)), np.where(rng.random(600) < 0.5, 0.0, -0.0)
    assert topology(build_cluster_forest(*points(center, radius))) == topology(build_cluster_forest(*points(center)))


# --- Invariances ---


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0), (1e4, 0), (2.0**-40, 0), (1, 100), (1e-4, 10)])
def test_the_unit_and_the_origin_of_positions_do_not_matter(scale, shift, seed):
    center, radius, *rest = random_lights(np.random.default_rng(seed), 900, omni=0.6)
    plain = build_cluster_forest(center, radius, *rest)
    moved = build_cluster_forest(center * scale + shift, radius * scale, *rest)
    assert topology(moved) == topology(plain)
    tolerance = 1e-12 * scale + 1e-14 * shift
    np.testing.assert_allclose(moved.center, plain.center * scale + shift, rtol=0, atol=tolerance)
    np.testing.assert_allclose(moved.centroid, plain.centroid * scale + shift, rtol=0, atol=tolerance)
    np.testing.assert_allclose(moved.radius, plain.radius * scale, rtol=0, atol=tolerance)


@given(st.integers(0, 2**32), st.integers(2, 200))
@settings(max_examples=examples(30), deadline=None)
def test_the_order_of_the_lights_does_not_matter(seed, count):
    rng = np.random.default_rng(seed)
    lights = random_lights(rng, count, extent=0)
    shuffle = rng.permutation(count)
    forest, other = build_cluster_forest(*lights), build_cluster_forest(*(array[shuffle] for array in lights))
    assert (other.escape == forest.escape).all()
    assert shuffle[other.leaf_order].tolist() == forest.leaf_order.tolist()


def test_a_light_a_trillion_times_brighter_is_the_centroid_of_all_its_ancestors():
    center, radius, axis, cone_cos, intensity = random_lights(np.random.default_rng(6), 400, omni=1)
    plain = build_cluster_forest(center, radius, axis, cone_cos, intensity)
    intensity[123] *= 1e12
    forest = build_cluster_forest(center, radius, axis, cone_cos, intensity)
    assert topology(forest) == topology(plain)
    above = [node for node in range(len(forest.escape)) if 123 in subtree(forest, node)]
    assert len(above) > 5
    np.testing.assert_allclose(forest.centroid[above], np.tile(center[123], (len(above), 1)), atol=1e-8)


# --- Bad input ---


def bad(array, row, value):
    array = np.array(array, float)
    array[row] = value
    return array


ARGUMENTS = ("center", "radius", "axis", "cone_cos", "intensity")
LIGHTS = dict(zip(ARGUMENTS, random_lights(np.random.default_rng(0), 5, omni=0), strict=True))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("center", bad(LIGHTS["center"], (2, 0), np.nan), "center must be finite and at most 1e+300, but row 2"),
        ("center", bad(LIGHTS["center"], (3, 1), -1e301), "center must be finite and at most 1e+300, but row 3"),
        ("radius", bad(LIGHTS["radius"], [1, 2], -1e-9), "radius must be from 0 to 1e+300, but row 1"),
        ("radius", bad(LIGHTS["radius"], 4, np.inf), "radius must be from 0 to 1e+300, but row 4 is inf"),
        ("radius", bad(LIGHTS["radius"], 4, np.nan), "radius must be from 0 to 1e+300, but row 4 is nan"),
        ("axis", bad(LIGHTS["axis"], (3, 1), np.inf), "axis must be finite, but row 3"),
        ("axis", bad(LIGHTS["axis"], 4, 0), "axis must be of unit length, but row 4"),
        ("axis", bad(LIGHTS["axis"], 4, 1e200), "axis must be of unit length, but row 4"),
        ("axis", LIGHTS["axis"] * 1.01, "axis must be of unit length, but row 0"),
        ("cone_cos", bad(LIGHTS["cone_cos"], 2, 1.001), "cone_cos must be from -1 to 1, but row 2 is 1.001"),
        ("cone_cos", bad(LIGHTS["cone_cos"], 2, np.nan), "cone_cos must be from -1 to 1, but row 2 is nan"),
        ("intensity", bad(LIGHTS["intensity"], 1, 0), "intensity must be positive, at most 1e+300, but row 1 is 0.0"),
        ("intensity", bad(LIGHTS["intensity"], 1, np.nan), "intensity must be positive, at most 1e+300, but row 1"),
        ("intensity", bad(LIGHTS["intensity"], 0, np.inf), "intensity must be positive, at most 1e+300, but row 0"),
        ("center", LIGHTS["center"][0], "center must have the shape (n, 3), got (3,)"),
        ("axis", LIGHTS["axis"][:, :2], "axis must have the shape (n, 3), got (5, 2)"),
        ("radius", LIGHTS["radius"][:, None], "radius must have the shape (n,), got (5, 1)"),
        ("cone_cos", 1.0, "cone_cos must have the shape (n,), got ()"),
        ("intensity", LIGHTS["intensity"][:4], "intensity has 4 rows, but center has 5"),
    ],
)
def test_bad_lights_are_refused_by_name(name, value, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        build_cluster_forest(**LIGHTS | {name: value})


def test_inputs_are_left_as_they_are():
    lights = random_lights(np.random.default_rng(3), 50)
    copies = [array.copy() for array in lights]
    build_cluster_forest(*lights)
    assert all((array == copy).all() for array, copy in zip(lights, copies, strict=True))
