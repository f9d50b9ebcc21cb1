"""Gather points in the order of their point tree, and the tree's nodes for kernels.

The device computes the nodes' boxes, cones and maxima: from points to leaves, then level by level to the root.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..core.cones import COSINE_ROUNDING
from .bsdf_proxies import MaterialProxy
from .point_tree import PointTree, build_point_tree
from .surfaces import Batch, Receiver

# Most points of a leaf: larger leaves make a smaller tree for 1 to 3% more shadow rays, but lobes need single points
_LAMBERTIAN_LEAF, _GLOSSY_LEAF = 4, 1


@dataclass
class PointNode:
    """Nodes of a point tree in a kernel: one per lane.  Fields as in :class:`vpl.points.point_tree.PointTree`."""

    receiver: Receiver
    first: mi.UInt32
    count: mi.UInt32
    child: mi.UInt32

    @property
    def radius(self):
        """Radius of the ball around the node's box."""
        return dr.norm(self.receiver.extent)


class PointClusters:
    """A batch of gather points in tree order, with the bounds of every node on the device [IC section 3].

    ``build``: function of positions and normals, (n, 3) each, that returns the tree; by default a tree by position,
    normal and material.  ``batch``: the points in tree order; ``order``: their rows in the original batch.
    """

    def __init__(self, batch: Batch, build: Callable | None = None):
        normal = unit_or_up(batch.normal)
        self.tree: PointTree = (build or partial(_tree_by_place, batch))(download(batch.position), download(normal))
        self.order = upload(mi.UInt32, self.tree.order)
        self.batch = batch.select(self.order)
        bounds, proxy = NodeBounds(self.tree), self.batch.proxy
        normal = dr.gather(mi.Vector3f, normal, self.order)
        self._records = _records(self.tree, bounds, self.batch.position, normal, proxy.base)
        self._lobes = _lobe_records(self.tree, bounds, proxy) if proxy.glossy else None
        self._no_cosine = None
        if proxy.without_cosines:
            any_point = bounds.reduce(dr.select(proxy.no_cosine, mi.UInt32(1), 0), dr.maximum)
            self._no_cosine = any_point == 1
            dr.eval(self._no_cosine)

    @property
    def count(self) -> int:
        """Number of gather points."""
        return self.batch.count

    def in_batch_order(self, arrays: list) -> list:
        """Reorder arrays of values from tree order to the order of the original batch, evaluated."""
        found = []
        for values in arrays:
            found.append(dr.empty(type(values), self.count))
            dr.scatter(found[-1], values, self.order)
        dr.eval(found)
        return found

    def ranges(self, index):
        """(First point in tree order, number of points) of nodes."""
        d = dr.gather(mi.Vector4f, self._records, index * 4 + 3)
        return dr.reinterpret_array(mi.UInt32, d.y), dr.reinterpret_array(mi.UInt32, d.z)

    def gather(self, index) -> PointNode:
        """Fetch one node per lane."""
        a, b, c, d = (dr.gather(mi.Vector4f, self._records, index * 4 + k) for k in range(4))
        low, high = mi.Point3f(a.x, a.y, a.z), mi.Point3f(a.w, b.x, b.y)
        base, none = mi.Color3f(c.z, c.w, d.x), mi.Bool(False)
        proxy = MaterialProxy(base, None, None, None, none, none, False, self._no_cosine is not None)
        receiver = Receiver(0.5 * (low + high), mi.Vector3f(b.z, b.w, c.x), proxy, 0.5 * (high - low), c.y)
        if self._lobes is not None:
            e, f = (dr.gather(mi.Vector4f, self._lobes, index * 2 + k) for k in range(2))
            proxy.axis, proxy.peak, proxy.exponent = mi.Vector3f(e.xyz), mi.Color3f(f.x, f.y, f.z), f.w
            proxy.glossy, receiver.mirror_cosine = True, e.w
        if self._no_cosine is not None:
            proxy.no_cosine = dr.gather(mi.Bool, self._no_cosine, index)
        first, count, child = (dr.reinterpret_array(mi.UInt32, value) for value in (d.y, d.z, d.w))
        return PointNode(receiver, first, count, child)


def _tree_by_place(batch: Batch, position: np.ndarray, normal: np.ndarray) -> PointTree:
    material = batch.surfaces.material()
    material = None if material is None else download(material)
    return build_point_tree(position, normal, _GLOSSY_LEAF if batch.proxy.glossy else _LAMBERTIAN_LEAF, material)


def unit_or_up(vectors):
    """Replace vectors without unit length, which broken meshes may have, by +z."""
    vectors = mi.Vector3f(vectors)
    return dr.select(dr.abs(dr.squared_norm(vectors) - 1) < 1e-3, vectors, mi.Vector3f(0, 0, 1))


def _records(tree: PointTree, bounds: NodeBounds, position, normal, base):
    """Per node: box, cone of normals, largest base, range of points, first child (16 floats), from values per point."""
    largest = bounds.reduce(mi.Vector3f(position), dr.maximum)
    least = bounds.reduce(mi.Vector3f(position), dr.minimum)
    axis, cosine = bounds.cones(normal)
    base = bounds.reduce(mi.Vector3f(base), dr.maximum)
    links = (dr.reinterpret_array(mi.Float, upload(mi.UInt32, x)) for x in (tree.first, tree.count, tree.child))
    return _interleaved(tree.size, [*least, *largest, *axis, cosine, *base, *links])


