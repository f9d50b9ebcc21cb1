"""Pairs of a point cluster and a light cluster: bounds, coverage, and lists."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.pairs import CLAMP, batch_of, exact, lit_by, prepared, scene_of, unit
from tests.support.rooms import glossy_room
from vpl.core.arrays import download, upload
from vpl.cuts import product_cuts as pairs
from vpl.cuts.pair_lists import evaluate_lists, list_pairs
from vpl.cuts.product_cuts import BoundCounter, Pairs, find_pairs
from vpl.lights.light_set import LightGroup
from vpl.lights.virtual_lights import KINDS, VirtualLights
from vpl.points.point_clusters import PointClusters
from vpl.transport.bounds import contribution_bound
from vpl.transport.contribution import contribution
from vpl.transport.evaluation import evaluate_pairs, sum_all_lights

PAIRS = 1500
# Surface lights are gathered by Lambertian points alone, and have an oracle of their own in tests/vpl/split
PAIRED = tuple(kind for kind in KINDS if kind != "surface")


def light_ranges(group: LightGroup):
    """Lights in the order of the tree's leaves, (n,), and the range of them below each node, two (m,)."""
    node = np.arange(group.tree.count)
    escape = download(group.tree.escape(upload(mi.UInt32, node)))
    before = np.concatenate([[0], np.cumsum(escape == node + 1)])
    leaves = upload(mi.UInt32, node[escape == node + 1])
    return download(group.tree.representative(leaves)), before[node], before[escape]


def light_of_points(kind, clusters: PointClusters, lights: VirtualLights):
    """The sum that bounds are held against, (points along the tree, lights) float64, for BSDFs that are proxies."""
    batch = clusters.batch
    position, normal, base = (download(x).astype(np.float64) for x in (batch.position, batch.normal, batch.proxy.base))
    peak, exponent, axis = np.zeros_like(base), np.ones(len(base)), normal
    if batch.proxy.glossy:
        lobe = batch.proxy.peak, batch.proxy.exponent, batch.proxy.axis
        peak, exponent, axis = (download(x).astype(np.float64) for x in lobe)

    def light(normal, lights):
        return exact(kind, position, normal, base, peak, exponent, axis, lights, CLAMP)

    truth = light(normal, lights)
    if batch.proxy.without_cosines:
        # Without a cosine: as if the surface faced each light
        everywhere = download(batch.proxy.no_cosine)
        for j in range(lights.count):
            to_light = -lights.direction[j] if lights.position is None else lights.position[j] - position
            facing = np.broadcast_to(to_light, position.shape) / np.linalg.norm(to_light, axis=-1, keepdims=True)
            truth[everywhere, j] = light(facing, lights.select([j]))[everywhere, 0]
    return truth


def worst_pairs(clusters: PointClusters, lights: VirtualLights, rng):
    """Largest ratio of contribution to bound over random pairs of nodes: over all pairs, and over pairs with several
    points and several lights."""
    lit = lit_by(lights)
    group, tree = lit.groups[0], clusters.tree
    order, begin, end = light_ranges(group)
    truth = light_of_points(group.kind, clusters, lights)[:, order]
    # Half of the point nodes are drawn among the upper ones, which are few
    nodes = rng.integers(0, np.where(rng.random(PAIRS) < 0.5, min(64, tree.size), tree.size))
    below = rng.integers(0, group.tree.count, PAIRS)
    points, fetched = clusters.gather(upload(mi.UInt32, nodes)), group.tree.gather(upload(mi.UInt32, below))
    bound = download(contribution_bound(group.kind, points.receiver, fetched, lit.smallest_distance)).astype(np.float64)
    assert not np.isnan(bound).any() and (bound >= 0).all()
    ratio = np.zeros(PAIRS)
    for k, (i, j) in enumerate(zip(nodes, below, strict=True)):
        light = truth[tree.first[i] : tree.first[i] + tree.count[i], begin[j] : end[j]].sum(1).max()
        ratio[k] = light / max(bound[k], 1e-300) if light > 1e-12 * truth.max() else 0
    return ratio.max(), ratio[(tree.count[nodes] > 1) & (end[below] - begin[below] > 1)].max()


