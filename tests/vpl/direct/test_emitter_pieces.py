"""Pieces of area emitters: sampling, densities, bounds."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import VARIANT, stress
from tests.support.sources import (
    COUNT,
    area,
    assert_means_agree,
    assert_mostly,
    colours,
    interactions,
    patches,
    texture,
    uniform_index,
)
from vpl.core.arrays import download, upload
from vpl.core.sampling import independent_sampler
from vpl.direct.emitter_pieces import EmitterPieces
from vpl.direct.sources import Sources
from vpl.lights.emitters import read_emitters

SHEAR = np.array([[0.8, 0.5, 0.1, 0.3], [0.0, 0.6, 0.2, -0.2], [0.2, 0.1, 0.7, 0.1], [0, 0, 0, 1]])


def placed(scale=(0.5, 0.8, 0.6)):
    return mi.ScalarTransform4f().translate([0.3, -0.2, 0.1]).rotate([0.6, 0.0, 0.8], 50).scale(list(scale))


# Plugins by name; a mirrored transform swaps the orientation of the edges
SHAPES = {
    "rectangle": lambda: {"type": "rectangle", "to_world": placed()},
    "mirrored rectangle": lambda: {"type": "rectangle", "to_world": placed((-0.5, 0.8, 0.6))},
    "sheared rectangle": lambda: {"type": "rectangle", "to_world": mi.ScalarTransform4f(SHEAR)},
    "disk": lambda: {"type": "disk", "to_world": placed((0.7, 0.7, 0.7))},
    "elliptic disk": lambda: {"type": "disk", "to_world": placed((0.4, 0.9, 0.7))},
    "mirrored disk": lambda: {"type": "disk", "to_world": placed((0.7, -0.7, 0.7))},
    "cube": lambda: {"type": "cube", "to_world": placed()},
    "mirrored cube": lambda: {"type": "cube", "to_world": placed((0.5, -0.8, 0.6))},
    "sheared cube": lambda: {"type": "cube", "to_world": mi.ScalarTransform4f(SHEAR)},
    "sphere": lambda: {"type": "sphere", "center": [0.1, 0.2, 0.3], "radius": 1.5, "to_world": placed((0.4,) * 3)},
    "cylinder": lambda: {"type": "cylinder", "to_world": placed((0.5,) * 3), "p0": [0, 0, -1]},
}


HOLLOW = ("cube", "sphere", "cylinder")


PLAIN = [(name, flip, False) for name in SHAPES for flip in (False, True)]


TEXTURED = [(name, False, True) for name in ("rectangle", "mirrored rectangle", "disk", "cube", "sphere", "cylinder")]
TEXTURED += [("rectangle", True, True), ("cube", True, True)]


NAMED = {"ids": lambda x: x if isinstance(x, str) else "FT"[x]}


CASES = pytest.mark.parametrize(("name", "flip", "textured"), PLAIN + TEXTURED, **NAMED)


QUICK = (PLAIN + TEXTURED)[::3]


QUICK_CASES = pytest.mark.parametrize(
    ("name", "flip", "textured"),
    [*QUICK, *stress(*(case for case in PLAIN + TEXTURED if case not in QUICK))],
    **NAMED,
)


def emitting(name, flip=False, textured=False):
    """A scene with a shape, and points with a view of the shape, (n, 3)."""
    shape = SHAPES[name]() | {"flip_normals": flip, "emitter": area(texture()) if textured else area()}
    scene = mi.load_dict({"type": "scene", "shape": shape})
    rng = np.random.default_rng(7)
    centre = np.array(scene.bbox().center(), float).ravel()
    if flip and name.endswith(HOLLOW):
        return scene, centre + rng.uniform(-0.1, 0.1, (4, 3))
    away = rng.normal(size=(2, 3))
    away *= rng.uniform(1.6, 3, (2, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    return scene, centre + np.concatenate([away, -away])


def rays_towards(scene, point, seed):
    """Rays from a point, even over the cone around the scene, and the cone's solid angle."""
    box = scene.bbox()
    offset = np.array(box.center(), float).ravel() - point
    sine = min(np.linalg.norm(np.array(box.extents(), float)) / 2 / np.linalg.norm(offset), 1)
    cosine = np.sqrt(1 - sine**2) if sine < 1 else -1.0
    local = mi.warp.square_to_uniform_cone(independent_sampler(seed, COUNT).next_2d(), mi.Float(cosine))
    frame = mi.Frame3f(mi.Vector3f(*(offset / np.linalg.norm(offset)).tolist()))
    ray = mi.Ray3f(mi.Point3f(*point.tolist()), frame.to_world(local))
    return ray, 2 * np.pi * (1 - cosine)


