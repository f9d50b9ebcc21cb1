"""The light tree: its structure, bounds, sums and representatives, for ordinary and for degenerate lights."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tests.support.marks import stress
from tests.support.properties import examples
from vpl.lights.light_set import moments_below
from vpl.lights.light_tree import (
    BOX_MAX,
    BOX_MIN,
    CONE_AXIS,
    CONE_COS,
    ESCAPE,
    FLUX,
    INTENSITY,
    REPRESENTATIVE,
    LightTree,
    build_light_tree,
)


def random_unit(rng, count):
    vector = rng.normal(size=(count, 3))
    return (vector / np.linalg.norm(vector, axis=1, keepdims=True)).astype(np.float32)


def random_lights(rng, count):
    position = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    return position, random_unit(rng, count), rng.uniform(0.1, 1, (count, 3)).astype(np.float32)


def build(position, direction, flux, seed=0, **options):
    return build_light_tree(position, direction, flux, np.random.default_rng(seed), **options)


def tree_cost(tree, has_position=True, has_direction=True):
    """Sum of the paper's cluster sizes over the inner nodes, relative to the root's intensity and the scene's size."""
    record = tree.records.astype(np.float64)
    squared = ((record[:, BOX_MAX] - record[:, BOX_MIN]) ** 2).sum(axis=1)
    size = squared / squared[0] if has_position else np.zeros(len(record))
    if has_direction:
        size = size + (1 - record[:, CONE_COS]) ** 2
    inner = tree.escape > np.arange(len(record)) + 1
    return (record[:, INTENSITY] / record[0, INTENSITY] * size)[inner].sum()


def subtree(tree, node):
    """Lights below a node, found through the children alone (recursion on a stack), left to right."""
    lights, stack = [], [node]
    while stack:
        node = stack.pop()
        if tree.escape[node] == node + 1:
            lights.append(int(tree.representative[node]))
        else:
            stack += [int(tree.escape[node + 1]), node + 1]
    return lights


def check_structure(tree, count):
    escape = tree.escape.astype(np.int64)
    node = np.arange(2 * count - 1)
    assert tree.records.shape == (2 * count - 1, 16)
    assert tree.records.dtype == np.float32
    assert tree.records.flags.c_contiguous
    assert escape[0] == 2 * count - 1
    assert (escape > node).all()
    inner = np.flatnonzero(escape != node + 1)
    assert len(inner) == count - 1
    second = escape[inner + 1]
    assert (second < escape[inner]).all()
    assert (escape[second] == escape[inner]).all()
    assert sorted(tree.leaf_order.tolist()) == list(range(count))
    assert tree.representative[escape == node + 1].tolist() == tree.leaf_order.tolist()
    assert subtree(tree, 0) == tree.leaf_order.tolist()
    depth = np.zeros(2 * count - 1, int)
    for parent in inner:
        depth[[parent + 1, escape[parent + 1]]] = depth[parent] + 1
    assert tree.depth == depth.max()


