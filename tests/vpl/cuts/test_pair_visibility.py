"""Adaptive visibility of pairs: results of probes, divided pairs, and remaining rays."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.pairs import batch_of, lit_by
from tests.support.scenes import sensor, wall
from vpl.core.arrays import download, upload
from vpl.cuts import adaptive_visibility as pair_visibility
from vpl.cuts.adaptive_visibility import decide_visibility
from vpl.cuts.pair_lists import evaluate_lists, list_pairs
from vpl.cuts.product_cuts import Pairs
from vpl.lights.virtual_lights import VirtualLights
from vpl.points.camera_paths import scene_traits
from vpl.points.point_clusters import PointClusters
from vpl.transport.evaluation import Transport, sum_all_lights

OPAQUE = {"type": "diffuse"}
VEIL = {"type": "mask", "opacity": 0.5, "nested": OPAQUE}
# Extent and material of the roof over each of four tiles of points
ROOFS = {"open": (0, OPAQUE), "closed": (2, OPAQUE), "half": (1, OPAQUE), "veiled": (2, VEIL)}
SIDE = 16


class Tiles:
    """Four tiles of points in a row, under nothing, a roof, half a roof and a veil; lights above all of them.

    ``tiles``: tiles below the points of each node; ``dark``: points without any light; both in the order of the point
    tree.
    """

    def __init__(self, kind, lamps=8, turned=()):
        scene, side = {"type": "scene", "sensor": sensor()}, (np.arange(SIDE) + 0.5) / SIDE - 0.5
        position = []
        for k, (reach, bsdf) in enumerate(ROOFS.values()):
            position.append(np.stack(np.meshgrid(4.0 * k + side, side, [0.0], indexing="ij"), -1).reshape(-1, 3))
            if reach:
                # A hair off the middle, where no point lies
                edge = 0.01 if reach == 1 else 0.8
                scene[f"roof{k}"] = wall([4.0 * k + edge - 0.8, 0, 0.1], [0, 0, 1], 0, 0.8, bsdf=bsdf)
        position = np.concatenate(position)
        normal = np.tile([0.0, 0.0, 1.0], (len(position), 1))
        tile = np.repeat(list(ROOFS), SIDE * SIDE)
        for name in turned:
            normal[tile == name] = [0, 0, -1]
        self.scene = mi.load_dict(scene)
        traits = scene_traits(self.scene)
        self.clusters = PointClusters(batch_of(position, normal))
        tree = self.clusters.tree
        tile, x = tile[tree.order], position[tree.order, 0]
        self.tiles = [set(tile[i : i + n]) for i, n in zip(tree.first, tree.count, strict=True)]
        closed = (tile == "closed") | ((tile == "half") & (x < 8.01)) | ((tile == "veiled") & (kind == "point"))
        self.dark = closed | np.isin(tile, turned)
        # Distant lights: shadows lie right below the roofs, and all lights see the same points
        rng = np.random.default_rng(0)
        place, down = [6, 0, 1e4] + rng.uniform(-1, 1, (lamps, 3)) * [1, 1, 0], np.tile([0.0, 0.0, -1.0], (lamps, 1))
        self.lights = lit_by(
            VirtualLights.of(kind, None if kind == "environment" else place, down, np.full((lamps, 3), 1e8))
        )
        self.group = self.lights.groups[0]
        self.transport = Transport(self.scene, traits, self.lights)

    def pairs_with_all_lights(self, nodes):
        """Pairs of some point nodes and the root of the lights."""
        return Pairs(upload(mi.UInt32, nodes), dr.opaque(mi.UInt32, 0, len(nodes)))

    def decide(self, pairs):
        """Open and traced pairs as lists of (point node, light node), and rays per point."""
        rays = dr.zeros(mi.UInt32, self.clusters.count)
        found = decide_visibility(self.transport, self.group, self.clusters, pairs, rays)
        return *found, download(rays)

    def points_of(self, pairs: Pairs):
        """How often each point is in a list of pairs."""
        tree, count = self.clusters.tree, np.zeros(self.clusters.count, int)
        for part in pairs:
            for node in download(part.points):
                count[tree.first[node] : tree.first[node] + tree.count[node]] += 1
        return count


@pytest.mark.usefixtures("restore_variant")
@pytest.mark.parametrize(
    ("variant", "kind"),
    [
        ("llvm_ad_rgb", "point"),
        ("llvm_ad_rgb", "oriented"),
        ("llvm_ad_rgb", "environment"),
        ("llvm_ad_mono", "point"),
        ("llvm_ad_mono", "oriented"),
    ],
)
def test_probes_tell_open_closed_and_mixed_pairs_apart(variant, kind):
    """A single kernel probes all pairs: probes of a pair must not decide for a different pair."""
    mi.set_variant(variant)
    place = Tiles(kind)
    tree = place.clusters.tree
    nodes = [i for i in range(tree.size) if tree.count[i] == SIDE * SIDE and len(place.tiles[i]) == 1]
    assert len(nodes) == 4
    rays = dr.zeros(mi.UInt32, place.clusters.count)
    union = pair_visibility._probe(
        place.transport,
        place.group,
        place.clusters,
        place.pairs_with_all_lights(nodes),
        16,
        rays,
    )
    found = {next(iter(place.tiles[i])): int(flags) for i, flags in zip(nodes, download(union), strict=True)}
    opened, closed = pair_visibility._OPEN, pair_visibility._CLOSED
    # Towards point lights a veil blocks, because no camera path passes it; elsewhere it is neither open nor closed
    veiled = closed if kind == "point" else opened | closed
    assert found == {"open": opened, "closed": closed, "half": opened | closed, "veiled": veiled}
    assert download(rays).sum() == 4 * 16 and download(rays).max() == 1


@pytest.mark.parametrize("kind", ["point", "oriented", "environment"])
def test_points_are_open_traced_or_dark_and_their_light_is_that_of_all_rays(kind):
    place = Tiles(kind)
    clusters = place.clusters
    opened, traced, rays = place.decide(place.pairs_with_all_lights([0]))
    lit, asked = place.points_of(opened), place.points_of(traced)
    assert (lit + asked).max() == 1 and not (lit > 0)[place.dark].any() and (lit + asked)[~place.dark].all()
    assert 0 < rays.sum() < 0.5 * clusters.count
    row = dr.arange(mi.UInt32, clusters.count)
    lists = list_pairs(place.group, clusters, traced, opened)
    ours, more = evaluate_lists(place.transport, place.group, clusters.batch, lists, row)
    exact = sum_all_lights(place.transport, clusters.batch)[0]
    assert np.allclose(download(ours), download(exact), rtol=1e-4, atol=0)
    assert np.array_equal(download(more), asked), "one ray for each point of a pair that is traced, none for open ones"
    # Open and closed tiles are left to their probes but for leftovers; the veiled one never is, if it passes light
    tile = {name: np.array([place.tiles[leaf] == {name} for leaf in clusters.tree.leaf]) for name in ROOFS}
    assert lit[tile["open"]].mean() > 0.8 and asked[tile["veiled"]].all() == (kind != "point")
    assert asked[tile["closed"]].mean() < 0.2


def test_probing_in_parts_changes_nothing(monkeypatch):
    place = Tiles("oriented")
    nodes = np.flatnonzero(place.clusters.tree.count >= 32)
    whole = place.decide(place.pairs_with_all_lights(nodes))
    monkeypatch.setattr(pair_visibility, "_PROBES_PER_KERNEL", 48)
    parts = place.decide(place.pairs_with_all_lights(nodes))
    assert np.array_equal(whole[2], parts[2])
    for one, other in zip(whole[:2], parts[:2], strict=True):
        both = [np.concatenate([download(part.points) for part in side]) for side in (one, other)]
        assert np.array_equal(*map(np.sort, both)) and len(both[0])


def test_small_pairs_and_single_lights_are_not_probed():
    place = Tiles("point")
    tree = place.clusters.tree
    small = np.flatnonzero((tree.count < 32) & (tree.count > 8))
    single = place.group.tree.count - 1
    assert int(place.group.tree.escape(mi.UInt32(single))[0]) == single + 1
    for pairs in (
        place.pairs_with_all_lights(small),
        Pairs(dr.opaque(mi.UInt32, 0, 1), dr.opaque(mi.UInt32, single, 1)),
    ):
        opened, traced, rays = place.decide(pairs)
        assert opened == [] and rays.sum() == 0
        assert np.array_equal(download(traced[0].points), download(pairs.points))


def test_pairs_that_no_probe_can_vote_for_are_traced():
    """Points that face away from the lights ask for no ray, and their neighbours may still need theirs."""
    place = Tiles("point", turned=("open",))
    tree = place.clusters.tree
    away = [i for i in range(tree.size) if place.tiles[i] == {"open"} and tree.count[i] == SIDE * SIDE]
    opened, traced, rays = place.decide(place.pairs_with_all_lights(away))
    assert opened == [] and rays.sum() == 0 and place.points_of(traced).sum() == SIDE * SIDE
    everything = place.decide(place.pairs_with_all_lights([0]))
    lit = place.points_of(everything[0]) + place.points_of(everything[1])
    assert lit[~place.dark].all() and lit.max() == 1


def test_coincident_points_are_divided_until_their_rays_are_traced():
    """The division of coincident points must end; here a veil keeps every pair undecided."""
    rng = np.random.default_rng(0)
    position = np.zeros((500, 3))
    clusters = PointClusters(batch_of(position, np.tile([0.0, 0.0, 1.0], (500, 1))))
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "veil": wall([0, 0, 0.5], [0, 0, 1], 0, 1.0, bsdf=VEIL)})
    down = np.tile([0.0, 0.0, -1.0], (8, 1))
    lights = lit_by(VirtualLights.of("oriented", [0, 0, 1] + rng.uniform(-0.1, 0.1, (8, 3)), down, np.ones((8, 3))))
    rays = dr.zeros(mi.UInt32, 500)
    pair = Pairs(dr.opaque(mi.UInt32, 0, 1), dr.opaque(mi.UInt32, 0, 1))
    transport = Transport(scene, scene_traits(scene), lights)
    opened, traced = decide_visibility(transport, lights.groups[0], clusters, pair, rays)
    nodes = np.concatenate([download(part.points) for part in traced])
    assert opened == [] and clusters.tree.count[nodes].sum() == 500 and clusters.tree.count[nodes].max() < 32
