"""What a sweep writes, and the page in a browser."""

import base64
import json
import re
import xml.etree.ElementTree
import zlib
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import compare
from comparison import analysis, baseline, images, page_images, report, strip
from comparison.command_line import UsageError

from . import chromium

ROOT = Path(__file__).resolve().parent.parent
CORNELL = str(ROOT / "scenes" / "cornell.xml")
SCHEMA = json.loads((ROOT / "comparison" / "results.schema.json").read_text())
SWEEP = [
    CORNELL, "-i", "path,lightcuts,vpl", "--width", "24", "--max-depth", "3", "--sweep", "path:spp=1,8", "--sweep",
    "lightcuts:error=0.4,0.1", "--sweep", "vpl:vpl_count=2000", "-p", "lightcuts.vpl_count=2000", "--seeds", "2",
    "--reference", "path:auto:0.9", "--spp", "1",
]  # fmt: skip


@pytest.fixture(scope="module")
def swept(tmp_path_factory, variant):
    """The folder of a sweep."""
    out = tmp_path_factory.mktemp("sweep")
    assert compare.main([*SWEEP, "-o", str(out), "--cache", str(out / "cache")]) == 0
    return out


def results_of(out):
    results = json.loads((out / "results.json").read_text())
    jsonschema.validate(results, SCHEMA, jsonschema.Draft202012Validator)
    return results


# --- results.json ---


def test_sweep_has_points_with_intervals(swept):
    results = results_of(swept)
    (scene,) = results["scenes"]
    assert (results["seeds"], results["complete"], len(scene["renders"])) == ([0, 1], True, 10)
    points = {(point["label"], point["setting"]): point for point in scene["points"] if point["cost"] == "seconds"}
    assert list(points) == [
        ("path", "spp=1"), ("lightcuts", "error=0.4"), ("vpl", "vpl_count=2000"), ("path", "spp=8"),
        ("lightcuts", "error=0.1"),
    ]  # fmt: skip
    assert points["path", "spp=8"]["error"]["mean"] < 0.3 * points["path", "spp=1"]["error"]["mean"]
    for point in points.values():
        assert point["seeds"] == [0, 1] and point["error"]["low"] < point["error"]["mean"] < point["error"]["high"]
    assert {point["label"] for point in scene["points"] if point["cost"] == "rays"} == {"lightcuts", "vpl"}
    assert any(point["pareto"] for point in scene["points"])
    lightcuts, every = (points[key] for key in (("lightcuts", "error=0.1"), ("vpl", "vpl_count=2000")))
    assert lightcuts["error"]["mean"] == pytest.approx(every["error"]["mean"], rel=0.3)


def test_runs_share_lights_and_say_how_they_were_made(swept):
    renders = results_of(swept)["scenes"][0]["renders"]
    assert [render["seed"] for render in renders] == [0] * 5 + [1] * 5
    lights = {
        (render["seed"], json.dumps(render["statistics"]["lights"])) for render in renders if render["label"] != "path"
    }
    assert len(lights) == 2  # a set of lights a seed
    # An empty kernel cache is found once by each label.
    assert [render["label"] for render in renders if render["cold_seconds"] is not None] == ["path", "lightcuts", "vpl"]
    assert all(render["load_average"] >= 0 and 0 <= render["errors"]["flip"] <= 1 for render in renders)
    for render in renders:
        assert images.read_exr_metadata(render["output"])["run"] == render["run"]
    assert len({render["run"] for render in renders}) == 10


def test_automatic_reference_is_good_enough(swept):
    (scene,) = results_of(swept)["scenes"]
    shares = [
        np.sqrt(render["errors"]["noise"]["relmse_trimmed"] / render["errors"]["relmse_trimmed"])
        for render in scene["renders"]
    ]
    assert scene["reference_share"] == pytest.approx(max(shares)) and max(shares) <= 0.9
    assert scene["reference"]["spp"] >= 64


def test_automatic_reference_is_continued_up_to_its_limit(tmp_path, swept, capsys):
    few = [CORNELL, "-i", "path", "--width", "24", "--max-depth", "3", "--spp", "128", "-o", str(tmp_path)]
    status = compare.main([*few, "-r", "path:auto:0.01", "--reference-limit", "100", "--cache", str(tmp_path)])
    assert status == 0
    scene = results_of(tmp_path)["scenes"][0]
    assert scene["reference"]["spp"] == 100 and scene["reference_share"] > 0.01
    assert "stopped at --reference-limit" in capsys.readouterr().out


