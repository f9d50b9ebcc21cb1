"""Many emitters, chosen by clusters of a tree that are learned by spatial cell: densities, expectation, clusters."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS
from tests.support.many_emitters import bulbs, interactions, panels, sampler_of, vertices
from tests.support.rendering import render
from tests.support.scenes import closed_box, rgb, wall
from tests.support.statistics import assert_same_mean
from vpl.core.arrays import upload_vectors
from vpl.lights.emitters import read_emitters
from vpl.split.emitters.emitter_tree import EmitterTree

COUNT = 300


def drawn(emitters, si, seed):
    """Return emitter samples at interactions: (cell, sample, unoccluded weight)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(si.p))
    cell = emitters.cell(si.p, si.n)
    numbers = sampler.next_1d(), sampler.next_1d(), sampler.next_2d()
    sample = emitters.sample(si, cell, *numbers, mi.Bool(True))
    return cell, sample, sample.arriving(emitters._scene, emitters, mi.UInt32(0), mi.Bool(True))[0]


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("sky", [False, True])
def test_what_is_drawn_has_the_density_with_which_it_is_met(sky, learns):
    rng = np.random.default_rng(1)
    box = closed_box(panels(100, rng) | bulbs(50, rng) | (EMITTERS["envmap"]() if sky else {}))
    del box["left"]
    scene = mi.load_dict(box)
    emitters, si = sampler_of(scene, rng, learns), interactions(*vertices(rng, 16_000))
    cell, sample, weight = drawn(emitters, si, 1)
    ray, density = si.spawn_ray(sample.direction), sample.density
    met = emitters.met(si.p, cell, ray, scene.ray_intersect(ray), mi.Bool(True), mi.Bool(True))
    lit = np.array((dr.max(weight) > 0) & ~sample.is_point)
    assert lit.sum() > 100
    # Directions to the very edge of a panel may miss it, and distances along grazing ones are rounded
    assert np.isclose(np.array(met.density), np.array(density), rtol=5e-2)[lit].mean() > 0.97
    assert np.isclose(np.array(met.radiance), np.array(weight * density), rtol=2e-2)[:, lit].all(0).mean() > 0.97


@pytest.mark.parametrize("learns", [False, True])
def test_all_point_emitters_are_expected_to_arrive_whole(learns):
    """Nothing occludes the emitters, so the mean over samples at a vertex is the sum over emitters."""
    rng = np.random.default_rng(2)
    scene = mi.load_dict(closed_box(bulbs(COUNT, rng), camera_light={"type": "directional", "irradiance": rgb(0.0)}))
    emitters, (position, normal) = sampler_of(scene, rng, learns), vertices(rng, 8)
    samples = 1 << 16
    si = interactions(np.repeat(position, samples, 0), np.repeat(normal, samples, 0))
    _, _, weight = drawn(emitters, si, 3)
    found = np.array(weight)[0].reshape(len(position), samples)
    points = read_emitters(scene).points
    distance2 = ((points.position[None] - position[:, None]) ** 2).sum(2)
    expected = (points.intensity[:, 0] / distance2).sum(1)
    error = found.std(1) / samples**0.5
    assert (np.abs(found.mean(1) - expected) < 4 * error + 1e-4 * expected).all()
    assert (error < 0.1 * expected).all()


@pytest.mark.parametrize(("count", "most"), [(1, 96), (2, 1), (50, 96), (1000, 96)])
def test_every_emitter_is_in_one_cluster_from_which_it_can_be_drawn(count, most):
    rng = np.random.default_rng(count)
    position = rng.normal(size=(count, 3))
    tree = EmitterTree(position, np.zeros(count), rng.random(count) + 0.1, most)
    assert tree.clusters == min(count, most)
    rows = dr.arange(mi.UInt32, count)
    everywhere = mi.Point3f(0.1, 0.2, 0.3)
    known = tree.walk(tree.leaf(rows, True), 0, everywhere, mi.Bool(True))
    assert (np.array(known.row) == np.arange(count)).all()
    cluster = np.array(known.cluster)
    assert set(cluster) == set(range(tree.clusters))
    from_root, within = (np.array(x, np.float64) for x in (known.probability, known.within))
    np.testing.assert_allclose(from_root.sum(), 1, rtol=1e-5)
    np.testing.assert_allclose(np.bincount(cluster, within), 1, rtol=1e-5)
    number = mi.Float(rng.random(20_000))
    which = mi.UInt32(rng.integers(0, tree.clusters, 20_000))
    from_cluster, anywhere = tree.root(which, True), mi.UInt32(0)
    for target, expected in ((from_cluster, within / tree.clusters), (anywhere, from_root)):
        found = tree.walk(target, number, everywhere, mi.Bool(True))
        row = np.array(found.row)
        assert (np.array(found.cluster) == (np.array(which) if target is from_cluster else cluster[row])).all()
        np.testing.assert_allclose(np.array(found.probability), from_root[row], rtol=1e-5)
        np.testing.assert_allclose(np.array(found.within), within[row], rtol=1e-5)
        often = np.bincount(row, minlength=count) / 20_000
        assert (np.abs(often - expected) < 5 * np.sqrt(expected / 20_000) + 1e-6).all()