def _lobe_records(tree: PointTree, bounds: NodeBounds, proxy: MaterialProxy):
    """Per node: cone of the lobes' axes, largest peak, smallest exponent (8 floats)."""
    axis, cosine = bounds.cones(unit_or_up(proxy.axis))
    peak = bounds.reduce(mi.Vector3f(proxy.peak), dr.maximum)
    return _interleaved(tree.size, [*axis, cosine, *peak, bounds.reduce(proxy.exponent, dr.minimum)])


def _interleaved(count: int, columns: list):
    """Array of records from one array per field."""
    records = dr.empty(mi.Float, count * len(columns))
    for k, column in enumerate(columns):
        dr.scatter(records, column, dr.arange(mi.UInt32, count) * len(columns) + k)
    dr.eval(records)
    return records


class NodeBounds:
    """Reduces values of n points in tree order to arrays of ``tree.size`` node values."""

    def __init__(self, tree: PointTree):
        self._levels, self._size = tree.levels, tree.size
        self._child = upload(mi.UInt32, tree.child)
        leaves = tree.leaves
        self._leaves = upload(mi.UInt32, leaves)
        self._first, self._count = (upload(mi.UInt32, x[leaves]) for x in (tree.first, tree.count))
        self._points = upload(mi.UInt32, tree.count)

    def reduce(self, values, join: Callable):
        """Reduce values of points to nodes.  ``join``: elementwise function of two arrays, such as ``dr.maximum``."""
        at_leaves = _over_points(values, self._first, self._count, join)
        return self._towards_root(at_leaves, lambda first, second, node, child: join(first, second))

    def cones(self, directions):
        """Bounding cones of unit vectors: (axes, cosines of half-angles), single precision.

        An inner node's axis is the mean direction, and its half-angle is the smallest that contains both children's
        cones.
        """
        precise = dr.float64_array_t(type(directions))
        # Unit length in double precision: near 1, acos magnifies single precision errors
        directions = _unit(precise(directions))
        dr.eval(directions)
        sums = self.reduce(directions, lambda first, second: first + second)
        length = dr.norm(sums)
        balanced = length < 1e-6 * dr.float64_array_t(mi.Float)(self._points)
        axes = dr.select(balanced, precise(0, 0, 1), _unit(sums))
        dr.eval(axes)
        angle = dr.acos(_least_cosine(directions, dr.gather(precise, axes, self._leaves), self._first, self._count))

        def enclose(first, second, node, child):
            axis = dr.gather(precise, axes, node)
            reach = [
                dr.safe_acos(dr.dot(axis, dr.gather(precise, axes, one))) + inside
                for one, inside in ((child, first), (child + 1, second))
            ]
            return dr.minimum(dr.maximum(*reach), dr.pi)

        angles = self._towards_root(angle, enclose)
        return mi.Vector3f(axes), mi.Float(dr.maximum(dr.cos(angles) - COSINE_ROUNDING, -1))

    def _towards_root(self, at_leaves, join: Callable):
        """Combine leaf values level by level, evaluated.

        ``join``: function of (values of first children, values of second children, nodes, indices of first children).
        """
        kind = type(at_leaves)
        values = dr.zeros(kind, self._size)
        dr.scatter(values, at_leaves, self._leaves)
        dr.eval(values)
        for first, last in zip(self._levels[-3::-1], self._levels[-2:0:-1], strict=True):
            node = dr.arange(mi.UInt32, int(last - first)) + dr.opaque(mi.UInt32, int(first))
            child = dr.gather(mi.UInt32, self._child, node)
            inner = child > 0
            children = [dr.gather(kind, values, child + k, inner) for k in (0, 1)]
            joined = join(*children, node, child)
            # Evaluate before the scatter: otherwise Dr.Jit copies the whole array, because a pending read needs it
            dr.eval(joined)
            dr.scatter(values, joined, node, inner)
            dr.eval(values)
        return values


def _unit(vectors):
    """Unit vectors in double precision.

    ``dr.normalize`` multiplies by a reciprocal, which on CUDA has the relative error 2e-7, for doubles too.
    """
    length = dr.norm(vectors)
    return type(vectors)(vectors.x / length, vectors.y / length, vectors.z / length)


@dr.syntax
def _over_points(values, first, count, join):
    """Reduce the values of each leaf's points, evaluated."""
    total, k = dr.gather(type(values), values, first), mi.UInt32(1)
    while dr.hint(k < count, exclude=[values, first, count]):
        total = join(total, dr.gather(type(values), values, first + k))
        k += 1
    dr.eval(total)
    return total


@dr.syntax
def _least_cosine(directions, axis, first, count):
    """Least cosine between each leaf's axis and the directions of its points."""
    least, k = dr.ones(type(axis.x), dr.width(first)), mi.UInt32(0)
    while dr.hint(k < count, exclude=[directions, axis, first, count]):
        cosine = dr.dot(axis, dr.gather(type(directions), directions, first + k))
        least = dr.minimum(least, cosine)
        k += 1
    return dr.maximum(least, -1)
