"""Triangles of Mitsuba's meshes.

The only module of ``vpl`` and ``integrators`` that names parameters and buffers of meshes: Mitsuba 3.10 renames them
(``vertex_positions`` becomes ``positions``, ``faces_buffer`` becomes ``faces``).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import download
from .parameters import parameters_of


def is_triangle_mesh(shape) -> bool:
    """Whether a shape consists of triangles.  Mitsuba's ``is_mesh`` holds for rectangles, too."""
    return shape.is_mesh() and shape.class_name() != "Rectangle"


def faces_of(mesh) -> np.ndarray:
    """Indices of the vertices of each triangle, (triangles, 3) uint32."""
    return _rows(mesh.faces_buffer(), 3)


def positions_of(mesh) -> np.ndarray | None:
    """Positions of the vertices, (vertices, 3) float64, world units; None for a mesh without this parameter, which a
    rectangle is."""
    return _vertices(mesh, "vertex_positions", 3)


def normals_of(mesh) -> np.ndarray | None:
    """Normals of the vertices, (vertices, 3) float64, before any flip; None for a mesh without normals at vertices."""
    return _vertices(mesh, "vertex_normals", 3) if mesh.has_vertex_normals() else None


def coordinates_of(mesh) -> np.ndarray | None:
    """Texture coordinates of the vertices, (vertices, 2) float64; None for a mesh without."""
    return _vertices(mesh, "vertex_texcoords", 2) if mesh.has_vertex_texcoords() else None


def corners_of(mesh, triangle: mi.UInt32) -> list[mi.Point3f]:
    """Positions of the three corners of each ``triangle``, an index, world units."""
    faces, positions = mesh.faces_buffer(), mesh.vertex_positions_buffer()
    return [dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, faces, 3 * triangle + k)) for k in range(3)]


def _vertices(mesh, name: str, size: int) -> np.ndarray | None:
    """A parameter with ``size`` numbers per vertex, (vertices, ``size``) float64; None for a mesh without it."""
    values = parameters_of(mesh, below=False).get(name)
    return None if values is None else _rows(values, size).astype(np.float64)


def _rows(values, size: int) -> np.ndarray:
    """Numbers on the device as rows, (n, ``size``)."""
    return download(values).reshape(-1, size)


@dataclass(frozen=True)
class Triangles:
    """Triangles of a shape, float32 and uint32, world units.

    ``faces`` (triangles, 3): indices of vertices; ``positions`` (vertices, 3); ``normals`` (vertices, 3) or None;
    ``coordinates`` (vertices, 2) of textures, or None; ``flipped``: whether the sides of the surface are exchanged.
    """

    faces: np.ndarray
    positions: np.ndarray
    normals: np.ndarray | None
    coordinates: np.ndarray | None
    flipped: bool


def is_hit_as_triangles(shape) -> bool:
    """Whether rays hit a shape as triangles: meshes and rectangles, but no ellipsoids made of triangles."""
    return shape.is_mesh() and not shape.is_ellipsoids()


def surface_of(shape) -> tuple[np.ndarray, np.ndarray]:
    """(Indices of the vertices of each triangle that rays hit, positions of the vertices): see :class:`Triangles`."""
    return faces_of(shape), _rows(shape.vertex_positions_buffer(), 3)


def triangles_of(shape) -> Triangles:
    """The triangles that rays hit."""
    faces, positions = surface_of(shape)
    normals = _rows(shape.vertex_normals_buffer(), 3) if shape.has_vertex_normals() else None
    coordinates = _rows(shape.vertex_texcoords_buffer(), 2) if shape.has_vertex_texcoords() else None
    return Triangles(faces, positions, normals, coordinates, shape.has_flipped_normals())
