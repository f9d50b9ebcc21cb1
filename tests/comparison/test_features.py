"""Albedo, normal and depth: what they are, how many samples they have, and as layers of images."""

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import features, fine_film, images
from comparison.features import FEATURES
from tests.support.paths import CORNELL
from tests.support.scenes import cornell, sensor, wall

RED = (0.6, 0.1, 0.2)


def guides(spp=64, size=8, **things):
    """Albedo and normal of a scene."""
    scene = mi.load_dict({"type": "scene", "sensor": sensor(size), **things})
    found, _ = features.auxiliary_features(scene, scene.sensors()[0], spp, 0)
    for name, plane in found.items():
        assert plane.shape == (size, size, len(FEATURES[name])) and plane.dtype == np.float32
        assert np.isfinite(plane).all()
    return found["albedo"], found["normal"]


def red_wall(**more):
    """Behind what is at the origin, and larger than the image."""
    return {"behind": wall([0, 0, -1], [0, 1, 0], 0, 5, RED), **more}


def screen(bsdf):
    return wall([0, 0, 0], [0, 1, 0], 0, 5, bsdf=bsdf)


def test_features_are_those_of_the_surface_that_is_seen():
    albedo, normal = guides(**red_wall())
    np.testing.assert_allclose(albedo, np.broadcast_to(RED, albedo.shape), rtol=1e-4)
    np.testing.assert_allclose(normal, np.broadcast_to((0, 0, 1), normal.shape), atol=1e-5)


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_emitters_that_are_hidden_are_in_no_feature(hide_emitters):
    lamp = wall([0, 0, 1], [0, 1, 0], 0, 5) | {"emitter": {"type": "area"}}
    sky = {"type": "constant", "radiance": 0.5}
    half = wall([-5, 0, -1], [0, 1, 0], 0, 5, RED)
    scene = mi.load_dict({"type": "scene", "sensor": sensor(8), "lamp": lamp, "half": half, "sky": sky})
    found, _ = features.auxiliary_features(scene, scene.sensors()[0], 64, 0, hide_emitters=hide_emitters)
    left, right = (RED, (0, 0, 0)) if hide_emitters else ((1, 1, 1), (1, 1, 1))
    np.testing.assert_allclose(found["albedo"][:, :3], np.broadcast_to(left, (8, 3, 3)), rtol=1e-4)
    np.testing.assert_allclose(found["albedo"][:, 5:], np.broadcast_to(right, (8, 3, 3)), rtol=1e-4)
    # The camera is at a distance of 4 from the origin; depth begins at the near clipping distance
    assert np.abs(found["depth"][4, 1] - (5 if hide_emitters else 3)).max() < 0.5


def test_layers_of_an_image_hide_the_emitters_that_its_integrator_hides():
    """Behind the lamp is nothing."""
    lamp = wall([0, 0, 0], [0, 1, 0], 0, 5) | {"emitter": {"type": "area"}}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(8), "lamp": lamp})
    for hides in (False, True):
        integrator = mi.load_dict({"type": "path", "hide_emitters": hides})
        image, took = manylights.render(scene, integrator, spp=4, layers=["albedo"])
        assert (image.numpy()[..., took.channels.index("albedo.R")] == 1 - hides).all()


@pytest.mark.parametrize(("name", "hides"), [("path", True), ("manylights", True), ("ptracer", False)])
def test_integrators_tell_whether_they_hide_emitters(name, hides):
    assert features.hides_emitters(mi.load_dict({"type": name, "hide_emitters": True})) is hides


def test_normals_are_turned_towards_the_viewer():
    two_sided = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    _, normal = guides(away=wall([0, 0, 0], [0, 1, 0], 180, 5, bsdf=two_sided))
    np.testing.assert_allclose(normal, np.broadcast_to((0, 0, 1), normal.shape), atol=1e-5)


