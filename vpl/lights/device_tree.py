"""Light trees in kernels: packed records, one per node."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from .light_tree import COLUMNS, ESCAPE, INTENSITY, REPRESENTATIVE, LightTree


@dataclass
class Node:
    """Nodes of a light tree in a kernel: one per lane.  Fields as in the records of :class:`LightTree`.

    ``least_c``: least c of the surface lights, undefined for other kinds.
    """

    box_min: mi.Point3f
    box_max: mi.Point3f
    axis: mi.Vector3f
    cosine: mi.Float
    intensity: mi.Color3f
    escape: mi.UInt32
    least_c: mi.Float

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


class DeviceTree:
    """A light tree's packed records on the device.

    ``second_representative``: (2n - 1,), a light per node, drawn independently of the tree's representatives; None for
    a tree without representatives.
    """

    def __init__(self, kind: str, tree: LightTree, second_representative=None):
        self.kind = kind
        self._second = None if second_representative is None else upload(mi.UInt32, second_representative)
        self.count = len(tree.records)
        self._records = upload(mi.Float, tree.records)

    def records(self) -> np.ndarray:
        """NumPy copy of the records, see :class:`LightTree`."""
        return download(self._records).reshape(self.count, -1)

    def gather(self, index, active=True) -> Node:
        """Fetch one node per lane."""
        a, b, c, d = (dr.gather(mi.Vector4f, self._records, index * 4 + k, active) for k in range(4))
        return Node(
            mi.Point3f(a.x, a.y, a.z),
            mi.Point3f(a.w, b.x, b.y),
            mi.Vector3f(b.z, b.w, c.x),
            c.y,
            mi.Color3f(c.w, d.x, d.y),
            dr.reinterpret_array(mi.UInt32, d.z),
            d.w,
        )

    def _column(self, column: int, index, active):
        return dr.gather(mi.Float, self._records, index * COLUMNS + column, active)

    def escape(self, index, active=True):
        """First node after a node's subtree."""
        return dr.reinterpret_array(mi.UInt32, self._column(ESCAPE, index, active))

    def summed_intensity(self, index, active=True):
        """Summed intensity of a node's lights, averaged over channels."""
        return self._column(INTENSITY, index, active)

    def representative(self, index, active=True, second=False):
        """Index of a node's representative light, or of its second representative."""
        if second:
            return dr.gather(mi.UInt32, self._second, index, active)
        return dr.reinterpret_array(mi.UInt32, self._column(REPRESENTATIVE, index, active))
