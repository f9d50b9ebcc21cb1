"""Tree over emitters, from which one is drawn for each vertex, with the probability of the draw."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import upload
from ...lights.light_set import largest_below, moments_below
from ...lights.light_tree import BOX_MAX, BOX_MIN, INTENSITY, LightTree, build_light_tree

# Vectors of four floats in a node's record: the two children's places, and their intensities with the node's links
_VECTORS = 3
# Least distance of a vertex to a node, in standard deviations of the emitters' positions. Below 1, because a vertex
# near the mean is likely to be near some emitters, which would be drawn too rarely
_LEAST_DISTANCE = 0.6
# Least intensity of an emitter relative to the brightest: the tree needs positive intensities, also of black emitters
_LEAST_INTENSITY = 1e-12


@dataclass
class Found:
    """Emitters at the ends of walks, one per lane; all fields are 0 in inactive lanes.

    ``row`` of the emitter; ``cluster`` of the emitter; ``probability``, ``within``: of a draw of the emitter from the
    root, and from its cluster.
    """

    row: mi.UInt32
    cluster: mi.UInt32
    probability: mi.Float
    within: mi.Float


class EmitterTree:
    """Tree over emitters at ``position`` (n, 3) with a ``radius`` (n,) and a radiant ``intensity`` (n,).

    From the root down, a child is drawn in proportion to its intensity over the squared distance [Conty Estevez and
    Kulla 2018, "Importance sampling of many lights with adaptive tree splitting"].  The tree lies in preorder, so the
    way to a known node needs no record of turns, and the walk of a draw and that to a known emitter are the same loop.
    ``count``: number of emitters; ``clusters``: number of subtrees at the beginning of a learned choice, limited by
    ``most_clusters``.
    """

    def __init__(self, position: np.ndarray, radius: np.ndarray, intensity: np.ndarray, most_clusters: int):
        self.count = len(position)
        least = _LEAST_INTENSITY * float(intensity.max()) or 1.0
        intensity = np.maximum(intensity, least)
        colours = np.repeat(intensity[:, None], 3, axis=1).astype(np.float32)
        tree = build_light_tree(position.astype(np.float32), None, colours)
        roots = _cut(tree, most_clusters)
        self.clusters = len(roots)
        self._root = upload(mi.UInt32, roots)
        mean, variance = moments_below(tree, position, intensity)
        # Lower bound of the squared distance of a vertex: emitters extend beyond a single position
        place = np.column_stack([mean, _LEAST_DISTANCE**2 * variance + largest_below(tree, radius) ** 2])
        self._records = upload(mi.Float, _records(tree, place, roots))
        node_of_emitter = np.zeros(self.count, np.uint32)
        node_of_emitter[tree.leaf_order] = np.flatnonzero(tree.is_leaf)
        self._leaf = upload(mi.UInt32, node_of_emitter)

    def root(self, cluster, active):
        """The node of a cluster."""
        return dr.gather(mi.UInt32, self._root, cluster, active)

    def leaf(self, row, active):
        """The node of the emitter in a row."""
        return dr.gather(mi.UInt32, self._leaf, row, active)

    @dr.syntax
    def walk(self, target, number, position, active) -> Found:
        """Walk from the root to the node ``target``, and draw an emitter below it by a uniform ``number``.

        The target 0, the root, draws from the whole tree, and that of :meth:`root` from a cluster.  That of
        :meth:`leaf` finds the probability of an emitter, whatever the number.
        """
        node, number = mi.UInt32(0), mi.Float(number)
        links = self._vector(node, 2, active)
        probability, within, cluster = mi.Float(1), mi.Float(1), _bits(links.w)
        inner = active & (_bits(links.z) != 0)
        while dr.hint(inner, exclude=[self, position, target]):
            left, right = node + 1, _bits(links.z)
            share = self._left_share(node, links, position)
            # In preorder, the nodes before the target are those above it
            above = node < target
            turns = dr.select(above, target >= right, number >= share)
            taken = dr.select(turns, 1 - share, share)
            rest = dr.select(turns, number - share, number) / taken
            number = dr.select(above, number, dr.minimum(rest, dr.one_minus_epsilon(mi.Float)))
            node = dr.select(turns, right, left)
            links = self._vector(node, 2, inner)
            probability *= taken
            begins = _bits(links.w) != 0
            cluster = dr.select(begins, _bits(links.w), cluster)
            within = dr.select(begins, 1, within * taken)
            inner = _bits(links.z) != 0
        cluster = dr.select(active, cluster - 1, 0)
        return Found(_bits(links.x), cluster, dr.select(active, probability, 0), dr.select(active, within, 0))

    def _vector(self, node, index, active):
        """A vector of the records of nodes."""
        return dr.gather(mi.Vector4f, self._records, node * _VECTORS + index, active)

    def _left_share(self, node, links, position):
        """Probability of the left child of inner nodes."""
        left, right = (self._vector(node, index, True) for index in (0, 1))
        left, right = (dr.maximum(dr.squared_norm(place.xyz - position), place.w) for place in (left, right))
        # Intensities over squared distances, with a common denominator
        of_left, of_right = links.x * right, links.y * left
        share = of_left / (of_left + of_right)
        return dr.select(dr.isfinite(share), share, 0.5)


def _bits(number):
    """The unsigned integers stored in floats."""
    return dr.reinterpret_array(mi.UInt32, number)


def _records(tree: LightTree, place: np.ndarray, roots: np.ndarray) -> np.ndarray:
    """Records of all nodes, (nodes, 3, 4) float32; ``place``: mean position and least squared distance; ``roots`` of
    clusters.

    Vectors of inner nodes: place of the left child; place of the right child; the children's intensities over that of
    the root, the right child, and the cluster that begins at the node, from 1 on, or 0.  The last vector of leaves: row
    of the emitter, 0, 0, and the cluster that begins at the leaf.
    """
    records = np.zeros((len(place), _VECTORS, 4), np.float32)
    inner = np.flatnonzero(~tree.is_leaf)
    # Products of intensities and squared distances stay within single precision, whatever the unit of light
    intensity = tree.records[:, INTENSITY] / tree.records[0, INTENSITY]
    right = tree.escape[inner + 1]
    for index, child in enumerate((inner + 1, right)):
        records[inner, index] = place[child]
        records[inner, 2, index] = intensity[child]
    links = records.view(np.uint32)
    links[inner, 2, 2] = right
    links[tree.is_leaf, 2, 0] = tree.leaf_order
    links[roots, 2, 3] = np.arange(len(roots)) + 1
    return records


def _cut(tree: LightTree, most: int) -> np.ndarray:
    """A cut of at most ``most`` nodes, sorted: divides the node with the largest intensity × size first."""
    low, high = (tree.records[:, box].astype(np.float64) for box in (BOX_MIN, BOX_MAX))
    priority = tree.records[:, INTENSITY] * np.linalg.norm(high - low, axis=1)
    is_leaf, nodes, leaves = tree.is_leaf, [(-priority[0], 0)], []
    while nodes and len(nodes) + len(leaves) < most:
        _, node = heappop(nodes)
        if is_leaf[node]:
            leaves.append(node)
            continue
        for child in (node + 1, tree.escape[node + 1]):
            heappush(nodes, (-priority[child], int(child)))
    return np.sort(leaves + [node for _, node in nodes])
