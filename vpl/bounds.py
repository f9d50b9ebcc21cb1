"""Upper bounds on what a cluster of lights can contribute to a gather point [LC section 4.1; IC section 4].

bound = material × geometry × intensity, each factor at its largest over the cluster, and visibility taken as 1.

Departure from the papers: the largest cosine between an axis and the vectors to a box is bounded without rotating the
box.  With c the vector to the box centre and e its half extents, the largest component along a unit axis n is exactly
z = n·c + |n|·e, the distance from the axis is at least ρ = |c - (n·c) n| - |e|, so that the cosine is at most
z / sqrt(z² + ρ²) and at most z / d with d the distance to the box.  It is as tight for small boxes and costs half.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import channel_mean, download, upload
from .light_tree import LightTree
from .lights import AT_INFINITY
from .proxies import MaterialProxy


@dataclass
class Node:
    """Nodes of a light tree in a kernel: one per lane."""

    box_min: object
    box_max: object
    axis: object
    cosine: object
    intensity: object
    escape: object

    @property
    def center(self):
        """Centre of the box of positions."""
        return 0.5 * (self.box_min + self.box_max)

    @property
    def extent(self):
        """Half extents of the box of positions."""
        return 0.5 * (self.box_max - self.box_min)

    @property
    def radius(self):
        """Radius of the ball around the box; 0 for lights at infinity."""
        return dr.norm(self.extent)


@dataclass
class Receiver:
    """Gather points, or boxes of them, in a kernel: one per lane.

    ``position``: of a point, or the centre of a box of half extents ``extent`` (None for points); ``normal``: shading
    normal on the side of the outgoing direction, or the axis of a cone around the normals of half-angle
    acos(``normal_cosine``); ``mirror_cosine``: the same for the proxy's axis.
    """

    position: object
    normal: object
    proxy: MaterialProxy
    extent: object = None
    normal_cosine: object = None
    mirror_cosine: object = None


class DeviceTree:
    """A light tree's packed records on the device.

    ``second_representative``: (2n - 1,) another light per node, drawn independently of the tree's own.
    """

    def __init__(self, kind: str, tree: LightTree, second_representative):
        self.kind = kind
        self._second = upload(mi.UInt32, second_representative)
        self.count = len(tree.records)
        self._records = upload(mi.Float, tree.records)

    def records(self) -> np.ndarray:
        """The records again, of NumPy: see :class:`vpl.light_tree.LightTree`."""
        return download(self._records).reshape(self.count, -1)

    def gather(self, index, active=True) -> Node:
        """Fetch one node per lane; see :mod:`vpl.light_tree` for the layout of the record."""
        a, b, c, d = (dr.gather(mi.Vector4f, self._records, index * 4 + k, active) for k in range(4))
        return Node(
            mi.Point3f(a.x, a.y, a.z),
            mi.Point3f(a.w, b.x, b.y),
            mi.Vector3f(b.z, b.w, c.x),
            c.y,
            mi.Color3f(c.w, d.x, d.y),
            dr.reinterpret_array(mi.UInt32, d.z),
        )

    def escape(self, index, active=True):
        """The node that follows a node's subtree."""
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._records, index * 16 + 14, active))

    def summed_intensity(self, index, active=True):
        """Scalar intensity of a node: the mean over channels of the sum over its lights."""
        return dr.gather(mi.Float, self._records, index * 16 + 10, active)

    def representative(self, index, active=True, second=False):
        """Index of a node's representative light, or of its second one."""
        if second:
            return dr.gather(mi.UInt32, self._second, index, active)
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._records, index * 16 + 15, active))


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


def _nearest_cosine(cosine, cone_cosine):
    """The larger cosine where an axis is only known to lie in a cone (None: it is exact)."""
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
            extent += receiver.extent
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
    # A point inside a flat box has an infinite factor and no cosine: that is nothing, not NaN
    return dr.select(reflected > 0, factor * reflected, 0)


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
    clamped2 = dr.maximum(distance2, dr.square(smallest_distance))
    return dr.select(emission > 0, emission / clamped2, 0)
