"""Sources of direct light: pieces of emitters, regions of the environment, and their common interface."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from vpl.core.arrays import download, upload
from vpl.core.sampling import find_interval, independent_sampler
from vpl.direct.emitter_pieces import EmitterPieces
from vpl.direct.environment_regions import EnvironmentRegions
from vpl.direct.sources import Sources
from vpl.lights.emitters import read_emitters

COUNT = 100_000
SHEAR = np.array([[0.8, 0.5, 0.1, 0.3], [0.0, 0.6, 0.2, -0.2], [0.2, 0.1, 0.7, 0.1], [0, 0, 0, 1]])


def image(height=6, width=10, seed=1):
    """Random colours, some of them black."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(0.1, 3, (height, width, 3)) * (rng.random((height, width, 1)) < 0.7)).astype(np.float32)


def texture(pixels=None, **more):
    return {"type": "bitmap", "bitmap": mi.Bitmap(image() if pixels is None else pixels), "raw": True, **more}


def area(radiance=(1.0, 2.0, 0.5)):
    value = radiance if isinstance(radiance, dict) else {"type": "rgb", "value": list(radiance)}
    return {"type": "area", "radiance": value}


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


def interactions(points, repeat=1):
    """Each point so many times."""
    rows = np.repeat(np.asarray(points, np.float32), repeat, axis=0)
    result = dr.zeros(mi.SurfaceInteraction3f, len(rows))
    result.p = mi.Point3f(*(upload(mi.Float, rows[:, k]) for k in range(3)))
    return result


def uniform_index(sampler, count):
    return dr.minimum(mi.UInt32(sampler.next_1d() * count), count - 1)


def rgb(value, count):
    return np.broadcast_to(download(value), (count, 3)).astype(float)


def mean_and_error(values):
    return values.mean(0), values.std(0) / np.sqrt(len(values))


def assert_same_mean(first, second, relative=2e-3):
    """First and second: samples (n, ...) of two estimators of the same."""
    (a, error_a), (b, error_b) = mean_and_error(first), mean_and_error(second)
    allowed = 5 * np.hypot(error_a, error_b) + relative * np.abs(b).max() + 1e-9
    assert (np.abs(a - b) < allowed).all(), (a, b, allowed)


def assert_mostly(condition, share=0.995):
    """All samples except for a few, which rounding moves over an edge."""
    assert np.mean(condition) >= share, np.mean(condition)


def draw_pieces(pieces, point, seed=0, count=COUNT):
    """(Piece, sample, direction, value times the number of pieces) from a point of view."""
    sampler = independent_sampler(seed, count)
    reference = interactions([point], count)
    piece = uniform_index(sampler, pieces.count)
    found, value = pieces.sample(piece, reference, sampler.next_2d(), mi.Bool(True))
    direction = dr.normalize(found.p - reference.p)
    dr.eval(piece, found, value, direction)
    return piece, found, direction, value


# ---- Pieces of emitters


@CASES
def test_sampled_points_are_visible_and_found_again(name, flip, textured):
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
        through = rgb(value, 5000)[lit] * expected[:, None]
        assert_mostly(np.abs(rgb(radiance, 5000)[lit] - through).max(1) < 0.02 * max(through.max(), 1e-9))
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
        emitted = rgb(si.emitter(scene).eval(si), COUNT)
        # Where shapes are mirrored, this is not the side of the geometric normal
        front = download(si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 0))
        assert_same_mean(inverse, cone * front)
        weighted = rgb(value, COUNT)[:, :, None] * pieces.count * download(direction)[:, None, :]
        assert_same_mean(weighted, cone * emitted[:, :, None] * download(ray.d)[:, None, :])
        _, active, radiance, pdf = pieces.found(hit, ray, mi.Bool(True))
        assert np.array_equal(download(active), download(hit.is_valid()))
        assert_mostly(np.abs(rgb(radiance, COUNT) - emitted).max(1) < 1e-3 * max(emitted.max(), 1), 0.999)
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
        ours = rgb(value, COUNT)[:, :, None] * pieces.count * download(direction)[:, None, :]
        theirs = rgb(weight, COUNT)[:, :, None] * download(ds.d)[:, None, :]
        assert_same_mean(ours, np.nan_to_num(theirs), 5e-3)


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
        assert rgb(value, 2000).max() == 0
        ray, _ = rays_towards(scene, point, 0)
        hit = scene.ray_intersect_preliminary(ray)
        _, active, radiance, pdf = pieces.found(hit, ray, mi.Bool(True))
        assert download(active).any()
        assert rgb(radiance, COUNT).max() == 0
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
    assert np.isfinite(rgb(value, 20_000)).all()
    assert not np.isnan(download(sample.pdf)).any()
    assert (rgb(value, 20_000).max(1) > 0)[download(piece) == 1].any()
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
        emitted = rgb(si.emitter(scene).eval(si), COUNT)
        assert emitted.max() > 1
        radiance = rgb(pieces.found(hit, ray, mi.Bool(True))[2], COUNT)
        assert_mostly(np.abs(radiance - emitted).max(1) < 1e-2, 0.999)


