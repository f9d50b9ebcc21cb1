"""Kernels: another size of the image, number of samples or seed compiles none but Mitsuba's own."""

import dataclasses
import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import integrators
from comparison import single_pass
from tests.support.marks import stress
from tests.support.rendering import plugin_with_model
from tests.support.scenes import area_light, closed_box
from vpl.core.registry import RegistryTable
from vpl.lights.emitters import read_emitters
from vpl.points.camera_paths import shape_in
from vpl.split import paths_from_places
from vpl.split.emitters import cell_emitters, irradiance

MITSUBAS = 2  # one makes the camera's rays, one puts samples on the film; both hold the image's width
SETTINGS = {"manylights": {}, "adaptivedirect": {}, "unoccludeddirect": {}}


@pytest.fixture
def compiled():
    """Return a function that counts the new kernels since its last call."""
    seen = set()
    # Kernels hold the code of all live scenes, and no scene may be freed in between
    gc.collect()

    def count():
        launched = {one["hash"] for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT}
        new = launched - seen
        seen.update(launched)
        return len(new)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield count


QUICK = ("manylights", "lightcuts", "adaptivedirect")


@pytest.mark.parametrize("name", [*QUICK, *stress(*(name for name in integrators.PLUGINS if name not in QUICK))])
def test_sizes_and_samples_are_in_no_kernel(name, compiled, lights_cost_nothing):
    views = {f"view_{size}": closed_box({}, size)["sensor"] for size in (32, 40, 48)}
    scene = mi.load_dict(closed_box({"lamp": area_light()}) | views)
    settings = SETTINGS.get(name, {"vpl_count": 3000})
    plugin = mi.load_dict({"type": name, "max_depth": 4, **settings})

    def new(camera=1, spp=4, seed=0):
        mi.render(scene, sensor=camera, integrator=plugin, spp=spp, seed=seed).numpy()
        assert name != "manylights" or plugin.statistics["light_paths"] > 0
        return compiled()

    # A scalar of one image may be an array in the next, which compiles a few more kernels
    assert sum(new(camera, seed=seed) for camera in (1, 2) for seed in range(3)) > 2 * MITSUBAS
    assert new(seed=3) == 0
    if name != "matrixrecovery":  # which solves larger problems otherwise
        assert new(camera=3) <= MITSUBAS
    assert new(spp=6) <= MITSUBAS


@pytest.mark.parametrize("name", ["lightcuts", *stress("manylights", "mdlightcuts")])
def test_depths_are_in_no_kernel(name, compiled, lights_cost_nothing):
    scene = mi.load_dict(closed_box({"lamp": area_light()}, 32))
    more = {} if name == "manylights" else {"vpl_count": 500}

    def rendered(depth):
        image = mi.render(scene, integrator=mi.load_dict({"type": name, "max_depth": depth, **more}), spp=4, seed=1)
        assert np.isfinite(np.array(image)).all() and np.array(image).max() > 0
        return compiled()

    assert rendered(4) > 0
    assert rendered(5) == 0
    # Beyond the depths that 32 bits count; light paths of any length have kernels of their own
    rendered(2**33)


def test_sizes_and_samples_are_in_no_kernel_of_many_emitters(compiled):
    """With another number of points on them for every size."""
    lamps = {f"lamp{i}": area_light() | {"to_world": turned(0.1 * i - 4)} for i in range(80)}
    views = {f"view_{size}": closed_box({}, size)["sensor"] for size in (32, 40, 48)}
    scene = mi.load_dict(closed_box(lamps) | views)

    def new(camera=1, spp=16, seed=0):
        mi.render(scene, sensor=camera, integrator=plugin, spp=spp, seed=seed).numpy()
        assert plugin.statistics["lights"]["emitters"] > 100
        return compiled()

    with plugin_with_model(pays_below=1e30, fewest_emitter_points=100):
        # Without indirect light, virtual lights represent emitters regardless of the pilot
        plugin = mi.load_dict({"type": "manylights", "max_depth": 2})
        assert sum(new(camera, seed=seed) for camera in (1, 2) for seed in range(3)) > 2 * MITSUBAS
        assert new(camera=3) <= MITSUBAS
        assert new(spp=24) <= MITSUBAS


