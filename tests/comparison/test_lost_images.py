"""Renders whose image is lost after the last pass go on from their checkpoint; images without colour are refused."""

import json
import re
import signal

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import checkpoint, images, one_image
from comparison.checkpoint import Checkpoint
from comparison.denoising import Denoiser
from comparison.rendering import Passes, Progressive
from comparison.scene_files import SceneFile
from comparison.single_pass import check_film
from tests.comparison.cluster.test_cluster import pass_of
from tests.support.distributed_renders import TINY
from tests.support.paths import CORNELL

# Passes at once: the limit of `error` is reached with the eighth one
BY_ERROR = {"integrator": "path", "pass_spp": 2, "error": 0.9, "spp": 64}


def command(output, *more):
    size = ["-D", "resx=16", "-D", "resy=16", "-i", "path", "--spp", "8", "--pass-spp", "4", "--resume"]
    return manylights.main([CORNELL, *size, "-o", str(output), *more])


def files_of(folder):
    return sorted(file.name for file in folder.iterdir())


@pytest.fixture
def passes(monkeypatch):
    """The sizes of the passes that are rendered."""
    rendered, render = [], Progressive.render
    monkeypatch.setattr(
        Progressive, "render", lambda self, spp, **more: rendered.append(spp) or render(self, spp, **more)
    )
    return rendered


def denoiser_of(folder, monkeypatch, error):
    def broken(*_):
        raise error

    monkeypatch.setattr(Denoiser, "denoise_passes", broken)


def full_disk(folder, monkeypatch, error):
    write = images.write

    def broken(path, *more):
        if len(list(folder.iterdir())):
            raise error
        write(path, *more)

    monkeypatch.setattr(images, "write", broken)


