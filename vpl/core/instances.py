"""Instances of shape groups that consist of triangles: the shapes that rays hit, and their surfaces in the world.

Mitsuba computes an interaction with an instance by a call of the instance, which calls the shapes of its group.
Dr.Jit records these calls for every instance.  Here two tables serve all instances: shapes of groups by their place in
the group, and transformations.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import upload
from .meshes import is_hit_as_triangles
from .parameters import matrix_of, parameters_of
from .registry import RegistryTable
from .shapes import ShapeGroup

# Rows of the affine transformation of points and of the linear one of normals, four numbers each
_ROWS = 6


class TriangleInstances:
    """Instances of shape groups that have no other shapes than triangles.

    ``shapes``, ``instances``: (registry index, shape) of the shapes in these groups, and of these instances.  An object
    holds the transformations as they are when it is made.
    """

    def __init__(self, groups: list[ShapeGroup]):
        groups = [one for one in groups if one.instances and all(is_hit_as_triangles(shape) for _, shape in one.shapes)]
        self.shapes = [row for group in groups for row in group.shapes]
        self.instances = [row for group in groups for row in group.instances]
        # The place of a group's first shape among all of them, for each instance
        begins = np.cumsum([0, *(len(group.shapes) for group in groups)])[:-1]
        begins = np.repeat(begins, [len(group.instances) for group in groups])
        self._number = RegistryTable([index for index, _ in self.instances], range(1, len(self.instances) + 1))
        # An entry for surfaces without an instance, and at least two: an array of one entry changes the kernels
        self._begin = upload(mi.UInt32, np.array([0, *begins], np.uint32))
        self._shape = upload(mi.UInt32, np.array([0, *(index for index, _ in self.shapes)], np.uint32))
        transforms = np.zeros((1 + len(self.instances), _ROWS, 4), np.float32)
        transforms[0, [0, 1, 2, 3, 4, 5], [0, 1, 2, 0, 1, 2]] = 1
        for row, (_, instance) in zip(transforms[1:], self.instances, strict=True):
            to_world = parameters_of(instance, below=False)["to_world"]
            row[:3], row[3:, :3] = matrix_of(to_world)[:3], matrix_of(to_world, range(3), of_normals=True)[:3]
        self._transforms = upload(mi.Float, transforms)

    def number(self, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.UInt32:
        """Numbers of the instances that rays meet, from 1 on; 0 for other surfaces."""
        return self._number.at(hit.instance, active)

    def shape(self, hit: mi.PreliminaryIntersection3f, number: mi.UInt32) -> mi.ShapePtr:
        """The shapes that rays meet; where ``number`` is that of an instance, the shape of its group."""
        if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
            return hit.shape
        # Mitsuba tells the place of the shape in its group
        inside = number > 0
        place = 1 + dr.gather(mi.UInt32, self._begin, number, inside) + hit.shape_index
        index = dr.gather(mi.UInt32, self._shape, place, inside)
        return dr.select(inside, dr.reinterpret_array(mi.ShapePtr, index), hit.shape)

    def place(self, si: mi.SurfaceInteraction3f, number: mi.UInt32, active: mi.Bool) -> None:
        """Move interactions from the space of a group to that of the world; ``number`` of the instance, 0 for surfaces
        that are in the world."""
        rows = [dr.gather(mi.Vector4f, self._transforms, _ROWS * number + k, active) for k in range(_ROWS)]

        def moved(vector, rows):
            return mi.Vector3f(*(dr.dot(row.xyz, vector) for row in rows))

        si.p = mi.Point3f(moved(si.p, rows[:3])) + mi.Vector3f(*(row.w for row in rows[:3]))
        si.dp_du, si.dp_dv = (moved(vector, rows[:3]) for vector in (si.dp_du, si.dp_dv))
        si.n, si.sh_frame.n = (mi.Normal3f(dr.normalize(moved(n, rows[3:]))) for n in (si.n, si.sh_frame.n))