@pytest.mark.parametrize(
    ("bsdf", "passed"),
    [
        ({"type": "thindielectric"}, 1.0),
        ({"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0}, 1.0),
        ({"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}}, 1.0),
        ({"type": "null"}, 1.0),
        ({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse", "reflectance": 0.0}}, 0.5),
    ],
)
def test_features_are_those_behind_glass_and_masks(bsdf, passed):
    albedo, normal = guides(512, screen=screen(bsdf), **red_wall())
    np.testing.assert_allclose(albedo.mean((0, 1)), passed * np.array(RED), rtol=0.12 if passed == 1 else 0.05)
    np.testing.assert_allclose(normal[..., 2].mean(), 1, rtol=0.12)


def test_features_are_those_in_a_mirror():
    """A mirror at 45 degrees shows a wall at the side."""
    mirror = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}
    albedo, normal = guides(
        mirror=wall([0, 0, 0], [0, 1, 0], 45, 5, bsdf=mirror), side=wall([9, 0, 0], [0, 1, 0], -90, 50, RED)
    )
    np.testing.assert_allclose(albedo, np.broadcast_to(0.5 * np.array(RED), albedo.shape), rtol=1e-3)
    np.testing.assert_allclose(normal, np.broadcast_to((-1, 0, 0), normal.shape), atol=1e-5)


def test_plastic_is_what_is_seen_of_it():
    albedo, normal = guides(512, screen=screen({"type": "plastic", "diffuse_reflectance": 0.4}), **red_wall())
    np.testing.assert_allclose(normal, np.broadcast_to((0, 0, 1), normal.shape), atol=1e-5)
    np.testing.assert_allclose(albedo[..., 0], albedo[..., 1], rtol=1e-4)  # nothing of what is behind
    assert 0.2 < albedo.mean() < 0.5


def test_emitters_are_seen_and_nothing_is_black():
    albedo, normal = guides()
    assert (albedo == 0).all() and (normal == 0).all()
    albedo, normal = guides(sky={"type": "constant", "radiance": {"type": "rgb", "value": [0.25, 0.5, 30.0]}})
    np.testing.assert_allclose(albedo, np.broadcast_to((0.25, 0.5, 1), albedo.shape), rtol=1e-4)
    assert (normal == 0).all()


def test_mirrors_that_face_each_other_end():
    mirrors = {
        f"m{z}": wall([0, 0, z], [0, 1, 0], 0 if z < 0 else 180, 50, bsdf={"type": "conductor"}) for z in (-1, 5)
    }
    albedo, normal = guides(**mirrors)
    assert (albedo == 0).all() and (normal == 0).all()


def test_features_of_more_samples_are_those_of_fewer_with_less_noise(monkeypatch):
    """Large images are rendered in parts, images with a time limit in two renders."""
    scene = cornell(16).load()
    sensor = scene.sensors()[0]
    exact, _ = features.auxiliary_features(scene, sensor, 1024, 7)
    few, _ = features.features_of(scene, sensor, 0, 4, None)
    timed, count = features.features_of(scene, sensor, 0, None, 1e6)
    monkeypatch.setattr(features, "FEATURE_WAVEFRONTS", (1, 1 << 25))
    in_parts, of_parts = features.auxiliary_features(scene, sensor, 50, 0)
    assert (count, of_parts) == (144, 48)
    for name, plane in exact.items():
        first, *others = (np.square(found[name] - plane).mean() for found in (few, timed, in_parts))
        assert max(others) < 0.5 * first < 0.05


@pytest.mark.parametrize("kind", ["independent", "multijitter"])
def test_features_leave_the_scenes_samples_as_they_were(kind):
    """Those of its own sampler, and of a sensor that is not replaced."""
    file = cornell(16)
    file.set_sampler(kind)
    scene = file.load()
    sampler = scene.sensors()[0].sampler()
    before = sampler.sample_count()
    features.auxiliary_features(scene, scene.sensors()[0], 16, 0)
    assert sampler.sample_count() == before != 16


@pytest.mark.parametrize(
    ("pixels", "sizes"),
    [(256 * 144, [64, 64]), (1920 * 1080, [16] * 8), (3840 * 2160, [4] * 32), (7680 * 4320, [1] * 128)],
)
def test_features_of_large_images_need_bounded_memory(pixels, sizes):
    assert features._sizes(128, pixels) == sizes
    assert sum(features._sizes(31, pixels)) == 16


def test_features_of_fine_films_have_a_sample_in_each_pixel():
    assert min(features._sizes(128, fine_film.LARGEST // 4)) >= 4


@pytest.mark.parametrize(
    ("things", "length"),
    [
        ({"behind": ([0, 0, -1], 0, None)}, 5),
        ({"screen": ([0, 0, 0], 0, {"type": "null"}), "behind": ([0, 0, -1], 0, None)}, 5),
        ({"mirror": ([0, 0, 0], 45, {"type": "conductor"}), "side": ([9, 0, 0], -90, None)}, 13),
        ({}, 0),
    ],
)
def test_depth_is_the_length_of_the_path_to_the_surface(things, length):
    """The camera is at a distance of 4 from the origin; the pixels in the middle are next to its axis."""
    walls = {name: wall(place, [0, 1, 0], angle, 50, bsdf=bsdf) for name, (place, angle, bsdf) in things.items()}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(9, fov=1, near_clip=1e-4), **walls})
    found, _ = features.auxiliary_features(scene, scene.sensors()[0], 256, 0)
    np.testing.assert_allclose(np.median(found["depth"]), length, rtol=1e-3)


# ---------------------- Layers ----------------------


def command(*arguments):
    """Run the command on a small scene and return its exit status."""
    try:
        size = ["-D", "resx=16", "-D", "resy=16", "-i", "path"]
        return manylights.main([CORNELL, *size, *(str(argument) for argument in arguments)])
    except SystemExit as error:
        return error.code


def test_layers_follow_the_channels_of_the_image():
    scene = cornell(16).load()
    image, took = manylights.render(scene, "path", spp=4, layers=("depth", "albedo"))
    assert took.channels == ["R", "G", "B", "depth.Z", "albedo.R", "albedo.G", "albedo.B"] and took.layer_spp == 16
    plain, usual = manylights.render(scene, "path", spp=4)
    np.testing.assert_allclose(image.numpy()[..., :3], plain.numpy(), rtol=1e-4, atol=1e-6)
    assert usual.layer_spp is None and usual.channels == ["R", "G", "B"]
    expected, _ = features.features_of(scene, scene.sensors()[0], 0, 4)
    np.testing.assert_allclose(image.numpy()[..., 3:4], expected["depth"], rtol=1e-4)
    np.testing.assert_allclose(image.numpy()[..., 4:], expected["albedo"], rtol=1e-4, atol=1e-6)


def test_layers_are_in_every_image_of_a_render():
    seen = []

    def progress(took, image):
        if image is not None:
            seen.append((image.shape[-1], took.channels[3:]))

    scene = cornell(16).load()
    _, took = manylights.render(scene, "path", spp=8, pass_spp=4, layers=["normal"], denoise=True, progress=progress)
    assert seen == [(6, ["normal.X", "normal.Y", "normal.Z"])] * 2
    assert took.raw.shape == (16, 16, 6)


def test_files_have_layers_with_the_samples_behind_them(tmp_path):
    assert command("-o", tmp_path / "a.exr", "--spp", 4, "--layers", "albedo, normal,depth", "--denoise") == 0
    for name in ("a.exr", "a.denoised.exr"):
        image, channels, metadata = images.read_exr(tmp_path / name)
        assert set(channels) == {"R", "G", "B", *features.channels_of(list(FEATURES))} and metadata["layer_spp"] == 16
        assert (image[..., channels.index("depth.Z")] > 0).all()


def test_layers_of_an_image_by_workers(tmp_path):
    pytest.importorskip("distributed")
    assert command("-o", tmp_path / "here.exr", "--spp", 8, "--pass-spp", 4, "--layers", "depth") == 0
    there = tmp_path / "there.exr"
    assert command("-o", there, "--spp", 8, "--pass-spp", 4, "--layers", "depth", "--workers", 1) == 0
    here, there = (images.read_exr(file) for file in (tmp_path / "here.exr", there))
    assert here[1] == there[1] and "depth.Z" in here[1]
    np.testing.assert_allclose(here[0], there[0], rtol=1e-4, atol=1e-6)


def test_files_have_layers_of_light(tmp_path):
    size = ("-i", "manylights", "--spp", 4, "--denoise")
    layers = ("--layers", "direct,depth,emission,indirect", "--light-groups", "lamp=light*")
    assert command("-o", tmp_path / "a.exr", *size, *layers) == 0
    for name in ("a.exr", "a.denoised.exr"):
        image, channels, metadata = images.read_exr(tmp_path / name)
        planes = {
            layer: image[..., [channels.index(f"{layer}.{channel}") for channel in "RGB"]]
            for layer in ("emission", "direct", "indirect", "lamp", "other")
        }
        assert "depth.Z" in channels and "lamp=light*" in metadata["parameters"]
        whole = planes["emission"] + planes["direct"] + planes["indirect"]
        np.testing.assert_allclose(planes["lamp"], whole, rtol=1e-4, atol=1e-5 * whole.max())
        assert planes["other"].max() == 0 and planes["indirect"].max() > 0


def test_only_manylights_has_layers_of_light(tmp_path, capsys):
    assert command("-o", tmp_path / "a.exr", "--spp", 1, "--layers", "direct") == 2
    assert "need the integrator manylights, and this one is path" in capsys.readouterr().err


@pytest.mark.parametrize("names", ["shape", "albedo,albedo", "", "albedo,"])
def test_other_layers_are_refused(names, capsys):
    assert command("--layers", names) == 2
    assert (
        "--layers: must be a list of distinct names out of albedo, normal, depth, emission" in capsys.readouterr().err
    )
    with pytest.raises(ValueError, match="layers must be a list of distinct names out of albedo, normal, depth"):
        manylights.render(cornell(16).load(), layers=names.split(","))


def test_layers_need_an_exr_file(tmp_path, capsys):
    assert command("-o", tmp_path / "a.png", "--layers", "depth") == 2
    assert "--layers needs an .exr file" in capsys.readouterr().err


def test_a_channel_of_the_integrator_is_no_layer():
    wrapper = mi.load_dict({"type": "aov", "aovs": "albedo:albedo", "image": {"type": "path"}})
    with pytest.raises(ValueError, match=r"layers must not name channels of the integrator, got albedo\.B, albedo\.G"):
        manylights.render(cornell(16).load(), wrapper, spp=1, layers=["albedo"])
