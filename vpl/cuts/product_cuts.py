"""Pairs of a cluster of gather points and a cluster of lights, found by descending both trees at once [IC section 3].

The papers keep a stack of pairs.  Here all pairs of a step are rows of an array: one kernel bounds, judges and splits
them, the accepted ones are kept, the others are replaced by the two pairs of the node that is split, and so on until
none is left.  A frontier that grows beyond ``_FRONTIER`` pairs is worked off in parts, which bounds memory.

Departure from the paper: what is compared when one node of a pair has to be split is not only the radii of both
boxes. Points are larger the more their normals and mirror directions spread, as seen from where the lights are.
Otherwise lights are split, and never joined again, because of points that did not belong together: at the same error
that took 1.1 (cornell) to 2.5 times (dining_room, glossy points) the shadow rays.

Pairs know no cut of a single point, so a largest cut is held by thresholds: see :func:`raise_thresholds`.
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
from ..transport.bounds import contribution_bound
from .light_cuts import limited_cuts, upload_thresholds

# Pairs that are judged at a time
_FRONTIER = 1 << 22
# How much a cone of normals or mirror directions makes points larger: chord times distance to the lights times this
_DIRECTIONS = 2.0
_ACCEPTED, _SPLIT_POINTS, _SPLIT_LIGHTS = 1, 2, 3


@dataclass
class Pairs:
    """Pairs of nodes: ``points``, ``lights``: UInt32 indices into the two trees, one pair per entry."""

    points: object
    lights: object

    @property
    def count(self) -> int:
        return dr.width(self.points)

    def select(self, index) -> Pairs:
        """The pairs picked by an index array, evaluated."""
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
        """All pairs of several parts, evaluated."""
        count = sum(part.count for part in parts)
        joined = Pairs(dr.empty(mi.UInt32, count), dr.empty(mi.UInt32, count))
        first = 0
        for part in parts:
            # dr.concat would bake every offset into a kernel of its own
            place = dr.arange(mi.UInt32, part.count) + dr.opaque(mi.UInt32, first)
            dr.scatter(joined.points, part.points, place)
            dr.scatter(joined.lights, part.lights, place)
            dr.eval(joined.points, joined.lights)
            first += part.count
        return joined


def _chord(cosine):
    """Distance between unit vectors at an angle given by its cosine."""
    return dr.sqrt(dr.maximum(2 - 2 * cosine, 0))


def _lights_spread_more(kind: str, points, lights):
    """Whether a pair is refined by splitting its light node rather than its point node."""
    spread = _chord(points.receiver.normal_cosine)
    if points.receiver.mirror_cosine is not None:
        spread += _chord(points.receiver.mirror_cosine)
    if kind in AT_INFINITY:
        return _chord(lights.cosine) > _DIRECTIONS * spread
    distance = dr.norm(lights.center - points.receiver.position)
    return lights.radius > points.radius + _DIRECTIONS * distance * spread


def _judge(clusters: PointClusters, group: LightGroup, pairs: Pairs, accept, points_first, smallest_distance):
    """One kernel: the verdict on every pair, and the node that the second of its children is ([IC] Algorithm 1).

    ``accept``, ``points_first``: functions of (point node, light node, bound, index of the point node) to a mask.
    """
    points, lights = clusters.gather(pairs.points), group.tree.gather(pairs.lights)
    bound = contribution_bound(group.kind, points.receiver, lights, smallest_distance)
    single, lowest = lights.escape == pairs.lights + 1, points.child == 0
    accepted = (single & lowest) | accept(points, lights, bound, pairs.points)
    # Algorithm 1, line 10: the larger node is split, if it has children
    of_lights = ~single & (lowest | _lights_spread_more(group.kind, points, lights))
    if points_first is not None:
        of_lights &= lowest | ~points_first(points, lights, bound, pairs.points)
    verdict = dr.select(accepted, _ACCEPTED, dr.select(of_lights, mi.UInt32(_SPLIT_LIGHTS), _SPLIT_POINTS))
    verdict = dr.select(bound > 0, verdict, 0)
    second = dr.select(of_lights, group.tree.escape(pairs.lights + 1, verdict == _SPLIT_LIGHTS), points.child + 1)
    dr.eval(verdict, second)
    return verdict, second


def _children(pairs: Pairs, verdict, second, split) -> Pairs:
    """The two pairs that take the place of each one that was split (an index array), next to each other."""
    lane = dr.arange(mi.UInt32, 2 * len(split))
    parent = dr.gather(mi.UInt32, split, lane >> 1)
    points, lights = (dr.gather(mi.UInt32, x, parent) for x in (pairs.points, pairs.lights))
    of_lights = dr.gather(mi.UInt32, verdict, parent) == _SPLIT_LIGHTS
    chosen, first = dr.gather(mi.UInt32, second, parent), (lane & 1) == 0
    # Light nodes lie in preorder: the first child follows its parent.  Point nodes are siblings next to each other.
    points = dr.select(of_lights, points, dr.select(first, chosen - 1, chosen))
    lights = dr.select(of_lights, dr.select(first, lights + 1, chosen), lights)
    dr.eval(points, lights)
    return Pairs(points, lights)


class BoundCounter:
    """Counts the bounds that were computed: ``total``, and, if ``located``, where.

    A bound of a cluster of points counts as 1 / number of points for each of them ([IC] section 4, figure 4).
    """

    def __init__(self, clusters: PointClusters, located: bool):
        self.total, self._clusters, self._at_nodes = 0, clusters, None
        self._at_points = np.zeros(clusters.count)
        if located:
            self._at_nodes = dr.zeros(mi.Float, clusters.tree.size)
            self._share = upload(mi.Float, 1 / clusters.tree.count)

    def add(self, points) -> None:
        """Count one bound for each of some point nodes."""
        self.total += dr.width(points)
        if self._at_nodes is not None:
            add_at(self._at_nodes, dr.gather(mi.Float, self._share, points), points)
            dr.eval(self._at_nodes)

    def add_at_points(self, index, counts) -> None:
        """Count bounds that were computed for single points along the tree: ``counts`` for the points ``index``."""
        counts = download(counts).astype(np.float64)
        self._at_points[download(index)] += counts
        self.total += int(counts.sum())

    def per_point(self):
        """Bounds for every point along the tree, (n,) Float: exact where located, else the same everywhere."""
        if self._at_nodes is None:
            return dr.opaque(mi.Float, self.total / self._clusters.count, self._clusters.count)
        tree = self._clusters.tree
        shared = tree.push_down(download(self._at_nodes).astype(np.float64))[tree.leaf]
        return upload(mi.Float, shared + self._at_points)


def in_batches(found, least: int):
    """Join what :func:`find_pairs` yields to :class:`Pairs` of at least ``least`` pairs, but for the last."""
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
    """Yield, some at a time, pairs that together hold once every point and light from which anything may arrive.

    ``accept``: see ``_judge``; pairs of two leaves are always accepted.  ``points_first``: which pairs are refined by
    splitting points whatever their sizes (None: none).  ``counter``: told of every bound.
    """
    clamp = lights.clamp
    root = dr.opaque(mi.UInt32, 0, 1)
    waiting = [Pairs(root, root)]
    while waiting:
        pairs = waiting.pop()
        if pairs.count > _FRONTIER:
            waiting.append(pairs.slice(_FRONTIER, pairs.count))
            pairs = pairs.slice(0, _FRONTIER)
        verdict, second = _judge(clusters, group, pairs, accept, points_first, clamp)
        counter.add(pairs.points)
        accepted, split = dr.compress(verdict == _ACCEPTED), dr.compress(verdict > _ACCEPTED)
        if len(split):
            waiting.append(_children(pairs, verdict, second, split))
        if len(accepted):
            yield pairs.select(accepted)


def raise_thresholds(
    lights: LightSet, clusters: PointClusters, allowed: np.ndarray, max_cut: int, stride: int, counter: BoundCounter
) -> np.ndarray:
    """Largest bounds that points accept, raised where cuts would be about larger than ``max_cut`` (0: nowhere).

    ``allowed``, (n,) float64: what each point along the tree would accept.  Cuts are tried at every ``stride``-th
    point; those up to the next one take after it.  Cuts grow about as fast as thresholds fall at most, so one that is
    not full leaves that much room below.  Returns the same for all points.
    """
    if max_cut == 0:
        return allowed
    rows = np.arange(0, clusters.count, stride)
    # What is 0 could not be raised by any factor
    tried = np.maximum(allowed[rows], np.finfo(np.float32).tiny)
    index = upload(mi.UInt32, rows)
    raised, sizes, visits = limited_cuts(lights, clusters.batch.select(index), upload_thresholds(tried), max_cut)
    counter.add_at_points(index, visits)
    least = download(raised).astype(np.float64) * np.minimum(sizes.total() / max_cut, 1)
    return np.maximum(allowed, np.repeat(least, stride)[: clusters.count])
