"""Where rays meet surfaces: triangles of all meshes in one array, also inside instances, other shapes by Mitsuba.

Mitsuba computes the surface interaction of a ray by a call of the shape that the ray hits.  Dr.Jit records such a call
for every shape in memory, and kernels pass its arguments and results through memory.  Here one piece of code serves all
triangles.  Against Mitsuba's call, kernels of paths take 0.86 to 0.96 of the time, and the loop of paths among 880
rectangles is recorded in 0.13 s instead of 0.34 s (decisions.md).
"""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import upload
from .instances import TriangleInstances
from .meshes import is_hit_as_triangles, triangles_of
from .registry import RegistryTable
from .shapes import INSTANCE, SceneShapes

# Bits of a triangle: its corners have normals, they have coordinates of textures, its sides are exchanged
_SMOOTH, _MAPPED, _FLIPPED = 1, 2, 4
# Shapes of a switch, at most. Python records a case in 1.4 times the time that Mitsuba's call by pointer takes for a
# shape (20 000 spheres), and does not record the meshes, nor shapes of other scenes
_MOST_SWITCHED = 1000


class Interactions:
    """Surface interactions in a scene, equal to those of ``Scene.ray_intersect`` up to rounding.

    The arrays, 16 bytes per triangle and 32 per vertex, hold the meshes as they are when the object is made: the scene
    must not change while the object is used.
    """

    def __init__(self, scene, shapes: SceneShapes | None = None):
        """``shapes`` of the scene, if known."""
        self._scene, shapes = scene, shapes or SceneShapes.of(scene)
        self._instances = TriangleInstances(shapes.groups)
        placed = {index for index, _ in self._instances.instances}
        meshes = [(index, shape) for index, shape in shapes.own if is_hit_as_triangles(shape)] + self._instances.shapes
        others = [row for row in shapes.own if not (is_hit_as_triangles(row[1]) or row[0] in placed)]
        self._others = [shape for _, shape in others]
        self._other = RegistryTable([index for index, _ in others], range(1, len(others) + 1))
        # The number of the first triangle of each mesh, from 1 on
        firsts = 1 + np.cumsum([0, *(mesh.face_count() for _, mesh in meshes)])[:-1]
        self._triangle = RegistryTable([index for index, _ in meshes], firsts)
        self._faces, self._vertices = _packed([mesh for _, mesh in meshes])

    def meet(self, ray: mi.Ray3f, active: mi.Bool, coherent: mi.Bool = False) -> mi.SurfaceInteraction3f:
        """The nearest surface on each ray, with the fields of ``RayFlags.All``; ``coherent``: whether neighbouring rays
        are alike."""
        return self.at(self._scene.ray_intersect_preliminary(ray, coherent, active), ray, active)

    def at(self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The surfaces that rays ``hit``."""
        active = active & hit.is_valid()
        instance = self._instances.number(hit, active) if self._instances.instances else None
        shape = hit.shape if instance is None else self._instances.shape(hit, instance)
        number = self._triangle.at(shape, active)
        on_mesh = number > 0
        other = self._on_others(ray, hit, active & ~on_mesh) if self._others else dr.zeros(mi.SurfaceInteraction3f)
        on_triangle = self._on_triangle(hit, number - 1 + hit.prim_index, on_mesh)
        on_triangle.shape = shape
        if instance is not None:
            self._instances.place(on_triangle, instance, on_mesh)
            on_triangle.instance = hit.instance
        si = dr.select(on_mesh, on_triangle, other)
        si.t = dr.select(active, si.t, dr.inf)
        si.time, si.wavelengths = ray.time, ray.wavelengths
        si.initialize_sh_frame()
        si.wi = dr.select(active, si.to_local(-ray.d), -ray.d)
        return si

    def _on_others(self, ray, hit, active) -> mi.SurfaceInteraction3f:
        """Interactions with shapes that are no meshes, and with instances of groups that have such shapes."""
        if len(self._others) > _MOST_SWITCHED:
            return hit.compute_surface_interaction(ray, mi.RayFlags.All, active)
        # Mitsuba tells the instance of a group, and on the CPU not the shape in the group
        is_instance = hit.instance != None  # noqa: E711
        number = self._other.at(dr.select(is_instance, hit.instance, hit.shape), active)
        cases = [partial(_by_mitsuba, shape) for shape in self._others]
        return dr.switch(number - 1, cases, ray, hit, active & (number > 0))

    def _on_triangle(self, hit, triangle: mi.UInt32, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Interactions with triangles, without time, direction and the axes of the shading frame."""
        face = dr.gather(mi.Vector4u, self._faces, triangle, active)
        smooth, mapped, flipped = ((face.w & bit) != 0 for bit in (_SMOOTH, _MAPPED, _FLIPPED))
        # Positions with u, and normals with v
        positions, normals = (
            [dr.gather(mi.Vector4f, self._vertices, 2 * face[k] + half, active) for k in range(3)] for half in range(2)
        )
        of_second, of_third = hit.prim_uv.x, hit.prim_uv.y
        of_first = 1 - of_second - of_third

        def between(x, y, z):
            return dr.fma(x, of_first, dr.fma(y, of_second, z * of_third))

        a, b, c = (mi.Point3f(record.xyz) for record in positions)
        along, across = b - a, c - a
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t, si.p, si.prim_index = hit.t, between(a, b, c), hit.prim_index
        flat = mi.Normal3f(dr.normalize(dr.cross(along, across)))
        facing = mi.Normal3f(dr.normalize(between(*(mi.Normal3f(record.xyz) for record in normals))))
        facing = dr.select(smooth, facing, flat)
        si.n, si.sh_frame.n = (dr.select(flipped, -normal, normal) for normal in (flat, facing))
        u, v = ([record.w for record in records] for records in (positions, normals))
        si.uv = dr.select(mapped, mi.Point2f(between(*u), between(*v)), mi.Point2f(of_second, of_third))
        (u1, u2), (v1, v2) = ((x[1] - x[0], x[2] - x[0]) for x in (u, v))
        # Rounded as in Mitsuba: on a line, the area is 0
        area = dr.fma(u1, v2, -(v1 * u2))
        by_map = (v2 * along - v1 * across) / area, (u1 * across - u2 * along) / area
        # Where the corners have coordinates on a line, Mitsuba takes any axes
        axes = zip(by_map, mi.coordinate_system(flat), (along, across), strict=True)
        si.dp_du, si.dp_dv = (dr.select(mapped, dr.select(area != 0, x, other), edge) for x, other, edge in axes)
        return si


def ray_to_emitter(si, direction: mi.Vector3f, point: mi.Point3f, is_infinite: mi.Bool) -> mi.Ray3f:
    """Shadow ray from each surface ``si`` to an emitter: to its ``point``, or, where the emitter ``is_infinite``, in a
    ``direction``.

    Mitsuba 3.9.1 places infinite emitters outside of the scene's bounding box, and the box ignores rectangles of equal
    materials.
    """
    return dr.select(is_infinite, si.spawn_ray(direction), si.spawn_ray_to(point))


def direction_sample(point: mi.Point3f, hit: mi.SurfaceInteraction3f, direction: mi.Vector3f):
    """Mitsuba's record of the ``direction`` from a point to a surface, for densities of emitter samples.

    The record has no emitter: kernels call no emitter pointers.  The distance is that from the point, because null
    surfaces may have divided the ray.  The normal is the shading normal, as in emitter samples.
    """
    ds = dr.zeros(mi.DirectionSample3f, dr.width(point))
    ds.p, ds.n, ds.uv, ds.d, ds.dist = hit.p, hit.sh_frame.n, hit.uv, direction, dr.norm(hit.p - point)
    return ds


def _by_mitsuba(shape, ray, hit, active):
    si = shape.compute_surface_interaction(ray, hit, mi.RayFlags.All, active)
    # A shape names itself by its index in Mitsuba's registry.  As a constant, it would make code of its own for each
    # shape, and other code in each process
    if shape.class_name() != INSTANCE:
        si.shape = hit.shape
    si.instance = hit.instance
    return si


def _packed(meshes: list) -> tuple[mi.UInt32, mi.Float]:
    """(Records of triangles: numbers of three vertices, and bits; records of vertices: position, u, normal, v)."""
    # One more record, because a scene without meshes needs arrays, too
    faces = np.zeros((1 + sum(mesh.face_count() for mesh in meshes), 4), np.uint32)
    vertices = np.zeros((1 + sum(mesh.vertex_count() for mesh in meshes), 8), np.float32)
    face = vertex = 0
    for mesh in map(triangles_of, meshes):
        rows, records = faces[face : face + len(mesh.faces)], vertices[vertex : vertex + len(mesh.positions)]
        np.add(mesh.faces, np.uint32(vertex), out=rows[:, :3])
        rows[:, 3] = _FLIPPED * mesh.flipped
        records[:, :3] = mesh.positions
        if mesh.normals is not None:
            rows[:, 3] |= _SMOOTH
            records[:, 4:7] = mesh.normals
        if mesh.coordinates is not None:
            rows[:, 3] |= _MAPPED
            records[:, 3::4] = mesh.coordinates
        face, vertex = face + len(rows), vertex + len(records)
    return upload(mi.UInt32, faces), upload(mi.Float, vertices)
