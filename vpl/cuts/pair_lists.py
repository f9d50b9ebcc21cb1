"""Evaluation of pairs of clusters: every gather point traverses the light lists of its leaf and its leaf's ancestors.

Every point node has a list of its light nodes.  A kernel with one lane per point, along the curve, traverses the lists
from the root to the point's leaf.  Neighbouring lanes share nearly all lists, hence packets of rays have close origins
and a common light.  No array of points times lights is needed, and every point sums its own radiance.
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

# Bit of a light's index that marks it as visible from every point of the pair
_SEEN = 1 << 31


@dataclass
class PairLists:
    """Lists of lights per point node: node i has ``lights[start[i] : end[i]]`` with scale factors ``scales``.

    ``path``: for every leaf, the nodes with a non-empty list from the root to the leaf; a gather point has the nodes
    ``path[path_start : path_end]``.  ``any_seen``: whether any light is marked as visible; ``length``: total length of
    each gather point's lists.
    """

    lights: mi.UInt32
    scales: mi.Float
    start: mi.UInt32
    end: mi.UInt32
    path: mi.UInt32
    path_start: mi.UInt32
    path_end: mi.UInt32
    any_seen: bool
    length: mi.UInt32


def list_pairs(group: LightGroup, clusters: PointClusters, traced: list[Pairs], seen: list[Pairs]) -> PairLists:
    """Sort pairs by point node and replace light nodes by their representatives.

    Lights of ``seen`` pairs are marked as visible: no ray is traced.
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
    """(``path``, ``path_start``, ``path_end``) of :class:`PairLists`; ``filled``: mask of nodes with a list."""
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
    """(Radiance due to a group of lights [IC eq. 3], shadow rays) at the points of a batch.

    ``lists``: :class:`PairLists`; ``rows``: index of each point in the lists' tree order.
    """
    surface = batch.surfaces
    radiance, rays = dr.zeros(mi.UnpolarizedSpectrum, batch.count), dr.zeros(mi.UInt32, batch.count)
    # One loop instead of nested loops: lanes with a common list stay together, and no lane waits at the end of a list
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