@pytest.mark.parametrize(
    ("breaks", "error", "status", "said"),
    [
        (denoiser_of, MemoryError("out of memory"), 1, "out of memory"),
        (denoiser_of, KeyboardInterrupt(), 130, "interrupted; wrote 8 samples per pixel to .*; --resume goes on"),
        (full_disk, OSError(28, "No space left on device", "a.exr"), 1, "No space left on device"),
    ],
)
def test_a_render_whose_image_is_lost_goes_on(breaks, error, status, said, passes, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as patched:
        breaks(tmp_path, patched, error)
        assert command(tmp_path / "a.exr", "--denoise") == status
    assert re.search(said, capfd.readouterr().err)
    assert "a.checkpoint.npz" in files_of(tmp_path) and passes == [4, 4]
    assert command(tmp_path / "a.exr", "--denoise") == 0
    assert files_of(tmp_path) == ["a.denoised.exr", "a.exr"] and passes == [4, 4]
    (tmp_path / "b").mkdir()
    assert command(tmp_path / "b" / "a.exr", "--denoise") == 0
    for name in ("a.exr", "a.denoised.exr"):
        found, expected = (images.read_exr(folder / name)[0] for folder in (tmp_path, tmp_path / "b"))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def interrupt(*_, **__):
    raise KeyboardInterrupt


def test_ctrl_c_in_the_denoiser_of_a_render_without_a_new_pass_tells_of_the_checkpoint(
    passes, tmp_path, monkeypatch, capfd
):
    with monkeypatch.context() as patched:
        denoiser_of(tmp_path, patched, MemoryError("out of memory"))
        assert command(tmp_path / "a.exr", "--denoise") == 1
        capfd.readouterr()
        denoiser_of(tmp_path, patched, KeyboardInterrupt())
        assert command(tmp_path / "a.exr", "--denoise") == 130
    said = f"interrupted without a new pass; '{tmp_path / 'a.checkpoint.npz'}' stays, and --resume goes on from it"
    assert said in capfd.readouterr().err and files_of(tmp_path) == ["a.checkpoint.npz"]
    assert command(tmp_path / "a.exr", "--denoise") == 0 and passes == [4, 4]


def test_ctrl_c_before_the_first_pass_wrote_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(Progressive, "render", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    assert command(tmp_path / "a.exr") == 130 and files_of(tmp_path) == []
    assert "interrupted before the first pass was finished; nothing was written" in capfd.readouterr().err


@pytest.mark.parametrize("where", ["keep", "write"])
def test_ctrl_c_while_the_last_image_is_written_tells_what_there_is(where, tmp_path, monkeypatch, capfd):
    original, calls = getattr(one_image.Output, where), []

    def broken(self, *arguments):
        calls.append(arguments)
        # `keep` is called after each of two passes, and with the last image
        if len(calls) == {"keep": 3, "write": 1}[where]:
            raise KeyboardInterrupt
        original(self, *arguments)

    monkeypatch.setattr(one_image.Output, where, broken)
    assert command(tmp_path / "a.exr") == 130
    said = f"interrupted; wrote 8 samples per pixel to {tmp_path / 'a.exr'}; --resume goes on"
    assert said in capfd.readouterr().err and files_of(tmp_path) == ["a.checkpoint.npz", "a.exr"]


@pytest.fixture
def saved(monkeypatch):
    """The numbers of passes of the checkpoints that are written."""
    found, savez = [], np.savez

    def noted(file, **arrays):
        found.append(len(json.loads(arrays["described"].item())["passes"]))
        savez(file, **arrays)

    monkeypatch.setattr(np, "savez", noted)
    return found


def test_a_render_that_is_complete_writes_no_checkpoint(saved, tmp_path):
    """The command removes a checkpoint once the image is written."""
    assert command(tmp_path / "a.exr") == 0
    assert saved == [] and files_of(tmp_path) == ["a.exr"]


def test_an_image_that_cannot_be_written_leaves_all_of_its_passes(saved, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(images, "write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        assert command(tmp_path / "a.exr") == 1
    assert saved == [2] and files_of(tmp_path) == ["a.checkpoint.npz"]
    assert command(tmp_path / "a.exr") == 0 and files_of(tmp_path) == ["a.exr"]


def test_a_render_that_reached_its_error_and_was_lost_has_no_further_pass(tmp_path, passes):
    scene, file = SceneFile(CORNELL, TINY).load(1), Checkpoint(tmp_path / "a.checkpoint.npz", {})

    def progress(took, image):
        if took.ended_by == "error":
            raise OSError("no image")

    with pytest.raises(OSError, match="no image"):
        manylights.render(scene, progress=progress, checkpoint=file, **BY_ERROR)
    assert file.path.is_file()
    number = len(passes)
    image, took = manylights.render(scene, checkpoint=file, **BY_ERROR)
    assert (took.ended_by, took.passes, len(passes)) == ("error", number, number) and took.error <= 0.9
    assert not file.path.exists()
    np.testing.assert_array_equal(image.numpy(), manylights.render(scene, **BY_ERROR)[0].numpy())


def test_a_checkpoint_that_was_removed_can_be_written_again(tmp_path):
    kept, file = Passes(0), Checkpoint(tmp_path / "a.checkpoint.npz", {})
    file.restore(kept)
    kept.add(pass_of(1.0))
    file.keep(3.0)
    file.save()
    file.remove()
    assert file.leave() and file.path.is_file()


# ---------------------- Images without colour ----------------------


WITHOUT_COLOUR = """
<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/><sensor type="perspective">
<film type="specfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
<spectrum name="blue" value="400:0.5, 450:1, 500:0.5"/><spectrum name="red" value="600:0.5, 650:1, 700:0.5"/>
</film></sensor></scene>
"""


@pytest.mark.usefixtures("restore_variant")
@pytest.mark.parametrize(
    ("output", "more", "purpose"),
    [("a.exr", ["--denoise"], "denoise"), ("a.png", [], "'.*a.png'"), ("a.exr", [], None)],
)
def test_what_needs_colour_is_refused_before_the_first_pass(output, more, purpose, passes, tmp_path, capfd):
    (tmp_path / "scene.xml").write_text(WITHOUT_COLOUR)
    arguments = ["-m", "llvm_ad_spectral", "-i", "scene", "--spp", "1", "-o", str(tmp_path / output), *more]
    assert manylights.main([str(tmp_path / "scene.xml"), *arguments]) == (1 if purpose else 0)
    said = capfd.readouterr().err
    if purpose is None:
        assert images.read_exr(tmp_path / "a.exr")[1] == ["blue", "red"]
    else:
        assert re.search(f"manylights: {purpose} needs an image with colour .*no colour channels among blue, red", said)
        assert passes == [] and files_of(tmp_path) == ["scene.xml"]


def test_a_film_with_colour_by_its_format_is_not_developed(monkeypatch):
    sensor = SceneFile(CORNELL, TINY).load(1).sensors()[0]
    monkeypatch.setattr(type(sensor.film()), "bitmap", interrupt)
    check_film(sensor, mi.load_dict({"type": "path"}), "denoise")


def test_a_png_file_without_colour_by_workers_is_refused_after_the_first_pass(tmp_path):
    took = manylights.Took(1, 1, 1.0, None, {}, None, ["blue", "red"])
    with pytest.raises(ValueError, match="needs an image with colour"):
        one_image.Output(tmp_path / "a.png").keep(took, mi.TensorXf(np.zeros((2, 2, 2))))
