"""Regions of an environment map: number, places, and cones."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.properties import examples
from vpl.direct.environment_strata import _assign, _cells, _components, _farthest_first, cones, stratify

SUN, LAMP = (0.5, 0.3, 0.8), (-0.2, 0.9, -0.4)


def directions(height, width):
    theta = np.repeat((np.arange(height) + 0.5) * np.pi / height, width).reshape(height, width)
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def solid_angles(height, width):
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    return np.repeat((edges[:-1] - edges[1:])[:, None] * 2 * np.pi / width, width, axis=1)


def disk(shape, centre, radius):
    return directions(*shape) @ (np.array(centre) / np.linalg.norm(centre)) > np.cos(radius)


def smooth(shape, seed):
    """A map of a few soft blobs over two decades."""
    rng = np.random.default_rng(seed)
    return np.exp(2 * np.cos(5 * directions(*shape) @ rng.normal(size=(3, 4)) + rng.uniform(0, 6, 4)).sum(axis=-1) / 2)


def check(labels, radiance, count):
    """Assert what holds for every map."""
    assert labels.shape == radiance.shape
    assert labels.dtype == np.int32
    lit = radiance > 0
    regions = max(1, min(count, np.count_nonzero(lit)))
    assert (np.unique(labels) == np.arange(regions)).all()
    if lit.any():
        assert len(np.unique(labels[lit])) == regions, "every region holds light"


def importance(radiance, inside):
    area = solid_angles(*radiance.shape)
    return (radiance * area)[inside].sum() * max(area[inside].sum(), 0.01) ** 0.25


maps = arrays.arrays(
    np.float64,
    arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9),
    elements=st.one_of(st.sampled_from([0.0, 1.0, 1e-12]), st.floats(1e-12, 1e6)),
)


@given(radiance=maps, count=st.integers(1, 100))
@settings(max_examples=examples(150), deadline=None)
def test_every_cell_has_a_region_and_every_region_light(radiance, count):
    check(stratify(radiance, count), radiance, count)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 3), (32, 64)], ids=str)
@pytest.mark.parametrize("count", [1, 2, 5, 300, 10**30])
def test_maps_of_any_shape_and_kind(shape, count):
    texel = np.zeros(shape)
    texel[shape[0] // 2, shape[1] // 3] = 7
    decades = 10 ** np.random.default_rng(1).uniform(-12, 0, shape)
    for radiance in (np.zeros(shape), np.full(shape, 0.1), texel, texel + 1e-12, decades):
        check(stratify(radiance, count), radiance, count)


def test_what_vanishes_beside_the_brightest_cell_is_black():
    radiance = np.array([[1e300, 1e250, 1e299, 0]])
    check(stratify(radiance, 4), np.where(radiance < 1e260, 0, radiance), 4)


def test_as_many_regions_as_cells_are_the_cells():
    labels = stratify(smooth((6, 12), 3), 72)
    assert sorted(labels.reshape(-1).tolist()) == list(range(72))


def test_three_hundred_regions_are_the_default():
    assert stratify(np.ones((24, 48))).max() == 299


@pytest.mark.parametrize("scale", [1e-20, 3e-7, 0.1, 7.0, 1e20])
def test_the_scale_of_the_map_changes_no_label(scale):
    noise = 10 ** np.random.default_rng(2).uniform(-12, 0, (32, 64))
    clipped = np.minimum(np.round(smooth((32, 64), 4), 1), 3)
    for radiance in (noise, clipped, np.full((32, 64), 0.3)):
        assert (stratify(radiance * scale, 100) == stratify(radiance, 100)).all()


def test_the_same_map_gives_the_same_labels_whatever_holds_it():
    radiance = np.round(smooth((32, 64), 5) * 16)
    expected = stratify(radiance, 50)
    before = radiance.copy()
    same = (radiance, radiance.astype(np.float32), radiance.astype(np.int64), np.asfortranarray(radiance))
    for other in (*same, radiance.tolist()):
        assert (stratify(other, 50) == expected).all()
    assert (radiance == before).all()


def test_regions_of_a_constant_map_are_alike_and_compact():
    shape, count = (64, 128), 100
    labels = stratify(np.ones(shape), count)
    area = np.bincount(labels.reshape(-1), solid_angles(*shape).reshape(-1))
    assert area.max() < 5 * area.min()
    # k caps cover the sphere only with a radius of at least r; farthest first needs at most 2r about its centres, and
    # the cone about a region's mean at most twice as much
    least = np.arccos(1 - 2 / count)
    _, cosine = cones(labels)
    assert np.arccos(cosine).max() < 2 * least + np.pi / 64


def test_brighter_areas_have_smaller_regions():
    shape = (64, 128)
    bright = directions(*shape)[..., 0] > 0
    labels = stratify(np.where(bright, 10.0, 1.0), 200)
    area = np.bincount(labels.reshape(-1), solid_angles(*shape).reshape(-1))
    within, without = (np.unique(labels[side]) for side in (bright, ~bright))
    assert not set(within) & set(without)
    assert len(within) > 3 * len(without)
    assert area[within].max() < area[without].min()


def test_a_sun_has_regions_of_its_own():
    shape = (256, 512)
    sun = disk(shape, SUN, 0.04)
    radiance = np.where(sun, 5e4, 1 + smooth(shape, 6))
    labels = stratify(radiance)
    check(labels, radiance, 300)
    own = np.unique(labels[sun])
    assert not set(own) & set(labels[~sun])
    assert len(own) == np.round(300 * importance(radiance, sun) / importance(radiance, radiance > 0))
    assert 10 < len(own) < 100, "the rest keeps most of the samples"


def test_bright_disks_get_their_shares():
    shape, count = (128, 256), 200
    great, little = disk(shape, SUN, 0.15), disk(shape, LAMP, 0.08)
    radiance = np.where(great, 40.0, np.where(little, 70.0, 0.1))
    labels = stratify(radiance, count)
    for lamp in (great, little):
        own = np.unique(labels[lamp])
        assert not set(own) & set(labels[~lamp])
        assert len(own) == np.round(count * importance(radiance, lamp) / importance(radiance, radiance > 0))


def test_the_disks_that_miss_most_come_first():
    radiance = np.zeros((64, 128))
    lamps = 30, np.arange(0, 128, 16)
    radiance[lamps] = 1.03, 1.07, 1.01, 1.05, 1.0, 1.06, 1.02, 1.04
    # Each is worth more than half a sample, which would make eight
    labels = stratify(radiance, 5)
    check(labels, radiance, 5)
    assert len(set(labels[lamps][radiance[lamps] > 1.025])) == 5


def test_a_small_disk_counts_as_a_hundredth_of_a_steradian():
    radiance = np.full((256, 512), 1e-9)
    radiance[128:131, 200:203] = 1
    assert solid_angles(256, 512)[128:131, 200:203].sum() < 0.002
    assert len(np.unique(stratify(radiance, 30)[radiance == 1])) == np.round(30 * (0.01 / (4 * np.pi)) ** 0.25) == 5


def test_samples_of_a_brighter_level_count_in_the_darker_one():
    shape, count = (128, 256), 200
    core, halo = disk(shape, SUN, 0.1), disk(shape, SUN, 0.4)
    radiance = np.where(core, 30.0, np.where(halo, 4.0, 0.05))
    labels = stratify(radiance, count)
    parts = [len(np.unique(labels[part])) for part in (core, halo & ~core, ~halo)]
    whole = importance(radiance, radiance > 0)
    shares = [np.round(count * importance(radiance, part) / whole) for part in (core, halo)]
    assert sum(parts) == count, "no region crosses an edge"
    # The halo's share includes the core's; a centre in the core may be among those that were placed for the halo
    assert shares[0] <= parts[0] <= shares[0] + 2
    assert parts[0] + parts[1] == shares[1]


def test_a_disk_across_the_seam_is_one():
    shape = (32, 64)
    radiance = np.full(shape, 1e-9)
    radiance[15:17, [0, 1, -1, -2]] = 1
    inside = radiance == 1
    share = importance(radiance, inside) / importance(radiance, radiance > 0)
    # The region merits 0.6 samples, rounded to 1; each half would merit 0.3 and get none
    labels = stratify(radiance, int(np.round(0.6 / share)))
    assert len(np.unique(labels[inside])) == 1
    assert labels[15, 0] not in labels[~inside]


def test_black_cells_join_the_nearest_bright_one():
    shape = (32, 64)
    lamps = np.zeros(shape)
    lamps[16, 16] = lamps[16, 48] = 1
    labels = stratify(lamps, 10)
    nearer = directions(*shape) @ directions(*shape)[16, 16] > directions(*shape) @ directions(*shape)[16, 48]
    assert (labels[nearer] == labels[16, 16]).all()
    assert (labels[~nearer] == labels[16, 48]).all()


@given(mask=arrays.arrays(bool, arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=8)))
@settings(max_examples=examples(200), deadline=None)
def test_components_are_those_that_a_flood_reaches(mask):
    height, width = mask.shape
    expected = np.full(mask.shape, -1)
    for number, start in enumerate(zip(*np.nonzero(mask), strict=True)):
        front = [start] if expected[start] < 0 else []
        while front:
            row, column = front.pop()
            if mask[row, column] and expected[row, column] < 0:
                expected[row, column] = number
                front += [(row, (column + step) % width) for step in (-1, 1)]
                front += [(near, column) for near in (row - 1, row + 1) if 0 <= near < height]
                if row in (0, height - 1):
                    front += [(row, other) for other in range(width)]
    found = _components(mask)
    first = np.unique(expected[mask])
    assert (found == np.where(mask, np.searchsorted(first, expected), -1).reshape(-1)).all()


def test_a_winding_component_is_one():
    mask = np.zeros((64, 64), bool)
    mask[1::2, 1:-1] = True
    mask[2:-1:4, 1] = mask[4:-1:4, -2] = True
    assert set(_components(mask).tolist()) == {-1, 0}


def test_centres_are_placed_farthest_first():
    rng = np.random.default_rng(7)
    unit = rng.normal(size=(400, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    values = rng.random(400)
    assert _farthest_first(unit, values, np.empty(0, np.int64), 1) == [values.argmax()]
    for kept in (np.empty(0, np.int64), np.array([3, 99])):
        before = kept.tolist()
        for cell in _farthest_first(unit, values, kept, 30):
            if before:
                distance = np.linalg.norm(unit[:, None] - unit[before], axis=2).min(axis=1)
                assert distance[cell] >= distance.max() - 1e-9
            before.append(cell)
        assert len(set(before)) == len(kept) + 30


def test_cells_join_the_nearest_centre_of_their_layer():
    unit = directions(24, 48).reshape(-1, 3)
    rng = np.random.default_rng(8)
    bright = unit[:, 0] > 0.5
    centres = np.concatenate([rng.choice(np.flatnonzero(side), 9, replace=False) for side in (bright, ~bright)])
    labels = _assign([np.where(bright, 0, -1), np.zeros(len(unit), np.int64)], unit, centres)
    distance = np.linalg.norm(unit[:, None] - unit[centres], axis=2)
    distance[bright[:, None] != bright[centres]] = np.inf
    assert (distance[np.arange(len(unit)), labels] <= distance.min(axis=1) + 1e-9).all()
    everywhere = _assign([np.where(bright, 0, -1), np.zeros(len(unit), np.int64)], unit, centres[9:])
    assert (distance[np.arange(len(unit)), 9 + everywhere] <= distance[:, 9:].min(axis=1) + 1e-9)[~bright].all()
    assert set(everywhere[bright]) <= set(range(9)), "a layer without a centre joins the one below"


def test_cells_that_rounding_does_not_tell_apart_are_centres_once():
    unit = np.tile((0.6, 0.0, 0.8), (5, 1))
    centres = _farthest_first(unit, np.ones(5), np.array([2]), 4)
    assert sorted(centres) == [0, 1, 3, 4]
    assert _assign([np.zeros(5, np.int64)], unit, np.array(centres))[centres].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (16, 32)], ids=str)
def test_cells_have_their_directions_and_solid_angles(shape):
    unit, solid_angle = _cells(*shape)
    np.testing.assert_allclose(unit, directions(*shape).reshape(-1, 3), atol=1e-14)
    np.testing.assert_allclose(solid_angle, solid_angles(*shape).reshape(-1), rtol=1e-10)


def least_cosines(labels, axis, steps):
    """The least cosine between each region's axis and its cells on a grid of directions in each of them."""
    height, width = labels.shape
    result = np.ones(len(axis))
    for down in np.linspace(0, 1, steps):
        for along in np.linspace(0, 1, steps):
            theta = (np.arange(height)[:, None] + down) * np.pi / height
            phi = (np.arange(width) + along) * 2 * np.pi / width
            spots = np.stack(
                [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1
            )
            cosine = np.einsum("ijk,ijk->ij", spots, axis[labels])
            np.minimum.at(result, labels, cosine)
    # Rounding may take the cosine of an opposite direction below -1
    return np.maximum(result, -1)


@given(
    labels=arrays.arrays(
        np.int64, arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=6), elements=st.integers(0, 3)
    )
)
@settings(max_examples=examples(150), deadline=None)
def test_cones_hold_their_cells_and_little_more(labels):
    axis, cosine = cones(labels)
    assert axis.dtype == cosine.dtype == np.float64
    assert axis.shape == (labels.max() + 1, 3)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 1, atol=1e-12)
    least = least_cosines(labels, axis, 13)
    assert (cosine <= least).all()
    assert (cosine >= -1).all()
    mean = np.zeros_like(axis)
    np.add.at(mean, labels, directions(*labels.shape) * solid_angles(*labels.shape)[..., None])
    length = np.linalg.norm(mean, axis=1)
    clear = length > 1e-4
    np.testing.assert_allclose(mean[clear], axis[clear] * length[clear, None], atol=1e-9)
    # Between two of the twelve steps along the side of a cell lies less than this
    step = np.hypot(np.pi / labels.shape[0], 2 * np.pi / labels.shape[1]) / 12
    assert (np.arccos(cosine) <= np.arccos(least) + step)[clear].all()
    assert (cosine[length < 1e-9] == -1).all()


