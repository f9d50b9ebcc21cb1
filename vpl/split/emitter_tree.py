"""Tree over the emitters of a scene that have a place, by which one is drawn for a vertex: near and bright ones first.

From the root down, a child is chosen in proportion to its intensity over the squared distance [Conty Estevez and Kulla
2018, "Importance sampling of many lights with adaptive tree splitting"].  The tree lies in preorder, so that the way
down to a known emitter, and with it the probability of having drawn it, needs no record of turns.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..lights.light_set import largest_below
from ..lights.light_tree import BOX_MAX, BOX_MIN, INTENSITY, build_light_tree

_RECORD = 8


class EmitterTree:
    """Tree over emitters at ``position`` (n, 3), of ``radius`` (n,) around it, and ``intensity`` (n,) at a distance."""

    def __init__(self, position: np.ndarray, radius: np.ndarray, intensity: np.ndarray):
        self.count = len(position)
        colours = np.repeat(intensity[:, None], 3, axis=1).astype(np.float32)
        tree = build_light_tree(position.astype(np.float32), None, colours, np.random.default_rng(0))
        low, high = tree.records[:, BOX_MIN].astype(np.float64), tree.records[:, BOX_MAX].astype(np.float64)
        records = np.zeros((len(tree.records), _RECORD), np.float32)
        records[:, 0:3] = 0.5 * (low + high)
        # Emitters reach beyond their places: no distance is below half the size of what a node holds
        records[:, 3] = (0.5 * np.linalg.norm(high - low, axis=1) + largest_below(tree, radius)) ** 2
        leaf = tree.escape == np.arange(len(tree.records)) + 1
        records[:, 4] = tree.records[:, INTENSITY]
        records[:, 5] = tree.escape.astype(np.uint32).view(np.float32)
        records[:, 6] = tree.representative.astype(np.uint32).view(np.float32)
        self._records = upload(mi.Float, records)
        node_of_emitter = np.zeros(len(position), np.uint32)
        node_of_emitter[tree.representative[leaf]] = np.flatnonzero(leaf)
        self._leaf = upload(mi.UInt32, node_of_emitter)

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

    @dr.syntax
    def draw(self, position, number, active):
        """The row of an emitter for each position, by a uniform number."""
        node = mi.UInt32(0)
        inner = active & (self._escape(node) != 1)
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
        """Probability with which :meth:`draw` finds the emitter of a row."""
        target = dr.gather(mi.UInt32, self._leaf, row, active)
        node, probability = mi.UInt32(0), mi.Float(1)
        inner = active & (target != 0)
        while dr.hint(inner, exclude=[self]):
            left = node + 1
            right = self._escape(left)
            share = self._left_share(left, right, position)
            turns = target >= right
            probability *= dr.select(turns, 1 - share, share)
            node = dr.select(turns, right, left)
            inner = node != target
        return dr.select(active, probability, 0)
