"""Phase I: a coarse and fast image that tells Phase II how much error every cluster of points can bear [IC section 3].

Departures from the paper: its aperture of 20 degrees is taken as the half-angle of a cone; nothing but the size of
the point cluster limits pairs with lights at infinity, whose distance is infinite, so it must be small next to the
whole image's points; normals of a point cluster may spread as much as directions of a light cluster.  And a pair
whose bound is a small part of the image's mean radiance is not refined further: with the paper's criterion alone,
Phase I takes 36 million pairs, each with a shadow ray, in the Cornell box and in the kitchen (width 512, 200,000
lights), ten times what Phase II then needs.
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

# Pairs that are shaded and traced at a time
_PAIRS_PER_KERNEL = 1 << 22
# [IC] section 3, Phase I: clusters are smaller than a tenth of their distance, cones narrower than 20 degrees
_SIZE_TO_DISTANCE, _APERTURE = 0.1, math.cos(math.radians(20))


def _coarse_enough(clusters: PointClusters, group: LightGroup, negligible: float):
    """The criterion of Phase I, for :func:`vpl.cuts.product_cuts.find_pairs`."""
    at_infinity = group.kind in AT_INFINITY
    whole = dr.norm(clusters.gather(dr.zeros(mi.UInt32, 1)).receiver.extent)
    largest, least = dr.opaque(mi.Float, _SIZE_TO_DISTANCE * float(whole[0])), dr.opaque(mi.Float, negligible)

    def accept(points, lights, bound, index):
        """Whether a pair is coarse enough, or its bound negligible."""
        receiver, radius = points.receiver, points.radius
        narrow = (points.child == 0) | (receiver.normal_cosine > _APERTURE)
        if at_infinity:
            separated = narrow & (lights.cosine > _APERTURE) & (radius < largest)
        else:
            reach = lights.radius
            distance = dr.norm(lights.center - receiver.position) - radius - reach
            if group.kind != "point":
                # Lights of one place and direction have a wide cone only if each of them has: then it cannot shrink
                narrow &= (lights.cosine > _APERTURE) | (reach == 0)
            separated = narrow & (dr.maximum(radius, reach) < _SIZE_TO_DISTANCE * distance)
        return separated | (bound <= least)

    return accept


def approximate_radiance(transport: Transport, clusters: PointClusters, negligible: float, generator, counter):
    """Light at every node of the point tree, as the mean over channels: its own pairs' and its ancestors'.

    One point and one light stand for each pair: the light is the second representative of its cluster, so that what
    Phase II chooses does not depend on the lights that it then uses.  ``negligible``: bound up to which a pair is not
    refined; ``generator``: NumPy's, draws the points; ``counter``: a :class:`vpl.cuts.product_cuts.BoundCounter`.

    Returns (radiance, (m,) float64, shadow rays per point along the tree).
    """
    tree = clusters.tree
    drawn = (generator.random(tree.size) * tree.count).astype(np.uint32)
    stand_in = upload(mi.UInt32, tree.first + np.minimum(drawn, tree.count - 1))
    radiance, rays = dr.zeros(mi.Float, tree.size), dr.zeros(mi.UInt32, clusters.count)
    dr.eval(radiance, rays)
    for group in transport.lights.groups:
        criterion = _coarse_enough(clusters, group, negligible)
        # Many steps of the search at a time: a kernel for each would cost more than its rays
        for part in in_batches(find_pairs(clusters, transport.lights, group, criterion, counter), _PAIRS_PER_KERNEL):
            point = dr.gather(mi.UInt32, stand_in, part.points)
            surface = clusters.batch.surfaces_at(point)
            light, scale = group.representatives(part.lights, second=True)
            value, traced = evaluate_pairs(transport, group, surface, light, scale)
            add_at(radiance, channel_mean(value), part.points)
            add_at(rays, dr.select(traced, mi.UInt32(1), 0), point)
            dr.eval(radiance, rays)
    return tree.push_down(download(radiance).astype(np.float64)), rays
