"""Several images by one command: selection and file names."""

from argparse import ArgumentTypeError, Namespace
from pathlib import Path

import mitsuba as mi
import pytest

import manylights
from comparison import batch, images
from comparison.command_line import UsageError
from tests.support.comparisons import TWO_SENSORS
from tests.support.paths import CORNELL


def options(**given):
    usual = {"scenes": [Path("a.xml")], "frames": None, "define": [], "output": None, "sensor": 0}
    return Namespace(**usual | given)


@pytest.mark.parametrize(("text", "found"), [("0..3", [0, 1, 2, 3]), ("7", [7]), ("4,2", [4, 2]), ("5..5", [5])])
def test_frames(text, found):
    assert batch.frames(text) == found


@pytest.mark.parametrize("text", ["", "3..1", "a", "1..", "1,,2", "-1"])
def test_frames_that_are_none(text):
    with pytest.raises(ArgumentTypeError, match="nor numbers separated by commas"):
        batch.frames(text)


def test_images_of_frames():
    found = batch.images(options(frames=[9, 10], define=[("mesh", "m{frame:03}.ply"), ("n", "2")]))
    assert [one.define for one in found] == [[("mesh", f"m{n}.ply"), ("n", "2")] for n in ("009", "010")]
    assert [str(batch.output(one, 0)) for one in found] == ["a.0009.exr", "a.0010.exr"]


def test_constants_with_braces_are_left_alone_without_frames():
    assert batch.images(options(define=[("a", "{b}")]))[0].define == [("a", "{b}")]
    with pytest.raises(UsageError, match=r"-D a: '\{b\}' has other braces"):
        batch.images(options(frames=[1], define=[("a", "{b}")]))


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({}, "a.exr"),
        ({"output": Path("x.png")}, "x.png"),
        ({"output": Path("{x}.png")}, "{x}.png"),
        ({"sensor": "all"}, "a.sensor1.exr"),
        ({"frames": [7], "sensor": "all", "output": Path("{scene}-{frame}-{sensor:02}.exr")}, "a-7-01.exr"),
    ],
)
def test_names_of_outputs(given, name):
    (one,) = batch.images(options(**given))
    assert str(batch.output(one, 1)) == name


@pytest.mark.parametrize(
    ("given", "missing"),
    [
        ({"frames": [1, 2]}, "frame"),
        ({"sensor": "all"}, "sensor"),
        ({"scenes": [Path("a.xml"), Path("b.xml")]}, "scene"),
    ],
)
def test_an_output_for_several_images_is_refused(given, missing):
    with pytest.raises(UsageError, match=rf"would be of several images; put \{{{missing}\}} into it"):
        batch.images(options(output=Path("x.exr"), **given))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"scenes": [Path("a/scene.xml"), Path("b/scene.xml")]}, "both 'a/scene.xml' and 'b/scene.xml'"),
        ({"frames": [3, 4, 3]}, "both 'a.xml', frame 3 and 'a.xml', frame 3"),
    ],
)
def test_a_file_for_two_images_is_refused(tmp_path, given, said):
    with pytest.raises(UsageError, match=f"would be of {said}"):
        batch.images(options(output=tmp_path, **given))
    if "frames" not in given:
        assert len(batch.images(options(**given))) == 2  # each beside its scene


def test_all_sensors(tmp_path):
    scene = tmp_path / "a.xml"
    scene.write_text(TWO_SENSORS)
    assert manylights.main([str(scene), "--sensor", "all", "--spp", "1"]) == 0
    shapes = [images.read_exr(tmp_path / f"a.sensor{index}.exr")[0].shape[:2] for index in (0, 1)]
    assert shapes == [(4, 8), (6, 6)]


def test_all_sensors_in_python(tmp_path):
    (tmp_path / "a.xml").write_text(TWO_SENSORS)
    scene = mi.load_file(str(tmp_path / "a.xml"))
    found = manylights.render(scene, sensor="all", spp=2)
    assert [image.shape[:2] for image, _ in found] == [(4, 8), (6, 6)] and all(took.spp == 2 for _, took in found)
    assert len(manylights.render(scene, sensor="all", spp=2, pass_spp=1, progress=lambda *_: False)) == 1


def test_what_fails_does_not_keep_others_from_being_rendered(tmp_path, capsys):
    tiny = ["-D", "resx=8", "-D", "resy=8", "--spp", "1", "-o", str(tmp_path)]
    assert manylights.main(["nosuch.xml", CORNELL, *tiny]) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["cornell.exr"]
    assert "no scene file 'nosuch.xml'" in capsys.readouterr().err


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("while creating: KeyboardInterrupt: ")])
@pytest.mark.parametrize("complete", [0, 2])
def test_an_interruption_between_images_names_what_is_complete(tmp_path, monkeypatch, capsys, error, complete):
    """Mitsuba replaces an interruption while a plugin is created."""
    parse, parsed = manylights.parse_scene, []

    def interrupted(options):
        if len(parsed) == complete:
            raise error
        parsed.append(1)
        return parse(options)

    monkeypatch.setattr(manylights, "parse_scene", interrupted)
    frames = ["--frames", "1..3", "-D", "resx={frame}", "-D", "resy=4", "--spp", "1", "-o", str(tmp_path)]
    assert manylights.main([CORNELL, *frames]) == 130
    written = sorted(tmp_path.iterdir())
    assert len(written) == complete
    said = f"complete images: 2, the last one {written[-1]}" if complete else "nothing was written"
    assert f"manylights: interrupted; {said}\n" in capsys.readouterr().err


def test_each_of_several_failures_is_told_with_its_traceback_if_that_is_asked_for(capsys):
    assert manylights.main(["nosuch.xml", "nobody.xml", "-v"]) == 1
    said = capsys.readouterr().err
    assert (
        "no scene file 'nosuch.xml'" in said and "no scene file 'nobody.xml'" in said and said.count("Traceback") == 2
    )
