"""The add-on for Blender: images against those of Cycles, by the module `bpy` in a process of its own."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from tests.support.paths import ROOT

PATIENCE = 600  # seconds for all cases, a minute on two idle cores
MEAN = 0.02  # relative difference of means

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs the package bpy: pip install 'manylights[blender]'"
)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Function from the name of a case to its results: a dictionary, see cases.py."""
    folder = tmp_path_factory.mktemp("blender")
    command = [sys.executable, "-m", "tests.blender.cases", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]

    def read(name):
        with np.load(folder / f"{name}.npz") as file:
            return {key: file[key] for key in file.files}

    return read


def checked(found, pixels, mean=MEAN):
    """Assert that both images agree, and that there is no problem; return them. `mean`: largest relative difference of
    the means of each channel; `pixels`: largest mean absolute difference of pixels, over the mean of Cycles."""
    assert "error" not in found, str(found["error"])
    ours, cycles = found["ours"], found["cycles"]
    assert ours.shape == cycles.shape and np.isfinite(ours).all()
    assert list(found["problems"]) == []
    colours = [image[..., :3].mean((0, 1)) for image in (ours, cycles)]
    np.testing.assert_allclose(*colours, rtol=mean)
    assert abs(ours - cycles)[..., :3].mean() < pixels * cycles[..., :3].mean()
    np.testing.assert_allclose(ours[..., 3], cycles[..., 3], atol=0.2)  # single pixels at edges have noise
    return ours, cycles


@pytest.mark.parametrize(
    "kind",
    ["point", "point_of_a_size", "sun", "real_sun", "large_sun", "square", "rectangle", "disk", "scaled_ellipse"],
)
def test_lights_have_the_power_of_cycles(rendered, kind):
    checked(rendered(f"light_{kind}"), pixels=0.03, mean=0.01)


@pytest.mark.parametrize(("kind", "pixels"), [("sharp_spot", 0.04), ("spot", 0.06), ("soft_spot", 0.12)])
def test_spots_have_the_power_of_cycles(rendered, kind, pixels):
    """Both engines fade a spot differently towards its edge, with the same flux."""
    checked(rendered(f"light_{kind}"), pixels, mean=0.01)


@pytest.mark.parametrize("count", ["none", "one", "many"])
def test_bounces_are_counted_as_in_cycles(rendered, count):
    checked(rendered(f"bounces_{count}"), pixels=0.04, mean=0.01)


@pytest.mark.parametrize(
    "name",
    [
        "wide", "tall", "vertical", "horizontal", "shifted", "tall_shifted", "orthographic", "tall_orthographic",
        "half_size",
    ],
)  # fmt: skip
def test_cameras_frame_as_in_cycles(rendered, name):
    """Silhouettes agree up to noise at their edges; an image that is shifted by a pixel differs by about a half."""
    checked(rendered(f"camera_{name}"), pixels=0.12)


@pytest.mark.parametrize("name", ["sharp", "near", "on_object"])
def test_lenses_blur_as_in_cycles(rendered, name):
    checked(rendered(f"focus_{name}"), pixels=0.2)


def test_a_lens_blurs(rendered):
    sharp, near = (rendered(f"focus_{name}")["ours"][..., 0] for name in ("sharp", "near"))
    assert near.max() < 0.5 * sharp.max()


@pytest.mark.parametrize("name", ["colour", "image", "turned_image", "behind_a_lamp"])
def test_worlds_are_those_of_cycles(rendered, name):
    checked(rendered(f"world_{name}"), pixels=0.02)


@pytest.mark.parametrize("name", ["srgb", "moved", "data"])
def test_textures_lie_as_in_cycles(rendered, name):
    checked(rendered(f"texture_{name}"), pixels=0.1)