def pieces_of(scene):
    return EmitterPieces(scene, read_emitters(scene).area)


def draw_pieces(pieces, point, seed=0, count=COUNT):
    """(Piece, sample, direction, value times the number of pieces) from a point of view."""
    sampler = independent_sampler(seed, count)
    reference = interactions([point], count)
    piece = uniform_index(sampler, pieces.count)
    found, value = pieces.sample(piece, reference, sampler.next_2d(), mi.Bool(True))
    direction = dr.normalize(found.p - reference.p)
    dr.eval(piece, found, value, direction)
    return piece, found, direction, value


@CASES
def test_sampled_points_are_visible_and_found_again(name, flip, textured):
    if name == "cylinder" and VARIANT.startswith("cuda"):
        pytest.skip("0.6% of the hits that OptiX finds on a cylinder are off by more than a ten thousandth")
    scene, points = emitting(name, flip, textured)
    pieces, hits = pieces_of(scene), 0
    for point in points:
        piece, sample, direction, value = draw_pieces(pieces, point, count=5000)
        ray = mi.Ray3f(mi.Point3f(*point.tolist()), direction)
        hit = scene.ray_intersect_preliminary(ray)
        row, active, radiance, pdf = pieces.found(hit, ray, mi.Bool(True))
        lit = np.broadcast_to(download(sample.pdf > 0), 5000)
        hits += lit.sum()
        if not lit.any():
            continue
        distance = download(dr.norm(sample.p - mi.Point3f(*point.tolist())))[lit]
        assert_mostly(download(active)[lit])
        assert_mostly(np.abs(download(hit.t)[lit] / distance - 1) < 1e-4)
        assert_mostly((download(row) == download(piece))[lit])
        expected = download(sample.pdf)[lit]
        assert_mostly(np.abs(download(pdf)[lit] / expected - 1) < 1e-2, 0.99)
        through = colours(value, 5000)[lit] * expected[:, None]
        assert_mostly(np.abs(colours(radiance, 5000)[lit] - through).max(1) < 0.02 * max(through.max(), 1e-9))
    assert hits >= 5000


@QUICK_CASES
def test_integrals_over_directions_are_those_of_traced_rays(name, flip, textured):
    """Solid angle and radiance, whatever Mitsuba's own sampling does."""
    scene, points = emitting(name, flip, textured)
    pieces, seen = pieces_of(scene), 0
    for seed, point in enumerate(points):
        _, sample, direction, value = draw_pieces(pieces, point, seed)
        inverse = download(dr.select(sample.pdf > 0, dr.rcp(sample.pdf), 0)).astype(float) * pieces.count
        ray, cone = rays_towards(scene, point, 1000 + seed)
        hit = scene.ray_intersect_preliminary(ray)
        si = hit.compute_surface_interaction(ray)
        emitted = colours(si.emitter(scene).eval(si), COUNT)
        # Where shapes are mirrored, this is not the side of the geometric normal
        front = download(si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 0))
        assert_means_agree(inverse, cone * front)
        weighted = colours(value, COUNT)[:, :, None] * pieces.count * download(direction)[:, None, :]
        assert_means_agree(weighted, cone * emitted[:, :, None] * download(ray.d)[:, None, :])
        _, active, radiance, pdf = pieces.found(hit, ray, mi.Bool(True))
        assert np.array_equal(download(active), download(hit.is_valid()))
        assert_mostly(np.abs(colours(radiance, COUNT) - emitted).max(1) < 1e-3 * max(emitted.max(), 1), 0.999)
        assert_mostly((download(pdf) > 0) == front, 0.999)
        seen += front.sum()
    assert seen > 1000