@pytest.mark.parametrize("light", [1e-12, 1e30])
@pytest.mark.parametrize("size", [1e-4, 1e4])
def test_probabilities_depend_on_no_unit(light, size):
    """One emitter is 100 000 times as bright as the others, and the vertex lies close to another one."""
    rng = np.random.default_rng(8)
    position, intensity = rng.normal(size=(100, 3)), np.append(1e5, rng.random(99) + 0.1)
    tree = EmitterTree(position, np.zeros(100), intensity, 16)
    other = EmitterTree(size * position, np.zeros(100), light * intensity, 16)
    rows, place = dr.arange(mi.UInt32, 100), (position[1] + 1e-3).astype(np.float32)
    found = tree.walk(tree.leaf(rows, True), 0, mi.Point3f(place), mi.Bool(True))
    scaled = other.walk(other.leaf(rows, True), 0, mi.Point3f(np.float32(size) * place), mi.Bool(True))
    np.testing.assert_allclose(np.array(scaled.probability), np.array(found.probability), rtol=1e-3)


def test_a_walk_to_an_emitter_ignores_the_number_and_inactive_lanes():
    rng = np.random.default_rng(9)
    tree = EmitterTree(rng.normal(size=(100, 3)), np.zeros(100), rng.random(100) + 0.1, 16)
    rows, place = dr.arange(mi.UInt32, 100), mi.Point3f(0.1, 0.2, 0.3)
    everywhere = tree.walk(tree.leaf(rows, True), 0, place, mi.Bool(True))
    some = tree.walk(tree.leaf(rows, True), mi.Float(rng.random(100)), place, rows % 3 == 0)
    expected = np.arange(100) % 3 == 0
    for name in ("row", "cluster", "probability", "within"):
        np.testing.assert_array_equal(np.array(getattr(some, name)), np.array(getattr(everywhere, name)) * expected)


@pytest.mark.parametrize("spread", ["volume", "ceiling"])
def test_one_draw_from_the_tree_is_nearly_in_proportion_to_what_arrives(spread):
    """Also close to single emitters: relative second and third moments of what is drawn, over the probability."""
    rng = np.random.default_rng(6)
    position = rng.uniform(-1, 1, (2000, 3)) * [1, 1 if spread == "volume" else 0, 1]
    tree = EmitterTree(position, np.zeros(2000), np.ones(2000), 96)
    seen = rng.uniform(-1, 1, (200, 3)) * [1, 1 if spread == "volume" else 0.2, 1]
    rows, place = dr.arange(mi.UInt32, 2000), upload_vectors(mi.Point3f, np.repeat(seen, 2000, 0).astype(np.float32))
    known = tree.walk(tree.leaf(dr.tile(rows, 200), True), 0, place, mi.Bool(True))
    probability = np.array(known.probability, np.float64).reshape(200, 2000)
    arrives = 1 / ((position[None] - seen[:, None]) ** 2).sum(2)
    second, third = (np.mean((arrives**k / probability ** (k - 1)).sum(1) / arrives.sum(1) ** k) for k in (2, 3))
    assert second < 3.5
    assert third < 40


def test_what_is_behind_a_wall_is_drawn_less_where_it_was_learned():
    """A bright bulb outside of the box next to many dim ones in it."""
    rng = np.random.default_rng(4)
    outside = {"bright": {"type": "point", "position": [0, 1.2, 0], "intensity": rgb(1000.0)}}
    scene = mi.load_dict(closed_box(bulbs(COUNT, rng) | outside))
    si, lit = interactions(*vertices(rng)), []
    for learns in (False, True):
        _, _, weight = drawn(sampler_of(scene, rng, learns), si, 5)
        lit.append(np.mean(np.array(weight)[0] > 0))
    assert lit[0] < 0.7 and lit[1] > 0.8


def test_the_mean_over_seeds_is_that_of_path():
    """With a wall in the middle, so visibility differs between cells."""
    rng = np.random.default_rng(5)
    middle = wall([0, 0, 0], [0, 1, 0], 30, 0.6) | {"bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    scene = mi.load_dict(closed_box(panels(60, rng) | bulbs(60, rng) | EMITTERS["envmap"](), 16, middle=middle))

    def pair(seed):
        return tuple(render(scene, name, 128, seed, max_depth=3) for name in ("manylights", "path"))

    assert_same_mean(pair, 8, 0.045)
