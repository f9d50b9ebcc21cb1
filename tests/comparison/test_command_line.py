"""manylights.py: options, errors, files, and Ctrl-C."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import command_line, images, one_image
from tests.support.marks import stress
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE

CORNELL = str(ROOT / "scenes" / "cornell.xml")
TINY = ["-D", "resx=16", "-D", "resy=16"]


def run(*arguments):
    """Run the command in this process and return its exit status."""
    try:
        return manylights.main([str(argument) for argument in arguments])
    except SystemExit as error:
        return error.code


def process(*arguments):
    """Start the command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "manylights.py"), *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "value"),
    [("3", 3), ("-1", -1), ("0.02", 0.02), ("1e-3", 1e-3), ("true", True), ("False", False), ("vpl", "vpl"), ("", "")],
)
def test_values_of_parameters(text, value):
    found = command_line.value(text)
    assert found == value and type(found) is type(value)


def test_exr_file_says_how_it_was_made(tmp_path, capsys):
    output = tmp_path / "a.exr"
    assert run(CORNELL, *TINY, "-o", output, "--spp", 5, "--pass-spp", 2, "--seed", 3, "-p", "rr_depth=4") == 0
    image, _, metadata = images.read_exr(output)
    assert image.shape == (16, 16, 3) and image.mean() > 0
    expected = {
        "integrator": "manylights",
        "replaced": "path",
        "seed": 3,
        "spp": 5,
        "passes": 3,
        "variant": "llvm_ad_rgb",
    }
    assert {key: metadata[key] for key in expected} == expected
    assert json.loads(metadata["parameters"]) == {"max_depth": 6, "rr_depth": 4}
    assert metadata["mitsuba"] == mi.__version__ and metadata["render_seconds"] > 0
    written = capsys.readouterr()
    assert str(output) in written.out and "manylights in place of path, 5 samples per pixel" in written.out
    assert written.err == ""  # no progress bar where nobody watches


def test_one_pass_is_what_mitsuba_renders(tmp_path):
    assert run(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 4, "--seed", 9, "-i", "scene") == 0
    expected = mi.render(mi.load_file(CORNELL, resx=16, resy=16), spp=4, seed=9).numpy()
    image = images.colour(*images.read_exr(tmp_path / "a.exr")[:2])
    np.testing.assert_allclose(image, expected, rtol=1e-5)


def test_default_output_is_beside_the_scene(tmp_path):
    scene = tmp_path / "box.xml"
    scene.write_text(Path(CORNELL).read_text())
    assert run(scene, *TINY, "-D", "spp=1") == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["box.exr", "box.xml"]


@pytest.mark.parametrize("exposure", [[], ["--exposure", "1.5"]])
def test_png_file_is_tone_mapped(tmp_path, exposure):
    assert run(CORNELL, *TINY, "-o", tmp_path / "a.png", "--spp", 16, *exposure) == 0
    pixels = np.array(mi.Bitmap(str(tmp_path / "a.png")))
    assert pixels.shape == (16, 16, 3) and pixels.dtype == np.uint8
    assert 40 < pixels.mean() < 230


def test_integrator_is_replaced_and_its_channels_are_kept(tmp_path):
    output = tmp_path / "a.exr"
    parameters = ["-i", "vpl", "-p", "vpl_count=300", "-p", "aovs=shadow_rays", "-D", "max_depth=3"]
    assert run(CORNELL, *TINY, "-o", output, "--spp", 1, *parameters) == 0
    image, channels, metadata = images.read_exr(output)
    assert channels == ["B", "G", "R", "shadow_rays"]
    assert image[..., 3].max() > 0
    assert json.loads(metadata["parameters"])["max_depth"] == 3


def scene_with(tmp_path, integrator, more=""):
    """A scene file of a lit sphere with that integrator (XML)."""
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>'
        '<integer name="height" value="8"/></film></sensor><emitter type="constant"/><shape type="sphere">'
        f'<transform name="to_world"><translate z="9"/></transform>{more}</shape>{integrator}</scene>'
    )
    return path