def lights_of(kind, rng, spread):
    """Random lights that shine from the camera towards the points."""
    lights = scene_of(kind, rng, np.array(spread))
    lights.direction *= -1
    return lights


@pytest.fixture(scope="module")
def batches():
    """Lambertian and glossy points of a scene."""
    return [job.batch for job in prepared(glossy_room(), vpl_count=100)[1]]


@pytest.mark.parametrize("kind", PAIRED)
@pytest.mark.parametrize("number", [0, 1], ids=["lambertian", "glossy"])
def test_no_point_of_a_box_gets_more_than_its_bound(batches, kind, number):
    rng, clusters = np.random.default_rng(number), PointClusters(batches[number])
    for spread in ((0.9, 0.9, 0.9), (0.9, 0.9, 0), (0, 0, 0)):
        worst, of_clusters = worst_pairs(clusters, lights_of(kind, rng, spread), rng)
        # A cosine rounded by 2^-21 to a power of some hundreds is off by some 1e-4
        assert worst <= 1 + 1e-3
        assert of_clusters > 0.4, "bounds that are never nearly reached would not find an error in this test"


@pytest.mark.parametrize("kind", PAIRED)
def test_bounds_of_boxes_of_any_points_hold(kind):
    """Points of all materials close to the lights, some with bounds without a cosine."""
    rng = np.random.default_rng(3)
    position, normal = rng.uniform(-1, 1, (500, 3)) * [1, 1, 0.2], unit(rng, 500) * 0.5 + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    peak = rng.uniform(0, 5, 500) * (rng.random(500) < 0.5)
    clusters = PointClusters(batch_of(position, normal, peak, rng.random(500) < 0.1))
    for spread in ((1, 1, 1), (0, 0, 1)):
        worst, of_clusters = worst_pairs(clusters, lights_of(kind, rng, spread), rng)
        assert worst <= 1 + 1e-3 and of_clusters > 0.3


@pytest.mark.parametrize(("records", "columns", "value"), [
    ("_records", slice(9, 10), 1.0), ("_records", slice(3, 6), None),
    ("_lobes", slice(3, 4), 1.0), ("_lobes", slice(7, 8), 1e3),
])  # fmt: skip
def test_a_record_that_is_too_narrow_would_be_found(batches, records, columns, value):
    """The harness above notices a wrong cone, lobe or box (whose upper corner is moved to the lower one)."""
    rng, clusters = np.random.default_rng(0), PointClusters(batches[1])
    wrong = download(getattr(clusters, records)).reshape(clusters.tree.size, -1)
    wrong[:, columns] = wrong[:, 0:3] if value is None else value
    setattr(clusters, records, upload(mi.Float, wrong))
    assert worst_pairs(clusters, lights_of("oriented", rng, (0.9, 0.9, 0.9)), rng)[0] > 1.05


ACCEPT = {
    "never": lambda points, lights, bound, index: mi.Bool(False),
    "always": lambda points, lights, bound, index: mi.Bool(True),
    "coarse": lambda points, lights, bound, index: bound < 0.05,
    "fine": lambda points, lights, bound, index: bound < 1e-3,
    "by node": lambda points, lights, bound, index: index % 3 == 0,
}


@pytest.fixture(scope="module")
def jobs():
    """Few points and lights of four kinds: every pair can be looked at."""
    return prepared(glossy_room(), size=16, vpl_count=150, direct="vpl", direct_count=16)[1]


def every_pair(job, clusters, group):
    """Rows (point, light), every light at every point."""
    rows, columns = np.indices((clusters.count, group.count)).reshape(2, -1)
    return upload(mi.UInt32, rows), upload(mi.UInt32, columns)


