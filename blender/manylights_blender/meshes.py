"""Evaluated geometry of Blender as Mitsuba's meshes, split by material."""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

HAS_MESH = ("MESH", "CURVE", "SURFACE", "META", "FONT")


@dataclass
class Part:
    """Triangles of one material of a mesh, in the object's space.

    `slot`: index of the material; `positions`, `normals` (n, 3) float32; `uvs` (n, 2) float32 or None; `faces` (m, 3)
    uint32. A corner of a polygon is a vertex, so flat and sharp edges keep their normals.
    """

    slot: int
    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray | None
    faces: np.ndarray


def _array(collection, name, width, dtype=np.float32):
    """Return attribute `name` of all items of a collection of Blender, (n, `width`)."""
    values = np.empty(len(collection) * width, dtype)
    collection.foreach_get(name, values)
    return values.reshape(-1, width)


def parts_of(evaluated):
    """Return the `Part`s of an evaluated object, an empty list if it has no faces."""
    mesh = evaluated.to_mesh()
    try:
        return [] if mesh is None or not len(mesh.polygons) else _parts(mesh)
    finally:
        evaluated.to_mesh_clear()


def _parts(mesh):
    mesh.calc_loop_triangles()
    triangles = _array(mesh.loop_triangles, "loops", 3, np.int32)
    slots = _array(mesh.loop_triangles, "material_index", 1, np.int32)[:, 0]
    positions = _array(mesh.vertices, "co", 3)[_array(mesh.loops, "vertex_index", 1, np.int32)[:, 0]]
    normals = _array(mesh.corner_normals, "vector", 3)
    layer = next((one for one in mesh.uv_layers if one.active_render), None)
    uvs = None if layer is None else _array(layer.uv, "vector", 2)
    parts = []
    for slot in np.unique(slots):
        corners, faces = np.unique(triangles[slots == slot], return_inverse=True)
        faces = faces.reshape(-1, 3).astype(np.uint32)
        parts.append(
            Part(int(slot), positions[corners], normals[corners], None if uvs is None else uvs[corners], faces)
        )
    return parts


def to_world(part, matrix):
    """Return a `Part` transformed by a matrix (4, 4). A mirroring matrix also turns the faces, so that they agree with
    the normals."""
    linear = matrix[:3, :3]
    positions = part.positions @ linear.T + matrix[:3, 3]
    # The matrix of cofactors: the transposed inverse times the determinant, which a flattened object has as well
    x, y, z = linear.T
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
    normals = part.normals @ cofactors.T * (-1 if np.linalg.det(linear) < 0 else 1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    faces = part.faces[:, ::-1] if np.linalg.det(linear) < 0 else part.faces
    return Part(part.slot, positions, normals, part.uvs, faces)


def is_open(part):
    """Whether an edge belongs to one face only. Corners at the same place are one."""
    _, point = np.unique(part.positions, axis=0, return_inverse=True)
    corners = point.reshape(-1)[part.faces]
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 1).any())


def shape(name, part, surface):
    """Return a `mi.Mesh` of a `Part` with a `materials.Surface`, whose BSDF is an object of Mitsuba."""
    properties = mi.Properties()
    properties["bsdf"] = surface.bsdf
    if surface.radiance:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": surface.radiance})
    mesh = mi.Mesh(
        name, len(part.positions), len(part.faces), has_vertex_normals=True, has_vertex_texcoords=part.uvs is not None,
        props=properties,
    )  # fmt: skip
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(part.positions, np.float32).ravel())
    parameters["vertex_normals"] = mi.Float(np.ascontiguousarray(part.normals, np.float32).ravel())
    if part.uvs is not None:
        parameters["vertex_texcoords"] = mi.Float(part.uvs.ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(part.faces).ravel())
    parameters.update()
    return mesh
