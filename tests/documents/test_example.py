"""Code of the documentation runs as printed: the first image of docs/start.md, and the method of docs/adding.md, whose
mean is the sum of all lights."""

import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from integrators.knobs import knobs_of
from tests.support.marks import stress
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE

SETTINGS = {"max_depth": 4, "vpl_count": 500}


def printed(page):
    """The first code in Python of a page of docs/."""
    found, *_ = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)
    return found


@pytest.fixture(scope="module")
def code():
    found = printed("adding.md")
    exec(compile(found, "adding.md", "exec"), {"__name__": "adding"})
    return found


def rendered(scene, name, **more):
    """The mean over four seeds, by the integrator of a name."""
    plugin = mi.load_dict({"type": name, **SETTINGS, **more})
    return np.mean([np.array(mi.render(scene, integrator=plugin, seed=seed, spp=4)) for seed in range(4)], axis=0)


@pytest.mark.stress
def test_the_first_image(tmp_path):
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    (tmp_path / "first.py").write_text(printed("start.md"))
    subprocess.run([sys.executable, "first.py"], cwd=tmp_path, check=True, timeout=PATIENCE)
    assert np.array(mi.Bitmap(str(tmp_path / "hall.png"))).mean() > 20


@pytest.mark.parametrize("name", ["cornell", *stress("hall")])
def test_the_mean_is_that_of_all_lights(code, name):
    scene = mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), resx="32", resy="24")
    found, expected = rendered(scene, "randomlights", samples=32), rendered(scene, "vpl")
    assert found.mean() == pytest.approx(expected.mean(), rel=0.01)
    # Noise of single pixels, which falls with the samples
    few = rendered(scene, "randomlights", samples=2)
    assert 0 < np.abs(found - expected).mean() < 0.5 * np.abs(few - expected).mean()


def test_the_example_is_short_and_has_what_plugins_have(code):
    assert len([line for line in code.splitlines() if line.strip()]) <= 40
    plugin = mi.load_dict({"type": "randomlights", "samples": 3})
    assert "samples" in {knob.name for knob in knobs_of(type(plugin))} and "samples = 3" in str(plugin)
    with pytest.raises(RuntimeError, match='property "samples" must be an integer of at least 1, got 0'):
        mi.load_dict({"type": "randomlights", "samples": 0})
