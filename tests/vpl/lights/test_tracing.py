"""Light paths: normalisation against closed forms, emitters against Mitsuba's own sampling, choices against pmfs."""

import gc
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.scenes import area_light, closed_box, wall
from vpl.core.arrays import download, upload
from vpl.core.sampling import Choice, derived_seed
from vpl.lights import tracing
from vpl.lights.emission import bounding_box, emitter_samplers
from vpl.lights.emitters import read_emitters
from vpl.lights.tracing import LightPathSettings, trace_lights


def traced(scene, count=20_000, seed=0, deepest=math.inf, rr_depth=5, lobe_limit=1.0):
    """Lights of a scene dictionary."""
    scene = mi.load_dict(scene)
    return trace_lights(scene, read_emitters(scene), count, seed, LightPathSettings(deepest, rr_depth, lobe_limit))


@pytest.fixture
def collects_often():
    """Python's collector runs all the time."""
    usual = gc.get_threshold()
    gc.set_threshold(1)
    yield
    gc.set_threshold(*usual)


def furnace(albedo, emitter=None, bsdf=None):
    """A point light of power 4 pi in the middle of a diffuse sphere."""
    material = bsdf or {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}}
    light = emitter or {"type": "point", "intensity": {"type": "rgb", "value": [1.0, 2.0, 0.5]}}
    return {"type": "scene", "light": light, "ball": {"type": "sphere", "flip_normals": True, "bsdf": material}}


@pytest.mark.parametrize("rr_depth", [1, 5])
@pytest.mark.parametrize("albedo", [0.3, 0.9])
def test_flux_in_a_furnace_is_the_geometric_series(albedo, rr_depth):
    lights = traced(furnace(albedo), rr_depth=rr_depth).lights
    flux = np.pi * lights.intensity.sum(0, dtype=np.float64)
    expected = 4 * np.pi * np.array([1.0, 2.0, 0.5]) * albedo / (1 - albedo)
    assert np.allclose(flux, expected, rtol=0.05)
    first = np.pi * lights.intensity[lights.depth == 1].sum(0, dtype=np.float64)
    assert np.allclose(first, 4 * np.pi * np.array([1.0, 2.0, 0.5]) * albedo, rtol=1e-3)


@pytest.mark.parametrize("count", [1, 100, 50_000])
def test_about_as_many_lights_as_asked_for(count):
    found = traced(furnace(0.7), count).lights.count
    assert count / 2 - 8 <= found <= 2 * count + 8


def test_depths_are_counted_in_edges_and_limited():
    lights = traced(furnace(0.7), deepest=3).lights
    assert set(np.unique(lights.depth)) == {1, 2, 3}
    assert traced(furnace(0.7), deepest=0).lights.count == 0


def test_edges_are_replayed_instead_of_being_recorded_one_by_one(monkeypatch):
    """Recording goes through every shape and material of the scene."""
    recorded, original = [], tracing.spectrum_to_rgb
    monkeypatch.setattr(tracing, "spectrum_to_rgb", lambda value: recorded.append(1) or original(value))
    found = traced(furnace(0.9)).lights
    # Repeatedly: if the number of remaining paths equals the size of an array of any live scene
    assert found.depth.max() > 60 and len(recorded) < 20


def test_scenes_that_are_let_go_while_lights_are_traced_do_no_harm(monkeypatch, collects_often):
    """A scene in a cycle of references lives until Python's collector finds it, which may be at any time."""
    original, scenes = tracing.spectrum_to_rgb, [mi.load_dict(furnace(0.5)) for _ in range(20)]

    def leaves_a_scene_behind(value):
        cycle = [scenes.pop()]
        cycle.append(cycle)
        return original(value)

    monkeypatch.setattr(tracing, "spectrum_to_rgb", leaves_a_scene_behind)
    assert traced(furnace(0.9)).lights.count > 1000


def test_lights_lie_on_the_surface_and_face_the_inside():
    lights = traced(furnace(0.7)).lights
    assert np.allclose(np.linalg.norm(lights.position, axis=1), 1, atol=1e-4)
    assert np.allclose(lights.direction, -lights.position, atol=1e-3)


