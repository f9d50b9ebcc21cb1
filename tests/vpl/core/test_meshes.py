"""Reading of triangles."""

import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from tests.support.paths import ROOT
from vpl.core import meshes

POSITIONS = [[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 2, 3]]
FACES = [[0, 1, 2], [2, 1, 3]]
NORMALS = [[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, -1]]
COORDINATES = [[0, 0], [1, 0], [0, 1], [0.5, 0.25]]


def mesh(**has):
    made = mi.Mesh("two", 4, 2, **has)
    values = {"vertex_positions": POSITIONS, "faces": FACES, "vertex_normals": NORMALS, "vertex_texcoords": COORDINATES}
    parameters = mi.traverse(made)
    for name, value in values.items():
        if name in parameters and len(parameters[name]):
            parameters[name] = np.ravel(value).tolist()
    parameters.update()
    return made


def test_arrays_of_a_mesh():
    one = mesh(has_vertex_normals=True, has_vertex_texcoords=True)
    np.testing.assert_array_equal(meshes.faces_of(one), FACES)
    np.testing.assert_array_equal(meshes.positions_of(one), POSITIONS)
    np.testing.assert_array_equal(meshes.normals_of(one), NORMALS)
    np.testing.assert_array_equal(meshes.coordinates_of(one), COORDINATES)
    assert meshes.faces_of(one).dtype == np.uint32 and meshes.positions_of(one).dtype == np.float64


def test_arrays_that_a_shape_lacks():
    bare, rectangle = mesh(), mi.load_dict({"type": "rectangle"})
    assert meshes.normals_of(bare) is None and meshes.coordinates_of(bare) is None
    assert meshes.is_triangle_mesh(bare) and not meshes.is_triangle_mesh(rectangle)
    assert meshes.positions_of(rectangle) is None


def test_corners_of_triangles():
    corners = meshes.corners_of(mesh(), mi.UInt32([1, 0]))
    found = np.stack([np.array(dr.ravel(corner)).reshape(-1, 3) for corner in corners], 1)
    np.testing.assert_array_equal(found, np.array(POSITIONS)[np.array(FACES)[[1, 0]]])


def test_no_other_module_names_what_mitsuba_renames():
    names = re.compile(r"vertex_(positions|normals|texcoords)\b|faces_buffer|face_indices|\[\"faces\"\]")
    files = [*Path(ROOT, "vpl").rglob("*.py"), *Path(ROOT, "integrators").rglob("*.py")]
    naming = {file.name for file in files if names.search(file.read_text().replace("has_vertex_", ""))}
    assert naming == {"meshes.py"}