DEEP = '<integer name="max_depth" value="7"/><integer name="rr_depth" value="3"/>'
HIDDEN = '<boolean name="hide_emitters" value="true"/>'


@pytest.mark.parametrize(
    ("integrator", "arguments", "name", "parameters", "replaced"),
    [
        (f'<integrator type="path">{DEEP}{HIDDEN}</integrator>', [], "manylights",
         {"max_depth": 7, "rr_depth": 3, "hide_emitters": True}, "path"),
        (f'<integrator type="volpath">{DEEP}</integrator>', [], "manylights", {"max_depth": 7, "rr_depth": 3},
         "volpath"),
        ("", [], "manylights", {}, None),
        ("", ["-p", "virtual_lights=false"], "manylights", {"virtual_lights": False}, None),
        # Another image is wanted, or one of ours
        ('<integrator type="direct"/>', [], "direct", {}, None),
        ('<integrator type="vpl"><integer name="vpl_count" value="50"/></integrator>', [], "vpl", {"vpl_count": 50},
         None),
        # It was asked for
        (f'<integrator type="path">{DEEP}</integrator>', ["-i", "scene", "-p", "max_depth=4"], "path",
         {"max_depth": 4, "rr_depth": 3}, None),
        (f'<integrator type="volpath">{DEEP}</integrator>', ["-i", "path"], "path", {"max_depth": 7, "rr_depth": 3},
         None),
        (f'<integrator type="direct">{HIDDEN}</integrator>', ["-i", "manylights"], "manylights",
         {"hide_emitters": True}, None),
    ],
)  # fmt: skip
def test_manylights_renders_what_path_would(tmp_path, capsys, integrator, arguments, name, parameters, replaced):
    output = tmp_path / "a.exr"
    assert run(scene_with(tmp_path, integrator), *arguments, "-o", output, "--spp", 1) == 0
    metadata = images.read_exr(output)[2]
    assert (metadata["integrator"], json.loads(metadata["parameters"])) == (name, parameters)
    assert metadata["replaced"] == (replaced or "null")
    assert ("in place of" in capsys.readouterr().out) == (replaced is not None)


def test_a_medium_keeps_the_scenes_integrator(tmp_path):
    fog = '<bsdf type="null"/><medium name="interior" type="homogeneous"/>'
    scene = scene_with(tmp_path, '<integrator type="volpath"/>', fog)
    assert run(scene, "-o", tmp_path / "a.exr", "--spp", 1) == 0
    assert images.read_exr(tmp_path / "a.exr")[2]["integrator"] == "volpath"


def test_a_medium_is_refused_before_the_first_pass(tmp_path, capfd):
    scene = scene_with(tmp_path, "", '<bsdf type="null"/><medium name="interior" type="homogeneous"/>')
    assert run(scene, "-i", "manylights", "-o", tmp_path / "a.exr") == 1
    said = capfd.readouterr()
    assert said.err.startswith("manylights: shape 0") and "bounds a participating medium" in said.err and not said.out


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", *stress("scalar_rgb")])
def test_a_variant_without_manylights_is_refused_and_may_render_the_scenes_integrator(tmp_path, variant):
    arguments = scene_with(tmp_path, '<integrator type="path"/>'), "-o", tmp_path / "a.exr", "--spp", 1, "-m", variant
    with process(*arguments) as refused:
        said = refused.communicate(timeout=PATIENCE)[1]
    assert refused.returncode == 1 and f'"manylights" does not support the variant "{variant}"' in said
    assert "llvm_ad_rgb, llvm_ad_mono" in said and "llvm_rgb" not in said and "such as path" in said
    with process(*arguments, "-i", "scene") as asked_for:
        assert asked_for.wait(PATIENCE) == 0, asked_for.stderr.read()
    assert images.read_exr(tmp_path / "a.exr")[2]["integrator"] == "path"


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="this machine has a GPU")
def test_a_variant_without_its_gpu_says_what_to_do(tmp_path):
    with process(CORNELL, "-o", tmp_path / "a.exr", "-m", "cuda_ad_rgb") as refused:
        said = refused.communicate(timeout=PATIENCE)[1]
    assert refused.returncode == 2 and len(said.splitlines()) == 1
    assert "the variant 'cuda_ad_rgb' needs an NVIDIA GPU and its driver" in said and "llvm_ad_rgb" in said