@pytest.mark.parametrize(
    "name",
    [
        "diffuse", "glossy", "glass", "emission", "smooth", "plastic", "rough", "strong_coat", "no_reflection", "metal",
        "half_metal", "principled_glass", "half_glass", "glowing", "mixed",
    ],
)  # fmt: skip
def test_materials_are_close_to_those_of_cycles(rendered, name):
    checked(rendered(f"material_{name}"), pixels=0.08, mean=0.04)


def test_rough_metals_are_darker_than_in_cycles(rendered):
    """Mitsuba leaves out light that is reflected several times between microfacets."""
    found = rendered("material_rough_metal")
    ours, cycles = (found[name][12:20, 12:20, 0].mean() for name in ("ours", "cycles"))
    assert 0.5 < ours / cycles < 0.9


def test_transparent_materials_are_close_to_those_of_cycles(rendered):
    """Mitsuba's shadow rays end at them, which Blender's pass."""
    checked(rendered("material_half_transparent"), pixels=0.08, mean=0.05)


def test_geometry_is_that_of_cycles(rendered):
    """Modifiers, instances, mirrored objects, text, several materials and flat faces."""
    checked(rendered("geometry"), pixels=0.04)


def test_flattened_objects_are_those_of_cycles(rendered):
    checked(rendered("flat"), pixels=0.04)


def test_image_textures_of_the_world_are_named(rendered):
    found = rendered("unsupported_world")
    assert "error" not in found, str(found["error"])
    assert len(found["problems"]) == 2 and "node 'Image Texture" in found["problems"][0]
    np.testing.assert_allclose(found["ours"][0, 0, :3], (0.1, 0.2, 0.3), rtol=1e-3)


def test_a_transparent_film_shows_no_world(rendered):
    ours, _ = checked(rendered("transparent_film"), pixels=0.05)
    assert ours[0, 0].tolist() == [0, 0, 0, 0] and ours[16, 16, 3] == 1


def test_what_is_not_exported_is_named(rendered):
    found = rendered("unsupported")
    assert "error" not in found, str(found["error"])
    for sentence in (
        "Material 'cloth': 'Coat Weight' of the Principled BSDF is not exported",
        "Material 'cloth': 'Sheen Weight' of the Principled BSDF is not exported",
        "Material 'cloth': node 'Noise Texture' at 'Base Color' is not exported; the value of the socket replaces it",
        "Material 'toon': shader 'Toon BSDF' (ShaderNodeBsdfToon) is not exported; it becomes black",
        "SpotLight 'spot': the radius of a spot light is not exported; its shadows are sharp",
        "AreaLight 'area': 'Spread' below 180° is not exported",
        "Mesh 'panel': an open mesh emits light on its front only",
        "Object 'twin': 'Ray Visibility' is not exported; the object is visible to rays of: camera",
        "Object 'Sphere': hair of particles is not exported",
        "World 'world': node 'Sky Texture' at 'Color' is not exported; the value of the socket replaces it",
        "Lights: the camera sees lights with a size, as the scene has emissive meshes",
        "Motion Blur: not exported",
        "Render Region: not exported; the whole image is rendered",
    ):
        assert sentence in found["problems"]
    assert len(found["problems"]) == 13


@pytest.mark.parametrize(("name", "least", "most"), [("time", 1, 10), ("escape", 0, 20), ("late_escape", 0, 25)])
def test_time_limit_and_escape_end_a_render(rendered, name, least, most):
    """With the image of the finished passes."""
    found = rendered(f"ended_by_{name}")
    checked(found, pixels=0.03)
    assert least <= found["seconds"] < most


def test_noise_threshold_ends_a_render(rendered):
    checked(rendered("ended_by_noise_and_denoised"), pixels=0.03)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("without_a_camera", "ValueError: the scene has no camera"),
        ("panoramic_camera", "camera 'camera': its type must be Perspective or Orthographic, got PANO"),
    ],
)
def test_a_scene_without_a_usable_camera_is_refused(rendered, name, message):
    assert message in str(rendered(name)["error"])