def test_many_shapes_of_all_kinds_keep_their_own_radiance():
    shapes = {}
    for number, name in enumerate(("rectangle", "disk", "cube", "sphere", "cylinder")):
        for copy in range(2):
            plugin = SHAPES[name]()
            plugin["to_world"] = mi.ScalarTransform4f().translate([4 * number, 4 * copy, 0]) @ plugin["to_world"]
            level = 1.0 + number + 10 * copy
            plugin["emitter"] = area(texture(level * image())) if copy and number % 2 else area((level, 1.0, 0.5))
            shapes[f"{name} {copy}"] = plugin
    scene = mi.load_dict({"type": "scene", **shapes})
    pieces = pieces_of(scene)
    sampler = independent_sampler(0, COUNT)
    origin = mi.Point3f(20 * sampler.next_1d() - 2, 8 * sampler.next_1d() - 2, 3)
    ray = mi.Ray3f(origin, mi.warp.square_to_uniform_sphere(sampler.next_2d()))
    hit = scene.ray_intersect_preliminary(ray)
    si = hit.compute_surface_interaction(ray)
    emitted = rgb(si.emitter(scene).eval(si), COUNT)
    radiance = pieces.found(hit, ray, mi.Bool(True))[2]
    assert len(np.unique(emitted[:, 0])) > 8
    assert_mostly(np.abs(rgb(radiance, COUNT) - emitted).max(1) < 1e-2 * np.maximum(emitted.max(1), 1), 0.999)


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
    assert np.allclose(rgb(value, 1000), np.pi * 1e-10, rtol=1e-3)
    sine = np.hypot(*download(direction).T[:2])
    assert sine.max() <= 1.01e-5


# ---- Intervals


def test_intervals_are_found_by_their_share():
    rng = np.random.default_rng(0)
    share = rng.random(50) * (rng.random(50) < 0.6)
    cumulative = np.concatenate([[0.0], np.cumsum(share)])
    device = upload(dr.float64_array_t(mi.Float), cumulative)
    for first, last in [(0, 50), (7, 8), (10, 30), (49, 50)]:
        n = 20_000
        sample = (mi.Float(dr.arange(mi.UInt32, n)) + 0.5) / n
        found = download(find_interval(device, mi.UInt32(first), mi.UInt32(last), sample))
        assert found.min() >= first
        assert found.max() < last
        expected = share[first:last]
        if expected.sum() > 0:
            drawn = np.bincount(found - first, minlength=last - first) / n
            assert np.allclose(drawn, expected / expected.sum(), atol=2 / n)
    ends = [0.0, float(np.nextafter(np.float32(1), np.float32(0)))]
    found = download(find_interval(device, mi.UInt32(0), mi.UInt32(50), upload(mi.Float, ends)))
    assert (share[found] > 0).all()


# ---- Regions of the environment


def sky(pixels, to_world=None, **more):
    plugin = {"type": "envmap", "bitmap": mi.Bitmap(np.asarray(pixels, np.float32)), **more}
    return plugin | ({} if to_world is None else {"to_world": to_world})


