"""Adaptive visibility: few shadow rays for the many points of a pair [IC Algorithm 2, "IlluminationCut-Sampling"].

A pair of many points and a cluster of lights is probed with 8 or 16 shadow rays to the cluster's representative.  If
every probe is unoccluded, every point counts as lit; if every probe is occluded, none.  A mixed pair is divided, and
its parts are probed.  Small parts, and pairs of a single light, trace a ray from every point.

The result is biased: occluders between the probes are missed.  The points of a pair are adjacent along a curve, hence
only an occluder smaller than the distance between probes, or the edge of an occluder, can be missed.

Departures from the paper.  A mixed pair is divided into 8 or 16 descendants of its point node instead of the subarrays
around its probes; descendants are subarrays of close points.  The paper probes pairs of 8 points or more, and uses 16
rays from 33 points on; the numbers here are 32 and 65.  At 512 x 512 pixels, 4 to 14% more rays are traced in 12 to 15%
less time, because packets of rays remain whole.  Probes at points with zero unoccluded contribution do not vote.  A
pair without votes has few points that need a ray, and these are traced.  Partly transparent occluders count as mixed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.arrays import add_at, even_chunks
from ..lights.light_set import LightGroup
from ..points.point_clusters import PointClusters
from ..transport.evaluation import Transport, probe_visibility
from .product_cuts import Pairs

# Pairs with fewer points than _FEWEST_POINTS are not probed; pairs with more than _MANY_POINTS get _MANY_PROBES probes
_FEWEST_POINTS, _FEW_PROBES, _MANY_PROBES, _MANY_POINTS = 32, 8, 16, 64
# Probes traced at a time
_PROBES_PER_KERNEL = 1 << 22
# Bits of a probe's result: unoccluded, occluded
_OPEN, _CLOSED = 1, 2


def _probe(transport: Transport, group: LightGroup, clusters: PointClusters, pairs: Pairs, probes: int, rays):
    """Trace ``probes`` rays for each pair, at equal steps over its points: the union of _OPEN and _CLOSED per pair.

    ``rays``: counts of shadow rays per point, incremented.
    """
    lane = dr.arange(mi.UInt32, pairs.count * probes)
    pair = lane // probes
    points = clusters.gather(dr.gather(mi.UInt32, pairs.points, pair))
    # Midpoints of equal parts of the node's range
    point = points.first + (2 * (lane % probes) + 1) * points.count // (2 * probes)
    surface = clusters.batch.surfaces_at(point)
    light, _ = group.representatives(dr.gather(mi.UInt32, pairs.lights, pair))
    passed, votes = probe_visibility(transport, group, surface, light)
    found = dr.select(dr.all(passed == 1), mi.UInt32(_OPEN), dr.select(dr.any(passed > 0), _OPEN | _CLOSED, _CLOSED))
    union = dr.block_reduce(dr.ReduceOp.Or, dr.select(votes, found, 0), probes)
    add_at(rays, dr.select(votes, mi.UInt32(1), 0), point)
    dr.eval(union, rays)
    return union


def decide_visibility(transport: Transport, group: LightGroup, clusters: PointClusters, pairs: Pairs, rays):
    """Classify pairs: unoccluded for every point, to be traced point by point, or occluded, which are dropped.

    ``rays``: (n,) UInt32, counts of shadow rays per point in tree order, incremented.  Returns (unoccluded, to trace),
    two lists of :class:`Pairs`.
    """
    opened, traced = [], []
    waiting = [pairs]
    while waiting:
        pairs = waiting.pop()
        points, lights_escape = clusters.gather(pairs.points), group.tree.escape(pairs.lights)
        small = (points.count < _FEWEST_POINTS) | (lights_escape == pairs.lights + 1)
        many = points.count > _MANY_POINTS
        dr.eval(small, many)
        traced.append(pairs.select(dr.compress(small)))
        for chosen, probes, levels in ((~small & ~many, _FEW_PROBES, 3), (~small & many, _MANY_PROBES, 4)):
            chosen_pairs = pairs.select(dr.compress(chosen))
            for first, last in even_chunks(chosen_pairs.count, probes, _PROBES_PER_KERNEL):
                part = chosen_pairs.slice(first, last - first)
                union = _probe(transport, group, clusters, part, probes, rays)
                opened.append(part.select(dr.compress(union == _OPEN)))
                traced.append(part.select(dr.compress(union == 0)))
                mixed = part.select(dr.compress(union == (_OPEN | _CLOSED)))
                if mixed.count:
                    waiting.append(_divide(clusters, mixed, levels))
    return [part for part in opened if part.count], [part for part in traced if part.count]


def _divide(clusters: PointClusters, pairs: Pairs, levels: int) -> Pairs:
    """Replace every point node by its descendants ``levels`` below; nodes too small to probe are not divided."""
    done = []
    for _ in range(levels):
        lane = dr.arange(mi.UInt32, 2 * pairs.count)
        parents = pairs.select(lane >> 1)
        children = clusters.gather(parents.points).child + (lane & 1)
        small = clusters.gather(children).count < _FEWEST_POINTS
        dr.eval(children, small)
        pairs = Pairs(children, parents.lights)
        done.append(pairs.select(dr.compress(small)))
        pairs = pairs.select(dr.compress(~small))
        if pairs.count == 0:
            break
    return Pairs.join([part for part in (*done, pairs) if part.count])