def check_tree(tree, position, direction, flux):
    """Assert every invariant of a tree over the given lights; what is rounded is compared to within its rounding."""
    check_structure(tree, len(flux))
    record, escape = tree.records, tree.escape.astype(np.int64)
    assert np.isfinite(np.delete(record, [ESCAPE, REPRESENTATIVE], axis=1)).all()
    np.testing.assert_allclose(np.linalg.norm(record[:, CONE_AXIS].astype(np.float64), axis=1), 1, atol=2e-7)
    assert (np.abs(record[:, CONE_COS]) <= 1).all()
    leaves_before = np.concatenate([[0], np.cumsum(escape == np.arange(len(escape)) + 1)])
    # The lights below each node in turn, and where they begin
    below = leaves_before[escape] - leaves_before[:-1]
    first, node = np.cumsum(below) - below, np.repeat(np.arange(len(record)), below)
    lights = tree.leaf_order[np.arange(below.sum()) - (first - leaves_before[:-1])[node]]
    assert np.logical_or.reduceat(tree.representative[node] == lights, first).all()
    total = np.add.reduceat(flux.astype(np.float64)[lights], first)
    # float64 sums round to the nearest float32; the second 2^-24 is for another order of summation.
    np.testing.assert_allclose(record[:, FLUX], total, rtol=2.0**-23, atol=2e-45)
    np.testing.assert_allclose(record[:, INTENSITY], total.mean(axis=1), rtol=2.0**-23, atol=2e-45)
    if position is None:
        assert (record[:, BOX_MIN] == 0).all()
        assert (record[:, BOX_MAX] == 0).all()
    else:
        assert (record[:, BOX_MIN] == np.minimum.reduceat(position[lights], first)).all()
        assert (record[:, BOX_MAX] == np.maximum.reduceat(position[lights], first)).all()
    if direction is None:
        assert (record[:, CONE_AXIS] == [0, 0, 1]).all()
        assert (record[:, CONE_COS] == -1).all()
    else:
        unit = direction.astype(np.float64)
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        axis = record[:, CONE_AXIS].astype(np.float64)
        cosine = np.minimum.reduceat(np.einsum("ij,ij->i", unit[lights], axis[node]), first)
        # No tolerance on this side: the cone is rounded outwards. Conversely, the cone is as wide as its lights need.
        assert (record[:, CONE_COS] <= cosine).all()
        assert (record[:, CONE_COS] >= np.maximum(cosine - 1e-6, -1)).all()
    inner = np.flatnonzero(escape != np.arange(len(escape)) + 1)
    inherited = tree.representative[inner + 1] == tree.representative[inner]
    inherited |= tree.representative[escape[inner + 1]] == tree.representative[inner]
    assert inherited.all()


# --- Invariants ---