def smooth_map(height=64, width=128):
    y, x = np.meshgrid(np.arange(height) * np.pi / height, np.arange(width) * 2 * np.pi / width, indexing="ij")
    waves = [np.cos(k * x + phase) * np.sin(q * y) for k, phase, q in [(1, 0.5, 1), (2, 3, 2), (5, 1, 3)]]
    return np.exp(2 * sum(waves))[..., None] * np.array([1.0, 0.7, 0.3])


def tilted():
    return mi.ScalarTransform4f().rotate([0.36, 0.8, -0.48], 70)


SKIES = {
    "envmap": lambda: sky(smooth_map()),
    "rotated envmap": lambda: sky(smooth_map(), tilted()),
    "odd size": lambda: sky(smooth_map(33, 75), tilted()),
    "scaled": lambda: sky(smooth_map(), scale=1e4),
    "constant": lambda: {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
}


def environment(plugin):
    ball = {"type": "sphere", "radius": 0.1}
    return mi.load_dict({"type": "scene", "sky": plugin, "ball": ball}).environment()


def grid_directions(height=1024):
    """Directions in the middle of all cells of a grid, and their solid angles."""
    width = 2 * height
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    theta = (np.arange(height) + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    sine, ones = np.sin(theta), np.ones(width)
    unit = np.stack([np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)), np.outer(np.cos(theta), ones)], -1)
    angle = np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / width, width)
    return mi.Vector3f(*(upload(mi.Float, unit[..., k]) for k in range(3))), angle


def draw_regions(regions, index, seed=0):
    """(Direction, value, density) with every region of ``index`` in turn."""
    sampler = independent_sampler(seed, len(index))
    return regions.sample(upload(mi.UInt32, index), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))


def mitsubas_light(env):
    """Samples of the light of all directions by Mitsuba's own routine, (COUNT, 3)."""
    sample = independent_sampler(5, COUNT).next_2d()
    return rgb(env.sample_direction(interactions([[0, 0, 0]], COUNT), sample)[1], COUNT)


