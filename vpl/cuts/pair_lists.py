"""Evaluating pairs of clusters: every gather point walks the lists of light nodes paired with it and its ancestors.

The pairs of a point are those of its leaf and of all nodes above.  So the light nodes are put in one list per point
node, and a kernel with one lane per point, along the curve, goes through the lists from the root down to its leaf.
Neighbouring lanes share nearly all lists, so that packets of rays leave from one place towards one light; nothing is
expanded to points times lights, and every point sums its own light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..lights.light_set import LightGroup
from ..points.point_clusters import PointClusters
from ..points.point_tree import PointTree
from ..points.surfaces import Batch
from ..transport.evaluation import Transport, evaluate_pairs
from .product_cuts import Pairs

# The bit of a light node's index that marks it as seen by all points of the pair
_SEEN = 1 << 31


@dataclass
class PairLists:
    """Lights by point node: those of node i are ``lights[start[i] : end[i]]``, with factors ``scales`` on their
    intensity.

    ``path``: for every leaf, the nodes from the root down to it that have any lights: those of each gather point are
    ``path[path_start : path_end]``.  ``any_seen``: whether any light is marked as seen; ``length``: lights in all lists
    of each gather point.
    """

    lights: object
    scales: object
    start: object
    end: object
    path: object
    path_start: object
    path_end: object
    any_seen: bool
    length: object


def list_pairs(group: LightGroup, clusters: PointClusters, traced: list[Pairs], seen: list[Pairs]) -> PairLists:
    """Sort pairs by point node; the lights of ``seen`` ones are marked, so that no ray will be traced towards them.

    Light nodes become their representatives here, once for all points of a pair.
    """
    pairs = Pairs.join(traced + [Pairs(part.points, part.lights | mi.UInt32(_SEEN)) for part in seen])
    tree = clusters.tree
    count = dr.zeros(mi.UInt32, tree.size)
    lights, scales = dr.empty(mi.UInt32, pairs.count), dr.empty(mi.Float, pairs.count)
    dr.eval(count, lights, scales)
    place = dr.scatter_inc(count, pairs.points)
    dr.eval(place, count)
    end = dr.cumsum(count)
    start = end - count

    to = dr.gather(mi.UInt32, start, pairs.points) + place
    nodes = pairs.lights & ~mi.UInt32(_SEEN)
    dr.scatter(lights, group.tree.representative(nodes) | (pairs.lights & mi.UInt32(_SEEN)), to)
    dr.scatter(scales, group.representatives(nodes)[1], to)
    dr.eval(lights, scales, start, end)
    count = download(count)
    paths = (upload(mi.UInt32, x) for x in _paths(tree, count > 0))
    length = upload(mi.UInt32, tree.push_down(count)[tree.leaf])
    return PairLists(lights, scales, start, end, *paths, len(seen) > 0, length)


def _paths(tree: PointTree, filled: np.ndarray):
    """Nodes with a list from the root down to every leaf, one leaf after the other, and where each point's are."""
    length = tree.push_down(filled.astype(np.uint32))
    leaves = tree.leaves
    end = np.cumsum(length[leaves], dtype=np.int64)
    path = np.zeros(end[-1], np.uint32)
    node, place = leaves, end - 1
    while len(node):
        inside = filled[node]
        path[place[inside]] = node[inside]
        place = place - inside
        onward = node > 0
        node, place = tree.parent[node[onward]].astype(np.int64), place[onward]
    size = tree.count[leaves]
    return path, np.repeat(end - length[leaves], size), np.repeat(end, size)


@dr.syntax
def evaluate_lists(transport: Transport, group: LightGroup, batch: Batch, lists, rows):
    """Light of a group at the points of a batch, and shadow rays traced for each: (radiance, rays).

    ``rows``: where each point of the batch lies along the tree that ``lists`` (:class:`PairLists`) belong to.
    """
    surface = batch.surfaces
    radiance, rays = dr.zeros(mi.UnpolarizedSpectrum, batch.count), dr.zeros(mi.UInt32, batch.count)
    # One loop, not one in another: lanes share their lists down to where their paths part, and wait for nothing below
    j, last = dr.gather(mi.UInt32, lists.path_start, rows), dr.gather(mi.UInt32, lists.path_end, rows)
    node = dr.gather(mi.UInt32, lists.path, j, j < last)
    k, end = dr.gather(mi.UInt32, lists.start, node, j < last), dr.gather(mi.UInt32, lists.end, node, j < last)
    while dr.hint(k < end, exclude=[transport, group, surface, lists]):
        entry, scale = dr.gather(mi.UInt32, lists.lights, k), dr.gather(mi.Float, lists.scales, k)
        seen = (entry & _SEEN) != 0 if lists.any_seen else None
        light = group.lights.gather(entry & ~mi.UInt32(_SEEN))
        value, traced = evaluate_pairs(transport, group, surface, light, scale, seen)
        radiance += value
        rays += dr.select(traced, 1, 0)
        k += 1
        finished = k >= end
        j += dr.select(finished, 1, 0)
        finished &= j < last
        node = dr.gather(mi.UInt32, lists.path, j, finished)
        k = dr.select(finished, dr.gather(mi.UInt32, lists.start, node, finished), k)
        end = dr.select(finished, dr.gather(mi.UInt32, lists.end, node, finished), end)
    dr.eval(radiance, rays)
    return radiance, rays