# --- The page's images ---


def unpack(packed):
    """What viewer.js does."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), np.uint8)
    shape = (packed["depth"], packed["channels"], packed["height"], packed["width"])
    planes = planes.reshape(shape).astype(np.uint16)
    differences = planes[0] + (planes[1] << 8 if packed["depth"] == 2 else 0)
    codes = np.cumsum(differences, axis=2, dtype=np.uint16) & (0xFFFF if packed["depth"] == 2 else 0xFF)
    return np.moveaxis(codes, 0, -1)


def test_colours_survive_their_encoding_over_thirty_stops():
    rgb = 2.0 ** np.random.default_rng(0).uniform(-14, 15.9, (40, 50, 3))
    half = (unpack(page_images.colours(rgb, 1.0)) << page_images.BITS_LEFT_OUT).view(np.float16)
    np.testing.assert_allclose(half.astype(float), rgb, rtol=2**-7)
    hostile = np.array([[[np.nan, np.inf, -1], [1e30, 65503, 0]]])
    half = (unpack(page_images.colours(hostile, 1.0)) << page_images.BITS_LEFT_OUT).view(np.float16)
    assert np.all(np.isfinite(half)) and half[0, 0].tolist() == [0, 0, 0] and half[0, 1, 0] > 65000


def test_planes_survive_their_encoding():
    values = np.random.default_rng(0).random((30, 20))
    np.testing.assert_allclose(unpack(page_images.plane(values))[..., 0] / 255, values, atol=0.5 / 255 + 1e-9)
    assert unpack(page_images.plane(np.array([[np.nan, -1, 2, 0.5]])))[..., 0].tolist() == [[255, 0, 255, 128]]


def test_large_images_are_shown_by_means_of_blocks(monkeypatch):
    image = np.random.default_rng(0).random((7, 5, 3))
    assert page_images.reduce(image) is image
    monkeypatch.setattr(page_images, "LARGEST", 10)
    assert page_images.block_size(7, 5) == 2
    small = page_images.reduce(image)
    assert small.shape == (4, 3, 3)
    np.testing.assert_allclose(small[1, 1], image[2:4, 2:4].mean(axis=(0, 1)))
    np.testing.assert_allclose(small[3, 2], image[6, 4])


# --- The page ---


def test_page_needs_nothing_else(swept):
    page = (swept / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)[^"']*""", page)
    assert not re.findall(r"@import|url\((?!#|data:)", page)
    assert len(page) < 1_000_000
    figures = re.findall("<figure>(<svg.*?</svg>)", page, flags=re.DOTALL)
    assert len(figures) == 2
    for figure in figures:
        xml.etree.ElementTree.fromstring(figure)
    assert re.findall('"title": "([^"]*)"', page) == [
        "reference", "path spp=1", "path spp=8", "lightcuts error=0.4", "lightcuts error=0.1", "vpl vpl_count=2000",
    ]  # fmt: skip


def test_page_escapes_what_it_is_given(tmp_path, swept):
    results = results_of(swept)
    results["command"] = "compare.py </script><script>alert(1)</script>"
    report.write(tmp_path, results, [None])
    assert "alert(1)</script>" not in (tmp_path / "report.html").read_text()


@pytest.fixture(scope="module")
def page(swept, tmp_path_factory):
    executable = chromium.find()
    if executable is None:
        pytest.skip("there is no Chromium on this machine (Debian's package: chromium)")
    with chromium.Chromium(executable, tmp_path_factory.mktemp("profile")) as browser:
        browser.open(swept / "report.html")
        browser.wait("document.querySelector('.stage').dataset.painted")
        yield browser
        assert browser.failures == []


def pixel(page, canvas, x, y):
    """The colour (RGB) of a pixel of a canvas."""
    code = f"[...document.querySelector('{canvas}').getContext('2d').getImageData({x}, {y}, 1, 1).data].slice(0, 3)"
    return page.value(code)