@pytest.mark.parametrize("name", SKIES)
@pytest.mark.parametrize("count", [1, 40])
def test_directions_are_found_in_the_region_they_were_drawn_from(name, count):
    regions = EnvironmentRegions(environment(SKIES[name]()), count)
    assert 1 <= regions.count <= count
    index = np.repeat(np.arange(regions.count), COUNT // regions.count)
    direction, value, density = draw_regions(regions, index)
    unit = download(direction)
    assert np.allclose(np.linalg.norm(unit, axis=1), 1, atol=1e-5)
    region, again = regions.find(direction, mi.Bool(True))
    assert_mostly(download(region) == index, 0.999)
    assert_mostly(np.abs(download(again) / download(density) - 1) < 1e-4, 0.998)
    cosine = np.einsum("ij,ij->i", unit, regions.axis[index])
    assert (cosine >= regions.cone_cos[index] - 1e-5).all()
    radiance = rgb(regions.radiance(direction, mi.Bool(True)), len(index))
    assert np.allclose(rgb(value, len(index)) * download(density)[:, None], radiance, rtol=1e-4)


@pytest.mark.parametrize("name", SKIES)
def test_regions_share_out_all_light(name):
    env = environment(SKIES[name]())
    regions = EnvironmentRegions(env, 30)
    direction, angle = grid_directions()
    region, density = regions.find(direction, mi.Bool(True))
    region, radiance = download(region), rgb(regions.radiance(direction, mi.Bool(True)), len(angle))
    assert np.allclose(np.bincount(region, angle * download(density), regions.count), 1, atol=1e-3)
    light = np.stack([np.bincount(region, angle * radiance[:, k], regions.count) for k in range(3)], 1)
    assert np.allclose(regions.irradiance, light.mean(1), rtol=0.03)
    per_region = 4000
    drawn = rgb(draw_regions(regions, np.repeat(np.arange(regions.count), per_region))[1], regions.count * per_region)
    drawn = drawn.reshape(regions.count, per_region, 3)
    mean, error = drawn.mean(1), drawn.std(1) / np.sqrt(per_region)
    assert (np.abs(mean - light) < 5 * error + 5e-3 * light + 1e-12).all()
    # Within a region the weights hardly differ, thanks to the table
    assert (drawn.std(1) < 0.5 * mean).all()
    expected, expected_error = mean_and_error(mitsubas_light(env))
    assert np.allclose(light.sum(0), expected, rtol=5e-3, atol=5 * expected_error.max())


def test_regions_of_a_constant_environment_fill_the_sphere():
    regions = EnvironmentRegions(environment(SKIES["constant"]()), 50)
    assert regions.count == 50
    assert regions.irradiance.sum() == pytest.approx(4 * np.pi * 2, rel=1e-4)


def test_a_black_environment_gives_nothing_and_no_nan():
    for plugin in (sky(np.zeros((8, 16, 3))), {"type": "constant", "radiance": 0.0}):
        regions = EnvironmentRegions(environment(plugin), 10)
        assert regions.count >= 1
        assert regions.irradiance.sum() == 0
        assert np.isfinite(regions.axis).all()
        direction, value, density = draw_regions(regions, np.zeros(1000, int))
        assert np.isfinite(download(direction)).all()
        assert rgb(value, 1000).max() == 0
        assert download(density).min() > 0
        scene = mi.load_dict({"type": "scene", "sky": plugin, "ball": {"type": "sphere"}})
        assert Sources(scene, read_emitters(scene), 10).count == 0


@pytest.mark.parametrize("shape", [(32, 64), (256, 512), (1024, 2048)], ids=str)
def test_a_single_very_bright_texel_is_found(shape):
    pixels = np.full((*shape, 3), 1e-3)
    pixels[shape[0] // 3, shape[1] // 5] = 1e9
    env = environment(sky(pixels, tilted()))
    regions = EnvironmentRegions(env, 20)
    brightest = int(np.argmax(regions.irradiance))
    assert regions.irradiance[brightest] > 0.1 * regions.irradiance.sum()
    index = np.arange(COUNT) % regions.count
    _, value, density = draw_regions(regions, index)
    value = rgb(value, COUNT)[:, 0]
    total = np.array([value[index == region].mean() for region in range(regions.count)])
    assert total.sum() == pytest.approx(mitsubas_light(env)[:, 0].mean(), rel=0.1)
    assert np.mean(value[index == brightest] * download(density)[index == brightest] > 1) > 0.8


def test_texels_that_are_not_finite_count_as_black():
    pixels = smooth_map()
    pixels[10, 10], pixels[20, 50] = np.nan, np.inf
    regions = EnvironmentRegions(environment(sky(pixels)), 10)
    assert np.isfinite(regions.irradiance).all()
    value = rgb(draw_regions(regions, np.arange(COUNT) % regions.count)[1], COUNT)
    assert np.isfinite(value).all()
    assert value.max() > 0


# ---- All sources


def point(position, intensity):
    return {"type": "point", "position": position, "intensity": {"type": "rgb", "value": intensity}}


def down(x=0.3, y=-0.2, z=2.0, axis=(0.1, 0.2, -1), scale=1.0):
    target = [x + axis[0], y + axis[1], z + axis[2]]
    return mi.ScalarTransform4f().look_at([x, y, z], target, [0, 1, 0]).scale(scale)


LIGHTS = {
    "point": lambda: {"a": point([0.3, 0.2, 1.5], [3.0, 2, 1]), "b": point([-2, 0.2, 1.2], [1.0, 2, 5])},
    "spot": lambda: {"spot": {"type": "spot", "to_world": down(), "cutoff_angle": 30, "beam_width": 15}},
    "backward spot": lambda: {
        "spot": {"type": "spot", "to_world": down(axis=(1, 0, 0.2)), "cutoff_angle": 150, "beam_width": 140}
    },
    "textured spot": lambda: {"spot": {"type": "spot", "to_world": down(), "texture": texture()}},
    "directional": lambda: {
        "sun": {"type": "directional", "direction": [0.4, 0.2, -1], "irradiance": {"type": "rgb", "value": [3.0, 2, 1]}}
    },
    "area": lambda: {"lamp": {"type": "rectangle", "to_world": down(scale=0.5), "emitter": area()}},
    "cube": lambda: {"lamp": {"type": "cube", "to_world": down(-0.9, 0.8, 1.8, scale=0.3), "emitter": area()}},
    "textured area": lambda: {
        "lamp": {"type": "disk", "to_world": down(-0.8, -0.7, 1.5, scale=0.6), "emitter": area(texture())}
    },
    "sphere": lambda: {"lamp": {"type": "sphere", "center": [0.5, 0.2, 1.3], "radius": 0.6, "emitter": area()}},
    "cylinder": lambda: {"lamp": {"type": "cylinder", "to_world": down(0.9, 0.9, 2.6, scale=0.4), "emitter": area()}},
    "envmap": lambda: {"sky": sky(smooth_map(), tilted())},
    "constant": lambda: {"sky": SKIES["constant"]()},
    "projector": lambda: {
        "beamer": {"type": "projector", "to_world": down(axis=(0, 0, -1)), "fov": 40, "irradiance": texture()}
    },
}


def lit_plane(lights):
    """A diffuse square of side 8 below the lights, and a camera above with its centre [-1, 1]^2 in view."""
    camera = {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0.5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
    }
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "camera": camera, "floor": floor, **lights})


