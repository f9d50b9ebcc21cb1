"""Adaptive visibility: a few shadow rays decide for all points of a pair [IC Algorithm 2, "IlluminationCut-Sampling"].

A pair of many points and a cluster of lights is probed with 8 or 16 rays to the cluster's representative.  If all of
them arrive, all points are taken to see it; if none does, none; otherwise the points are divided and each part is
probed on its own, until parts are so small that all their rays are traced.

The result is biased: what blocks the light between the probes only is not seen.  The points of a pair lie next to each
other along a curve, so that takes an occluder smaller than their distance, or its very edge.

Departures from the paper.  A mixed pair is divided not into the 16 or 8 subarrays that its probes stand for but into
as many descendants of its point node, which are subarrays too, of points that are near to each other.  The paper
probes pairs of 8 points or more, with 16 rays from 33 points on; here it is 32 and 64: at 512 pixels a side that
takes 4 to 14% more rays, and 12 to 15% less time, because packets of rays stay whole. Probes at points to which the
representative would contribute nothing, whatever its visibility, do not vote; where none votes, few points can need a
ray, and those are traced.  Partly transparent occluders count as neither open nor closed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.arrays import add_at, even_chunks
from ..lights.light_set import LightGroup
from ..points.point_clusters import PointClusters
from ..transport.evaluation import Transport, probe_visibility
from .product_cuts import Pairs

# Rays of pairs with fewer points are all traced; probes of larger ones, and of those above the limit
_FEWEST_POINTS, _FEW_PROBES, _MANY_PROBES, _MANY_POINTS = 32, 8, 16, 64
# Probes traced at a time
_PROBES_PER_KERNEL = 1 << 22
_OPEN, _CLOSED = 1, 2


def _probe(transport: Transport, group: LightGroup, clusters: PointClusters, pairs: Pairs, probes: int, rays):
    """Trace ``probes`` rays for each pair, spread over its points: the union of _OPEN and _CLOSED per pair.

    ``rays``: array of counts per point, to which the traced ones are added.
    """
    lane = dr.arange(mi.UInt32, pairs.count * probes)
    pair = lane // probes
    points = clusters.gather(dr.gather(mi.UInt32, pairs.points, pair))
    # The middle of each of as many equally long parts of the node's range
    point = points.first + (2 * (lane % probes) + 1) * points.count // (2 * probes)
    surface = clusters.batch.surfaces_at(point)
    light, _ = group.representatives(dr.gather(mi.UInt32, pairs.lights, pair))
    passed, votes = probe_visibility(transport, group, surface, light)
    found = dr.select(dr.all(passed == 1), mi.UInt32(_OPEN), dr.select(dr.any(passed > 0), _OPEN | _CLOSED, _CLOSED))
    union = dr.block_reduce(dr.ReduceOp.Or, dr.select(votes, found, 0), probes)
    add_at(rays, dr.select(votes, mi.UInt32(1), 0), point)
    dr.eval(union, rays)
    return union


def decide_visibility(transport: Transport, group: LightGroup, clusters, pairs: Pairs, rays):
    """Divide pairs into those whose light arrives at all points and those whose rays must be traced; drop the others.

    ``rays``: (n,) UInt32 counts per point along the tree; the probes are added.  Returns (open, traced) lists of
    :class:`Pairs`.
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
    """The descendants of every point node so many levels below, or where too few points are left to probe."""
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
