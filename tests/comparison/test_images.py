"""EXR and PNG files, tone mapping, false colours."""

import resource
import threading

import mitsuba as mi
import numpy as np
import pytest

from comparison import images
from comparison.occasional import OccasionalWriter


@pytest.mark.parametrize("half", [False, True])
def test_exr_files_keep_channels_and_metadata(tmp_path, half):
    image = np.random.default_rng(0).random((5, 7, 4))
    metadata = {"spp": 4, "seconds": 1.5, "name": "path", "seed": 2**32 - 1, "parameters": {"a": 1}, "flag": True}
    images.write_exr(tmp_path / "a.exr", image, ["R", "G", "B", "dd.T"], metadata, half)
    read, channels, found = images.read_exr(tmp_path / "a.exr")
    assert channels == ["B", "G", "R", "dd.T"]
    np.testing.assert_allclose(images.colour(read, channels), image[..., :3], rtol=1e-3 if half else 1e-6)
    np.testing.assert_allclose(read[..., 3], image[..., 3], rtol=1e-3 if half else 1e-6)
    assert {key: found[key] for key in metadata} == metadata | {
        "seed": "4294967295", "parameters": '{"a": 1}', "flag": "true",
    }  # fmt: skip
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


def test_text_of_another_encoding_is_named(tmp_path):
    """OpenEXR reads nothing of such a file."""
    file = tmp_path / "a.exr"
    images.write_exr(file, np.ones((2, 2, 3)), "RGB", {"owner": "J?rg"})
    file.write_bytes(file.read_bytes().replace(b"J?rg", "Jörg".encode("latin-1")))
    for read in (images.read_exr, images.read_exr_metadata):
        with pytest.raises(ValueError, match=f"'{file}' has an attribute whose text is not UTF-8: 'Jörg'"):
            read(file)


def test_failed_write_leaves_the_old_file(tmp_path):
    (tmp_path / "a.png").write_text("old")
    with pytest.raises(RuntimeError), images.replacing(tmp_path / "a.png") as temporary:
        temporary.write_text("new, but")
        raise RuntimeError("disk full")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a.png", "old")]


def test_two_threads_may_write_a_file_at_once(tmp_path):
    written = []

    def write():
        with images.replacing(tmp_path / "a.png") as other:
            other.write_text("whole")
            written.append(other)

    with images.replacing(tmp_path / "a.png") as temporary:
        temporary.write_text("whole, too")
        thread = threading.Thread(target=write)
        thread.start()
        thread.join()
        assert written and (tmp_path / "a.png").read_text() == "whole"
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a.png", "whole, too")]


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*/a\.json'"),
        images.replacing(tmp_path / "a.json") as file,
    ):
        file.symlink_to("/dev/full")
        file.write_text("{}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extension", images.EXTENSIONS)
def test_a_disk_that_is_full_within_an_image_is_such_an_error(tmp_path, extension):
    limits, image = resource.getrlimit(resource.RLIMIT_FSIZE), np.random.default_rng(0).random((64, 64, 3))
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
    try:
        with pytest.raises(OSError, match=rf"'.*/a\{extension}'"):
            images.write(tmp_path / f"a{extension}", image)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_the_colour_of_xyz_is_that_of_mitsuba():
    xyz = np.random.default_rng(0).random((4, 5, 3))
    expected = np.array(mi.xyz_to_srgb(mi.Color3f(*np.float32(xyz.reshape(-1, 3).T)))).T.reshape(4, 5, 3)
    image, names = np.concatenate([np.ones((4, 5, 1)), xyz], axis=-1), ["A", "X", "Y", "Z"]
    np.testing.assert_allclose(images.colour(image, names), expected, atol=1e-5)
    np.testing.assert_allclose(images.with_colour(np.zeros((4, 5, 4)), names, expected)[..., 1:], xyz, atol=1e-5)


def test_exposures_beyond_the_numbers_are_refused(tmp_path):
    with pytest.raises(ValueError, match="exposure must be from -100 to 100 stops, got 1024"):
        images.write(tmp_path / "a.png", np.ones((4, 4, 3)), exposure=1024)
    with pytest.raises(ValueError, match="got nan"):
        images.check_exposure(float("nan"))


def test_tone_mapping():
    rgb = np.zeros((20, 20, 3))
    rgb[:2], rgb[2:4], rgb[4:] = 4.0, np.inf, 2.0
    exposure = images.automatic_exposure(rgb)
    assert exposure == pytest.approx(0.2)
    mapped = images.tone_map(rgb, exposure)
    assert mapped.dtype == np.uint8
    assert mapped[0, 0, 0] == round(255 * (1.055 * 0.8 ** (1 / 2.4) - 0.055))
    assert images.automatic_exposure(np.zeros((4, 4, 3))) == 1


def test_false_colours_get_brighter_with_the_error():
    errors = np.array([[0.0, 0.01, 0.05, 0.2, 0.7, 1.0, 50.0, np.nan]])
    brightness = images.false_colours(errors).astype(int).sum(axis=-1)[0]
    assert np.all(np.diff(brightness) >= 0)
    assert brightness[0] == brightness[1] < brightness[2] < brightness[3] < brightness[4] < brightness[5]


def test_false_colours_of_other_channels_span_their_scale():
    colours = images.false_colours(np.array([[0.0, -1.0, 30.0, 300.0, 3000.0, np.inf, np.nan]]), (30, 3000))[0]
    assert np.all(colours[:3] == images.FALSE_COLOURS[0]) and np.all(colours[4:] == images.FALSE_COLOURS[-1])
    np.testing.assert_allclose(colours[3], images.FALSE_COLOURS[2:4].mean(axis=0), atol=1)  # the middle of the scale


def test_scale_of_several_images_holds_all_and_ignores_grazed_pixels():
    few, many = np.linspace(101.0, 201, 1000).reshape(20, 50), np.full((20, 50), 4000.0)
    few[0, :5], few[1, :10], many[0, 0] = 1e-3, 0, np.inf
    assert images.logarithmic_ends([few, many]) == (100, 4000)
    assert images.logarithmic_ends([many, np.zeros((2, 2))]) == (2000, 4000)
    assert images.logarithmic_ends([np.zeros((2, 2))]) == (1, 2)


def test_colour_of_luminance_and_of_nothing():
    assert images.colour(np.ones((2, 2, 1)), ["Y"]).shape == (2, 2, 3)
    with pytest.raises(ValueError, match="no colour channels among depth"):
        images.colour(np.ones((2, 2, 1)), ["depth"])


def test_files_that_take_long_to_write_are_not_written_all_the_time(monkeypatch):
    now, written = [0.0], []

    def write():
        now[0] += 15.0
        written.append(now[0])

    monkeypatch.setattr("comparison.occasional.time.monotonic", lambda: now[0])
    writer = OccasionalWriter("The image", 10.0)
    for _ in range(100):
        now[0] += 1.0
        writer.offer(write)
    assert len(written) == 9 and min(np.diff(written)) > 25.0
