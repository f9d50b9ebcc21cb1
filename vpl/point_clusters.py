"""Gather points in the order of their point tree, and the nodes of that tree as kernels see them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import download, upload
from .bounds import Receiver
from .point_tree import PointTree, build_point_tree
from .proxies import MaterialProxy
from .surfaces import Batch

# Floats per node: box, cone of normals, largest base, range of points, first child; and of lobes: cone, peak, exponent
_RECORD, _LOBE_RECORD = 16, 8
# Most points of a leaf: a few make a smaller tree at 1 to 3% more shadow rays, but lobes need points of their own
_LAMBERTIAN_LEAF, _GLOSSY_LEAF = 4, 1


@dataclass
class PointNode:
    """Nodes of a point tree in a kernel: one per lane.  ``child``: the first of two children, 0 for a leaf."""

    receiver: Receiver
    first: object
    count: object
    child: object

    @property
    def radius(self):
        """Radius of the ball around the node's box."""
        return dr.norm(self.receiver.extent)


class PointClusters:
    """A batch of gather points along a tree over them, with the bounds of every node on the device [IC section 3].

    ``build``: makes the tree of positions and normals, (n, 3) each; by default one over all points by place, normal and
    material.  ``order``: row of the original batch that each point of ``batch`` is.
    """

    def __init__(self, batch: Batch, build: Callable | None = None):
        position, normal = download(batch.position), _directions(batch.normal)
        self.tree: PointTree = (build or partial(_tree_by_place, batch))(position, normal)
        self.order = upload(mi.UInt32, self.tree.order)
        self.batch = batch.select(self.order)
        self._records = upload(mi.Float, _records(self.tree, position, normal, download(batch.proxy.base)))
        proxy = batch.proxy
        self._lobes = upload(mi.Float, _lobe_records(self.tree, proxy)) if proxy.glossy else None
        self._no_cosine = None
        if proxy.without_cosines:
            some = self.tree.reduce(download(proxy.no_cosine), np.logical_or)
            self._no_cosine = upload(mi.UInt32, some) == 1
            dr.eval(self._no_cosine)

    @property
    def count(self) -> int:
        """Number of gather points."""
        return self.batch.count

    def ranges(self, index):
        """(First point along the tree, number of points) of nodes."""
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


def _directions(vectors) -> np.ndarray:
    """Unit vectors, (n, 3) float32; those of broken meshes that are not become +z, so that they have a place."""
    values = download(vectors)
    length = np.einsum("ij,ij->i", values, values)
    values[~(np.abs(length - 1) < 1e-3)] = (0, 0, 1)
    return values


def _records(tree: PointTree, position: np.ndarray, normal: np.ndarray, base: np.ndarray) -> np.ndarray:
    """(m, _RECORD) float32."""
    records = np.zeros((tree.size, _RECORD), np.float32)
    # One pass for all bounds: the largest of -x is the least of x
    largest = tree.reduce(np.hstack([-position, position, base]), np.maximum)
    records[:, 0:3], records[:, 3:6], records[:, 10:13] = -largest[:, 0:3], largest[:, 3:6], largest[:, 6:9]
    records[:, 6:9], records[:, 9] = tree.cones(normal)
    for column, values in ((13, tree.first), (14, tree.count), (15, tree.child)):
        records[:, column] = values.view(np.float32)
    return records


def _lobe_records(tree: PointTree, proxy: MaterialProxy) -> np.ndarray:
    """(m, _LOBE_RECORD) float32."""
    records = np.zeros((tree.size, _LOBE_RECORD), np.float32)
    records[:, 0:3], records[:, 3] = tree.cones(_directions(proxy.axis))
    records[:, 4:7] = tree.reduce(download(proxy.peak), np.maximum)
    records[:, 7] = tree.reduce(download(proxy.exponent), np.minimum)
    return records
