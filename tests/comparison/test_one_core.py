"""A single core, and a single thread of Dr.Jit, where Mitsuba's own reading and writing of EXR files never ends."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

import manylights
from comparison import images
from tests.support.paths import ROOT

ONE_CORE = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
ONE_THREAD = "import drjit\ndrjit.set_thread_count(1)\n"
pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no processes to cores")


def run(code, folder):
    """Run Python code; return what it prints. A code that waits for ever fails."""
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def folder(tmp_path):
    """A folder with the scenes, and one whose environment is an EXR file."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    images.write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)), "RGB")
    (tmp_path / "sky.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/><integer name="height" '
        'value="8"/></film></sensor><integrator type="path"/></scene>'
    )
    return tmp_path


@pytest.mark.parametrize("pinned", [ONE_CORE, ""])
def test_the_example_of_the_readme_runs_on_one_core(folder, pinned):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    said = run(pinned + example.replace("spp=64", 'spp=1, resx="32", resy="24"'), folder)
    image, channels, _ = images.read_exr(folder / "hall.exr")
    assert image.shape == (24, 32, 3) and image.mean() > 0 and sorted(channels) == ["B", "G", "R"]
    one_core = bool(pinned) or len(os.sched_getaffinity(0)) == 1
    assert said.count("Dr.Jit uses two threads on this one core") == one_core


def test_mitsuba_reads_and_writes_exr_files_on_one_core(folder):
    code = """
import manylights, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
image = mi.render(mi.load_file("sky.xml"), spp=1)
mi.util.write_bitmap("a.exr", image, write_async=False)
print(mi.Bitmap("a.exr").size())
"""
    assert "[8, 8]" in run(ONE_CORE + code, folder)


@pytest.mark.parametrize("before", [True, False])
def test_one_thread_by_the_callers_choice_stays(folder, before):
    """Images are rendered from a path, and written, all the same."""
    code = f"""
import manylights, mitsuba as mi, drjit
{"" if before else ONE_THREAD}
mi.set_variant("llvm_ad_rgb")
image, took = manylights.render("sky.xml", spp=1)
manylights.write("a.exr", image, took.channels)
manylights.write("a.png", image)
print("threads", drjit.thread_count())
"""
    said = run((ONE_THREAD if before else "") + code, folder)
    assert "threads 1" in said
    assert said.count("Dr.Jit was set to one thread") == (before and len(os.sched_getaffinity(0)) > 1)
    assert (folder / "a.exr").is_file() and (folder / "a.png").is_file()


@pytest.mark.parametrize("output", ["a.exr", "a.png"])
def test_the_command_renders_a_scene_with_an_exr_file_on_one_core(folder, output):
    code = f"import sys, manylights\nsys.exit(manylights.main(['sky.xml', '-o', '{output}', '--spp', '1', '-t', '1']))"
    run(ONE_CORE + code, folder)
    assert (folder / output).is_file()


# ---------------------- The writer ----------------------


@pytest.mark.parametrize("names", ["Y", "YA", "RGB", "RGBA"])
def test_channels_have_their_usual_names(tmp_path, names):
    image = np.random.default_rng(0).random((4, 5, len(names)), np.float32)
    manylights.write(tmp_path / "a.exr", image)
    read, channels, _ = images.read_exr(tmp_path / "a.exr")
    assert channels == sorted(names)
    np.testing.assert_array_equal(read, image[..., [names.index(name) for name in channels]])


def test_pictures_are_as_bright_as_they_are_asked_to_be(tmp_path):
    image = np.full((4, 4, 3), 0.1)
    for name, exposure in (("automatic", None), ("same", 0), ("brighter", 2)):
        manylights.write(tmp_path / f"{name}.png", image, exposure=exposure)
    found = {file.stem: images.read_png(file).mean() for file in tmp_path.iterdir()}
    assert found["same"] < found["brighter"] < found["automatic"]
    assert found["same"] == images.tone_map(image, 1.0).mean()


@pytest.mark.parametrize(
    ("file", "arguments", "said"),
    [
        ("a.jpg", {}, r"cannot write '.*a\.jpg': the output must be an \.exr or a \.png file"),
        ("a", {}, r"must be an \.exr or a \.png file"),
        ("a.exr", {"channels": "RG"}, r"channels must name the channels of an image of shape \(4, 4, 5\), got R, G"),
        ("a.exr", {}, r"channels must name the channels of an image of shape \(4, 4, 5\), got none"),
        ("a.png", {"channels": "abcde"}, "no colour channels among a, b, c, d, e"),
    ],
)
def test_what_cannot_be_written_is_named(tmp_path, file, arguments, said):
    with pytest.raises(ValueError, match=said):
        manylights.write(tmp_path / file, np.ones((4, 4, 5)), **arguments)
    assert not list(tmp_path.iterdir())