def turned(angle):
    """A small panel below the ceiling, somewhere."""
    return mi.ScalarTransform4f().rotate([0, 1, 0], 40 * angle).translate([0.1 * angle, 0.8, 0.4]).rotate(
        [1, 0, 0], 90
    ).scale(0.05)  # fmt: skip


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_paths_from_the_camera_and_from_lights_are_followed_by_one_kernel(hide_emitters, lights_cost_nothing):
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    plugin = mi.load_dict({"type": "manylights", "max_depth": 4, "hide_emitters": hide_emitters})
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        mi.render(scene, integrator=plugin, spp=16).numpy()
        history = [one for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT]
    launched = {one["hash"]: one["operation_count"] for one in history}
    assert plugin.statistics["light_paths"] > 0
    longest = max(launched.values())
    assert sum(operations > 0.9 * longest for operations in launched.values()) == 1


def test_places_in_the_registry_are_in_no_kernel(compiled):
    """Mitsuba loads shapes in parallel, so registry indices differ between processes."""
    shapes = mi.load_dict(closed_box({"lamp": area_light()})).shapes_dr()
    indices = dr.reinterpret_array(mi.UInt32, shapes).numpy()
    compiled()
    few = RegistryTable(indices[:2], [7, 8]).at(shapes).numpy()
    assert compiled() > 0
    all_and_more = RegistryTable([*indices, 5000], 3).at(shapes).numpy()
    assert compiled() == 0
    assert few.tolist() == [7, 8] + [0] * (len(indices) - 2)
    assert (all_and_more == 3).all()
    assert (RegistryTable(indices, 3).at(shapes, False).numpy() == 0).all()
    assert (RegistryTable(indices, 3).at(dr.zeros(mi.ShapePtr, 3)).numpy() == 0).all()


def test_shapes_that_are_told_apart_are_in_no_kernel(compiled):
    scene = mi.load_dict(closed_box({"lamp": area_light(), "other": area_light()}))
    shapes, area = scene.shapes_dr(), read_emitters(scene).area
    indices = dr.reinterpret_array(mi.UInt32, shapes).numpy()
    si = dr.zeros(mi.SurfaceInteraction3f, len(indices))
    si.shape = shapes
    dr.eval(si)
    compiled()
    for indices_of_two, index_of_emitters in ((indices[:2], area.shape_index), ([1, 700], area.shape_index + 900)):
        shape_in(shapes, tuple(int(index) for index in indices_of_two)).numpy()
        dataclasses.replace(area, shape_index=index_of_emitters).row(si).numpy()
        assert (compiled() == 0) == (700 in indices_of_two)


def test_sites_and_lights_find_irradiance_by_one_kernel(monkeypatch, lights_cost_nothing):
    scene = mi.load_dict(closed_box({"lamp": area_light(), "other": area_light()}))
    find, launched = irradiance.irradiance_from_emitters, []

    def watched(*arguments):
        dr.kernel_history_clear()
        found = find(*arguments)
        launched.append(max(dr.kernel_history(), key=lambda one: one.get("operation_count") or 0)["hash"])
        return found

    monkeypatch.setattr(cell_emitters, "irradiance_from_emitters", watched)
    monkeypatch.setattr(paths_from_places, "irradiance_from_emitters", watched)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        mi.render(scene, integrator=mi.load_dict({"type": "manylights", "max_depth": 4}), spp=64).numpy()
    assert len(launched) == 2
    assert len(set(launched)) == 1


@pytest.mark.parametrize("lit", [False, True])
def test_pixels_with_different_numbers_of_samples_use_the_kernel_of_equal_numbers(lit):
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    film = scene.sensors()[0].film()
    film_shape, launched = tuple(film.crop_size())[::-1], []
    density = np.where(np.arange(np.prod(film_shape)) % 2, 2.0, 0.5).reshape(film_shape)
    with (
        plugin_with_model(pays_below=1e30 if lit else 0.0),
        dr.scoped_set_flag(dr.JitFlag.KernelHistory, True),
    ):
        plugin = mi.load_dict({"type": "manylights", "max_depth": 4, "denoised": True})
        for numbers in (None, density, density * np.linspace(1, 3, film_shape[1])):
            dr.kernel_history_clear()
            taken = single_pass.render_pass(scene, 0, plugin, 8, 0, density=numbers).taken
            assert taken.has_lights == lit
            history = [one for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT]
            launched.append(max(history, key=lambda one: one["operation_count"])["hash"])
    assert len(set(launched)) == 1
