"""The report's page: its images and its behaviour in a browser."""

import base64
import json
import re
import xml.etree.ElementTree
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import compare
from comparison import images, page_images, report, worker
from comparison import page as page_module
from tests.support import chromium
from tests.support.paths import CORNELL


def results_of(out):
    return json.loads((out / "results.json").read_text())


# --- The page's images ---


def unpack(packed):
    """Image codes as pixels.js unpacks them."""
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


def test_errors_survive_their_encoding():
    errors = np.geomspace(1e-4, 10, 200).reshape(10, 20)
    low, high = page_images.RELATIVE_ENDS
    found = low * (high / low) ** (unpack(page_images.relative(errors))[..., 0] / 255)
    np.testing.assert_allclose(found, errors, rtol=0.025)
    errors = np.linspace(-1, 1, 200).reshape(10, 20)
    roots = (unpack(page_images.signed(errors))[..., 0] - 127.5) / 127.5
    np.testing.assert_allclose(roots * np.abs(roots), errors, atol=0.01)
    assert unpack(page_images.signed(np.array([[-5, np.inf, 0.0]])))[..., 0].tolist() == [[0, 255, 128]]


def test_stills_are_jpeg_files():
    still = page_images.jpeg(np.full((8, 8, 3), 200, np.uint8))
    assert still.startswith("data:image/jpeg;base64,") and base64.b64decode(still.partition(",")[2])[:2] == b"\xff\xd8"


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
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)[^"']*""", page)  # links to EXR files are made by scripts
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


def test_sections_of_finished_scenes_are_made_once(tmp_path, monkeypatch):
    """The page is written after each scene."""
    made, shown = [], page_module._scene
    monkeypatch.setattr(page_module, "_scene", lambda scene, *more: made.append(scene["name"]) or shown(scene, *more))
    failed = {"error": "no renderer", "traceback": "", "load_average": 0.0}
    monkeypatch.setattr(worker, "run", lambda job, tick: asdict(job) | failed)
    for name in ("a.xml", "b.xml"):
        (tmp_path / name).write_text(Path(CORNELL).read_text())
    scenes = [str(tmp_path / name) for name in ("a.xml", "b.xml")]
    assert compare.main([*scenes, "-i", "path", "--spp", "1", "--reference", "vpl", "-o", str(tmp_path)]) == 1
    assert made == ["a", "b"]
    written = (tmp_path / "report.html").read_text()
    assert re.findall(r"<h2>(\w)</h2>", written) == made and written.count("Failed: no renderer") == 2
    results = results_of(tmp_path)
    report.write(tmp_path, results, [None, None])
    assert (tmp_path / "report.html").read_text() == written


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


def shown(page):
    """The names in the corners, and where the cut between the pictures is, as a share of the stage."""
    names = page.value("['left', 'right'].map((side) => document.querySelector(`.badge.${side} b`).textContent)")
    cut = page.value(
        "parseFloat(document.querySelector('.over').style.clipPath.match(/([0-9.]+)px\\)/)[1]) / "
        "document.querySelector('.over').width"
    )
    return names, cut


def test_pictures_are_those_of_the_files(page, swept):
    chromium.choose(page, ".a", 1)
    chromium.choose(page, ".b", 0)
    for canvas, name in ((".under", "path.spp=1"), (".over", "reference")):
        expected = images.read_png(swept / f"cornell.{name}.png").astype(int)
        for x, y in ((3, 4), (12, 8), (20, 20)):
            np.testing.assert_allclose(pixel(page, canvas, x, y), expected[y, x], atol=2)


def test_exposure_works_on_the_linear_values(page, swept):
    exposure = results_of(swept)["scenes"][0]["pictures"]["exposure"]
    chromium.choose(page, ".a", 1)
    chromium.choose(page, ".exposure", -7)
    image = images.colour(*images.read_exr(swept / "cornell.path.spp=1.seed0.exr")[:2])
    expected = images.tone_map(image, exposure / 2**7).astype(int)
    lamp = np.unravel_index(image.sum(axis=-1).argmax(), image.shape[:2])
    for y, x in ((8, 12), lamp):
        np.testing.assert_allclose(pixel(page, ".under", x, y), expected[y, x], atol=2)
    clipped = images.read_png(swept / "cornell.path.spp=1.png")[lamp]
    assert clipped.max() == 255 > expected[lamp].min()
    chromium.choose(page, ".exposure", 0)


def test_errors_are_shown(page, swept):
    chromium.choose(page, ".a", 1)
    chromium.choose(page, ".kind", "relative")
    expected = images.read_png(swept / "cornell.path.spp=1.error.png").astype(int)
    for x, y in ((3, 4), (12, 8), (20, 20)):
        np.testing.assert_allclose(pixel(page, ".under", x, y), expected[y, x], atol=4)
    for kind in ("signed", "distance", "flip"):
        chromium.choose(page, ".kind", kind)
        assert shown(page)[0][0] == f"path spp=1: {kind}"
    chromium.choose(page, ".kind", "image")


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
    chromium.choose(page, ".a", 1)
    chromium.choose(page, ".b", 0)
    page.click(".flip")
    assert shown(page) == (["", "reference"], 0)
    page.click(".flip")
    assert shown(page) == (["path spp=1", ""], 1)
    page.click(".under")
    page.press(" ")
    assert shown(page) == (["", "reference"], 0)
    page.click(".split")
    assert shown(page)[0] == ["path spp=1", "reference"]


def test_the_wheel_zooms_with_control_and_pictures_move(page):
    transform = "document.querySelector('.under').style.transform"
    x, y = page.centre(".stage")
    page.click(".fit")
    before = page.value(transform)
    page.wheel(x - 60, y, -100, control=True)
    page.wait(f"{transform} !== {json.dumps(before)}")
    zoomed = page.value(transform)
    page.drag(x - 60, y, x - 80, y)
    assert page.value(transform) != zoomed
    page.click(".fit")
    assert page.value(transform) == before