def test_broad_glossy_lobes_store_lights_only_when_asked():
    metal = {"type": "roughconductor", "alpha": 0.5}
    assert traced(furnace(0, bsdf=metal), 2000, deepest=2, lobe_limit=0.0).lights.count == 0
    assert traced(furnace(0, bsdf=metal), 2000, deepest=2, lobe_limit=2.0).lights.count > 500


def test_same_seed_same_lights():
    first, again, other = (traced(closed_box({"lamp": area_light()}), 2000, seed) for seed in (1, 1, 2))
    assert np.array_equal(first.lights.position, again.lights.position)
    assert first.lights.count != other.lights.count or not np.array_equal(first.lights.position, other.lights.position)


def test_a_light_that_cannot_get_in_does_not_starve_the_emitter_inside():
    scene = closed_box({"lamp": area_light(), "sky": {"type": "constant", "radiance": 1000.0}})
    scene = mi.load_dict(scene)
    lights = trace_lights(scene, read_emitters(scene), 5000, 0, LightPathSettings(3, 5, 1.0)).lights
    inside = np.abs(lights.position).max(1) < 1.001
    facing_in = np.sum(lights.direction * lights.position, axis=1) < 0
    assert (inside & facing_in).sum() > 100


EMITTERS = {
    "point": {"type": "point", "intensity": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
    "spot": {"type": "spot", "cutoff_angle": 40.0, "beam_width": 10.0},
    "area": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
    "directional": {"type": "directional", "direction": [0.1, 0.2, -1]},
    "constant": {"type": "constant"},
}


def test_a_spot_with_a_cone_of_size_zero_sends_no_light():
    spot = EMITTERS["spot"] | {"cutoff_angle": 0.0, "beam_width": 0.0}
    box = {"ball": {"type": "sphere"}, "lamp": area_light(), "spot": spot}
    scenes = [
        mi.load_dict({"type": "scene", **box}),
        mi.load_dict({"type": "scene", "spot": spot, "ball": box["ball"]}),
    ]
    assert [len(emitter_samplers(scene, read_emitters(scene))) for scene in scenes] == [1, 0]


def test_rays_of_an_oval_spot_have_its_intensity():
    """Sums over the rays of a sampler, and over directions on the sphere with the emitter's intensity."""
    frame = mi.ScalarTransform4f().rotate([0, 1, 0], 40).scale([2, 1, 0.5])
    spot = {"type": "spot", "cutoff_angle": 35.0, "beam_width": 20.0, "to_world": frame}
    scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}, "spot": spot})
    count = 200_000
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(3, count)
    (sampler,) = emitter_samplers(scene, read_emitters(scene))
    ray, weight = sampler.sample(numbers.next_1d(), numbers.next_2d(), numbers.next_2d())
    reference = dr.zeros(mi.SurfaceInteraction3f, count)
    reference.p = mi.warp.square_to_uniform_sphere(numbers.next_2d())
    _, intensity = scene.emitters()[0].sample_direction(reference, mi.Point2f(0.5))
    found, expected = (
        np.mean(download(mi.Color3f(value))[:, :1] * np.c_[np.ones(count), download(direction)], axis=0)
        for value, direction in ((weight, ray.d), (4 * np.pi * intensity, reference.p))
    )
    np.testing.assert_allclose(found, expected, atol=0.02 * expected[0])


