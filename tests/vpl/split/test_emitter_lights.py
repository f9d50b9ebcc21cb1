"""Emitters as virtual lights: lights and traced remainder add up to the image of `path`."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.calls import calls_of
from tests.support.catalogue import EMITTERS
from tests.support.many_emitters import bulbs, interactions, panels, sampler_of, vertices
from tests.support.marks import stress
from tests.support.rendering import plugin_with_model, render
from tests.support.rooms import smooth_octahedron
from tests.support.scenes import closed_box, image, rgb, wall
from tests.support.statistics import assert_same_mean
from vpl.split import estimator, plan, start


def spots(number, rng):
    """Spot emitters with random directions in the closed box."""
    found = {}
    for i in range(number):
        start, end = rng.uniform(-0.9, 0.9, (2, 3))
        turn = mi.ScalarTransform4f().look_at(list(start), list(end), [0.1, 0.2, 1])
        found[f"spot{i}"] = {"type": "spot", "to_world": turn, "intensity": rgb(float(rng.uniform(0.5, 3)))}
    return found


def balls(number, rng):
    """Small spheres that shine, in the closed box."""
    places = rng.uniform(-0.8, 0.8, (number, 3))
    return {
        f"ball{i}": {
            "type": "sphere", "center": list(place), "radius": 0.03,
            "emitter": {"type": "area", "radiance": rgb(float(rng.uniform(1, 8)))},
        }
        for i, place in enumerate(places)
    }  # fmt: skip


def smooth_tile(folder):
    """A glowing mesh with vertex normals off its surface normals."""
    mesh = mi.Mesh("tile", 4, 2, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [-0.3, 0.5, -0.3, 0.3, 0.5, -0.3, 0.3, 0.5, 0.3, -0.3, 0.5, 0.3]
    parameters["vertex_normals"] = [-0.5, -0.8, -0.3, 0.5, -0.8, -0.3, 0.5, -0.8, 0.3, -0.5, -0.8, 0.3]
    parameters["faces"] = [0, 1, 2, 0, 2, 3]
    parameters.update()
    mesh.write_ply(str(folder / "tile.ply"))
    emitter = {"type": "area", "radiance": rgb(2.0)}
    return {"tile": {"type": "ply", "filename": str(folder / "tile.ply"), "emitter": emitter}}


@pytest.fixture
def always():
    """Lights stand for emitters even in small images, because the cost model has all lights for nothing."""
    costs = "fixed_cost", "light_path_cost", "ray_cost", "raw_chosen_ray_cost", "emitter_cuts"
    free = dict.fromkeys(costs, 1e-9)
    # All vertices are lit
    with plugin_with_model(pays_below=1e30, fewest_light_paths=4000, vertex_variance=1e9, **free):
        yield


def assert_image_of_path(scene, spp=128, finds=0.06, **more):
    def pair(seed):
        return tuple(render(scene, name, spp, seed, **more) for name in ("manylights", "path"))

    assert_same_mean(pair, 8, finds)


def assert_lights_stand_for_emitters(integrator, scene, spp):
    mi.render(scene, integrator=integrator, spp=spp)
    assert integrator.statistics["lights"]["emitters"] > 0


@pytest.mark.usefixtures("lights_cost_nothing")
def test_lights_that_promise_less_are_not_measured(monkeypatch):
    """The decision equals the decision after all lights are measured."""
    rng = np.random.default_rng(5)
    scene = mi.load_dict(closed_box(panels(40, rng) | balls(40, rng), 64))
    found, choose = [], plan.choose

    def after_all(evidence, options, **more):
        for option in options:
            option.measure()
        return choose(evidence, options, **more)

    for choice in (choose, after_all):
        with monkeypatch.context() as patch:
            measured = calls_of(patch, start, "single_sample_radiance")
            patch.setattr(estimator, "choose", choice)
            integrator = mi.load_dict({"type": "manylights", "max_depth": 5})
            mi.render(scene, integrator=integrator, spp=64)
        found.append((integrator.statistics["plan"], integrator.statistics["lights"], len(measured)))
    (*chosen, number), (*expected, of_all) = found
    assert chosen == expected and number < of_all


# ---------------------- Expectation ----------------------


@pytest.mark.parametrize(
    ("floor", "max_depth"),
    [("plastic", 3), *stress(("diffuse", -1), ("plastic", 2), ("plastic", -1), ("diffuse", 2), ("diffuse", 3))],
)
def test_the_mean_over_seeds_is_that_of_path(floor, max_depth, always):
    rng = np.random.default_rng(5)
    box = closed_box(panels(40, rng) | spots(20, rng) | bulbs(20, rng) | balls(20, rng) | EMITTERS["envmap"](), 16)
    box["floor"]["bsdf"] = {"type": "roughplastic", "alpha": 0.2} if floor == "plastic" else {"type": "diffuse"}
    del box["left"]
    scene = mi.load_dict(box)
    integrator = mi.load_dict({"type": "manylights", "max_depth": max_depth})
    assert_lights_stand_for_emitters(integrator, scene, 64)
    assert_image_of_path(scene, max_depth=max_depth)


@pytest.mark.stress
@pytest.mark.parametrize("integrator", [{"hide_emitters": True, "rr_depth": 1}])
def test_emitters_that_are_hidden_and_paths_that_end_soon_change_no_mean(integrator, always):
    rng = np.random.default_rng(6)
    scene = mi.load_dict(closed_box(panels(40, rng) | balls(40, rng), 16))
    assert_lights_stand_for_emitters(mi.load_dict({"type": "manylights"} | integrator), scene, 64)
    assert_image_of_path(scene, finds=0.03, **integrator)


@pytest.mark.stress
def test_no_lights_stand_for_emitters_with_normals_of_vertices(tmp_path, always):
    """Mitsuba's densities of such emitters differ from the densities of the surface: the remainder finds their light
    like `path`."""
    rng = np.random.default_rng(7)
    scene = mi.load_dict(closed_box(bulbs(64, rng) | smooth_tile(tmp_path), 16))
    emitters = sampler_of(scene, rng, False)
    assert emitters.lights.carried.tolist() == [False]
    assert [group.kind for group in emitters.lights.groups(1000, 0.1, 0)] == ["spot"]
    assert_lights_stand_for_emitters(mi.load_dict({"type": "manylights", "max_depth": 3}), scene, 64)
    assert_image_of_path(scene, max_depth=3)


@pytest.mark.parametrize("kind", ["mapped", *stress("smooth")])
def test_emitters_below_an_open_surface_do_not_shine_through_it(kind, always):
    """Although they are above perturbed normals and normals of vertices."""
    rng = np.random.default_rng(3)
    lamps = bulbs(80, rng)
    for lamp in lamps.values():
        lamp["position"][1] = float(rng.uniform(-0.5, -0.25))
    if kind == "smooth":
        shelf = smooth_octahedron(mi.load_dict({"type": "twosided", "of": {"type": "diffuse"}}), [0, -0.1, 0])
    else:
        colours = np.tile(0.5 + 0.5 * np.array([np.sin(0.7), 0, np.cos(0.7)]), (2, 2, 1))
        mapped = {"type": "normalmap", "normalmap": image(colours), "of": {"type": "diffuse"}}
        shelf = wall([0, -0.2, 0], [1, 0, 0], -90, 0.9, bsdf={"type": "twosided", "of": mapped})
    assert_image_of_path(mi.load_dict(closed_box(lamps | {"shelf": shelf}, 16)), max_depth=3)


@pytest.mark.parametrize("lit", [False, True])
def test_black_and_flat_emitters_among_many_are_no_trouble(lit, always):
    rng = np.random.default_rng(9)
    black = panels(70, rng)
    for panel in black.values():
        panel["emitter"]["radiance"] = rgb(0.0)
    flat = {"type": "sphere", "center": [0.1, 0.2, 0], "radius": 0.0, "emitter": {"type": "area", "radiance": rgb(1.0)}}
    scene = mi.load_dict(closed_box(black | {"flat": flat} | (balls(3, rng) if lit else {}), 16))
    found = render(scene, "manylights", 64, max_depth=3)
    assert np.isfinite(found).all() and (found.mean() > 0) == lit
    if lit:
        assert_image_of_path(scene, max_depth=3)


@pytest.mark.stress
def test_turned_covered_hollow_and_uneven_emitters_change_no_mean(always):
    """Panels that face up, a mask, a ball that shines inwards around a second ball, bumps, a sun, and a bright emitter
    among dim emitters."""
    rng = np.random.default_rng(8)
    up = {name: one | {"flip_normals": True} for name, one in panels(30, rng).items()}
    bump = {
        "type": "bumpmap",
        "bsdf": {"type": "diffuse"},
        "arbitrary": image(rng.random((8, 8, 3)).astype(np.float32)),
    }
    mask = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    hollow = {"type": "sphere", "center": [0.4, -0.4, 0], "radius": 0.3, "flip_normals": True}
    more = {
        "hollow": hollow | {"emitter": {"type": "area", "radiance": rgb(2.0)}},
        "core": {"type": "sphere", "center": [0.4, -0.4, 0], "radius": 0.1, "bsdf": {"type": "diffuse"}},
        "veil": wall([0, 0, -0.3], [0, 1, 0], 0, 0.5) | {"bsdf": mask},
        "bright": {"type": "point", "position": [-0.5, 0.5, -0.6], "intensity": rgb(20.0)},
        "sun": {"type": "directional", "direction": [1, -0.3, -0.2], "irradiance": rgb(1.0)},
    }
    box = closed_box(up | spots(20, rng) | balls(20, rng) | more, 16)
    box["floor"]["bsdf"] = bump
    del box["left"]
    scene = mi.load_dict(box)
    assert_image_of_path(scene, 256, 0.1, max_depth=4)


# ---------------------- Lights ----------------------


def test_kept_lights_and_those_that_stand_for_emitters_give_the_same_image_again(always):
    scene = mi.load_dict(closed_box(bulbs(100, np.random.default_rng(9)), 24))
    integrator = mi.load_dict({"type": "manylights", "max_depth": 4, "keep_lights": True, "stratified": False})
    first, again = (np.array(mi.render(scene, integrator=integrator, spp=64, seed=3)) for _ in range(2))
    assert integrator.statistics["lights"]["emitters"] == 100 and integrator.statistics["light_paths"] == 0
    np.testing.assert_allclose(again, first, rtol=1e-4, atol=1e-5)


def test_a_dim_emitter_next_to_a_bright_one_has_points():
    scene = mi.load_dict(closed_box(panels(64, np.random.default_rng(1))))
    lights = sampler_of(scene, np.random.default_rng(0), False).lights
    radiance = np.full_like(lights.emitters.area.radiance, 1e-6)
    radiance[0] = 1
    uneven = dataclasses.replace(
        lights,
        emitters=dataclasses.replace(
            lights.emitters, area=dataclasses.replace(lights.emitters.area, radiance=radiance)
        ),
    )
    (group,) = uneven.groups(1000, 0.1, 0)
    found = np.array(group.lights.gather(dr.arange(mi.UInt32, 1000)).intensity)[0]
    np.testing.assert_allclose(found.sum(), uneven.emitters.area.power.sum() / np.pi, rtol=0.05)
    assert (found < 1e-3 * found.max()).sum() == pytest.approx(500, rel=0.1)


@pytest.mark.parametrize("shapes, close", [(panels, 0.97), (balls, 0.9)], ids=["panels", "balls"])
def test_who_samples_an_emitter_and_who_meets_it_agree_on_what_is_carried(shapes, close):
    rng = np.random.default_rng(1)
    scene = mi.load_dict(closed_box(shapes(100, rng) | bulbs(10, rng)))
    emitters, si = sampler_of(scene, rng, True), interactions(*vertices(rng, 40_000))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, dr.width(si.p))
    cell = emitters.cell(si.p, si.n)
    numbers = sampler.next_1d(), sampler.next_1d(), sampler.next_2d()
    sample = emitters.sample(si, cell, *numbers, mi.Bool(True))
    ray = si.spawn_ray(sample.direction)
    met = emitters.met(si.p, cell, ray, scene.ray_intersect(ray), mi.Bool(True), mi.Bool(True))
    arriving, _ = sample.arriving(scene, emitters, mi.UInt32(0), mi.Bool(True))
    lit = np.array((dr.max(arriving) > 0) & ~sample.is_point)
    assert lit.sum() > 1000
    # Directions to the edge of a shape may miss it, or meet a ball elsewhere
    assert np.isclose(np.array(met.nearness), np.array(sample.nearness), rtol=5e-2)[lit].mean() > close
    points = np.array(sample.is_point)
    assert (np.array(sample.nearness)[points] == 0).all() and np.isinf(np.array(met.nearness)[points]).any()


def test_lights_have_the_power_of_the_emitters_and_typical_distances():
    rng = np.random.default_rng(2)
    scene = mi.load_dict(closed_box(panels(100, rng) | bulbs(50, rng)))
    lights = sampler_of(scene, rng, False).lights
    omni, areas = lights.groups(20_000, 0.1, 0)
    area = lights.emitters.area
    assert omni.count == 50 and areas.count == 20_000
    np.testing.assert_allclose(omni.lights.scalar_intensity.sum(), lights.omni.intensity.mean(1).sum(), rtol=1e-5)
    np.testing.assert_allclose(areas.lights.scalar_intensity.sum(), area.power.sum() / np.pi, rtol=1e-3)
    # Alike in size: the area of all, shared out
    assert lights.spacing(20_000) == pytest.approx((100 * 0.04**2 / 20_000) ** 0.5, rel=1e-3)


def test_lights_stand_for_many_emitters_and_not_for_few():
    rng = np.random.default_rng(3)
    few, many = (mi.load_dict(closed_box(bulbs(number, rng), 96)) for number in (10, 300))
    integrator = mi.load_dict({"type": "manylights", "max_depth": 2})
    assert_lights_stand_for_emitters(integrator, many, 64)
    assert integrator.statistics["lights"] == {"emitters": 300}
    mi.render(few, integrator=integrator, spp=64)
    assert "lights" not in integrator.statistics


def test_lights_that_stand_for_emitters_leave_less_noise(always):
    rng = np.random.default_rng(4)
    scene = mi.load_dict(closed_box(bulbs(300, rng), 48))

    def noise(virtual_lights):
        integrator = mi.load_dict({"type": "manylights", "max_depth": 2, "virtual_lights": virtual_lights})
        # More samples of the emitters remove noise as well
        integrator.cost_model = dataclasses.replace(integrator.cost_model, most_emitter_samples=1)
        images = np.array([mi.render(scene, integrator=integrator, spp=64, seed=seed) for seed in range(4)])
        return np.median(images.var(0) / images.mean(0) ** 2)

    with_lights = noise(True)
    # 0.29 of it, as measured
    assert with_lights < 0.5 * noise(False)
