"""What the nodes of a point tree hold, found on the device: from points to leaves, then level by level to the root."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..core.arrays import upload
from .point_tree import PointTree

# A cosine is lowered by this much before it is stored in single precision, so that no cone loses a vector to rounding
_COSINE_ROUNDING = 2.0**-21


class NodeBounds:
    """Combines values of the points along a tree for every node: arrays of n entries become arrays of ``tree.size``."""

    def __init__(self, tree: PointTree):
        self._levels, self._size = tree.levels, tree.size
        self._child = upload(mi.UInt32, tree.child)
        leaves = tree.leaves
        self._leaves = upload(mi.UInt32, leaves)
        self._first, self._count = (upload(mi.UInt32, x[leaves]) for x in (tree.first, tree.count))
        self._points = upload(mi.UInt32, tree.count)

    def reduce(self, values, join: Callable):
        """``join``: combines two arrays lane by lane, such as ``dr.maximum``."""
        at_leaves = _over_points(values, self._first, self._count, join)
        return self._towards_root(at_leaves, lambda first, second, node, child: join(first, second))

    def cones(self, directions):
        """Cones that hold unit vectors: (axes, cosines of half-angles), single precision.

        An inner node's axis is the mean direction, its half-angle the least that holds the cones of both children.
        """
        precise = dr.float64_array_t(type(directions))
        # Unit in double precision too: near 1 the angle of a cosine magnifies what single precision left over
        directions = dr.normalize(precise(directions))
        dr.eval(directions)
        sums = self.reduce(directions, lambda first, second: first + second)
        length = dr.norm(sums)
        balanced = length < 1e-6 * dr.float64_array_t(mi.Float)(self._points)
        axes = dr.select(balanced, precise(0, 0, 1), sums / length)
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
        return mi.Vector3f(axes), mi.Float(dr.maximum(dr.cos(angles) - _COSINE_ROUNDING, -1))

    def _towards_root(self, at_leaves, join: Callable):
        """``join``: function of (values of the first children, of the second ones, nodes, their first children)."""
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
            # Before it is written to: an array that is still to be read is copied first, as a whole
            dr.eval(joined)
            dr.scatter(values, joined, node, inner)
            dr.eval(values)
        return values


@dr.syntax
def _over_points(values, first, count, join):
    total, k = dr.gather(type(values), values, first), mi.UInt32(1)
    while dr.hint(k < count, exclude=[values, first, count]):
        total = join(total, dr.gather(type(values), values, first + k))
        k += 1
    dr.eval(total)
    return total


@dr.syntax
def _least_cosine(directions, axis, first, count):
    """Of each leaf, the least cosine between its axis and the direction of one of its points."""
    least, k = dr.ones(type(axis.x), dr.width(first)), mi.UInt32(0)
    while dr.hint(k < count, exclude=[directions, axis, first, count]):
        cosine = dr.dot(axis, dr.gather(type(directions), directions, first + k))
        least = dr.minimum(least, cosine)
        k += 1
    return dr.maximum(least, -1)
