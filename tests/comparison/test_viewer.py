"""What the viewer of the report's page does in a browser, on a page of two scenes that nothing was rendered for."""

import re

import numpy as np
import pytest

from comparison import images, metrics, report, verdict
from comparison.pictures import REFERENCE, Pictures
from tests.support import chromium

SIZE = 32
SCENES = ("hall", "garden")


def pictures_of(folder, name, seed):
    """Integrator "bright" is too bright by a tenth in the left half, "noisy" has noise of both signs."""
    rng = np.random.default_rng(seed)
    reference = 0.5 + rng.random((SIZE, SIZE, 3))
    bright = reference * np.where(np.arange(SIZE) < SIZE // 2, 1.1, 1.0)[None, :, None]
    noisy = reference * rng.uniform(0.5, 1.5, (SIZE, SIZE, 1))
    found = Pictures(folder, name)
    found.show(REFERENCE, None, REFERENCE, f"{name}.reference.exr", reference)
    for title, image, error in (("noisy", noisy, "0.08"), ("bright", bright, "0.005")):
        flip = metrics.flip(image, reference)[0]
        found.show(title, title, title, f"{name}.{title}.exr", image, reference, flip, error)
    return found, reference, bright


@pytest.fixture(scope="module")
def report_page(tmp_path_factory):
    """Its folder, and the reference and the bright image of the first scene."""
    folder = tmp_path_factory.mktemp("page")
    made = [pictures_of(folder, name, seed) for seed, name in enumerate(SCENES)]
    scenes = [{"name": name, "renders": [], "reference": {"noise": None}} for name in SCENES]
    results = {
        "command": "compare.py", "complete": True, "created": "now", "seeds": [0], "variant": "v", "versions": {},
        "machine": {"processor": "p", "cores": 2, "memory_bytes": 1, "system": "s"}, "metrics": {"compared": "relmse"},
        "summary": verdict.summarise(scenes, "relmse"), "scenes": scenes,
    }  # fmt: skip
    report.write(folder, results, [pictures for pictures, *_ in made])
    return folder, made[0][1], made[0][2]


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    executable = chromium.find()
    if executable is None:
        pytest.skip("there is no Chromium on this machine (Debian's package: chromium)")
    with chromium.Chromium(executable, tmp_path_factory.mktemp("profile")) as found:
        yield found
        assert found.failures == []


def load(browser, folder, width=1200, height=1000, dark=False):
    browser.look(width, height, dark)
    browser.open(folder / "report.html")
    browser.wait("[...document.querySelectorAll('.stage')].every((stage) => stage.dataset.painted)")
    return browser


@pytest.fixture
def page(browser, report_page):
    yield load(browser, report_page[0])
    browser.run_scripts(True)


def texts(page, selector, within=0):
    """The texts of what a selector finds in a viewer."""
    code = (
        f"[...document.querySelectorAll('.viewer')[{within}].querySelectorAll('{selector}')].map((e) => e.textContent)"
    )
    return page.value(code)


def place(page, x, y):
    """The place in the window of a pixel of the first scene's pictures, where nothing is zoomed."""
    page.centre(".stage")
    left, top, width = page.value(
        "(() => { const b = document.querySelector('.stage').getBoundingClientRect(); return [b.x, b.y, b.width]; })()"
    )
    return left + (x + 0.5) * width / SIZE, top + (y + 0.5) * width / SIZE


def test_badges_have_the_errors(page):
    assert texts(page, ".badge b") == ["noisy", "bright"]
    assert texts(page, ".badge span") == ["0.08", "0.005"]


def test_values_are_shown_under_the_pointer(page, report_page):
    _, reference, bright = report_page
    chromium.choose(page, ".a", 0)
    chromium.choose(page, ".kind", "signed")
    page.move(*place(page, 3, 5))
    page.wait("/^x 3, y 5/.test(document.querySelector('.readout').textContent)")
    text = texts(page, ".readout")[0]
    shown = re.fullmatch(r"x 3, y 5: reference ([\d. ]+) \| bright ([\d. ]+) \((.*)\)", text)
    for group, image in ((1, reference), (2, bright)):
        np.testing.assert_allclose([float(word) for word in shown[group].split()], image[5, 3], rtol=0.06)
    assert shown[3] == "+9.9%" or shown[3] == "+10%"
    page.move(5, 5)
    page.wait("/^Drag/.test(document.querySelector('.readout').textContent)")


def test_numbers_choose_pictures(page):
    page.press("1")
    wait_for_badges(page, "reference", "")
    page.press("3")
    wait_for_badges(page, "bright", "")
    page.press("2", shift=True)
    wait_for_badges(page, "bright", "noisy")
    page.press("9")
    assert texts(page, ".badge b") == ["bright", "noisy"]


def test_arrows_go_through_scenes_and_keep_what_is_shown(page):
    chromium.choose(page, ".kind", "relative")
    page.press("1")
    wait_for_badges(page, "reference", "")
    page.click(".stage")
    page.press("ArrowRight")
    focused = "document.activeElement.closest('.viewer')?.dataset.scene"
    assert page.value(focused) == "garden"
    page.wait("document.querySelectorAll('.badge.left b')[1].textContent === 'reference'")
    assert page.value("document.querySelectorAll('.kind')[1].value") == "relative"
    page.press("ArrowRight")
    assert page.value(focused) == "garden"
    page.press("ArrowLeft")
    assert page.value(focused) == "hall"


def test_the_page_scrolls_over_pictures(page):
    transform = "document.querySelector('.under').style.transform"
    x, y = page.centre(".stage")
    before, top = page.value(transform), page.value("window.scrollY")
    page.wheel(x, y, 100)
    page.wait(f"window.scrollY > {top}")
    assert page.value(transform) == before
    assert "Ctrl" in texts(page, ".readout")[0]
    assert page.value("getComputedStyle(document.querySelector('.stage')).touchAction") == "pan-x pan-y"


def wait_for_badges(page, *names):
    found = "[...document.querySelector('.viewer').querySelectorAll('.badge b')].map((e) => e.textContent).join('|')"
    page.wait(f"{found} === '{'|'.join(names)}'")


def average(page, index):
    """The mean colour of a tile of the first scene."""
    return page.value(
        f"(() => {{ const c = document.querySelectorAll('.tiles canvas')[{index}], sum = [0, 0, 0]; "
        "const data = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; "
        "data.forEach((value, i) => { if (i % 4 < 3) sum[i % 4] += (4 * value) / data.length; }); return sum; })()"
    )


def test_signed_errors_show_bias(page):
    chromium.choose(page, ".kind", "signed")
    chromium.choose(page, ".exposure", 2)
    page.click("button.all")
    page.wait("document.querySelector('.tiles').dataset.drawn")
    red, _, blue = average(page, 2)
    assert red - blue > 20
    assert texts(page, ".bar output") == ["+25%", "0", "−25%"]


def test_exposure_acts_on_errors_or_is_hidden(page):
    hidden = "document.querySelector('.of-exposure').hidden"
    chromium.choose(page, ".kind", "relative")
    assert texts(page, ".bar output") == ["100%", "", "1%"] and not page.value(hidden)
    colour = "[...document.querySelector('.over').getContext('2d').getImageData(3, 4, 1, 1).data].slice(0, 3)"
    page.press("3")
    chromium.choose(page, ".exposure", 0)
    before = page.value(colour)
    np.testing.assert_allclose(before, images.palette(np.array(np.log(0.1 / 0.01) / np.log(100))), atol=12)
    chromium.choose(page, ".exposure", 2)
    assert sum(page.value(colour)) > sum(before) + 100
    assert texts(page, ".bar output") == ["25%", "", "0.25%"]
    chromium.choose(page, ".kind", "flip")
    assert page.value(hidden) and texts(page, ".bar output") == ["1", "", "0"]
    chromium.choose(page, ".kind", "image")
    assert page.value("document.querySelector('.bar').hidden")


def test_the_bar_is_as_high_as_the_picture(page):
    chromium.choose(page, ".kind", "relative")
    heights = page.value("['.stage', '.bar'].map((name) => document.querySelector(name).offsetHeight)")
    assert heights[0] == heights[1] > 200


def test_an_inset_is_seen_of_all(page):
    page.click("button.inset")
    page.drag(*place(page, 2, 4), *place(page, 9, 11))
    page.wait("/here/.test(document.querySelectorAll('.tiles figcaption')[2].textContent)")
    assert texts(page, ".tiles .here") == ["", texts(page, ".tiles .here")[1], "here 10%"]
    page.wait(
        "[...document.querySelector('.tiles').querySelectorAll('canvas')].every("
        "({width, height}) => width > 100 && Math.abs(width - height) <= 1)"
    )
    frame = page.value("(() => { const f = document.querySelector('.frame'); return [f.offsetWidth, f.hidden]; })()")
    assert frame[0] == pytest.approx(8 * page.value("document.querySelector('.stage').offsetWidth") / SIZE, abs=2)
    page.click("button.inset")
    assert page.value("document.querySelector('.frame').hidden")
    assert texts(page, ".tiles .here") == ["", "", ""]


def test_all_pictures_are_in_step(page):
    drawn = "Number(document.querySelector('.tiles').dataset.drawn)"
    page.click("button.all")
    page.wait(f"{drawn} > 0")
    before = average(page, 0)
    for _ in range(6):
        page.click("button.in")
    steps = page.value(drawn)
    x, y = page.centre(".stage")
    page.drag(x, y, x + 300, y + 300)
    page.wait(f"{drawn} > {steps}")
    assert average(page, 0) != before
    page.click(".tiles canvas")
    wait_for_badges(page, "reference", "")


def test_a_viewer_fills_the_screen(page):
    page.click("button.full")
    page.wait("document.querySelector('.viewer').getBoundingClientRect().height === window.innerHeight")
    page.press("a")
    bottom = "document.querySelector('.tiles').getBoundingClientRect().bottom"
    page.wait(f"document.querySelector('.tiles').dataset.drawn && {bottom} < window.innerHeight")
    page.press("ArrowRight")
    assert page.value("document.querySelector('.viewer.full').dataset.scene") == "garden"
    page.press("f")
    assert page.value("document.querySelector('.viewer.full')") is None


def test_images_are_linked(page):
    links = page.value("[...document.querySelectorAll('.tiles a')].map((a) => a.getAttribute('href'))")
    assert links[:3] == ["hall.reference.exr", "hall.noisy.exr", "hall.bright.exr"]


@pytest.mark.parametrize("width", [420, 1600])
@pytest.mark.parametrize("dark", [False, True])
def test_page_fits_windows_and_tastes(browser, report_page, width, dark):
    page = load(browser, report_page[0], width, 900, dark)
    page.click("button.all")
    assert page.value("document.documentElement.scrollWidth") == width
    for selector in (".stage", ".controls", ".tiles", "nav"):
        left, right = page.value(
            f"(() => {{ const b = document.querySelector('{selector}').getBoundingClientRect(); "
            "return [b.left, b.right]; })()"
        )
        assert left >= 0 and right <= width, selector
    red, *_ = page.value("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert red < 60 if dark else red == 255


def test_scenes_are_listed_wherever_one_is(page):
    page.value("window.scrollTo(0, document.body.scrollHeight)")
    assert page.value("document.querySelector('nav').getBoundingClientRect().top") == 0
    page.click("nav a")
    page.wait("Math.abs(document.querySelector('#scene-hall').getBoundingClientRect().top) < 80")


def test_pictures_are_there_without_scripts(page, report_page):
    page.run_scripts(False)
    page.look(1200, 1000)
    page.open(report_page[0] / "report.html")
    shown = "[...document.querySelectorAll('.stills img')].filter((i) => i.offsetWidth > 100 && i.complete).length"
    assert page.value(shown) == 6
    assert page.value("getComputedStyle(document.querySelector('.controls')).display") == "none"
