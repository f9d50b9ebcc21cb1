"""Pairs of a cluster of gather points and a cluster of lights, by simultaneous descent of both trees [IC section 3].

The papers use a stack of pairs.  Here the pairs of a step form an array: one kernel bounds and classifies them.
Accepted pairs are yielded; each remaining pair is replaced by the two pairs with the children of its split node.  A
frontier of more than ``_FRONTIER`` pairs is processed in parts, which bounds memory.

Departure from the paper: the choice between splitting points or lights compares more than the radii of both boxes.
The spread of normals and mirror directions, times the distance to the lights, adds to the radius of the points.  With
radii alone, lights are split because of dissimilar points and stay split for their parts: at equal error, the number
of shadow rays was 1.1 (cornell) to 2.5 times as large (dining_room, glossy points).

Pairs do not record the cut of a single point.  Thresholds limit the size of cuts: see :func:`raise_thresholds`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, download, upload
from ..lights.light_set import LightGroup, LightSet
from ..lights.virtual_lights import AT_INFINITY
from ..points.point_clusters import PointClusters
from ..transport.bounds import chord, contribution_bound
from .light_cuts import limited_cuts, upload_thresholds

# Pairs classified at a time
_FRONTIER = 1 << 22
# Weight of a cone's chord times the distance to the lights, relative to the radius of the points
_CONE_WEIGHT = 2.0
# Classes of pairs; 0: no light arrives
_ACCEPTED, _SPLIT_POINTS, _SPLIT_LIGHTS = 1, 2, 3


@dataclass
class Pairs:
    """Pairs of nodes, one per entry: indices ``points`` in the point tree and ``lights`` in the light tree."""

    points: mi.UInt32
    lights: mi.UInt32

    @property
    def count(self) -> int:
        return dr.width(self.points)

    def select(self, index) -> Pairs:
        """Pairs at the indices ``index``, evaluated."""
        if dr.width(index) == 0:
            return Pairs(mi.UInt32(), mi.UInt32())
        picked = Pairs(dr.gather(mi.UInt32, self.points, index), dr.gather(mi.UInt32, self.lights, index))
        dr.eval(picked.points, picked.lights)
        return picked

    def slice(self, first: int, most: int) -> Pairs:
        """At most ``most`` consecutive pairs from ``first`` on, evaluated."""
        if first == 0 and self.count <= most:
            return self
        return self.select(dr.arange(mi.UInt32, min(most, self.count - first)) + dr.opaque(mi.UInt32, first))

    @staticmethod
    def join(parts: list[Pairs]) -> Pairs:
        """Concatenate parts, evaluated."""
        count = sum(part.count for part in parts)
        joined = Pairs(dr.empty(mi.UInt32, count), dr.empty(mi.UInt32, count))
        first = 0
        for part in parts:
            # dr.concat would compile every offset into its own kernel
            place = dr.arange(mi.UInt32, part.count) + dr.opaque(mi.UInt32, first)
            dr.scatter(joined.points, part.points, place)
            dr.scatter(joined.lights, part.lights, place)
            dr.eval(joined.points, joined.lights)
            first += part.count
        return joined


def _lights_spread_more(kind: str, points, lights):
    """Whether to split the light node of a pair rather than the point node."""
    spread = chord(points.receiver.normal_cosine)
    if points.receiver.mirror_cosine is not None:
        spread += chord(points.receiver.mirror_cosine)
    if kind in AT_INFINITY:
        return chord(lights.cosine) > _CONE_WEIGHT * spread
    distance = dr.norm(lights.center - points.receiver.position)
    return lights.radius > points.radius + _CONE_WEIGHT * distance * spread


def _classify(clusters: PointClusters, group: LightGroup, pairs: Pairs, accept, points_first, smallest_distance):
    """(Class of every pair, second child of its split node) ([IC] Algorithm 1), in one kernel.

    ``accept``, ``points_first``: functions of (point node, light node, bound, index of the point node) to a mask.
    """
    points, lights = clusters.gather(pairs.points), group.tree.gather(pairs.lights)
    bound = contribution_bound(group.kind, points.receiver, lights, smallest_distance)
    single, lowest = lights.escape == pairs.lights + 1, points.child == 0
    accepted = (single & lowest) | accept(points, lights, bound, pairs.points)
    # Algorithm 1, line 10: split the larger node if it has children
    of_lights = ~single & (lowest | _lights_spread_more(group.kind, points, lights))
    if points_first is not None:
        of_lights &= lowest | ~points_first(points, lights, bound, pairs.points)
    kind = dr.select(accepted, _ACCEPTED, dr.select(of_lights, mi.UInt32(_SPLIT_LIGHTS), _SPLIT_POINTS))
    kind = dr.select(bound > 0, kind, 0)
    second = dr.select(of_lights, group.tree.escape(pairs.lights + 1, kind == _SPLIT_LIGHTS), points.child + 1)
    dr.eval(kind, second)
    return kind, second


def _children(pairs: Pairs, kind, second, split) -> Pairs:
    """The two adjacent pairs that replace each pair of the index array ``split``."""
    lane = dr.arange(mi.UInt32, 2 * len(split))
    parent = dr.gather(mi.UInt32, split, lane >> 1)
    points, lights = (dr.gather(mi.UInt32, x, parent) for x in (pairs.points, pairs.lights))
    of_lights = dr.gather(mi.UInt32, kind, parent) == _SPLIT_LIGHTS
    chosen, first = dr.gather(mi.UInt32, second, parent), (lane & 1) == 0
    # Light nodes are in preorder: the first child follows its parent.  Sibling point nodes are adjacent.
    points = dr.select(of_lights, points, dr.select(first, chosen - 1, chosen))
    lights = dr.select(of_lights, dr.select(first, lights + 1, chosen), lights)
    dr.eval(points, lights)
    return Pairs(points, lights)


class BoundCounter:
    """Counts computed bounds: ``total``, and per point if ``located``.

    A bound of a cluster of points counts as 1 / number of points for each point ([IC] section 4, figure 4).
    """

    def __init__(self, clusters: PointClusters, located: bool):
        self.total, self._clusters, self._at_nodes = 0, clusters, None
        self._at_points = np.zeros(clusters.count)
        if located:
            self._at_nodes = dr.zeros(mi.Float, clusters.tree.size)
            self._share = upload(mi.Float, 1 / clusters.tree.count)

    def add(self, points) -> None:
        """Count one bound for each of the given point nodes."""
        self.total += dr.width(points)
        if self._at_nodes is not None:
            add_at(self._at_nodes, dr.gather(mi.Float, self._share, points), points)
            dr.eval(self._at_nodes)

    def add_at_points(self, index, counts) -> None:
        """Count bounds of single points: ``counts`` of the points ``index`` in tree order."""
        counts = download(counts).astype(np.float64)
        self._at_points[download(index)] += counts
        self.total += int(counts.sum())

    def per_point(self):
        """Bounds per point in tree order, (n,) Float: the mean if not ``located``."""
        if self._at_nodes is None:
            return dr.opaque(mi.Float, self.total / self._clusters.count, self._clusters.count)
        tree = self._clusters.tree
        shared = tree.push_down(download(self._at_nodes).astype(np.float64))[tree.leaf]
        return upload(mi.Float, shared + self._at_points)


def in_batches(found, least: int):
    """Join the results of :func:`find_pairs` to :class:`Pairs` of at least ``least`` pairs, except the last."""
    held, count = [], 0
    for pairs in found:
        held.append(pairs)
        count += pairs.count
        if count >= least:
            yield Pairs.join(held)
            held, count = [], 0
    if held:
        yield Pairs.join(held)


def find_pairs(
    clusters: PointClusters, lights: LightSet, group: LightGroup, accept: Callable, counter: BoundCounter,
    points_first: Callable | None = None,
):  # fmt: skip
    """Yield :class:`Pairs` that cover every combination of a point and a light with a positive bound exactly once.

    ``accept``, ``points_first``: see :func:`_classify`.  Pairs of two leaves are always accepted; ``points_first``
    forces a split of the points (None: never).  ``counter``: counts the bounds.
    """
    clamp = lights.clamp
    root = dr.opaque(mi.UInt32, 0, 1)
    waiting = [Pairs(root, root)]
    while waiting:
        pairs = waiting.pop()
        if pairs.count > _FRONTIER:
            waiting.append(pairs.slice(_FRONTIER, pairs.count))
            pairs = pairs.slice(0, _FRONTIER)
        kind, second = _classify(clusters, group, pairs, accept, points_first, clamp)
        counter.add(pairs.points)
        accepted, split = dr.compress(kind == _ACCEPTED), dr.compress(kind > _ACCEPTED)
        if len(split):
            waiting.append(_children(pairs, kind, second, split))
        if len(accepted):
            yield pairs.select(accepted)


def raise_thresholds(
    lights: LightSet, clusters: PointClusters, allowed: np.ndarray, max_cut: int, stride: int, counter: BoundCounter
) -> np.ndarray:
    """Thresholds (n,) float64, raised at points whose cut would have more than about ``max_cut`` nodes (0: no limit).

    ``allowed``, (n,) float64: threshold of each point in tree order.  Every ``stride``-th point tests its light cut,
    and the points up to the next one use its result.  The size of a cut grows at most about inversely to the threshold.
    Therefore a tested cut of size s permits thresholds down to its own times s / ``max_cut``.
    """
    if max_cut == 0:
        return allowed
    rows = np.arange(0, clusters.count, stride)
    # The search multiplies thresholds, so they must be positive
    tried = np.maximum(allowed[rows], np.finfo(np.float32).tiny)
    index = upload(mi.UInt32, rows)
    raised, sizes = limited_cuts(lights, clusters.batch.select(index), upload_thresholds(tried), max_cut, stores=False)
    counter.add_at_points(index, sizes.visits)
    least = download(raised).astype(np.float64) * np.minimum(sizes.total() / max_cut, 1)
    return np.maximum(allowed, np.repeat(least, stride)[: clusters.count])