@pytest.mark.parametrize("accept", ACCEPT)
@pytest.mark.parametrize("number", [0, 1], ids=["lambertian", "glossy"])
def test_pairs_hold_every_point_and_light_that_can_arrive_once(jobs, number, accept):
    job = jobs[number]
    clusters, smallest = PointClusters(job.batch), job.lights.smallest_distance
    tree = clusters.tree
    for group in job.lights.groups:
        counter = BoundCounter(clusters, True)
        found = list(find_pairs(clusters, job.lights, group, ACCEPT[accept], counter))
        order, begin, end = light_ranges(group)
        covered = np.zeros((clusters.count, group.count), int)
        for part in found:
            for i, j in zip(download(part.points), download(part.lights), strict=True):
                covered[tree.first[i] : tree.first[i] + tree.count[i], begin[j] : end[j]] += 1
        rows, columns = every_pair(job, clusters, group)
        surface = clusters.batch.surfaces_at(rows)
        value = download(contribution(group.kind, surface, group.lights.gather(columns), smallest)).max(1)
        arrives = value.reshape(covered.shape)[:, order] > 0
        assert covered.max(initial=0) <= 1 and (covered[arrives] == 1).all()
        # Every split replaces one pair by two
        kept = sum(part.count for part in found)
        assert counter.total % 2 == 1 and kept <= (counter.total + 1) // 2
        assert np.isclose(download(counter.per_point()).sum(dtype=np.float64), counter.total, rtol=1e-5)
        if accept == "always":
            assert kept <= 1
        if accept == "never":
            nodes, lights = (np.concatenate([download(getattr(p, x)) for p in found]) for x in ("points", "lights"))
            assert (tree.child[nodes] == 0).all() and (end[lights] - begin[lights] == 1).all()


def some_pairs(job, clusters, group):
    """Pairs of nodes of all sizes."""
    threshold = dr.opaque(mi.Float, 0.02 * job.mean)
    accept = find_pairs(clusters, job.lights, group, lambda *node: node[2] < threshold, BoundCounter(clusters, False))
    return Pairs.join(list(accept))


def split_in_two(found: Pairs):
    """Every third pair, and the remaining pairs with the pair of roots: lists of the root must not be lost."""
    place, root = np.arange(found.count + 1), dr.opaque(mi.UInt32, 0, 1)
    found = Pairs.join([found, Pairs(root, root)])
    return [found.select(upload(mi.UInt32, place[chosen])) for chosen in (place % 3 > 0, place % 3 == 0)]


def expanded(clusters, found: Pairs):
    """Rows (point, light node) of single points, on the host."""
    tree, nodes = clusters.tree, download(found.points)
    points = [np.arange(tree.first[i], tree.first[i] + tree.count[i]) for i in nodes]
    return np.concatenate(points), np.repeat(download(found.lights), tree.count[nodes])


@pytest.mark.parametrize("number", [0, 1], ids=["lambertian", "glossy"])
def test_lists_hold_each_pair_once_and_paths_lead_down_to_every_point(jobs, number):
    job = jobs[number]
    clusters = PointClusters(job.batch)
    for group in job.lights.groups:
        traced, seen = split_in_two(some_pairs(job, clusters, group))
        lists = list_pairs(group, clusters, [traced], [seen])
        start, end, entries, scales = (download(getattr(lists, x)) for x in ("start", "end", "lights", "scales"))
        listed = [(i, entries[k], scales[k]) for i in range(clusters.tree.size) for k in range(start[i], end[i])]
        expected = []
        for part, mark in ((traced, 0), (seen, 1 << 31)):
            light, scale = group.tree.representative(part.lights), group.representatives(part.lights)[1]
            columns = download(part.points), download(light | mi.UInt32(mark)), download(scale)
            expected += zip(*columns, strict=True)
        assert sorted(listed) == sorted(expected) and lists.any_seen
        first, last, path, length = (download(getattr(lists, x)) for x in ("path_start", "path_end", "path", "length"))
        for k in range(0, clusters.count, 7):
            node, above = int(clusters.tree.leaf[k]), []
            while True:
                above += [node] if end[node] > start[node] else []
                if node == 0:
                    break
                node = int(clusters.tree.parent[node])
            assert path[first[k] : last[k]].tolist() == above[::-1], "from the root down"
            assert length[k] == sum(end[i] - start[i] for i in above)


