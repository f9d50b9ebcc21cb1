"""The documentation site: built without warnings, with a page for every plugin, and complete without a network."""

import html
import re
import subprocess
import sys
import tomllib

import mitsuba as mi
import pytest

import integrators
from integrators.knobs import knobs_of
from tests.support import chromium
from tests.support.chromium import Chromium
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE

MOST_BYTES = 2_000_000
WIDTHS = (420, 1600)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", "--fresh-env"]
    done = subprocess.run(
        [*command, "-c", "docs", "-d", str(folder / "read"), ".", str(folder / "built")],
        cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return folder / "built"


def text(page):
    """What is written on a page."""
    return html.unescape(re.sub(r"<[^>]*>", "", page.read_text()))


@pytest.mark.parametrize("name", integrators.PLUGINS)
def test_every_plugin_has_a_page_with_all_of_its_properties(site, name):
    page = site / "docs" / "plugins" / f"{name}.html"
    table = re.search(r'<table class="[^"]*paramstable.*?</table>', page.read_text(), re.DOTALL)[0]
    rows = re.findall(r'paramname[^>]*"><span class="pre">(\w+)', table)
    assert rows == [knob.name for knob in knobs_of(type(mi.load_dict({"type": name})))]
    assert "|int|" not in text(page) and "{" not in table
    description = page.read_text().partition("</h1>")[2].partition("<table")[0]
    assert description.count("<p>") == 1, "the table comes after the first paragraph"


def test_links_to_plugins_lead_to_their_pages(site):
    for page in ("README.html", "docs/choosing.html"):
        linked = set(re.findall(r'href="[\w./]*plugins/(\w+)\.html"', (site / page).read_text()))
        assert linked >= set(integrators.PLUGINS)


def test_links_to_code_show_it(site):
    linked = set(re.findall(r'href="code/([\w.]+)\.html"', (site / "docs" / "reading.html").read_text()))
    assert {"integrators.lightcuts", "vpl.cuts.light_cuts"} <= linked
    assert "def shade(self, job" in text(site / "docs" / "code" / "integrators.lightcuts.html")
    assert not list(site.glob("_downloads/*/*.py"))


def test_the_sidebar_has_every_page(site):
    front = (site / "docs" / "index.html").read_text()
    sidebar = re.search(r'<div class="sidebar-tree">.*?</aside>', front, re.DOTALL)[0]
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} - {"index"}
    assert set(re.findall(r'href="(\w+)\.html"', sidebar)) == pages
    assert "url=docs/index.html" in (site / "index.html").read_text().replace(" ", "")


def test_every_page_shows_the_version_of_the_package(site):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    for page in ("README", "docs/start", "docs/plugins/vpl"):
        assert f'<span class="sidebar-brand-text">Manylights {version}</span>' in (site / f"{page}.html").read_text()


def test_lines_of_links_for_single_files_are_left_out(site):
    assert "README · " not in text(site / "docs" / "results.html")


def test_the_gallery_shows_every_scene_and_pictures_are_small():
    scenes = {path.stem for path in (ROOT / "scenes").glob("*.xml")}
    shown = re.findall(
        r"\(gallery/(\w+)\.(path|manylights|reference)\.jpg\)", (ROOT / "docs" / "gallery.md").read_text()
    )
    assert len(shown) == 3 * len(scenes) and {name for name, _ in shown} == scenes
    folders = (ROOT / "docs" / "gallery", ROOT / "docs" / "figures")
    assert sum(file.stat().st_size for folder in folders for file in folder.iterdir()) < MOST_BYTES


@pytest.fixture(scope="module")
def browser(site, tmp_path_factory):
    executable = chromium.find()
    if executable is None:
        pytest.skip("there is no Chromium")
    with Chromium(executable, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.mark.parametrize("width", WIDTHS)
def test_pages_fit_and_ask_nothing_of_the_network(site, browser, width):
    browser.look(width, 1000)
    for name in ("index", "gallery", "methods", "adding", "plugins/manylights", "plugins/lightcuts"):
        browser.open(site / "docs" / f"{name}.html")
        assert browser.value("document.documentElement.scrollWidth") <= width, name
        assert browser.value("[...document.images].every((image) => image.complete && image.naturalWidth > 0)"), name
    assert browser.failures == []


def test_the_gallery_compares_pictures(site, browser):
    browser.look(1600, 1500)  # nothing has to be scrolled to
    browser.open(site / "docs" / "gallery.html")
    assert browser.value("document.querySelectorAll('.compared').length") == len(list((ROOT / "scenes").glob("*.xml")))
    x, y = browser.centre(".compared .stage")
    width = browser.value("document.querySelector('.compared .stage').getBoundingClientRect().width")
    browser.drag(x, y, x + width / 4, y)
    assert browser.value("parseFloat(document.querySelector('.compared input').value)") == pytest.approx(75, abs=2)
    over = "document.querySelector('.compared img.over')"
    assert "path" in browser.value(f"{over}.alt")
    browser.click(".compared button:last-child")
    assert "manylights" in browser.value(f"{over}.alt")
