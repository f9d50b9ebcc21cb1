"""Tree over the emitters of a scene that have a place, by which one is drawn for a vertex: near and bright ones first.

From the root down, a child is chosen in proportion to its intensity over the squared distance [Conty Estevez and Kulla
2018, "Importance sampling of many lights with adaptive tree splitting"].  The tree lies in preorder, so that the way
down to a known emitter, and with it the probability of having drawn it, needs no record of turns.
"""

from __future__ import annotations

from heapq import heappop, heappush

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..lights.light_set import largest_below, moments_below
from ..lights.light_tree import BOX_MAX, BOX_MIN, INTENSITY, build_light_tree

_RECORD = 8
# Distance that a vertex has to the emitters of a node at least, as it is taken, in standard deviations of their places.
# Lower than their spread: a vertex that is near the middle of them is likely to be near some, which would else be drawn
# too seldom
_LEAST_DISTANCE = 0.6
# Intensity of an emitter next to that of the brightest, as it is taken at least
_LEAST_INTENSITY = 1e-12


class EmitterTree:
    """Tree over emitters at ``position`` (n, 3), of ``radius`` (n,) around it, and ``intensity`` (n,) at a distance.

    ``clusters``: how many subtrees there are that a choice may begin with, of up to ``most_clusters``.
    """

    def __init__(self, position: np.ndarray, radius: np.ndarray, intensity: np.ndarray, most_clusters: int):
        self.count = len(position)
        # Black emitters, too, have a place in a tree
        least = _LEAST_INTENSITY * float(intensity.max()) or 1.0
        intensity = np.maximum(intensity, least)
        colours = np.repeat(intensity[:, None], 3, axis=1).astype(np.float32)
        tree = build_light_tree(position.astype(np.float32), None, colours, np.random.default_rng(0))
        low, high = tree.records[:, BOX_MIN].astype(np.float64), tree.records[:, BOX_MAX].astype(np.float64)
        records = np.zeros((len(tree.records), _RECORD), np.float32)
        records[:, 0:3], variance = moments_below(tree, position, intensity)
        # Emitters reach beyond their places
        records[:, 3] = _LEAST_DISTANCE**2 * variance + largest_below(tree, radius) ** 2
        leaf = tree.escape == np.arange(len(tree.records)) + 1
        records[:, 4] = tree.records[:, INTENSITY]
        records[:, 5] = tree.escape.astype(np.uint32).view(np.float32)
        records[:, 6] = tree.representative.astype(np.uint32).view(np.float32)
        self._records = upload(mi.Float, records)
        node_of_emitter = np.zeros(len(position), np.uint32)
        node_of_emitter[tree.representative[leaf]] = np.flatnonzero(leaf)
        self._leaf = upload(mi.UInt32, node_of_emitter)
        roots = _cut(tree.escape, records[:, 4], np.linalg.norm(high - low, axis=1), most_clusters)
        self.clusters = len(roots)
        self._root = upload(mi.UInt32, roots)
        self._cluster = upload(mi.UInt32, np.searchsorted(roots, node_of_emitter, side="right") - 1)

    def _escape(self, node):
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._records, node * _RECORD + 5))

    def _importance(self, node, position):
        place = dr.gather(mi.Vector4f, self._records, node * 2)
        intensity = dr.gather(mi.Float, self._records, node * _RECORD + 4)
        return intensity / dr.maximum(dr.squared_norm(place.xyz - position), place.w)

    def _left_share(self, left, right, position):
        """Probability of the left one of two children."""
        of_left, of_right = self._importance(left, position), self._importance(right, position)
        share = of_left / (of_left + of_right)
        return dr.select(dr.isfinite(share), share, 0.5)

    def cluster(self, row, active):
        """The cluster that the emitter of a row is in."""
        return dr.gather(mi.UInt32, self._cluster, row, active)

    def root(self, cluster, active):
        """The node that a cluster is."""
        return dr.gather(mi.UInt32, self._root, cluster, active)

    @dr.syntax
    def draw(self, node, position, number, active):
        """The row of an emitter below a node (0: the root) for each position, by a uniform number."""
        node = mi.UInt32(node)
        inner = active & (self._escape(node) != node + 1)
        while dr.hint(inner, exclude=[self]):
            left = node + 1
            right = self._escape(left)
            share = self._left_share(left, right, position)
            turns = number >= share
            taken = dr.select(turns, 1 - share, share)
            number = dr.select(turns, number - share, number) / taken
            number = dr.minimum(number, dr.one_minus_epsilon(mi.Float))
            node = dr.select(turns, right, left)
            inner = self._escape(node) != node + 1
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._records, node * _RECORD + 6))

    @dr.syntax
    def probability(self, row, position, active):
        """Probabilities with which :meth:`draw` finds the emitter of a row: (from the root, from its cluster)."""
        target = dr.gather(mi.UInt32, self._leaf, row, active)
        root = self.root(self.cluster(row, active), active)
        node, probability, within = mi.UInt32(0), mi.Float(1), mi.Float(1)
        inner = active & (target != 0)
        while dr.hint(inner, exclude=[self]):
            left = node + 1
            right = self._escape(left)
            share = self._left_share(left, right, position)
            turns = target >= right
            taken = dr.select(turns, 1 - share, share)
            probability *= taken
            node = dr.select(turns, right, left)
            within = dr.select(node <= root, 1, within * taken)
            inner = node != target
        return dr.select(active, probability, 0), dr.select(active, within, 0)


def _cut(escape: np.ndarray, intensity: np.ndarray, size: np.ndarray, most: int) -> np.ndarray:
    """Nodes, sorted, below which all leaves are, each below one: those are divided first that are bright and large."""
    priority = np.asarray(intensity, np.float64) * size
    nodes, leaves = [(-priority[0], 0)], []
    while nodes and len(nodes) + len(leaves) < most:
        _, node = heappop(nodes)
        if escape[node] == node + 1:
            leaves.append(node)
            continue
        for child in (node + 1, escape[node + 1]):
            heappush(nodes, (-priority[child], int(child)))
    return np.sort(leaves + [node for _, node in nodes])