@pytest.mark.parametrize("number", [0, 1], ids=["lambertian", "glossy"])
def test_lists_are_evaluated_as_their_pairs_one_by_one(jobs, number):
    job = jobs[number]
    clusters = PointClusters(job.batch)
    rows = np.arange(0, clusters.count, 2)
    index = upload(mi.UInt32, rows)
    for group in job.lights.groups:
        parts = traced, seen = split_in_two(some_pairs(job, clusters, group))
        expected, rays = np.zeros((clusters.count, 3)), np.zeros(clusters.count, int)
        for part, is_seen in zip(parts, (False, True), strict=True):
            points, nodes = expanded(clusters, part)
            light, scale = group.representatives(upload(mi.UInt32, nodes))
            surface = clusters.batch.surfaces_at(upload(mi.UInt32, points))
            value, asked = evaluate_pairs(job.transport, group, surface, light, scale, mi.Bool(is_seen))
            np.add.at(expected, points, download(value).astype(np.float64))
            np.add.at(rays, points, download(dr.select(asked, mi.UInt32(1), 0)))
        for chosen, part in ((rows, clusters.batch.select(index)), (np.arange(clusters.count), clusters.batch)):
            lists = list_pairs(group, clusters, [traced], [seen])
            found = evaluate_lists(job.transport, group, part, lists, upload(mi.UInt32, chosen))
            assert np.allclose(download(found[0]), expected[chosen], rtol=1e-4, atol=1e-5 * expected.mean())
            assert np.array_equal(download(found[1]), rays[chosen])


@pytest.mark.parametrize("number", [0, 1], ids=["lambertian", "glossy"])
def test_lists_of_all_single_pairs_are_the_sum_of_all_lights(jobs, number, monkeypatch):
    """The frontier is worked off in parts here: none may be lost or come twice."""
    monkeypatch.setattr(pairs, "_FRONTIER", 500)
    job = jobs[number]
    clusters = PointClusters(job.batch)
    total = np.zeros((clusters.count, 3))
    for group in job.lights.groups:
        counter = BoundCounter(clusters, False)
        found = list(find_pairs(clusters, job.lights, group, ACCEPT["never"], counter))
        assert group.count < 20 or len(found) > 5
        if found:
            lists = list_pairs(group, clusters, found, [])
            row = dr.arange(mi.UInt32, clusters.count)
            total += download(evaluate_lists(job.transport, group, clusters.batch, lists, row)[0])
    exact_sum = download(sum_all_lights(job.transport, clusters.batch)[0])
    assert np.allclose(total, exact_sum, rtol=1e-4, atol=1e-6 * exact_sum.mean())


def test_a_pair_is_accepted_only_below_the_threshold_of_all_its_points(monkeypatch):
    plugin = mi.load_dict({"type": "illuminationcut", "max_cut": 0, "error": 0.05})
    kept = []

    def spy(clusters, lights, group, *more):
        for found in find_pairs(clusters, lights, group, *more):
            kept.append((clusters, group, found))
            yield found

    monkeypatch.setattr("integrators.illuminationcut.find_pairs", spy)
    for job in prepared(glossy_room())[1]:
        kept.clear()
        bright = download(plugin.shade(job).phase_one).astype(np.float64)
        allowed = plugin.error * np.maximum(bright, plugin.dark_floor * job.mean)
        for clusters, group, found in kept:
            least = clusters.tree.reduce(allowed, np.minimum)[download(found.points)]
            points, lights = clusters.gather(found.points), group.tree.gather(found.lights)
            bound = contribution_bound(group.kind, points.receiver, lights, job.lights.smallest_distance)
            single = download((points.child == 0) & (lights.escape == found.lights + 1))
            assert (download(bound) <= least * (1 + 1e-5))[~single].all()
        assert sum(found.count for _, _, found in kept) > 1000