def choose(page, selector, value):
    """Choose as a person would, and wait until it is painted."""
    before = page.value("document.querySelector('.stage').dataset.painted")
    page.value(
        f"(() => {{ const e = document.querySelector('{selector}'); e.value = '{value}'; "
        "for (const type of ['input', 'change']) e.dispatchEvent(new Event(type)); })()"
    )
    page.wait(f"document.querySelector('.stage').dataset.painted > {before}")


def shown(page):
    """The names in the corners, and where the cut between the pictures is, as a share of the stage."""
    names = page.value("['left', 'right'].map((side) => document.querySelector(`.badge.${side}`).textContent)")
    cut = page.value(
        "parseFloat(document.querySelector('.over').style.clipPath.match(/([0-9.]+)px\\)/)[1]) / "
        "document.querySelector('.over').width"
    )
    return names, cut


def test_pictures_are_those_of_the_files(page, swept):
    import mitsuba as mi

    choose(page, ".a", 1)
    choose(page, ".b", 0)
    for canvas, name in ((".under", "path.spp=1"), (".over", "reference")):
        expected = np.array(mi.Bitmap(str(swept / f"cornell.{name}.png"))).astype(int)
        for x, y in ((3, 4), (12, 8), (20, 20)):
            np.testing.assert_allclose(pixel(page, canvas, x, y), expected[y, x], atol=2)


def test_exposure_works_on_the_linear_values(page, swept):
    import mitsuba as mi

    exposure = results_of(swept)["scenes"][0]["pictures"]["exposure"]
    choose(page, ".a", 1)
    choose(page, ".exposure", -7)
    image = images.colour(*images.read_exr(swept / "cornell.path.spp=1.seed0.exr")[:2])
    expected = images.tone_map(image, exposure / 2**7).astype(int)
    lamp = np.unravel_index(image.sum(axis=-1).argmax(), image.shape[:2])
    for y, x in ((8, 12), lamp):
        np.testing.assert_allclose(pixel(page, ".under", x, y), expected[y, x], atol=2)
    clipped = np.array(mi.Bitmap(str(swept / "cornell.path.spp=1.png")))[lamp]
    assert clipped.max() == 255 > expected[lamp].min()
    choose(page, ".exposure", 0)


def test_errors_are_shown(page, swept):
    import mitsuba as mi

    choose(page, ".a", 1)
    choose(page, ".kind", "relative")
    expected = np.array(mi.Bitmap(str(swept / "cornell.path.spp=1.error.png"))).astype(int)
    for x, y in ((3, 4), (12, 8), (20, 20)):
        np.testing.assert_allclose(pixel(page, ".under", x, y), expected[y, x], atol=4)
    for kind in ("distance", "flip"):
        choose(page, ".kind", kind)
        assert shown(page)[0][0] == f"path spp=1: {kind}"
    choose(page, ".kind", "image")


def test_the_split_is_dragged(page):
    page.click(".split")
    (x, y), width = page.centre(".handle"), page.value("document.querySelector('.stage').clientWidth")
    assert shown(page)[1] == pytest.approx(0.5, abs=0.02)
    page.drag(x, y, x + 0.3 * width, y)
    assert shown(page)[1] == pytest.approx(0.8, abs=0.02)
    page.drag(*page.centre(".handle"), x - 2 * width, y)
    assert shown(page)[1] == 0
    page.drag(*page.centre(".handle"), x, y)
    page.press("ArrowRight")
    assert shown(page)[1] == pytest.approx(0.52, abs=0.02)


def test_a_click_flips(page):
    choose(page, ".a", 1)
    choose(page, ".b", 0)
    page.click(".flip")
    assert shown(page) == (["", "reference"], 0)
    page.click(".flip")
    assert shown(page) == (["path spp=1", ""], 1)
    page.click(".under")
    page.press(" ")
    assert shown(page) == (["", "reference"], 0)
    page.click(".split")
    assert shown(page)[0] == ["path spp=1", "reference"]


def test_the_wheel_zooms_and_pictures_move(page):
    transform = "document.querySelector('.under').style.transform"
    x, y = page.centre(".stage")
    page.click(".fit")
    before = page.value(transform)
    page.wheel(x - 60, y, -100)
    page.wait(f"{transform} !== {json.dumps(before)}")
    zoomed = page.value(transform)
    page.drag(x - 60, y, x - 80, y)
    assert page.value(transform) != zoomed
    page.click(".fit")
    assert page.value(transform) == before