@pytest.mark.parametrize("name", EMITTERS)
def test_emitted_power_and_directions_equal_mitsubas(name):
    emitter = dict(EMITTERS[name])
    shape = {"type": "sphere", "radius": 0.5}
    scene = {"type": "scene", "shape": shape | ({"emitter": emitter} if name == "area" else {})}
    if name != "area":
        scene["emitter"] = emitter
    scene = mi.load_dict(scene)
    count = 200_000
    sampler = mi.load_dict({"type": "independent"})

    def moments(sample):
        sampler.seed(3, count)
        ray, weight = sample(sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
        weight = np.broadcast_to(download(mi.Color3f(weight)), (count, 3))
        parts = (np.ones((1, 1)), download(mi.Vector3f(ray.o)), download(ray.d))
        where = np.concatenate([np.broadcast_to(part, (count, part.shape[1])) for part in parts], axis=1)
        return (weight[:, :, None] * where[:, None, :]).mean(0)

    (emitter_sampler,) = emitter_samplers(scene, read_emitters(scene))
    ours = moments(emitter_sampler.sample)
    expected = moments(lambda a, b, c: scene.emitters()[0].sample_ray(0.0, a, b, c))
    # Position is compared through its mean weighted by power; directional rays may start on another plane
    columns = [0, 4, 5, 6] if name in ("directional", "constant") else slice(None)
    assert np.allclose(ours[:, columns], expected[:, columns], atol=0.02 * np.abs(expected[:, 0]).max())


@pytest.mark.parametrize("kind", ["envmap", "constant", "directional"])
def test_rays_from_infinity_fill_the_disk_that_the_scene_shows_to_them(kind):
    sky = mi.Bitmap(np.random.default_rng(0).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 4)
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 70).rotate([1, 0, 0], 50)
    emitter = {
        "envmap": {"type": "envmap", "bitmap": sky, "to_world": turned},
        "constant": {"type": "constant"},
        "directional": {"type": "directional", "direction": [0.3, 0.1, -1]},
    }[kind]
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [3, 1, 2]}, "sky": emitter})
    (emitter_sampler,) = emitter_samplers(scene, read_emitters(scene))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 50_000)
    ray, _ = emitter_sampler.sample(sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    sphere = scene.bbox().bounding_sphere()
    offset = download(ray.o) - np.array(sphere.center).reshape(3)
    direction, radius = download(ray.d), float(sphere.radius)
    along = np.sum(offset * direction, axis=1)
    across2 = np.sum((offset - along[:, None] * direction) ** 2, axis=1)
    assert np.allclose(along, -radius, rtol=1e-3)
    assert across2.mean() == pytest.approx(radius**2 / 2, rel=0.02)


def test_choice_follows_its_pmf_and_never_takes_a_zero():
    weight = np.array([0.0, 3.0, 0.0, 1.0, 1e-12, 6.0, 0.0])
    choice = Choice(weight)
    assert choice.pmf.sum() == pytest.approx(1)
    uniform = (np.arange(1 << 18) + 0.5) / (1 << 18)
    rows = download(choice.row(upload(mi.Float, uniform)))
    assert np.allclose(np.bincount(rows, minlength=7) / len(rows), choice.pmf, atol=1e-4)
    edges = download(choice.row(upload(mi.Float, [0.0, np.nextafter(np.float32(1), np.float32(0))])))
    assert np.all(weight[edges] > 0)
    assert np.allclose(download(choice.probability(mi.UInt32(rows[:5]))), choice.pmf[rows[:5]])


@pytest.mark.parametrize("weight", [[0.0, 0.0], [np.nan, 1.0], [np.inf, 1.0]])
def test_choice_refuses_weights_that_cannot_be_chosen_from(weight):
    with pytest.raises(ValueError, match="positive sum"):
        Choice(np.array(weight))


def test_derived_seeds_differ():
    seeds = {derived_seed(seed, stream) for seed in range(20) for stream in range(20)}
    assert len(seeds) == 400
    assert all(isinstance(seed, int) and 0 <= seed < 2**32 for seed in seeds)
    assert dr.width(mi.UInt32(derived_seed(1, 2, 3))) == 1


def test_the_size_of_a_scene_counts_rectangles_that_were_merged():
    """Mitsuba joins shapes of equal material and loses their sizes."""
    walls = {f"wall{k}": wall([0, 0, 2.5 * k], [0, 1, 0], 0, 3.0) for k in range(3)}
    scene = mi.load_dict({"type": "scene", **walls})
    assert len(scene.shapes()) == 1
    box = bounding_box(scene)
    assert np.allclose(box.min, [-3, -3, 0]) and np.allclose(box.max, [3, 3, 5])
