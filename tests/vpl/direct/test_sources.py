"""Sources of direct light: pieces of emitters, regions of the environment, and their common interface."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.sources import (
    COUNT,
    SKIES,
    area,
    assert_mostly,
    colours,
    mean_and_error,
    sky,
    smooth_map,
    texture,
    tilted,
    uniform_index,
)
from vpl.core.arrays import download, upload
from vpl.core.sampling import independent_sampler
from vpl.direct.sources import Sources
from vpl.lights.emitters import read_emitters

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
    return rank, reference, drawn, colours(radiance, count)


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
    through = colours(drawn.value, len(lit))[seen] * expected[:, None]
    assert_mostly(np.abs(colours(radiance, len(lit))[seen] - through).max(1) < 0.02 * through.max())


def test_rays_find_sources_among_all_kinds():
    scene = lit_plane(everything())
    sources = sources_of(scene)
    check_found(scene, sources)
    # The plane is no source
    ray = mi.Ray3f(dr.zeros(mi.Point3f, 3) + mi.Point3f(0, 0, 0.2), mi.Vector3f(0, 0, -1))
    radiance, rank, pdf = sources.find(scene.ray_intersect_preliminary(ray), ray, mi.Bool(True))
    assert (np.broadcast_to(download(rank), 3) == sources.count).all()
    assert colours(radiance, 3).max() == 0
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
    assert colours(radiance, 1).max() == 0


def test_no_lights_at_all():
    scene = lit_plane({})
    sources = sources_of(scene)
    assert (sources.count, sources.nodes.count, sources.extended) == (0, 0, False)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, 4) + mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1))
    radiance, rank, pdf = sources.find(scene.ray_intersect_preliminary(ray), ray, mi.Bool(True))
    assert colours(radiance, 1).max() == 0
    assert (download(rank) == 0).all()
    assert download(pdf).max() == 0


def test_an_environment_alone_has_no_finite_nodes():
    sources = sources_of(lit_plane(LIGHTS["envmap"]()), regions=25)
    assert sources.extended
    assert 1 < sources.count == sources.nodes.count <= 25
    assert sources.nodes.infinite.all()