# Mitsuba takes the axes of sheared and elliptic shapes for orthogonal or equal, and samples flipped rectangles and
# meshes with overlapping texture coordinates wrongly once they are textured
@pytest.mark.parametrize(
    ("name", "flip", "textured"),
    [case for case in PLAIN if not case[0].startswith(("sheared", "elliptic"))]
    + [("rectangle", False, True), ("disk", False, True), ("cylinder", False, True)],
)
def test_irradiance_equals_that_of_mitsubas_sampling(name, flip, textured):
    scene, points = emitting(name, flip, textured)
    pieces, emitter = pieces_of(scene), scene.emitters()[0]
    for seed, point in enumerate(points):
        _, _, direction, value = draw_pieces(pieces, point, seed)
        sampler = independent_sampler(2000 + seed, COUNT)
        ds, weight = emitter.sample_direction(interactions([point], COUNT), sampler.next_2d())
        ours = colours(value, COUNT)[:, :, None] * pieces.count * download(direction)[:, None, :]
        theirs = colours(weight, COUNT)[:, :, None] * download(ds.d)[:, None, :]
        assert_means_agree(ours, np.nan_to_num(theirs), 5e-3)


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("name", ["rectangle", "disk", "cube", "sphere", "cylinder"])
def test_nothing_is_seen_from_behind(name, textured):
    scene, _ = emitting(name, False, textured)
    centre = np.array(scene.bbox().center(), float).ravel()
    if name in HOLLOW:
        points = centre + np.random.default_rng(0).uniform(-0.1, 0.1, (4, 3))
    else:
        matrix = np.array(mi.traverse(scene.shapes()[0])["to_world"].matrix, float).reshape(4, 4)
        normal = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        points = centre - normal * np.array([[0.01], [1], [50]])
    pieces = pieces_of(scene)
    for point in points:
        _, sample, _, value = draw_pieces(pieces, point, count=2000)
        assert download(sample.pdf).max() == 0
        assert colours(value, 2000).max() == 0
        ray, _ = rays_towards(scene, point, 0)
        hit = scene.ray_intersect_preliminary(ray)
        _, active, radiance, pdf = pieces.found(hit, ray, mi.Bool(True))
        assert download(active).any()
        assert colours(radiance, COUNT).max() == 0
        assert download(pdf).max() == 0


def mesh(vertices, faces, emitter, uv=None, **properties):
    props = mi.Properties()
    props["emitter"] = mi.load_dict(emitter)
    for key, value in properties.items():
        props[key] = value
    result = mi.Mesh("mesh", len(vertices), len(faces), props, has_vertex_texcoords=uv is not None)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = upload(mi.Float, np.array(vertices))
    parameters["faces"] = upload(mi.UInt32, np.array(faces))
    if uv is not None:
        parameters["vertex_texcoords"] = upload(mi.Float, np.array(uv))
    parameters.update()
    return result


@pytest.mark.parametrize("textured", [False, True])
def test_triangles_without_area_give_no_nan(textured):
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]]
    faces = [[0, 1, 3], [0, 1, 2], [2, 2, 2], [0, 0, 1]]
    uv = [[0, 0], [1, 0], [0, 1], [0, 0]] if textured else None
    scene = mi.load_dict(
        {"type": "scene", "mesh": mesh(vertices, faces, area(texture() if textured else (1, 1, 1)), uv)}
    )
    pieces = pieces_of(scene)
    assert pieces.count == 4
    for name in ("center", "radius", "axis", "cone_cos", "intensity"):
        assert np.isfinite(getattr(pieces, name)).all()
    assert (pieces.intensity > 0).tolist() == [False, True, False, False]
    piece, sample, _, value = draw_pieces(pieces, np.array([0.3, 0.3, 1.0]), count=20_000)
    assert np.isfinite(colours(value, 20_000)).all()
    assert not np.isnan(download(sample.pdf)).any()
    assert (colours(value, 20_000).max(1) > 0)[download(piece) == 1].any()
    sources = Sources(scene, read_emitters(scene), 10)
    assert sources.count == 1