def test_the_command_says_what_ended_it_and_which_error_was_reached(tmp_path, capfd):
    common = [CORNELL, *TINY, "-i", "path", "-o", tmp_path / "a.exr", "--error", "0.0001"]
    assert run(*common, "--time", "1e-6") == 0
    said = "".join(capfd.readouterr())
    assert "error unknown (one pass), ended by time" in said and "The error of 0.01% was not reached" in said
    assert run(*common, "--spp", "8", "--pass-spp", "4") == 0
    error = images.read_exr(tmp_path / "a.exr")[2]["estimated_error"]
    said = "".join(capfd.readouterr())
    assert f"error {error:.2%}, ended by spp" in said and "The error of 0.01% was not reached" in said


def test_log_says_what_replaced_what(tmp_path):
    with process(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 1, "-v") as verbose:
        said = "".join(verbose.communicate(timeout=PATIENCE))
    assert verbose.returncode == 0
    assert "The integrator is manylights in place of path; -i scene would keep the scene's." in said


def test_exr_file_says_what_was_chosen(tmp_path):
    """Samples are enough for virtual lights to pay."""
    output = tmp_path / "a.exr"
    assert run(CORNELL, "-D", "resx=96", "-D", "resy=96", "-o", output, "--spp", 64, "--pass-spp", 64) == 0
    found = json.loads(images.read_exr(output)[2]["statistics"])
    assert "of the variance" in found["plan"]
    assert found["light_paths"] > 0 and found["shadow_rays"] > 0 and found["seconds"]["cuts"] > 0


def test_mono_variant(tmp_path):
    with process(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 1, "-m", "llvm_ad_mono") as mono:
        assert mono.wait(PATIENCE) == 0, mono.stderr.read()
    assert images.read_exr(tmp_path / "a.exr")[1] == ["Y"]


def test_single_thread_does_not_hang(tmp_path):
    with process(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 1, "-t", 1) as single:
        assert single.wait(PATIENCE) == 0, single.stderr.read()
    assert (tmp_path / "a.exr").is_file()


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["nosuch.xml"], 2, "no scene file 'nosuch.xml'"),
        ([CORNELL, "-m", "bogus"], 2, "unknown variant 'bogus'; there are"),
        ([CORNELL, "-D", "bogus"], 2, "'bogus' is not of the form key=value"),
        ([CORNELL, "-D", "bogus=1"], 1, "$bogus=1"),
        ([CORNELL, "-i", "nosuch"], 2, "unknown integrator 'nosuch'; there are manylights, vpl"),
        ([CORNELL, "-i", "path", "-p", "bogus=1"], 1, '"bogus"'),
        ([CORNELL, "-p", "bogus=1"], 1, 'manylights: unknown property "bogus"'),
        ([CORNELL, "-o", "nosuch/a.exr"], 2, "for the output"),
        ([CORNELL, "-o", "a.jpg"], 2, "must be an .exr or a .png"),
        ([CORNELL, "--sensor", "1"], 2, "no sensor 1: the scene has 1"),
        ([CORNELL, "--error", "0"], 2, "'0' is not a positive number"),
        ([CORNELL, "--time", "-1"], 2, "'-1' is not a positive number"),
        ([CORNELL, "--time", "nan"], 2, "'nan' is not a positive number"),
        ([CORNELL, "--spp", "0"], 2, "'0' is not a positive whole number"),
        ([CORNELL, "--seed", "-1"], 2, "'-1' is not a whole number"),
        (["SENSORLESS"], 1, "no sensor"),
        (["NO_INTEGRATOR", "-i", "scene"], 2, "has no integrator"),
        (["BROKEN"], 1, "Parsing of XML file"),
    ],
)
def test_errors_are_one_line(tmp_path, monkeypatch, capsys, arguments, status, message):
    monkeypatch.chdir(tmp_path)
    for name, content in (
        ("SENSORLESS", '<shape type="sphere"/></scene>'),
        ("NO_INTEGRATOR", '<sensor type="perspective"/></scene>'),
        ("BROKEN", '<sensor type="perspective">'),
    ):
        (tmp_path / name).write_text(f'<scene version="3.0.0">{content}')
    assert run(*arguments) == status
    written = capsys.readouterr()
    assert message in written.err and "Traceback" not in written.err
    assert written.out == ""
    assert not list(tmp_path.glob("*.exr"))


