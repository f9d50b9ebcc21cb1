"""Upper bounds on the contribution of a cluster of lights to a gather point [LC section 4.1; IC section 4], and the
expected error of a light that represents the cluster.

bound = material × geometry × intensity, with the largest value of each factor over the cluster, and a visibility of 1.

Departure from the papers: the largest cosine between an axis and the vectors to a box is bounded without rotating the
box.  With c the vector to the box centre and e the half extents of the box, the largest component along a unit axis n
is exactly z = n·c + |n|·e, and a lower bound of the distance from the axis is ρ = |c - (n·c) n| - |e|.  Upper bounds of
the cosine are z / sqrt(z² + ρ²) and z / d with d the distance to the box.  The bound is equally tight for small boxes,
at half the cost.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.arrays import channel_mean
from ..lights.device_tree import Node
from ..lights.virtual_lights import AT_INFINITY
from ..points.bsdf_proxies import MaterialProxy
from ..points.surfaces import Receiver
from .carried_share import carried_geometry_term, carried_share

# Least first-order change that counts, over the bound of a contribution. Variance × squared seconds of cuts over that
# with the bound alone: 0.77 in kitchen and 0.69 in staircase2 with 0.03, 0.79 and 0.75 with 0.1
LEAST_CHANGE = 0.03
# Least squared distance of centres that counts, world units²: its inverse stays finite
_LEAST_DISTANCE2 = 1e-20


def cosine_to_box(axis, center, extent, distance2, radius):
    """Largest cosine between a unit axis and any vector to a point of a box; exact sign, see the module's note.

    ``center``, ``extent``: vector to the box's centre and half extents; ``distance2``: squared distance to the box;
    ``radius``: norm of ``extent``.  Negative when the whole box lies behind the axis.
    """
    along = dr.dot(axis, center)
    z = along + dr.dot(dr.abs(axis), extent)
    away = dr.sqrt(dr.maximum(dr.squared_norm(center) - dr.square(along), 0))
    rho = dr.select(z >= 0, dr.maximum(away - radius, 0), away + radius)
    length2 = dr.square(z) + dr.square(rho)
    length2 = dr.select(z >= 0, dr.maximum(length2, distance2), length2)
    return dr.select(length2 > 0, dr.minimum(z * dr.rsqrt(length2), 1), 1)


def cosine_less_angle(cosine, cone_cosine):
    """cos(max(φ - β, 0)) for angles given by their cosines; 1 inside the cone."""
    sines = dr.sqrt(dr.maximum((1 - dr.square(cosine)) * (1 - dr.square(cone_cosine)), 0))
    return dr.select(cosine >= cone_cosine, 1, cosine * cone_cosine + sines)


def chord(cosine):
    """Distance between two unit vectors with the given cosine."""
    return dr.sqrt(dr.maximum(2 - 2 * cosine, 0))


def _nearest_cosine(cosine, cone_cosine):
    """The larger cosine where an axis is only known to lie in a cone (None: the axis is exact)."""
    return cosine if cone_cosine is None else cosine_less_angle(cosine, cone_cosine)


def contribution_bound(kind: str, receiver: Receiver, node: Node, smallest_distance):
    """Upper bound of the mean over channels of a cluster's contribution to gather points; 0 is exact.

    For a box of points the vectors to a box of lights fill a box again, with the sum of both extents [IC section 3].
    """
    proxy, mirror = receiver.proxy, None
    if kind in AT_INFINITY:
        # Directions towards the lights fill a cone around -axis: no distance, and cosines against a cone

        def largest_cosine(axis):
            return cosine_less_angle(-dr.dot(axis, node.axis), node.cosine)

    else:
        center, extent = node.center - receiver.position, node.extent
        if receiver.extent is not None:
            extent = extent + receiver.extent
        radius = dr.norm(extent)
        distance2 = dr.squared_norm(dr.maximum(dr.abs(center) - extent, 0))

        def largest_cosine(axis):
            return cosine_to_box(axis, center, extent, distance2, radius)

    cosine = dr.maximum(_nearest_cosine(largest_cosine(receiver.normal), receiver.normal_cosine), 0)
    if proxy.glossy:
        mirror = dr.maximum(_nearest_cosine(largest_cosine(proxy.axis), receiver.mirror_cosine), 0)
    factor = mi.Float(1)
    if kind not in AT_INFINITY:
        factor = _geometry_bound(kind, node, center, extent, distance2, radius, smallest_distance)
    reflected = channel_mean(_material_bound(proxy, cosine, mirror) * node.intensity)
    if kind == "surface":
        # w G grows with the geometry term G
        factor = carried_geometry_term(dr.square(node.least_c), factor * cosine)
        reflected = channel_mean(proxy.base * node.intensity) & (cosine > 0)
    # A point inside a flat box has an infinite factor and no cosine: that is nothing, not NaN
    return dr.select(reflected > 0, factor * reflected, 0)


def expected_error(kind: str, receiver: Receiver, node: Node, bound):
    """Expected error of a light that represents a cluster: the geometric mean of the ``bound`` of the contribution and
    of its change over the cluster, where the change counts from :data:`LEAST_CHANGE` times the bound up to the bound.

    The contribution is I w G for G = cosθ1 cosθ2 / d² and w = 1 / (1 + c² G), so its first-order change is I w² dG.
    The extents of both boxes, relative to d, change the distance and both cosines.  The cones of normals change the
    cosines by at most the chords of their half-angles.  The bound is far too large for clusters that are near or wide,
    and the change is too small where a cosine is 0 at the centres.

    For surface lights, and receivers that are white and have boxes and cones; for other kinds, the bound.
    """
    if kind != "surface":
        return bound
    toward = node.center - receiver.position
    distance2 = dr.maximum(dr.squared_norm(toward), _LEAST_DISTANCE2)
    inverse = dr.rsqrt(distance2)
    extent = dr.norm(node.extent + receiver.extent) * inverse
    cosines = [dr.dot(receiver.normal, toward) * inverse, -dr.dot(node.axis, toward) * inverse]
    first_sine, second_sine = (dr.sqrt(dr.maximum(1 - dr.square(cosine), 0)) for cosine in cosines)
    first, second = (dr.maximum(cosine, 0) for cosine in cosines)
    change = extent * (2 * first * second + first_sine * second + first * second_sine)
    change += chord(receiver.normal_cosine) * second + first * chord(node.cosine)
    share = carried_share(dr.square(node.least_c), first * second / distance2)
    change *= dr.square(share) / distance2
    # Roots one by one: squares of very bright and very dark lights are out of range
    change = dr.sqrt(dr.clip(change * channel_mean(node.intensity), LEAST_CHANGE * bound, bound))
    return change * dr.sqrt(bound)


def _material_bound(proxy: MaterialProxy, cosine, mirror):
    """Largest BSDF times cosine, given the largest cosines to the normal and to the mirror direction."""
    if proxy.without_cosines:
        cosine = dr.select(proxy.no_cosine, 1, cosine)
    material = proxy.base * cosine
    if proxy.glossy:
        # The lobe exists only where the receiver's hemisphere can see the cluster
        material += proxy.peak * dr.select(cosine > 0, dr.power(mirror, proxy.exponent), 0)
    return material


def _geometry_bound(kind: str, node: Node, center, extent, distance2, radius, smallest_distance):
    """Largest emission cosine (or spot test) over squared distance."""
    if kind == "point":
        return dr.rcp(distance2)
    emission = cosine_less_angle(cosine_to_box(node.axis, -center, extent, distance2, radius), node.cosine)
    if kind == "spot":
        # The node's cone already includes the spots' cut-off angle: nothing is emitted outside it
        return dr.select(emission >= 1, dr.rcp(distance2), 0)
    clamped2 = distance2 if kind == "surface" else dr.maximum(distance2, dr.square(smallest_distance))
    return dr.select(emission > 0, emission / clamped2, 0)
