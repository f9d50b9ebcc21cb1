"""Phase I: a coarse image that determines the error threshold of every cluster of points in Phase II [IC section 3].

Departures from the paper:

- The half-angle of a cone is less than the paper's aperture of 20 degrees.
- The cone of a point cluster's normals has the same limit.
- Lights at infinity have infinite distance, so the criterion limits the size of the point cluster instead, relative to
  the root's.
- A pair with a bound below a fraction of the image's mean radiance is not refined.  With the paper's criterion alone,
  Phase I accepts 36 million pairs, each with a shadow ray, in the Cornell box and in the kitchen (width 512, 200,000
  lights): ten times the pairs of Phase II.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, channel_mean, download, upload
from ..lights.light_set import LightGroup
from ..lights.virtual_lights import AT_INFINITY
from ..points.point_clusters import PointClusters
from ..transport.evaluation import Transport, evaluate_pairs
from .product_cuts import find_pairs, in_batches

# Pairs shaded and traced at a time
_PAIRS_PER_KERNEL = 1 << 22
# [IC] section 3, Phase I: largest ratio of a cluster's radius to the distance, and cosine of the cones' largest angle
_SIZE_TO_DISTANCE, _APERTURE = 0.1, math.cos(math.radians(20))


def _coarse_enough(clusters: PointClusters, group: LightGroup, negligible: float):
    """Acceptance criterion of Phase I, for :func:`vpl.cuts.product_cuts.find_pairs`."""
    at_infinity = group.kind in AT_INFINITY
    whole = dr.norm(clusters.gather(dr.zeros(mi.UInt32, 1)).receiver.extent)
    largest, least = dr.opaque(mi.Float, _SIZE_TO_DISTANCE * float(whole[0])), dr.opaque(mi.Float, negligible)

    def accept(points, lights, bound, index):
        """Whether a pair satisfies max(r(R), r(Q)) < 0.1 d(R, Q) and the cone limits, or has a negligible bound."""
        receiver, radius = points.receiver, points.radius
        narrow = (points.child == 0) | (receiver.normal_cosine > _APERTURE)
        if at_infinity:
            separated = narrow & (lights.cosine > _APERTURE) & (radius < largest)
        else:
            reach = lights.radius
            distance = dr.norm(lights.center - receiver.position) - radius - reach
            if group.kind != "point":
                # The cone of lights at a single position may be their own spot cone, which refinement cannot narrow
                narrow &= (lights.cosine > _APERTURE) | (reach == 0)
            separated = narrow & (dr.maximum(radius, reach) < _SIZE_TO_DISTANCE * distance)
        return separated | (bound <= least)

    return accept


def approximate_radiance(transport: Transport, clusters: PointClusters, negligible: float, generator, counter):
    """(Radiance (m,) float64 at every node of the point tree, shadow rays per point in tree order).

    The radiance is the mean over channels of the pairs of a node and of its ancestors.  Every pair has one random point
    and the second representative light of its cluster: the choice of pairs in Phase II must be independent of the
    representatives that Phase II uses.  ``negligible``: bound up to which pairs are not refined; ``generator``: NumPy
    generator of the points; ``counter``: a :class:`vpl.cuts.product_cuts.BoundCounter`.
    """
    tree = clusters.tree
    drawn = (generator.random(tree.size) * tree.count).astype(np.uint32)
    representative = upload(mi.UInt32, tree.first + np.minimum(drawn, tree.count - 1))
    radiance, rays = dr.zeros(mi.Float, tree.size), dr.zeros(mi.UInt32, clusters.count)
    dr.eval(radiance, rays)
    for group in transport.lights.groups:
        criterion = _coarse_enough(clusters, group, negligible)
        # Join several steps of the search: a kernel launch per step would cost more than its rays
        for part in in_batches(find_pairs(clusters, transport.lights, group, criterion, counter), _PAIRS_PER_KERNEL):
            point = dr.gather(mi.UInt32, representative, part.points)
            surface = clusters.batch.surfaces_at(point)
            light, scale = group.representatives(part.lights, second=True)
            value, traced = evaluate_pairs(transport, group, surface, light, scale)
            add_at(radiance, channel_mean(value), part.points)
            add_at(rays, dr.select(traced, mi.UInt32(1), 0), point)
            dr.eval(radiance, rays)
    return tree.push_down(download(radiance).astype(np.float64)), rays