@pytest.mark.parametrize("count", [1, 8, 300])
def test_cones_of_regions_hold_their_cells(count):
    labels = stratify(smooth((64, 128), 9), count)
    axis, cosine = cones(labels)
    assert (cosine <= least_cosines(labels, axis, 3)).all()
    assert (cosine == -1).all() if count == 1 else (cosine > -1).all()


def test_cells_with_negative_labels_are_left_out_of_cones():
    labels = np.full((16, 32), -1)
    labels[4, 5] = 1
    axis, cosine = cones(labels)
    assert axis.shape == (2, 3)
    assert (axis[0].tolist(), cosine[0]) == ([0, 0, 1], -1)
    np.testing.assert_allclose(axis[1], directions(16, 32)[4, 5], atol=1e-12)
    assert cosine[1] > 0.95
    axis, cosine = cones(np.full((16, 32), -1))
    assert (axis.shape, cosine.shape) == ((0, 3), (0,))


@pytest.mark.parametrize(
    "radiance",
    [np.ones(4), np.ones((2, 2, 3)), np.ones((0, 4)), np.ones((2, 2), complex), [["a"]]],
    ids=["line", "channels", "empty", "complex", "text"],
)
def test_a_map_of_another_form_is_refused(radiance):
    with pytest.raises(ValueError, match=r"radiance must be real numbers of a shape \(height, width\)"):
        stratify(radiance)


@pytest.mark.parametrize("value", [-1e-9, np.nan, np.inf])
def test_a_radiance_that_is_none_is_refused(value):
    radiance = np.ones((3, 4))
    radiance[1, 2] = value
    with pytest.raises(ValueError, match=re.escape(f"radiance must be finite and at least 0, but [1, 2] is {value}")):
        stratify(radiance)


@pytest.mark.parametrize("count", [0, -3, 2.5, None])
def test_a_count_that_is_none_is_refused(count):
    with pytest.raises(ValueError, match=rf"count must be an integer of at least 1, got {count}"):
        stratify(np.ones((3, 4)), count)


@pytest.mark.parametrize("labels", [np.zeros(3, int), np.zeros((0, 3), int), np.zeros((2, 2))], ids=str)
def test_labels_of_another_form_are_refused(labels):
    with pytest.raises(ValueError, match="labels must be integers"):
        cones(labels)