def test_textures_of_meshes_with_and_without_coordinates():
    vertices, faces = [[-1, -1, 0], [1, -1, 0], [1, 1, 0.5], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    for uv in (None, [[0, 0], [2, 0.3], [1, 1], [-0.5, 1]]):
        scene = mi.load_dict({"type": "scene", "mesh": mesh(vertices, faces, area(texture()), uv)})
        pieces = pieces_of(scene)
        ray, _ = rays_towards(scene, np.array([0.1, -0.2, 2]), 0)
        hit = scene.ray_intersect_preliminary(ray)
        si = hit.compute_surface_interaction(ray)
        emitted = colours(si.emitter(scene).eval(si), COUNT)
        assert emitted.max() > 1
        radiance = colours(pieces.found(hit, ray, mi.Bool(True))[2], COUNT)
        assert_mostly(np.abs(radiance - emitted).max(1) < 1e-2, 0.999)


def test_many_shapes_of_all_kinds_keep_their_own_radiance():
    shapes = {}
    for number, name in enumerate(("rectangle", "disk", "cube", "sphere", "cylinder")):
        for copy in range(2):
            plugin = SHAPES[name]()
            plugin["to_world"] = mi.ScalarTransform4f().translate([4 * number, 4 * copy, 0]) @ plugin["to_world"]
            level = 1.0 + number + 10 * copy
            plugin["emitter"] = area(texture(level * patches())) if copy and number % 2 else area((level, 1.0, 0.5))
            shapes[f"{name} {copy}"] = plugin
    scene = mi.load_dict({"type": "scene", **shapes})
    pieces = pieces_of(scene)
    sampler = independent_sampler(0, COUNT)
    origin = mi.Point3f(20 * sampler.next_1d() - 2, 8 * sampler.next_1d() - 2, 3)
    ray = mi.Ray3f(origin, mi.warp.square_to_uniform_sphere(sampler.next_2d()))
    hit = scene.ray_intersect_preliminary(ray)
    si = hit.compute_surface_interaction(ray)
    emitted = colours(si.emitter(scene).eval(si), COUNT)
    radiance = pieces.found(hit, ray, mi.Bool(True))[2]
    assert len(np.unique(emitted[:, 0])) > 8
    assert_mostly(np.abs(colours(radiance, COUNT) - emitted).max(1) < 1e-2 * np.maximum(emitted.max(1), 1), 0.999)


@CASES
def test_bounds_hold_all_points_and_normals(name, flip, textured):
    scene, points = emitting(name, flip, textured)
    pieces = pieces_of(scene)
    assert np.allclose(np.linalg.norm(pieces.axis, axis=1), 1)
    for point in points:
        piece, sample, _, _ = draw_pieces(pieces, point, count=5000)
        piece, p, n = download(piece), download(sample.p), np.broadcast_to(download(sample.n), (5000, 3))
        lit = np.broadcast_to(download(sample.pdf > 0), 5000)
        distance = np.linalg.norm(p - pieces.center[piece], axis=1)[lit]
        assert (distance <= pieces.radius[piece][lit] * (1 + 1e-4)).all()
        cosine = np.einsum("ij,ij->i", n, pieces.axis[piece])[lit]
        assert (cosine >= pieces.cone_cos[piece][lit] - 1e-4).all()


def test_far_small_spheres_keep_their_solid_angle():
    sphere = {"type": "sphere", "center": [0, 0, 1000.0], "radius": 0.01, "emitter": area((1, 1, 1))}
    pieces = pieces_of(mi.load_dict({"type": "scene", "sphere": sphere}))
    _, _, direction, value = draw_pieces(pieces, np.zeros(3), count=1000)
    assert np.allclose(colours(value, 1000), np.pi * 1e-10, rtol=1e-3)
    sine = np.hypot(*download(direction).T[:2])
    assert sine.max() <= 1.01e-5