def sources_of(scene, regions=20):
    return Sources(scene, read_emitters(scene), regions)


def draw_sources(scene, sources, seed=0, count=COUNT):
    """(Rank, reference points on the plane, sample, radiance due to it) with every source equally likely."""
    sampler = independent_sampler(seed, count)
    reference = dr.zeros(mi.SurfaceInteraction3f, count)
    place = sampler.next_2d()
    reference.p = mi.Point3f(2 * place.x - 1, 2 * place.y - 1, 0)
    reference.n = mi.Normal3f(0, 0, 1)
    rank = uniform_index(sampler, sources.count)
    drawn = sources.sample(rank, reference, sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
    offset = drawn.p - reference.p
    ray = mi.Ray3f(reference.p + mi.Vector3f(0, 0, 1e-4), offset)
    ray.maxt = 0.999
    cosine = drawn.direction.z
    lit = (cosine > 0) & ~scene.ray_test(ray)
    radiance = dr.select(lit, drawn.value * cosine * dr.inv_pi * sources.count, 0)
    return rank, reference, drawn, rgb(radiance, count)


def assert_same_light(scene, spp=1000):
    """The plane's mean radiance equals that of the integrator ``direct``."""
    ours, error = mean_and_error(draw_sources(scene, sources_of(scene), count=4 * COUNT)[3])
    direct = mi.load_dict({"type": "direct"})
    theirs = np.array(mi.render(scene, integrator=direct, spp=spp, seed=3), float).mean((0, 1))
    assert theirs.max() > 0
    assert (np.abs(ours - theirs) < 5 * error + 0.01 * theirs).all(), (ours, theirs, error)
    assert (error < 0.03 * theirs.max()).all()


@pytest.mark.parametrize("name", LIGHTS)
def test_every_kind_of_light_is_worth_what_mitsuba_makes_of_it(name):
    assert_same_light(lit_plane(LIGHTS[name]()))


def everything():
    lights = {}
    for number, name in enumerate(LIGHTS):
        if name != "constant":
            lights |= {f"{key}{number}": plugin for key, plugin in LIGHTS[name]().items()}
    return lights


def test_all_kinds_together():
    assert_same_light(lit_plane(everything()))


@pytest.mark.parametrize("name", ["area", "cube", "textured area", "sphere", "cylinder", "envmap", "constant"])
def test_rays_find_the_source_that_was_sampled(name):
    scene = lit_plane(LIGHTS[name]())
    check_found(scene, sources_of(scene))


def check_found(scene, sources):
    rank, reference, drawn, lit = draw_sources(scene, sources, count=40_000)
    # Except for points out of reach of rays from the plane
    seen = (lit.max(1) > 0) & (np.broadcast_to(download(drawn.pdf), len(lit)) > 0)
    assert seen.sum() > 1000
    ray = mi.Ray3f(reference.p + mi.Vector3f(0, 0, 1e-5), drawn.direction)
    hit = scene.ray_intersect_preliminary(ray)
    radiance, found, pdf = sources.find(hit, ray, mi.Bool(True))
    assert_mostly((download(found) == download(rank))[seen])
    expected = np.broadcast_to(download(drawn.pdf), len(lit))[seen]
    assert_mostly(np.abs(download(pdf)[seen] / expected - 1) < 1e-2, 0.99)
    through = rgb(drawn.value, len(lit))[seen] * expected[:, None]
    assert_mostly(np.abs(rgb(radiance, len(lit))[seen] - through).max(1) < 0.02 * through.max())


def test_rays_find_sources_among_all_kinds():
    scene = lit_plane(everything())
    sources = sources_of(scene)
    check_found(scene, sources)
    # The plane is no source
    ray = mi.Ray3f(dr.zeros(mi.Point3f, 3) + mi.Point3f(0, 0, 0.2), mi.Vector3f(0, 0, -1))
    radiance, rank, pdf = sources.find(scene.ray_intersect_preliminary(ray), ray, mi.Bool(True))
    assert (np.broadcast_to(download(rank), 3) == sources.count).all()
    assert rgb(radiance, 3).max() == 0
    assert download(pdf).max() == 0


def test_nodes_hold_ranges_of_ranks_and_their_sum():
    sources = sources_of(lit_plane(everything()))
    nodes = sources.nodes
    assert nodes.infinite.any()
    assert not nodes.infinite.all()
    single = np.flatnonzero(nodes.escape == np.arange(nodes.count) + 1)
    assert nodes.first[single].tolist() == list(range(sources.count))
    assert (nodes.last[single] == nodes.first[single] + 1).all()
    assert (nodes.intensity > 0).all()
    level = nodes.intensity[single]
    for node in range(nodes.count):
        assert nodes.intensity[node] == pytest.approx(level[nodes.first[node] : nodes.last[node]].sum())
    device = sources.node(dr.arange(mi.UInt32, nodes.count))
    assert np.array_equal(download(device.first), nodes.first)
    assert np.array_equal(download(device.last), nodes.last)
    for name in ("centroid", "radius", "axis", "cone_cos", "intensity"):
        assert np.allclose(download(getattr(device, name)), getattr(nodes, name), rtol=1e-6)


def many_points(intensities, seed=0):
    rng = np.random.default_rng(seed)
    return {f"p{i}": point(rng.uniform(-1, 1, 3).tolist(), [float(x)] * 3) for i, x in enumerate(intensities)}


MEMBERS = {
    "even": lambda: many_points(np.ones(60)),
    "twelve decades": lambda: many_points(10 ** np.random.default_rng(1).uniform(-6, 6, 60)),
    "everything": everything,
}


@pytest.mark.parametrize("name", MEMBERS)
def test_members_are_drawn_with_the_claimed_probability(name):
    sources = sources_of(lit_plane(MEMBERS[name]()))
    nodes, samples = sources.nodes, 20_000
    single = np.flatnonzero(nodes.escape == np.arange(nodes.count) + 1)
    level = nodes.intensity[single]
    chosen = np.flatnonzero(np.isin(np.arange(nodes.count), single, invert=True) | (np.arange(nodes.count) % 10 == 0))
    index = np.repeat(chosen, samples)
    sample = np.tile((np.arange(samples) + 0.5) / samples, len(chosen))
    rank, probability = sources.member(sources.node(upload(mi.UInt32, index)), upload(mi.Float, sample))
    rank, probability = (download(x).reshape(len(chosen), samples) for x in (rank, probability))
    for node, ranks, shares in zip(chosen, rank, probability, strict=True):
        first, last = int(nodes.first[node]), int(nodes.last[node])
        assert ranks.min() >= first
        assert ranks.max() < last
        expected = level[first:last] / level[first:last].sum()
        assert np.allclose(np.bincount(ranks - first, minlength=last - first) / samples, expected, atol=2 / samples)
        assert np.allclose(shares, expected[ranks - first], rtol=1e-3)


@pytest.mark.parametrize("name", MEMBERS)
def test_probabilities_of_members_sum_to_one(name):
    sources = sources_of(lit_plane(MEMBERS[name]()))
    nodes = sources.nodes
    size = (nodes.last - nodes.first).astype(int)
    index = np.repeat(np.arange(nodes.count), size)
    rank = np.concatenate([np.arange(a, b) for a, b in zip(nodes.first, nodes.last, strict=True)])
    share = download(sources.member_probability(sources.node(upload(mi.UInt32, index)), upload(mi.UInt32, rank)))
    assert (share > 0).all()
    assert np.allclose(np.bincount(index, share, nodes.count), 1, atol=1e-5)


def test_lights_too_faint_beside_the_others_still_have_a_probability():
    sources = sources_of(lit_plane(many_points(10 ** np.linspace(10, -10, 60))))
    nodes = sources.nodes
    index = np.repeat(np.arange(nodes.count), (nodes.last - nodes.first).astype(int))
    rank = np.concatenate([np.arange(a, b) for a, b in zip(nodes.first, nodes.last, strict=True)])
    share = download(sources.member_probability(sources.node(upload(mi.UInt32, index)), upload(mi.UInt32, rank)))
    assert np.allclose(np.bincount(index, share, nodes.count), 1, atol=1e-5)


def test_lights_without_power_are_never_drawn():
    dark = {
        "p": point([0, 0, 1], [0.0, 0, 0]),
        "a": {"type": "rectangle", "to_world": down(), "emitter": area((0, 0, 0))},
        "d": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 0.0}},
        "s": {"type": "spot", "to_world": down(), "intensity": {"type": "rgb", "value": 0.0}},
        "c": {"type": "constant", "radiance": {"type": "rgb", "value": 0.0}},
        "t": {"type": "disk", "to_world": down(1, 1, 1), "emitter": area(texture(np.zeros((4, 4, 3), np.float32)))},
    }
    assert sources_of(lit_plane(dark)).count == 0
    # Behind the dark ones in every list: an area emitter among the pieces, a projector after a black environment
    lit = {"z": {"type": "rectangle", "to_world": down(-0.5, 0.4, 1.8, scale=0.5), "emitter": area()}}
    scene = lit_plane(dark | many_points([1, 2]) | lit | LIGHTS["projector"]())
    sources = sources_of(scene)
    assert sources.count == 4
    assert (sources.nodes.intensity > 0).all()
    assert_same_light(scene)
    # A dark emitter that a ray meets is no source
    ray = mi.Ray3f(dr.zeros(mi.Point3f, 1) + mi.Point3f(0.35, -0.1, 1.5), mi.Vector3f(0, 0, 1))
    hit = scene.ray_intersect_preliminary(ray)
    assert download(hit.is_valid())[0]
    radiance, rank, _ = sources.find(hit, ray, mi.Bool(True))
    assert download(rank)[0] == sources.count
    assert rgb(radiance, 1).max() == 0


def test_no_lights_at_all():
    scene = lit_plane({})
    sources = sources_of(scene)
    assert (sources.count, sources.nodes.count, sources.extended) == (0, 0, False)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, 4) + mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1))
    radiance, rank, pdf = sources.find(scene.ray_intersect_preliminary(ray), ray, mi.Bool(True))
    assert rgb(radiance, 1).max() == 0
    assert (download(rank) == 0).all()
    assert download(pdf).max() == 0


def test_an_environment_alone_has_no_finite_nodes():
    sources = sources_of(lit_plane(LIGHTS["envmap"]()), regions=25)
    assert sources.extended
    assert 1 < sources.count == sources.nodes.count <= 25
    assert sources.nodes.infinite.all()