def test_a_folder_that_refuses_files_is_told_before_the_render(tmp_path, monkeypatch, capsys):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(command_line.tempfile, "TemporaryFile", refuse)
    monkeypatch.setattr(one_image, "render", None)
    assert run(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 1) == 2
    assert f"cannot write to the folder '{tmp_path}': Permission denied" in capsys.readouterr().err


def test_message_of_an_integrator_is_not_hidden(tmp_path, capsys):
    class Failing(mi.SamplingIntegrator):
        def sample(self, *_):
            raise ValueError("too many lights to count")

        def to_string(self):
            return "Failing"

    mi.register_integrator("failing", Failing)
    assert run(CORNELL, *TINY, "-i", "failing", "-o", tmp_path / "a.exr") in (1, 2)
    assert "too many lights to count" in capsys.readouterr().err


@pytest.fixture
def interruptible():
    """Install the default handler of Ctrl-C, since a script that runs tests in the background ignores the signal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("interruptions", "passes"), [([3], 2), ([3, 3], 2), ([1], 0)])
def test_interruption_writes_what_is_there(tmp_path, monkeypatch, capsys, interruptible, interruptions, passes):
    """Ctrl-C comes during the pass of that number, once or twice."""
    calls, original = [], mi.render

    def render(*arguments, **keywords):
        calls.append(1)
        for _ in range(interruptions.count(len(calls))):
            signal.raise_signal(signal.SIGINT)
        return original(*arguments, **keywords)

    monkeypatch.setattr(mi, "render", render)
    assert run(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 1000, "--pass-spp", 4) == 130
    said = capsys.readouterr().err
    assert "Traceback" not in said
    if passes:
        assert f"interrupted; wrote {4 * passes} samples per pixel" in said
        assert images.read_exr(tmp_path / "a.exr")[2]["spp"] == 4 * passes
    else:
        assert "nothing was written" in said and not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_image_ends_by_itself(tmp_path, capsys):
    output = tmp_path / "a.exr"
    assert run(CORNELL, *TINY, "-o", output, "--error", "0.3", "--time", "1000") == 0
    metadata = images.read_exr(output)[2]
    assert metadata["ended_by"] == "error" and 0 < metadata["estimated_error"] <= 0.3 and metadata["passes"] >= 8
    assert f"error {metadata['estimated_error']:.2%}" in capsys.readouterr().out
    assert run(CORNELL, *TINY, "-o", output, "--time", "1e-6") == 0
    # The earlier file contributes nothing
    metadata = images.read_exr(output)[2]
    assert (metadata["ended_by"], metadata["passes"], metadata["spp"]) == ("time", 1, 4)


def test_image_is_written_while_it_is_rendered(tmp_path, monkeypatch):
    output, found, original = tmp_path / "a.exr", [], mi.render

    def render(*arguments, **keywords):
        found.append(images.read_exr(output)[2]["spp"] if output.exists() else 0)
        return original(*arguments, **keywords)

    monkeypatch.setattr(mi, "render", render)
    monkeypatch.setattr(one_image, "WRITE_SECONDS", 0.0)
    assert run(CORNELL, *TINY, "-o", output, "--spp", 8, "--pass-spp", 2) == 0
    assert found == [0, 2, 4, 6]
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize(("passes", "disk"), [(0, "free"), (3, "free"), (3, "full")])
def test_interruption_does_not_wait_for_a_pass(tmp_path, passes, disk):
    """The integrator handles no signal while it renders."""
    output = tmp_path / "a.exr"
    script = f"""
import sys, time
import mitsuba as mi
from comparison import images, interruption
import manylights
def full(path, *_):
    raise OSError(28, "No space left on device", str(path))
