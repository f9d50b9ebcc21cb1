"""Area emitters on shapes with a wrong density in Mitsuba: turned or textured spheres, smooth meshes."""

import itertools

import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import glowing_octahedron
from tests.support.scenes import closed_box, image
from tests.support.statistics import assert_same_mean
from vpl.lights.emitters import read_emitters

# Plugins that find emitters in ways of their own, with light paths of two edges
DIRECT = {
    "nee": ("lightcuts", {"direct": "nee"}),
    "vpl": ("vpl", {"direct": "vpl", "direct_count": 2000, "clamping": 0.0}),
    "adaptivedirect": ("adaptivedirect", {"error": 0.1}),
    "unoccludeddirect": ("unoccludeddirect", {"error": 0.5, "max_samples": 200}),
    "manylights": ("manylights", {}),
}


def ball(radiance):
    """A glowing sphere in the middle of the closed box, rotated off the axes of the world."""
    turned = mi.ScalarTransform4f().translate([0, 0.1, 0]).rotate([0, 0, 1], 25).rotate([1, 0, 0], 60).scale(0.35)
    return {"ball": {"type": "sphere", "to_world": turned, "emitter": {"type": "area", "radiance": radiance}}}


def half_bright():
    """A texture of large patches with a bright half."""
    pixels = np.random.default_rng(3).uniform(0, 4, (4, 8, 3)).astype(np.float32)
    pixels[1, :4] = 20
    return {"type": "bitmap", "raw": True, "filter_type": "nearest", "bitmap": mi.Bitmap(pixels)}


def assert_light_of_path(emitters, plugin, max_depth=2, **more):
    scene = mi.load_dict(closed_box(emitters, 16))

    def pair(seed):
        found = render(scene, plugin, 32, seed, max_depth=max_depth, **more)
        return found, render(scene, "path", 32, seed, max_depth=max_depth)

    assert_same_mean(pair, 8, 0.005)


@pytest.mark.parametrize("method", ["nee", "manylights", *stress("vpl", "adaptivedirect", "unoccludeddirect")])
def test_a_textured_sphere_lights_from_where_its_texture_is_bright(method):
    plugin, more = DIRECT[method]
    assert_light_of_path(ball(half_bright()), plugin, **more)


@pytest.mark.stress
def test_light_paths_leave_a_turned_sphere_outwards():
    white = {"type": "rgb", "value": 4.0}
    assert_light_of_path(ball(white), "vpl", max_depth=3, vpl_count=2000, clamping=0.0)


@pytest.mark.parametrize("method", ["adaptivedirect", *stress("unoccludeddirect")])
def test_a_mesh_with_vertex_normals_emits_to_the_side_of_its_shading_normals(method):
    """``path`` itself takes shading normals for the density of what it draws by area: BSDF samples are right."""
    plugin, more = DIRECT[method]
    scene = mi.load_dict(closed_box(glowing_octahedron(), 16))
    bsdf_samples = {"emitter_samples": 0, "bsdf_samples": 1}

    def pair(seed):
        return render(scene, plugin, 256, seed, **more), render(scene, "direct", 256, seed, **bsdf_samples)

    assert_same_mean(pair, 8)


@pytest.mark.parametrize("period", [16, 64])
def test_the_power_of_a_regular_texture_is_found(period):
    """A grid of samples as regular as the texture may meet dark texels alone."""
    texels = np.zeros((1024, 1024, 3), np.float32)
    for row, column in itertools.product(range(4), repeat=2):
        texels[row::period, column::period] = 100.0
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": image(texels)}}
    (found,) = read_emitters(mi.load_dict({"type": "scene", "lamp": lamp})).area.radiance
    np.testing.assert_allclose(found, texels.mean((0, 1)), rtol=0.1)
