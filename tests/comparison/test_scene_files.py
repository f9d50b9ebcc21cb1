"""Scene files: sensors and their parts, image sizes and crop windows, nested integrators, hashes of files."""

import json
import os

import mitsuba as mi
import numpy as np
import pytest

import compare
import manylights
from comparison import images
from comparison.one_image import LazyScene
from comparison.scene_files import SceneFile, file_hash

FILM = ("width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
BATCH = '<sensor type="batch"><sensor type="perspective"/><sensor type="perspective"/></sensor>'
# An emitter in the centre of the view of a camera
LAMP = '<shape type="sphere"><point name="center" x="0" y="0" z="5"/><emitter type="area"/></shape>'
PARTS = """
<film type="hdrfilm" id="film"><integer name="width" value="8"/><integer name="height" value="6"/></film>
<alias id="film" as="picture"/><sampler type="multijitter" id="sampler"/>
"""


def scene_file(folder, content):
    (folder / "a.xml").write_text(f'<scene version="3.0.0">{content}</scene>')
    return SceneFile(folder / "a.xml")


def camera(*values):
    """A camera with the first properties of a film (see `FILM`)."""
    given = "".join(f'<integer name="{name}" value="{value}"/>' for name, value in zip(FILM, values, strict=False))
    return f'<sensor type="perspective"><film type="hdrfilm">{given}<rfilter type="box"/></film></sensor>'


# --- Sensors and their parts ---


@pytest.mark.parametrize("nodes", [2, 3, 4, 8, 16, 32])
def test_a_sensor_gets_its_parts_in_a_scene_of_any_size(tmp_path, nodes):
    """The list of nodes moves in memory when its size exceeds a power of two."""
    file = scene_file(tmp_path, '<sensor type="perspective"/>' + '<bsdf type="diffuse"/>' * (nodes - 2))
    file.set_sampler("multijitter")
    file.set_width(16)
    assert (file.sampler_name, file.size) == ("multijitter", (16, 12))
    (sensor,) = file.load().sensors()
    assert sensor.sampler().class_name() == "MultijitterSampler" and list(sensor.film().crop_size()) == [16, 12]


@pytest.mark.parametrize(
    ("content", "sizes"),
    [
        (BATCH, [(768, 576)]),
        (camera(8, 4) + BATCH + camera(6, 6), [(8, 4), (768, 576), (6, 6)]),
        (camera(8, 4) + '<shape type="sphere"><sensor type="irradiancemeter"/></shape>', [(8, 4), (768, 576)]),
        (PARTS + '<sensor type="perspective"><ref id="picture"/><ref id="sampler"/></sensor>', [(8, 6)]),
    ],
    ids=["batch", "batch between others", "shape", "references"],
)
def test_sensors_and_their_films_are_those_of_the_loaded_scene(tmp_path, content, sizes):
    file = scene_file(tmp_path, content)
    pixels = [file.sampling(index)[0] for index in range(file.sensors)]
    assert file.size == sizes[0] and pixels == [width * height for width, height in sizes]
    assert [tuple(sensor.film().crop_size()) for sensor in file.load().sensors()] == sizes


@pytest.mark.parametrize(("sensor", "looks"), [("", False), ('<sensor type="irradiancemeter"/>', True)])
def test_shapes_are_only_searched_for_sensors_that_are_found_nowhere_else(tmp_path, sensor, looks, monkeypatch):
    """Copies of the properties of many shapes take long."""
    seen, parts = [], SceneFile._parts
    monkeypatch.setattr(
        SceneFile,
        "_parts",
        lambda self, properties, *kind: seen.append(properties.plugin_name()) or parts(self, properties, *kind),
    )
    file = scene_file(tmp_path, camera(8, 4) + BATCH + LAMP + f'<shape type="sphere">{sensor}</shape>')
    assert file.sensors == (3 if looks else 2) and ("sphere" in seen) is looks


def test_parts_by_reference_are_those_of_the_sensor(tmp_path):
    file = scene_file(tmp_path, PARTS + '<sensor type="perspective"><ref id="picture"/><ref id="sampler"/></sensor>')
    assert file.sampler_name == "multijitter" and file.sampling(0)[1].class_name() == "MultijitterSampler"
    file.set_width(4)
    file.set_sampler("stratified")
    assert (file.sampler_name, file.size) == ("stratified", (4, 3))
    (sensor,) = file.load().sensors()
    assert sensor.sampler().class_name() == "StratifiedSampler" and list(sensor.film().crop_size()) == [4, 3]


def test_a_reference_to_nothing_is_refused_by_mitsuba(tmp_path):
    file = scene_file(tmp_path, '<sensor type="perspective"><ref id="nothing"/></sensor>')
    with pytest.raises(RuntimeError, match='unresolved reference to "nothing"'):
        file.load()


# --- Image sizes ---


@pytest.mark.parametrize(
    ("film", "width", "scaled"),
    [
        ((64, 48, 16, 12, 24, 18), 16, (64, 48, 16, 12, 24, 18)),
        ((64, 48, 16, 12, 24, 18), 8, (32, 24, 8, 6, 12, 9)),
        ((64, 48, 16, 12, 24, 18), 32, (128, 96, 32, 24, 48, 36)),
        ((64, 48, 16), 8, (32, 24, 8, 24, 0, 0)),
        ((64, 48), 8, (8, 6, 8, 6, 0, 0)),
    ],
)
def test_width_scales_film_and_crop_window_alike(tmp_path, film, width, scaled):
    file = scene_file(tmp_path, camera(*film))
    file.set_width(width)
    assert file.size == scaled[2:4] and file.sampling(0)[0] == scaled[2] * scaled[3]
    found = SceneFile(file.path, changes=file.changes).load().sensors()[0].film()
    assert (*found.size(), *found.crop_size(), *found.crop_offset()) == scaled


def test_a_scaled_crop_window_lies_in_the_film(tmp_path):
    """Also after rounding: Mitsuba would refuse another."""
    for film in ((13, 11, 7, 5, 6, 6), (13, 11, 3, 10, 9, 1), (13, 11, 6, 1, 3, 10), (12, 40, 12, 3, 0, 37)):
        for width in range(1, 20):
            file = scene_file(tmp_path, camera(*film))
            file.set_width(width)
            assert file.size[0] == width == file.load().sensors()[0].film().crop_size()[0]


@pytest.mark.parametrize("film", [(64, 48, 16, 12, 50, 0), (64, 48, 0, 12), (64, 48, 16, 12, 0, 37)])
def test_a_crop_window_outside_the_film_is_refused(tmp_path, film):
    file = scene_file(tmp_path, camera(*film))
    with pytest.raises(
        ValueError, match=rf"the crop window of {film[2]} x 12 pixels at \(.*\) does not lie in the film"
    ):
        file.set_width(8)


def test_widths_of_all_sensors_keep_their_aspect(tmp_path):
    file = scene_file(tmp_path, camera(8, 4) + camera(6, 6, 3, 2))
    file.set_width(4)
    assert [tuple(sensor.film().crop_size()) for sensor in file.load().sensors()] == [(4, 2), (4, 3)]


def test_a_crop_window_is_compared_with_its_reference(tmp_path, capsys):
    """The window shows the sky alone, as the lamp is in the centre of the view."""
    sky = '<emitter type="constant"><rgb name="radiance" value="0.25"/></emitter>'
    scene_file(tmp_path, camera(64, 48, 16, 12) + LAMP + sky)
    common = [str(tmp_path / "a.xml"), "-i", "path", "--spp", "1", "-r", "path:2", "--cache", str(tmp_path / "cache")]
    assert compare.main([*common, "-o", str(tmp_path / "out")]) == 0, capsys.readouterr().out
    (scene,) = json.loads((tmp_path / "out" / "results.json").read_text())["scenes"]
    image, _, _ = images.read_exr(scene["renders"][0]["output"])
    assert image.shape == (12, 16, 3) and np.ptp(image) == 0


# --- Integrators ---


def nested(folder, kind="aov"):
    own = '<string name="aovs" value="old:depth"/>' if kind == "aov" else ""
    integrator = f'<integrator type="{kind}">{own}<integrator type="path"/></integrator>'
    return scene_file(folder, camera(8, 6) + LAMP + integrator)


def test_new_parameters_leave_nested_integrators(tmp_path):
    file = nested(tmp_path)
    file.set_integrator("aov", {"aovs": "new:depth"}, keep=None)
    for one in (SceneFile(file.path, changes=file.changes), file):
        scene = one.load()
        image, channels = mi.render(scene, spp=1).numpy(), scene.integrator().aov_names()
        assert "new.T" in channels and image[..., :3].max() > 0.9 and image.shape[-1] == 4


def test_an_integrator_with_parts_is_not_tried_without_them(tmp_path):
    file = nested(tmp_path, "stokes")
    file.set_integrator("stokes", {"meridian_align": False}, keep=None)
    assert file.integrator == ("stokes", {"meridian_align": False})


def test_the_command_sets_parameters_of_nested_integrators(tmp_path, capsys):
    path, output = nested(tmp_path).path, tmp_path / "a.exr"
    assert manylights.main([str(path), "-p", "aovs=dd:depth", "--spp", "1", "-o", str(output)]) == 0, (
        capsys.readouterr()
    )
    image, channels, _ = images.read_exr(output)
    assert "dd.T" in channels and images.colour(image, channels).max() > 0.9


# --- Hashes of files ---


def written(path, content, age):
    """Write a file that was last changed `age` seconds before a fixed time in nanoseconds, which is returned."""
    path.write_bytes(content)
    changed = int(path.stat().st_mtime_ns - age * 1e9)
    os.utime(path, ns=(changed, changed))
    return changed


def sky(folder, more=""):
    bitmap = mi.Bitmap(np.full((2, 4, 3), 0.5, np.float32))
    bitmap.write(str(folder / "light.exr"))
    emitter = '<emitter type="envmap"><string name="filename" value="light.exr"/></emitter>'
    return scene_file(folder, camera(8, 6) + emitter + more)


def test_files_are_read_once_for_the_fingerprints_of_a_scene(tmp_path):
    file, light = sky(tmp_path), tmp_path / "light.exr"
    changed = written(light, b"one", 10)
    before = file.fingerprint()
    light.write_bytes(b"two")
    os.utime(light, ns=(changed, changed))  # as if it had not been changed
    assert file.fingerprint() == before
    os.utime(light, ns=(changed + 1, changed + 1))
    assert file.fingerprint() != before


def test_a_file_that_was_just_changed_is_read_again(tmp_path):
    """Another change may have the same time."""
    changed = written(tmp_path / "a", b"one", 0)
    before = file_hash(tmp_path / "a")
    (tmp_path / "a").write_bytes(b"two")
    os.utime(tmp_path / "a", ns=(changed, changed))
    assert file_hash(tmp_path / "a") != before


@pytest.mark.parametrize("changes", [False, True])
def test_kept_lights_end_with_the_files_of_the_frame_before(tmp_path, changes):
    keeps = '<integrator type="manylights"><boolean name="keep_lights" value="true"/></integrator>'
    first = LazyScene(sky(tmp_path, keeps))
    first.get()
    if changes:
        mi.Bitmap(np.ones((2, 4, 3), np.float32)).write(str(tmp_path / "light.exr"))
    second = LazyScene(SceneFile(first.file.path), before=first)
    second.get()
    assert (second.integrator is first.integrator) != changes