@st.composite
def hostile_lights(draw):
    """Lights of any kind, with coincident positions, few distinct directions, and intensities over many decades."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.one_of(st.integers(1, 8), st.integers(9, 90)))
    position, direction, flux = random_lights(rng, count)
    grid = draw(st.sampled_from([None, 0, 1, 3]))
    if grid is not None:
        position = np.round(position * grid).astype(np.float32)
    flat = draw(st.integers(0, 3))
    position[:, :flat] = draw(st.sampled_from([0.0, -7.5]))
    position *= np.float32(draw(st.sampled_from([1e-30, 1e-4, 1.0, 1e4, 1e18])))
    position += np.float32(draw(st.sampled_from([0.0, 100.0])))
    match draw(st.sampled_from(["any", "axes", "one", "opposite"])):
        case "axes":
            direction = np.eye(3, dtype=np.float32)[rng.integers(0, 3, count)]
            direction *= rng.choice([-1, 1], (count, 1)).astype(np.float32)
        case "one":
            direction[:] = direction[0]
        case "opposite":
            direction[:] = direction[0] * rng.choice([-1, 1], (count, 1))
    decades = draw(st.sampled_from([0, 12, 30]))
    flux *= (10.0 ** -rng.uniform(0, decades, (count, 1))).astype(np.float32)
    flux[rng.random((count, 3)) < draw(st.sampled_from([0, 0.3]))] = 0
    flux[:, 1][flux.sum(axis=1) == 0] = 1e-30
    kind = draw(st.sampled_from(["oriented", "omni", "directional"]))
    options = {
        "window": draw(st.sampled_from([1, 2, 16, 1024])),
        "angular_weight": draw(st.sampled_from([0, 1 / 16, 1])),
    }
    return None if kind == "directional" else position, None if kind == "omni" else direction, flux, options


@given(hostile_lights())
@settings(max_examples=examples(300), deadline=None)
def test_every_invariant_holds_for_hostile_lights(lights):
    position, direction, flux, options = lights
    check_tree(build(position, direction, flux, **options), position, direction, flux)


@pytest.mark.parametrize("count", [1, 2, 3, 8193, *stress(8191)])
def test_sizes_around_the_smallest_and_the_chunk(count):
    lights = random_lights(np.random.default_rng(count), count)
    check_tree(build(*lights), *lights)


@pytest.mark.parametrize("column", ["BOX_MIN", "BOX_MAX", "CONE_AXIS", "CONE_COS", "FLUX", "INTENSITY", "leaf"])
def test_the_checker_notices_a_corrupted_node(column):
    lights = random_lights(np.random.default_rng(0), 40)
    tree = build(*lights)
    records, order = tree.records.copy(), tree.leaf_order.copy()
    node = int(np.flatnonzero(tree.escape - np.arange(79) > 9)[-1])
    match column:
        case "BOX_MIN":
            records[node, 1] = np.nextafter(records[node, 1], np.float32(np.inf))
        case "BOX_MAX":
            records[node, 4] = np.nextafter(records[node, 4], np.float32(-np.inf))
        case "CONE_AXIS":
            records[node, CONE_AXIS] *= -1
        case "CONE_COS":
            records[node, CONE_COS] += 1e-6
        case "FLUX":
            records[node, 12] *= 1 + 1e-6
        case "INTENSITY":
            records[node, INTENSITY] *= 1 + 1e-6
        case "leaf":
            order[[0, 1]] = order[[1, 0]]
    with pytest.raises(AssertionError):
        check_tree(LightTree(records, order, tree.depth), *lights)


@pytest.mark.parametrize("column", [ESCAPE, REPRESENTATIVE])
def test_the_checker_notices_a_corrupted_link(column):
    lights = random_lights(np.random.default_rng(0), 40)
    tree = build(*lights)
    for node in (0, 1, 20, 78):
        records = tree.records.copy()
        value = int(records.view(np.uint32)[node, column])
        outside = set(range(40)) - set(subtree(tree, node))
        records.view(np.uint32)[node, column] = value - 1 if column == ESCAPE else min(outside, default=40)
        with pytest.raises((AssertionError, IndexError)):
            check_tree(LightTree(records, tree.leaf_order, tree.depth), *lights)


def test_the_walk_without_a_stack_reaches_every_leaf_in_order():
    tree = build(*random_lights(np.random.default_rng(1), 500))
    node, seen = 0, []
    while node < len(tree.records):
        if tree.escape[node] == node + 1:
            seen.append(int(tree.representative[node]))
        node += 1
    assert seen == tree.leaf_order.tolist()
    node, taken = 0, []
    while node < len(tree.records):
        if tree.escape[node] - node > 50:
            node += 1
        else:
            taken += subtree(tree, node)
            node = int(tree.escape[node])
    assert taken == tree.leaf_order.tolist()


# --- Degenerate lights ---


def test_two_lights_are_summed_and_bounded():
    tree = build([[0, 0, 0], [1, 2, 3]], [[1, 0, 0], [0, 1, 0]], [[1, 2, 3], [3, 0, 0]])
    root = tree.records[0]
    assert root[BOX_MIN].tolist() == [0, 0, 0]
    assert root[BOX_MAX].tolist() == [1, 2, 3]
    np.testing.assert_allclose(root[CONE_AXIS], [0.5**0.5, 0.5**0.5, 0], atol=1e-7)
    assert root[CONE_COS] == pytest.approx(0.5**0.5, abs=1e-6)
    assert root[FLUX].tolist() == [4, 2, 3]
    assert root[INTENSITY] == 3


def test_equal_lights_make_a_balanced_tree():
    count = 1 << 12
    one = np.ones((count, 3), np.float32)
    tree = build(one, np.tile(np.float32([0, 0, 1]), (count, 1)), one)
    assert tree.depth == 12
    assert (tree.records[:, CONE_COS] > 1 - 1e-6).all()


def test_where_positions_coincide_directions_decide():
    rng = np.random.default_rng(3)
    direction, flux = random_unit(rng, 300), np.ones((300, 3), np.float32)
    tree = build(np.full((300, 3), 5, np.float32), direction, flux)
    directional = build(None, direction, flux)
    assert tree.leaf_order.tolist() == directional.leaf_order.tolist()
    assert (tree.escape == directional.escape).all()


def test_opposite_walls_are_joined_last():
    """Two coincident sheets with opposite orientation, so angles matter most."""
    rng = np.random.default_rng(4)
    position = np.c_[rng.random((400, 2)), np.zeros(400)].astype(np.float32)
    direction = np.zeros((400, 3), np.float32)
    direction[:, 2] = rng.choice([-1, 1], 400)
    tree = build(position, direction, np.ones((400, 3), np.float32), window=1024, angular_weight=1e4)
    # The box of the two directions is centred at zero; an axis along either would need the whole sphere.
    assert tree.records[0, CONE_COS] == pytest.approx(0, abs=1e-6)
    assert (tree.records[1:, CONE_COS] > 1 - 1e-6).all()


@pytest.mark.parametrize("power", [-30, 30])
def test_the_unit_of_flux_does_not_matter(power):
    position, direction, flux = random_lights(np.random.default_rng(5), 1000)
    scaled = (flux * 10.0**power).astype(np.float32)
    tree, other = build(position, direction, flux), build(position, direction, scaled)
    assert tree_cost(other) == pytest.approx(tree_cost(tree), rel=1e-3)
    np.testing.assert_allclose(other.records[0, FLUX], scaled.sum(axis=0, dtype=np.float64), rtol=1e-6)


def test_a_light_a_trillion_times_brighter_represents_all_its_ancestors():
    position, direction, flux = random_lights(np.random.default_rng(6), 2000)
    flux[123] *= 1e12
    tree = build(position, direction, flux)
    leaf = int(np.flatnonzero((tree.representative == 123) & (tree.escape == np.arange(3999) + 1))[0])
    ancestors = np.flatnonzero((np.arange(3999) <= leaf) & (tree.escape > leaf))
    assert (tree.representative[ancestors] == 123).all()
    assert tree.depth < 60


@pytest.mark.parametrize("growth", [1e12, 1e60])
def test_chains_of_growing_intensities_stay_shallow(growth):
    """The cheapest partner of each light is its predecessor, so mutual pairs alone would merge a pair per round."""
    count = 2**17 + 1  # makes the distances of the normalised positions exactly equal
    position = np.zeros((count, 3), np.float32)
    position[:, 0] = np.arange(count)
    flux = np.repeat(1e-30 * growth ** np.linspace(0, 1, count), 3).reshape(-1, 3).astype(np.float32)
    for direction in (None, np.tile(np.float32([0, 0, 1]), (count, 1))):
        assert build(position, direction, flux).depth < 100


def test_one_dim_light_among_bright_ones_again_and_again():
    """All lights of a window prefer the same partner, the worst case for a matching."""
    count = 33 * 600
    flux = np.ones((count, 3), np.float32)
    flux[::33] = 1e-12
    position = np.zeros((count, 3), np.float32)
    position[:, 0] = np.arange(count)
    assert build(position, None, flux).depth < 100


def test_bright_clusters_are_costlier_to_merge_than_dim_ones():
    """Lights at 0, 1 and 2.1: the gap is smaller on the left, but that is where the intensity is."""
    position = np.zeros((66, 3), np.float32)
    position[64:, 0] = 1, 2.1
    flux = np.ones((66, 3), np.float32)
    assert build(position, None, flux).escape[1] == 128  # the 64 lights at 0
    position, flux = position[63:], np.repeat(np.float32([[100], [1], [1]]), 3, axis=1)
    tree = build(position, None, flux)
    assert tree.escape.tolist() == [5, 2, 5, 4, 5]
    assert tree.leaf_order.tolist() == [0, 1, 2]


def test_dim_lights_are_still_clustered_beside_one_that_dwarfs_them():
    """45 decades, more than float32 has below one."""
    position, _, flux = random_lights(np.random.default_rng(12), 500)
    flux *= np.float32(1e-30)
    alone = tree_cost(build(position, None, flux), has_direction=False)
    flux[0] = 1e15
    tree = build(position, None, flux)
    record = tree.records[tree.records[:, INTENSITY] < 1].astype(np.float64)
    squared = ((record[:, BOX_MAX] - record[:, BOX_MIN]) ** 2).sum(axis=1)
    whole = (np.ptp(position, axis=0) ** 2).sum()
    beside = (record[:, INTENSITY] * squared).sum() / flux[1:].mean(axis=1).sum() / whole
    assert beside < 1.05 * alone


# --- Invariances ---


def topology(tree):
    return tree.escape.tolist(), tree.leaf_order.tolist()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [2.0**-13, 2.0**13, 1e-4, 1e4])
def test_the_unit_of_length_does_not_matter(scale, seed):
    position, direction, flux = random_lights(np.random.default_rng(seed), 300)
    scaled = build((position * scale).astype(np.float32), direction, flux)
    assert topology(scaled) == topology(build(position, direction, flux))


@given(st.integers(0, 2**32), st.integers(2, 200))
@settings(max_examples=examples(50), deadline=None)
def test_the_order_of_the_lights_does_not_matter(seed, count):
    rng = np.random.default_rng(seed)
    position, direction, flux = random_lights(rng, count)
    shuffle = rng.permutation(count)
    tree, other = build(position, direction, flux), build(position[shuffle], direction[shuffle], flux[shuffle])
    assert (other.escape == tree.escape).all()
    assert shuffle[other.leaf_order].tolist() == tree.leaf_order.tolist()
    assert tree_cost(other) == tree_cost(tree)


def test_the_same_seed_gives_the_same_tree_and_another_only_other_representatives():
    lights = random_lights(np.random.default_rng(7), 3000)
    first, again, other = build(*lights, seed=1), build(*lights, seed=1), build(*lights, seed=2)
    assert first.records.tobytes() == again.records.tobytes()
    assert topology(first) == topology(other)
    assert (first.representative != other.representative).any()


@pytest.mark.parametrize("kind", ["oriented", "omni", "directional"])
def test_clustering_beats_the_same_shape_over_shuffled_lights(kind):
    rng = np.random.default_rng(8)
    position, direction, flux = random_lights(rng, 1000)
    position = None if kind == "directional" else position
    direction = None if kind == "omni" else direction
    tree = build(position, direction, flux, angular_weight=1)
    records, order = tree.records.copy(), rng.permutation(1000)
    leaves_before = np.concatenate([[0], np.cumsum(tree.escape == np.arange(1999) + 1)])
    for record, begin, end in zip(records, leaves_before[:-1], leaves_before[tree.escape], strict=True):
        lights = order[begin:end]
        record[INTENSITY] = flux[lights].mean(axis=1).sum()
        if position is not None:
            record[BOX_MIN], record[BOX_MAX] = position[lights].min(axis=0), position[lights].max(axis=0)
        if direction is not None:
            centre = direction[lights].min(axis=0) + direction[lights].max(axis=0)
            record[CONE_COS] = (direction[lights] @ centre).min() / np.linalg.norm(centre)
    shuffled = LightTree(records, order.astype(np.uint32), tree.depth)
    terms = position is not None, direction is not None
    assert tree_cost(tree, *terms) < 0.6 * tree_cost(shuffled, *terms)


def test_a_wider_window_and_the_angular_weight_do_what_they_say():
    lights = random_lights(np.random.default_rng(9), 4000)
    assert tree_cost(build(*lights, window=16)) < tree_cost(build(*lights, window=1))
    paper, flat = build(*lights, angular_weight=1), build(*lights, angular_weight=0)
    assert tree_cost(paper) < tree_cost(flat)
    assert tree_cost(flat, has_direction=False) < tree_cost(paper, has_direction=False)


# --- Representatives ---


def test_a_tree_without_representatives_is_the_same_tree():
    lights = random_lights(np.random.default_rng(2), 70)
    with_them, without = build(*lights), build_light_tree(*lights)
    assert not without.representative.any() and with_them.representative.any()
    without.representative[:] = with_them.representative
    np.testing.assert_array_equal(without.records, with_them.records)
    np.testing.assert_array_equal(without.leaf_order, with_them.leaf_order)


@pytest.mark.stress
def test_representatives_are_drawn_in_proportion_to_intensity():
    rng = np.random.default_rng(10)
    position, direction, flux = random_lights(rng, 12)
    flux *= (10.0 ** rng.uniform(-1, 1, (12, 1))).astype(np.float32)
    draws = 1500
    trees = [build(position, direction, flux, seed=seed) for seed in range(draws)]
    chosen = np.array([tree.representative for tree in trees])
    intensity = flux.mean(axis=1, dtype=np.float64)
    p_values = []
    for node in np.flatnonzero(trees[0].escape > np.arange(23) + 1):
        lights = subtree(trees[0], int(node))
        expected = intensity[lights] / intensity[lights].sum() * draws
        observed = (chosen[:, node, None] == lights).sum(axis=0)
        p_values.append(stats.chisquare(observed, expected).pvalue)
    assert min(p_values) > 1e-4 / len(p_values)


def test_representatives_of_dim_lights_are_not_one_sided():
    """An absolute epsilon in the probabilities would always choose the same child here."""
    flux = np.full((2, 3), 1e-30, np.float32)
    position = np.float32([[0, 0, 0], [1, 0, 0]])
    first = sum(int(build(position, None, flux, seed=seed).representative[0]) for seed in range(400))
    assert 140 < first < 260  # six standard deviations around 200


# --- Bad input ---


def bad(array, row, value):
    array = array.copy()
    array[row] = value
    return array


POSITION, DIRECTION, LIGHT_FLUX = random_lights(np.random.default_rng(0), 5)


@pytest.mark.parametrize(
    ("position", "direction", "flux", "message"),
    [
        (bad(POSITION, (2, 0), np.nan), DIRECTION, LIGHT_FLUX, "position must be finite, but row 2"),
        (POSITION.astype(np.float64) * 1e300, DIRECTION, LIGHT_FLUX, "position must be finite"),
        (POSITION, bad(DIRECTION, (3, 1), np.inf), LIGHT_FLUX, "direction must be finite, but row 3"),
        (POSITION, bad(DIRECTION, 4, 0), LIGHT_FLUX, "direction must be of unit length, but row 4"),
        (POSITION, DIRECTION * 1.01, LIGHT_FLUX, "direction must be of unit length"),
        (POSITION, DIRECTION, bad(LIGHT_FLUX, (1, 2), np.nan), "flux must be finite, but row 1"),
        (POSITION, DIRECTION, bad(LIGHT_FLUX, (1, 2), -1e-9), "flux must be not negative, but row 1"),
        (POSITION, DIRECTION, bad(LIGHT_FLUX, 0, 0), "flux must be positive in some channel, but row 0"),
        (POSITION, DIRECTION, LIGHT_FLUX * np.float32(3e38), "flux is too large"),
        (POSITION, DIRECTION, None, "flux must have the shape (n, 3)"),
        (POSITION, DIRECTION, LIGHT_FLUX[:4], "position has 5 rows, but flux has 4"),
        (POSITION, DIRECTION[:4], LIGHT_FLUX, "direction has 4 rows, but flux has 5"),
        (POSITION[:, :2], DIRECTION, LIGHT_FLUX, "position must have the shape (n, 3)"),
        (POSITION[0], DIRECTION, LIGHT_FLUX, "position must have the shape (n, 3)"),
        (POSITION[:0], DIRECTION[:0], LIGHT_FLUX[:0], "with n > 0, got (0, 3)"),
        (None, None, LIGHT_FLUX, "position and direction are both None"),
    ],
)
def test_bad_lights_are_refused_by_name(position, direction, flux, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        build(position, direction, flux)


@pytest.mark.parametrize(
    "option", [{"window": 0}, {"window": 1025}, {"angular_weight": -1}, {"angular_weight": np.nan}]
)
def test_bad_options_are_refused_by_name(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        build(POSITION, DIRECTION, LIGHT_FLUX, **option)


def test_the_inputs_are_left_alone():
    lights = random_lights(np.random.default_rng(11), 100)
    copies = [array.copy() for array in lights]
    build(*lights)
    for array, copy in zip(lights, copies, strict=True):
        assert (array == copy).all()


@pytest.mark.parametrize("weighted", [True, False])
def test_moments_of_a_node_are_those_of_its_lights(weighted):
    rng = np.random.default_rng(7)
    position = rng.normal(size=(300, 3)) + [1000, 0, 0]
    weight = rng.random(300) * weighted
    tree = build_light_tree(position.astype(np.float32), None, np.ones((300, 3), np.float32), rng)
    mean, variance = moments_below(tree, position, weight)
    for node in range(599):
        # The leaves below a node are those of the preorder up to its escape
        below = [k for k in range(node, tree.escape[node]) if tree.escape[k] == k + 1]
        lights = tree.representative[below]
        share = weight[lights] if weighted else None
        expected = np.average(position[lights], axis=0, weights=share)
        np.testing.assert_allclose(mean[node], expected, rtol=1e-9)
        squares = ((position[lights] - expected) ** 2).sum(1)
        np.testing.assert_allclose(variance[node], np.average(squares, weights=share), rtol=1e-6, atol=1e-8)


def test_moments_of_dim_lights_keep_their_digits_next_to_bright_ones():
    rng = np.random.default_rng(8)
    position, weight = rng.normal(size=(200, 3)), 10 ** rng.uniform(-8, 8, 200)
    tree = build_light_tree(position.astype(np.float32), None, np.ones((200, 3), np.float32), rng)
    mean, _ = moments_below(tree, position, weight)
    leaves = np.flatnonzero(tree.escape == np.arange(399) + 1)
    np.testing.assert_allclose(mean[leaves], position[tree.representative[leaves]], rtol=1e-9)
