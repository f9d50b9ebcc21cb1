"""Gradients of ``manylights``: those of ``prb``, of scenes that an optimiser changes; the other plugins refuse."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import integrators
from tests.integrators.test_threads import REFUSAL, paused
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import bulb
from tests.support.scenes import area_light, closed_box, image
from tests.support.statistics import assert_same_mean, relative_error

LAMP, WALL, TEXTURE = "lamp.emitter.radiance.value", "left.bsdf.reflectance.value", "floor.bsdf.reflectance.data"
SIZE, DEPTH = 8, 4
# Rounding of sums in any order
ROUNDING = 1e-4


def room(**more):
    """A closed box with a lamp, and a texture on the floor."""
    box = closed_box({"lamp": area_light()}, SIZE, 4)
    texture = image(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3))) | {"filter_type": "nearest"}
    box["floor"]["bsdf"] = {"type": "diffuse", "reflectance": texture}
    return box | more


def with_gradients(scene, *keys):
    """The parameters of a scene, with gradients of those named."""
    parameters = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(parameters[key])
    parameters.update()
    return parameters


def plugin(name, **more):
    return mi.load_dict({"type": name, "max_depth": DEPTH, **more})


def gradients(loss, parameters, *keys):
    """Gradients of a loss, flat, which are cleared."""
    dr.backward(loss)
    found = [np.array(dr.grad(parameters[key]), np.float64).ravel() for key in keys]
    for key in keys:
        dr.clear_grad(parameters[key])
    return found


def linear_loss(picture):
    """A loss whose gradient depends on the adjoint alone, not on the image."""
    weights = np.random.default_rng(1).uniform(0, 1, picture.shape).astype(np.float32)
    return dr.mean(picture * mi.TensorXf(weights), axis=None)


# ---------------------- Agreement with prb ----------------------


@pytest.mark.usefixtures("lights_cost_nothing")
def test_gradients_of_a_squared_error_have_the_mean_of_those_of_prb():
    scene, keys = mi.load_dict(room()), (LAMP, WALL, TEXTURE)
    parameters = with_gradients(scene, *keys)
    # With the camera rays of prb, differences have less variance
    plugins = [plugin("manylights", stratified=False), plugin("prb")]

    @cache
    def pair(seed):
        found = []
        for one in plugins:
            picture = mi.render(scene, parameters, integrator=one, spp=64, spp_grad=16, seed=seed)
            # A target darker than the image, so all gradients are positive
            loss = dr.mean(dr.square(picture - 0.01), axis=None)
            found.append(gradients(loss, parameters, *keys))
        assert plugins[0].statistics["light_paths"] > 0
        return found

    for number, shape, tiles in ((0, (1, 1, 3), 1), (1, (1, 1, 3), 1), (2, (4, 4, 3), 4)):
        assert_same_mean(
            lambda seed, number=number, shape=shape: [one[number].reshape(shape) for one in pair(seed)],
            8, finds=0.02, tiles=tiles,
        )  # fmt: skip


SETTINGS = [{}, {"max_depth": -1}, {"rr_depth": 1}, *stress({"max_depth": 1}, {"hide_emitters": True})]


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_the_adjoint_is_that_of_prb(settings):
    scene, keys = mi.load_dict(room()), (LAMP, WALL)
    parameters = with_gradients(scene, *keys)
    found, expected = (
        gradients(
            linear_loss(mi.render(scene, parameters, integrator=plugin(name, **settings), spp=2, spp_grad=8, seed=3)),
            parameters, *keys,
        )
        for name in ("manylights", "prb")
    )  # fmt: skip
    np.testing.assert_allclose(np.concatenate(found), np.concatenate(expected), rtol=ROUNDING)


def test_forward_mode_for_a_second_sensor_with_alpha():
    film = {"type": "hdrfilm", "width": 6, "height": 4, "pixel_format": "rgba", "rfilter": {"type": "tent"}}
    scene = mi.load_dict(room(second=room()["sensor"] | {"film": film}))
    parameters = with_gradients(scene, LAMP)

    def derivative(name, sensor):
        dr.set_grad(parameters[LAMP], 1)
        picture = mi.render(scene, parameters, sensor, plugin(name), spp=2, spp_grad=8, seed_grad=7)
        dr.forward_to(picture)
        return np.array(dr.grad(picture))

    expected = derivative("prb", 1)
    assert expected.shape == (4, 6, 4) and expected[..., :3].mean() > 0
    for place in (1, scene.sensors()[1]):
        np.testing.assert_allclose(derivative("manylights", place), expected, rtol=ROUNDING, atol=1e-6)


def test_direct_calls_take_an_index_a_container_and_the_samples_of_the_scene():
    scene = mi.load_dict(room())
    parameters, ours, prb = with_gradients(scene, LAMP), plugin("manylights"), plugin("prb")
    ours.render(scene, spp=16)
    ones = dr.ones(mi.TensorXf, (SIZE, SIZE, 3))
    found = []
    for one, held in ((ours, {"any": [parameters[LAMP]]}), (ours, None), (prb, parameters)):
        one.render_backward(scene, held, ones, 0, 5)
        found.append(np.array(dr.grad(parameters[LAMP])))
        dr.clear_grad(parameters[LAMP])
    np.testing.assert_allclose(found[:2], [found[2]] * 2, rtol=ROUNDING)
    assert scene.sensors()[0].sampler().sample_count() == 4


def test_a_depth_of_zero_has_no_gradients():
    scene = mi.load_dict(room())
    parameters = with_gradients(scene, LAMP)
    dark = plugin("manylights", max_depth=0)
    loss = linear_loss(mi.render(scene, parameters, integrator=dark))
    assert not gradients(loss, parameters, LAMP)[0].any()
    dr.set_grad(parameters[LAMP], 1)
    assert not np.array(dark.render_forward(scene, parameters)).any()


def test_a_depth_of_more_than_32_bits_is_no_limit():
    scene = mi.load_dict(room())
    parameters = with_gradients(scene, LAMP)
    found, expected = (
        gradients(linear_loss(mi.render(scene, parameters, integrator=plugin(name, max_depth=depth))), parameters, LAMP)
        for name, depth in (("manylights", 2**33), ("prb", -1))
    )
    np.testing.assert_allclose(found, expected, rtol=ROUNDING)


def test_there_are_no_gradients_below_moment():
    scene = mi.load_dict(room())
    parameters = with_gradients(scene, LAMP)
    wrapped = mi.load_dict({"type": "moment", "image": {"type": "manylights", "max_depth": DEPTH}})
    with pytest.raises(RuntimeError, match="does not depend"):
        dr.backward(linear_loss(mi.render(scene, parameters, integrator=wrapped)))


def test_the_integrator_of_a_scene_below_aov():
    nested = {"type": "manylights", "max_depth": DEPTH}
    scene = mi.load_dict(room(integrator={"type": "aov", "aovs": "depth:depth", "image": nested}))
    parameters = with_gradients(scene, LAMP)
    found, expected = (
        gradients(linear_loss(picture[..., :3]), parameters, LAMP)
        for picture in (mi.render(scene, parameters), mi.render(scene, parameters, integrator=plugin("prb")))
    )
    np.testing.assert_allclose(found, expected, rtol=ROUNDING)


def test_gradients_in_mono(restore_variant):
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(room())
    parameters = with_gradients(scene, LAMP)
    found, expected = (
        gradients(linear_loss(mi.render(scene, parameters, integrator=plugin(name))), parameters, LAMP)
        for name in ("manylights", "prb")
    )
    np.testing.assert_allclose(found, expected, rtol=ROUNDING)


# ---------------------- Optimisers ----------------------

MOVED = ("lamp.vertex_positions", "cube.vertex_positions")
STEPS = 3


def furnished():
    """A closed box with a lamp and a cube, both meshes, a bulb and a texture."""
    lamp = mi.ScalarTransform4f().translate([0, 0.8, 0]).scale([0.3, 0.05, 0.3])
    cube = mi.ScalarTransform4f().translate([0.4, -0.6, -0.2]).rotate([0, 1, 0], 20).scale(0.25)
    box = room(**bulb(), cube={"type": "cube", "to_world": cube, "bsdf": {"type": "diffuse", "id": "of_cube"}})
    return box | {"lamp": {"type": "cube", "to_world": lamp, "emitter": area_light()["emitter"]}}


@pytest.mark.usefixtures("lights_cost_nothing")
@pytest.mark.parametrize("keep_lights", [True, *stress(False)])
def test_an_optimised_scene_has_the_images_of_a_fresh_one(keep_lights):
    optimised = mi.load_dict(furnished())
    parameters = mi.traverse(optimised)
    keys = (LAMP, TEXTURE, "bulb.intensity.value", *MOVED)
    ours = plugin("manylights", keep_lights=keep_lights)
    optimiser = mi.ad.Adam(lr=0.05, params={key: parameters[key] for key in keys})
    for step in range(STEPS):
        parameters.update(optimiser)
        parameters["bulb.position"] = mi.Point3f(0.3, 0.4 - 0.1 * step, 0.6)
        parameters.update()
        fresh = mi.load_dict(furnished())
        values = mi.traverse(fresh)
        for key in (*keys, "bulb.position"):
            values[key] = dr.detach(parameters[key])
        values.update()
        picture = mi.render(optimised, parameters, integrator=ours, spp=16, seed=9)
        assert ours.statistics["light_paths"] > 0
        found, expected = np.array(picture, np.float64), render(fresh, plugin("manylights"), 16, 9)
        assert relative_error(found, expected) < ROUNDING
        dr.backward(dr.mean(dr.square(picture - 0.1), axis=None))
        optimiser.step()


# ---------------------- Refusals ----------------------


@pytest.mark.parametrize("name", [name for name in integrators.PLUGINS if name != "manylights"])
def test_other_plugins_name_what_to_use_instead(name):
    other = mi.load_dict({"type": name})
    for call in (other.render_forward, other.render_backward):
        with pytest.raises(NotImplementedError, match=f"{type(other).__name__} cannot.* use manylights.* prb"):
            call(None, None)


def test_a_variant_without_derivatives_is_refused(monkeypatch):
    scene, ours = mi.load_dict(room()), plugin("manylights")
    monkeypatch.setattr(mi, "variant", lambda: "llvm_rgb")
    with pytest.raises(RuntimeError, match=r'manylights: the variant "llvm_rgb" has no derivatives: .* llvm_ad_rgb'):
        ours.render_forward(scene, None)


def test_a_medium_is_refused():
    fog = {"type": "homogeneous", "albedo": 0.5}
    scene = mi.load_dict(room(fog={"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}))
    with pytest.raises(ValueError, match="medium"):
        plugin("manylights").render_backward(scene, None, dr.ones(mi.TensorXf, (SIZE, SIZE, 3)))


def test_a_sensor_that_another_thread_renders_with_is_refused(monkeypatch):
    scene, first = mi.load_dict(room()), plugin("manylights")
    with paused(monkeypatch, first, lambda: render(scene, first)), pytest.raises(RuntimeError, match=REFUSAL):
        plugin("manylights").render_forward(scene, None)