# --- Strips ---


def test_strip_of_pictures(swept, tmp_path, capsys):
    output = tmp_path / "strip.png"
    assert strip.main([str(swept), "--output", str(output)]) == 0
    assert "made by: compare.py" in capsys.readouterr().out
    pixels = images.read_png(output)
    assert pixels.shape == (24 + 45, 11 * 28 - 4, 3)  # five settings, the reference, five errors
    expected = images.read_png(swept / "cornell.path.spp=1.png")
    np.testing.assert_array_equal(pixels[:24, :24], expected)
    assert pixels[24:].min() < 128  # captions


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--scene", "nosuch"], "there are cornell"), (["--output", "/no/folder.png"], "no folder")],
)
def test_strip_refuses(swept, tmp_path, capsys, arguments, message):
    given = arguments if "--output" in arguments else [*arguments, "--output", str(tmp_path / "a.png")]
    assert strip.main([str(swept), *given]) == 2
    assert message in capsys.readouterr().err


def test_strip_needs_a_comparison(tmp_path, capsys):
    assert strip.main([str(tmp_path), "--output", str(tmp_path / "a.png")]) == 2
    assert "no results.json in" in capsys.readouterr().err


# --- --check ---


def fake_results(speed_up):
    """Results of two integrators whose errors are inverse to their time, the second of them so many times faster."""
    renders = [
        {
            "label": label, "setting": f"spp={spp}", "seed": 0, "seconds": spp / factor, "rays_per_sample": None,
            "spp": spp, "errors": {"relmse": 1 / spp, "noise": {"relmse": 0}},
        }
        for label, factor in (("path", 1.0), ("fast", speed_up)) for spp in (1, 4, 16)
    ]  # fmt: skip
    scene = {"name": "box", "renders": renders}
    scene |= analysis.analyse(renders, ["path", "fast"], "relmse")
    return {"metrics": {"compared": "relmse"}, "scenes": [scene]}


def test_check_finds_speed_ups_that_fell():
    before = fake_results(5)
    assert baseline.check(fake_results(4.2), before, 0.2) == []
    lines = baseline.check(fake_results(3.5), before, 0.2)
    assert len(lines) == 4 and lines[0].startswith(
        "box: fast over path, seconds at error 0.1: 5× before, 3.5× now, 30%"
    )
    assert baseline.check(fake_results(3.5), before, 0.5) == []


def test_check_finds_errors_that_are_no_longer_reached():
    now = fake_results(5)
    now["scenes"][0]["renders"] = [one for one in now["scenes"][0]["renders"] if one["label"] != "fast"]
    assert all(line.endswith("not reached now") for line in baseline.check(now, fake_results(5), 0.2))


def test_check_refuses_what_cannot_be_compared(tmp_path):
    now, before = fake_results(5), fake_results(5)
    before["scenes"][0]["name"] = "other"
    with pytest.raises(UsageError, match="none of these scenes"):
        baseline.check(now, before, 0.2)
    before["metrics"]["compared"] = "rmse"
    with pytest.raises(UsageError, match="errors are rmse, not relmse"):
        baseline.check(now, before, 0.2)
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(UsageError, match="no speed-ups"):
        baseline.read(tmp_path / "a.json")


def test_check_sets_the_exit_status(swept, tmp_path, capsys, monkeypatch):
    """With everything finished, nothing is rendered again."""
    monkeypatch.setattr("comparison.worker.run", lambda *_: pytest.fail("rendered again"))
    results = results_of(swept)
    entry = {"value": 1, "at_most": None, "low": None, "high": None, "speed_up": 1e9}
    results["scenes"][0]["equal_errors"]["rays"] = [{"error": 0.05, "costs": {"lightcuts": entry, "vpl": entry}}]
    (tmp_path / "baseline.json").write_text(json.dumps(results))
    again = [*SWEEP, "-o", str(swept), "--cache", str(swept / "cache"), "--resume", "--check"]
    assert compare.main([*again, str(tmp_path / "baseline.json")]) == 3
    assert "vpl over lightcuts, rays at error 0.05: 1e+09× before" in capsys.readouterr().err
