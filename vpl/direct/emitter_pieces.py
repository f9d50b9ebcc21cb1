"""Area emitters cut into pieces: triangles, parallelograms, disks and spheres in one array.

Sampling a point on a piece, or evaluating its density, needs no virtual call, so the size of kernels does not depend on
the number of shapes.  Cylinders and other shapes, and disks with textured emission, stay whole and are sampled by
Mitsuba's routine.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero, select_record, upload
from ..core.cones import mean_axes
from ..core.meshes import coordinates_of, faces_of, is_triangle_mesh, normals_of, positions_of
from ..core.parameters import matrix_of, parameters_of
from ..core.shapes import registered_shapes
from ..lights.emitters import AreaEmitters
from ..lights.spheres import Sphere, sphere_coordinates

PARALLELOGRAM, TRIANGLE, DISK, SPHERE, SHAPE = range(5)
# Largest difference of equal normals in single precision
_ROUNDING = 1e-6


@dataclass
class PieceSample:
    """Points on pieces, one per lane.  ``n``: normal of the emitting side, not normalised; the shading normal on smooth
    meshes.  ``pdf``: density per solid angle at the reference point, 0 on the back."""

    p: mi.Point3f
    n: mi.Normal3f
    uv: mi.Point2f
    pdf: mi.Float


class EmitterPieces:
    """The area emitters of a scene, cut into k pieces; arrays are float64.

    ``center`` (k, 3), ``radius`` (k,): bounding spheres, world units; ``axis`` (k, 3), ``cone_cos`` (k,): cones of
    normals, with a cosine of -1 for omnidirectional pieces; ``intensity`` (k,): radiance (mean over channels) times
    area, or times the mean projected area of curved pieces.
    """

    def __init__(self, scene, area: AreaEmitters):
        self._area = area
        shapes = _shapes_of(scene, area)
        textured = {row for row, _ in area.textured}
        parts = [_pieces_of(shape, row in textured) for row, shape in enumerate(shapes)]
        counts = np.array([len(part.kind) for part in parts], np.int64)
        row = np.repeat(np.arange(len(parts)), counts)
        kind, corner, first, second, normal, shading, uv = (_joined(parts, name) for name in _COLUMNS)
        size = _areas(kind, first, second)
        whole = kind == SHAPE
        size[whole] = area.area[row[whole]]
        self.count = len(kind)
        self._store(kind, corner, first, second, normal, size, row)
        self._uv = upload(mi.Float, np.pad(uv, ((0, 0), (0, 2)))) if textured else None
        smooth = (np.abs(shading - _constant(normal)) > _ROUNDING).any(1)
        self._shading = upload(mi.Float, np.pad(shading, ((0, 0), (0, 3)))) if smooth.any() else None
        self._first_piece = upload(mi.UInt32, np.cumsum(counts) - counts)
        self._has_meshes = upload(mi.UInt32, np.array([is_triangle_mesh(shape) for shape in shapes], np.uint32))
        self._kinds = set(np.unique(kind).tolist())
        self._hollow = bool((first[kind == SPHERE, 1] < 0).any())
        self._bound(kind, corner, first, second, size, row, shapes)
        self._face(kind, normal, shading, np.flatnonzero(smooth))

    def _store(self, kind, corner, first, second, normal, size, row):
        records = np.zeros((self.count, 16), np.float32)
        records[:, 0:3], records[:, 4:7], records[:, 8:11], records[:, 12:15] = corner, first, second, normal
        records[:, 7] = size
        bits = records.view(np.uint32)
        bits[:, 3], bits[:, 11] = kind, row
        self._records = upload(mi.Float, records)

    def _face(self, kind, normal, shading, smooth):
        """Compute the cone of normals of every piece."""
        flat = (kind <= DISK)[:, None]
        self.axis = np.where(flat, normal, (0.0, 0.0, 1.0))
        self.cone_cos = np.where(flat[:, 0], 1.0, -1.0)
        # A cone of less than 90 degrees around three normals also contains their interpolations
        normals = shading[smooth, None, :3] + np.insert(shading[smooth, 3:].reshape(-1, 2, 3), 0, 0.0, axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), np.finfo(np.float64).tiny)
        self.axis[smooth], balanced = mean_axes(normals.sum(1), normals[:, 0])
        cosine = np.einsum("ijk,ik->ij", normals, self.axis[smooth]).min(1)
        self.cone_cos[smooth] = np.where(balanced | (cosine <= 0), -1.0, np.minimum(cosine, 1))

    def _bound(self, kind, corner, first, second, size, row, shapes):
        corners = np.stack([corner, corner + first, corner + second, corner + first + second], 1)
        corners[kind == TRIANGLE, 3] = corners[kind == TRIANGLE, 0]
        self.center = corners.mean(1)
        triangle, disk, sphere = kind == TRIANGLE, kind == DISK, kind == SPHERE
        self.center[triangle] = corners[triangle, :3].mean(1)
        self.center[disk | sphere] = corner[disk | sphere]
        self.radius = np.linalg.norm(corners - self.center[:, None], axis=2).max(1)
        lengths = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
        # Valid for half-axes that are not orthogonal, too
        self.radius[disk] = np.hypot(*lengths)[disk]
        self.radius[sphere] = first[sphere, 0]
        for index in np.flatnonzero(kind == SHAPE):
            box = shapes[row[index]].bbox()
            low, high = np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel()
            self.center[index], self.radius[index] = (low + high) / 2, np.linalg.norm(high - low) / 2
        # The mean projected area of a convex body is a quarter of its surface
        projected = np.where(kind <= DISK, size, size / 4)
        self.intensity = projected * self._area.radiance.mean(1, dtype=np.float64)[row]

    def _fetch(self, piece, active):
        """Fetch (kind, corner, first edge, second edge, normal, area, row of the emitter) of pieces."""
        a, b, c, d = (dr.gather(mi.Vector4f, self._records, piece * 4 + k, active) for k in range(4))
        kind, row = dr.reinterpret_array(mi.UInt32, a.w), dr.reinterpret_array(mi.UInt32, c.w)
        return kind, mi.Point3f(a.xyz), b.xyz, c.xyz, mi.Normal3f(d.xyz), b.w, row

    def sample(self, piece, interaction, sample, active):
        """Sample a point on each piece for a reference point: flat pieces by area, spheres by solid angle.

        Returns (:class:`PieceSample`, radiance towards the reference point over the density).
        """
        kind, corner, first, second, normal, size, row = self._fetch(piece, active)
        a, b = mi.Float(sample.x), mi.Float(sample.y)
        folded = (kind == TRIANGLE) & (a + b > 1)
        a, b = dr.select(folded, 1 - a, a), dr.select(folded, 1 - b, b)
        if DISK in self._kinds:
            disk = mi.warp.square_to_uniform_disk_concentric(sample)
            a, b = dr.select(kind == DISK, disk.x, a), dr.select(kind == DISK, disk.y, b)
        p = corner + a * first + b * second
        shading = self._shading_normal(piece, a, b, normal, active)
        pdf = _area_density(interaction.p, p, normal, size, shading)
        found = PieceSample(p, shading, self._texture_coordinates(piece, a, b, active), pdf)
        if SPHERE in self._kinds:
            of_sphere = self._sample_sphere(interaction.p, corner, first, second, normal, size, sample)
            found = select_record(kind == SPHERE, of_sphere, found)
        if SHAPE in self._kinds:
            whole = active & (kind == SHAPE)
            # By area, because only position samples have texture coordinates
            ps = self._area.sample_position(row, interaction.time, sample, whole)
            other = PieceSample(ps.p, ps.n, ps.uv, _area_density(interaction.p, ps.p, ps.n, size))
            found = select_record(whole, other, found)
        active = active & (found.pdf > 0)
        radiance = self._area.emitted_in_front(row, found, active)
        return found, dr.select(active, finite_or_zero(radiance / found.pdf), 0)

    def found(self, preliminary, ray, active):
        """Piece that a ray hits: (piece, whether any, radiance towards the origin, density of :meth:`sample`)."""
        row = self._area.row(preliminary, active & preliminary.is_valid())
        active = active & (row > 0)
        row -= 1
        mesh = dr.gather(mi.UInt32, self._has_meshes, row, active) == 1
        piece = dr.gather(mi.UInt32, self._first_piece, row, active) + dr.select(mesh, preliminary.prim_index, 0)
        kind, corner, first, second, normal, size, _ = self._fetch(piece, active)
        p = ray(preliminary.t)
        a, b = _place_in_plane(p, corner, first, second)
        shading = self._shading_normal(piece, a, b, normal, active)
        pdf = _area_density(ray.o, p, normal, size, shading)
        hit = PieceSample(p, shading, self._texture_coordinates(piece, a, b, active), pdf)
        if SPHERE in self._kinds:
            outward = mi.Normal3f(dr.normalize(p - corner))
            of_sphere = PieceSample(p, outward * first.y, self._on_sphere(outward, second, normal, first.z), None)
            by_area = _area_density(ray.o, p, of_sphere.n, size)
            seen = dr.select(dr.dot(ray.d, of_sphere.n) < 0, _sphere_density(ray.o, corner, first.x), 0)
            of_sphere.pdf = dr.select(first.y > 0, seen, by_area)
            hit = select_record(kind == SPHERE, of_sphere, hit)
        if SHAPE in self._kinds:
            whole = active & (kind == SHAPE)
            si = preliminary.compute_surface_interaction(ray, mi.RayFlags.All, whole)
            other = PieceSample(si.p, si.n, si.uv, _area_density(ray.o, si.p, si.n, size))
            hit = select_record(whole, other, hit)
        shown = active & (hit.pdf > 0)
        return piece, active, self._area.emitted_in_front(row, hit, shown), hit.pdf & shown

    def _sample_sphere(self, origin, center, first, second, axis, size, sample) -> PieceSample:
        """Sample a sphere: the visible part uniformly in solid angle, or by area if the sphere emits inwards."""
        n = _visible_normal(origin, center, first.x, sample)
        if self._hollow:
            n = dr.select(first.y > 0, n, mi.Normal3f(mi.warp.square_to_uniform_sphere(sample)))
        p = center + first.x * n
        pdf = dr.select(
            first.y > 0, _sphere_density(origin, center, first.x), _area_density(origin, p, n * first.y, size)
        )
        return PieceSample(p, n * first.y, self._on_sphere(n, second, axis, first.z), pdf)

    def _on_sphere(self, outward, across, axis, handed):
        """Texture coordinates of a point on a sphere with the given x and z axes."""
        if self._uv is None:
            return mi.Point2f(0)
        return sphere_coordinates(outward, across, axis, handed)

    def _texture_coordinates(self, piece, a, b, active):
        if self._uv is None:
            return mi.Point2f(0)
        origin, along = (dr.gather(mi.Vector4f, self._uv, piece * 2 + k, active) for k in range(2))
        return mi.Point2f(origin.x + a * origin.z + b * along.x, origin.y + a * origin.w + b * along.y)

    def _shading_normal(self, piece, a, b, normal, active):
        """Normal of the emitting side, not normalised."""
        if self._shading is None:
            return normal
        x, y, z = (dr.gather(mi.Vector4f, self._shading, piece * 3 + k, active) for k in range(3))
        along_a, along_b = mi.Vector3f(x.w, y.x, y.y), mi.Vector3f(y.z, y.w, z.x)
        return mi.Normal3f(x.xyz + a * along_a + b * along_b)


def _place_in_plane(p, corner, first, second):
    """Coordinates of a point in the plane of a piece, relative to its corner and both edges."""
    offset = p - corner
    ff, fs, ss = dr.squared_norm(first), dr.dot(first, second), dr.squared_norm(second)
    of, os = dr.dot(offset, first), dr.dot(offset, second)
    scale = dr.rcp(ff * ss - fs * fs)
    return (of * ss - os * fs) * scale, (os * ff - of * fs) * scale


def _area_density(origin, p, normal, size, shading=None):
    """Density per solid angle of a point drawn by area, 0 on the back.

    ``shading``: normal of the emitting side if different from ``normal``.
    """
    offset = origin - p
    distance2 = dr.squared_norm(offset)
    facing = dr.dot(offset, normal if shading is None else shading) > 0
    cosine = dr.abs(dr.dot(offset, normal)) * dr.rsqrt(distance2)
    return dr.select(facing & (cosine > 0) & (distance2 > 0), distance2 / (size * cosine), 0)


def _cap(origin, center, radius):
    """(1 - cosine of the half-angle that a sphere subtends, 0 from inside; squared distance of the centre)."""
    distance2 = dr.squared_norm(center - origin)
    sine2 = dr.square(radius) / distance2
    return dr.select(sine2 < 1, sine2 / (1 + dr.safe_sqrt(1 - sine2)), 0), distance2


def _sphere_density(origin, center, radius):
    cap, _ = _cap(origin, center, radius)
    return dr.select(cap > 0, dr.inv_two_pi / cap, 0)


def _visible_normal(origin, center, radius, sample):
    """Normal at a point on the visible part of a sphere, drawn uniformly in solid angle."""
    cap, distance2 = _cap(origin, center, radius)
    versine = sample.x * cap  # 1 - cosine, accurate in single precision for small distant spheres
    sine2 = versine * (2 - versine)
    azimuth = dr.two_pi * sample.y
    sine = dr.safe_sqrt(sine2)
    local = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), 1 - versine)
    direction = mi.Frame3f(dr.normalize(center - origin)).to_world(local)
    distance = dr.sqrt(distance2) * (1 - versine) - dr.safe_sqrt(dr.square(radius) - distance2 * sine2)
    return mi.Normal3f(dr.normalize(origin + distance * direction - center))


# ---- Reading shapes

_COLUMNS = ("kind", "corner", "first", "second", "normal", "shading", "uv")


@dataclass
class _Pieces:
    """Pieces of one shape: corner, edges (half-axes of disks), normal; ``shading`` (k, 9): normal of the emitting side
    at the corner, and changes along both edges; ``uv`` (k, 6): the same for texture coordinates.

    Spheres: centre, (radius, emitting side: 1 is outside, handedness of the frame), x axis, z axis.
    """

    kind: np.ndarray
    corner: np.ndarray
    first: np.ndarray
    second: np.ndarray
    normal: np.ndarray
    shading: np.ndarray
    uv: np.ndarray


def _joined(parts: list[_Pieces], name: str) -> np.ndarray:
    empty = np.zeros(0, np.uint32) if name == "kind" else np.zeros((0, {"shading": 9, "uv": 6}.get(name, 3)))
    return np.concatenate([empty, *(getattr(part, name) for part in parts)])


def _shapes_of(scene, area: AreaEmitters) -> list:
    by_index = dict(registered_shapes(scene))
    return [by_index[int(index)] for index in area.shape_index]


def _areas(kind, first, second) -> np.ndarray:
    size = np.linalg.norm(np.cross(first, second), axis=1)
    size[kind == TRIANGLE] *= 0.5
    size[kind == DISK] *= np.pi
    size[kind == SPHERE] = 4 * np.pi * first[kind == SPHERE, 0] ** 2
    return size


def _pieces_of(shape, textured: bool) -> _Pieces:
    name = shape.class_name()
    if is_triangle_mesh(shape):
        return _triangles(shape, textured)
    matrix = np.eye(4)
    if name in ("Rectangle", "Disk", "Sphere"):
        matrix = matrix_of(parameters_of(shape, below=False)["to_world"])
    linear, origin = matrix[:3, :3], matrix[:3, 3]
    if np.linalg.det(linear) == 0:
        # A flattened shape has no area and is never drawn, but its row must be finite
        return _one(PARALLELOGRAM, origin, np.zeros(3), np.zeros(3), (0, 0, 1))
    if name == "Rectangle":
        normal = np.linalg.inv(linear).T[:, 2] * (-1 if shape.has_flipped_normals() else 1)
        return _one(PARALLELOGRAM, origin - linear[:, 0] - linear[:, 1], 2 * linear[:, 0], 2 * linear[:, 1], normal)
    # Texture coordinates of disks are polar, not linear
    if name == "Disk" and not textured:
        return _one(DISK, origin, linear[:, 0], linear[:, 1], np.linalg.inv(linear).T[:, 2])
    if name == "Sphere":
        sphere = Sphere.of(shape)
        return _one(SPHERE, sphere.center, (sphere.radius, sphere.side, sphere.handed), sphere.across, sphere.axis)
    return _one(SHAPE, (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 1))


def _one(kind, corner, first, second, normal) -> _Pieces:
    normal = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    rows = [np.asarray(value, np.float64)[None] for value in (corner, first, second, normal)]
    return _Pieces(np.array([kind], np.uint32), *rows, _constant(rows[-1]), np.array([[0.0, 0, 1, 0, 0, 1]]))


def _constant(normal: np.ndarray) -> np.ndarray:
    """``shading`` of pieces with a constant normal."""
    return np.pad(normal, ((0, 0), (0, 6)))


def _triangles(mesh, textured: bool) -> _Pieces:
    faces, vertices = faces_of(mesh), positions_of(mesh)
    corner, second, third = (vertices[faces[:, k]] for k in range(3))
    first, second = second - corner, third - corner
    normal = np.cross(first, second)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # A triangle without area is never drawn, but its normal must be finite
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
    shading = _constant(normal)
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        at = normals_of(mesh)[faces]
        shading = np.concatenate([at[:, 0], at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]], 1)
    if mesh.has_flipped_normals():
        normal, shading = -normal, -shading
    uv = np.tile([0.0, 0, 1, 0, 0, 1], (len(faces), 1))
    if textured and mesh.has_vertex_texcoords():
        at = coordinates_of(mesh)[faces]
        uv = np.concatenate([at[:, 0], at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]], 1)
    return _Pieces(np.full(len(faces), TRIANGLE, np.uint32), corner, first, second, normal, shading, uv)