if {disk == "full"}:
    images.write_exr = full
interruption.PATIENCE = 0.1
render, calls = mi.render, []
def slow(*arguments, **keywords):
    calls.append(1)
    if len(calls) == {passes + 1}:
        print("waiting", flush=True)
        time.sleep(600)
    return render(*arguments, **keywords)
mi.render = slow
sys.exit(manylights.main({[CORNELL, *TINY, "-o", str(output), "--spp", "100", "--pass-spp", "2"]!r}))
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as rendering:
        assert rendering.stdout.readline() == "waiting\n"
        rendering.send_signal(signal.SIGINT)
        _, said = rendering.communicate(timeout=PATIENCE)
    if disk == "full":
        assert rendering.returncode == 1 and f"No space left on device: '{output}'" in said
        return
    assert rendering.returncode == 130
    assert ("wrote 6 samples per pixel" if passes else "nothing was written") in said
    assert [images.read_exr(file)[2]["spp"] for file in tmp_path.iterdir()] == ([6] if passes else [])


def test_interruption_reaches_a_process(tmp_path):
    with process(CORNELL, *TINY, "-o", tmp_path / "a.exr", "--spp", 10**9, "--pass-spp", 1, "-v") as rendering:
        assert any("The integrator is manylights" in line for line in iter(rendering.stdout.readline, ""))
        rendering.send_signal(signal.SIGINT)
        _, said = rendering.communicate(timeout=PATIENCE)
    assert rendering.returncode == 130 and "interrupted" in said, said
    assert all(file.name == "a.exr" for file in tmp_path.iterdir())


@pytest.mark.parametrize(
    ("scenes", "moment"),
    [("one", "__init__"), ("one", "render"), ("one", "sample"), ("two", "sample"),
     *stress(("two", "__init__"), ("two", "render"))],
)  # fmt: skip
def test_interruption_within_the_integrator(tmp_path, scenes, moment):
    """Mitsuba replaces KeyboardInterrupt while it loads a scene, and after a second Ctrl-C in a pass."""
    output = tmp_path / "a.exr" if scenes == "one" else tmp_path
    more = ["-v"] if scenes == "one" else [str(ROOT / "scenes" / "glossy.xml")]
    script = f"""
import signal, sys
import mitsuba as mi
import manylights
mi.set_variant({mi.variant()!r})
from comparison.scene_files import SceneFile
from integrators.gathering import GatheringIntegrator
load, method = SceneFile.load, GatheringIntegrator.{moment}
def interrupted(*given, **named):
    signal.raise_signal(signal.SIGINT)
    return method(*given, **named)
def begin(*given):
    GatheringIntegrator.{moment} = interrupted
    return load(*given)
SceneFile.load = begin
sys.exit(manylights.main({[CORNELL, *more, *TINY, "-o", str(output), "--spp", "4"]!r}))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    said = "interrupted before the first pass was finished; nothing was written"
    assert done.returncode == 130 and done.stderr.count(said) == 1, done.stderr
    assert not list(tmp_path.iterdir())


def raising(error, cause=None, cleaning=None):
    """Return a function that raises an error, with a cause, or `cleaning` in the clean-up after the error."""

    def run():
        try:
            raise error from cause
        finally:
            if cleaning:
                raise cleaning

    return run


@pytest.mark.parametrize(
    ("run", "status"),
    [
        (raising(KeyboardInterrupt()), 130),
        (raising(RuntimeError("while loading: Traceback: KeyboardInterrupt: ")), 130),
        (raising(RuntimeError("custom operation"), KeyboardInterrupt()), 130),
        (raising(RuntimeError("custom operation"), ValueError()), 1),
        (raising(KeyboardInterrupt(), cleaning=OSError(28, "No space left")), 1),
    ],
    ids=["itself", "in a message", "as a cause", "another cause", "an error in the clean-up"],
)
def test_status_after_an_interruption(run, status, capsys):
    assert command_line.exit_status("name", run, lambda: "all is well", False) == status
    assert ("interrupted; all is well" in capsys.readouterr().err) == (status == 130)
