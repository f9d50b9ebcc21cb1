"""Many renders in one process, and processes killed at any time."""

import gc
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import PLUGINS, plugin
from tests.support.paths import ROOT
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box


def resident() -> int:
    """Memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.stress
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
@pytest.mark.parametrize("name", PLUGINS)
def test_memory_does_not_grow_over_200_renders(name):
    """Of scenes loaded anew each time; the first renders compile kernels and fill caches."""

    def once(seed):
        scene = mi.load_dict(closed_box({"lamp": area_light()}, 32))
        render(scene, mi.load_dict(plugin(name, max_depth=3)), 4, seed)

    for seed in range(40):
        once(seed)
    gc.collect()
    before = resident()
    for seed in range(40, 240):
        once(seed)
    gc.collect()
    assert resident() - before < 40 << 20


@pytest.mark.stress
def test_a_killed_render_leaves_a_whole_file_or_none(tmp_path):
    """The command is killed after a random time, again and again, over a file that is there already."""
    output = tmp_path / "image.exr"
    size = ["-D", "resx=64", "-D", "resy=64"]
    command = [sys.executable, str(ROOT / "manylights.py"), str(ROOT / "scenes" / "cornell.xml"), "-o", str(output)]
    command += ["--integrator", "lightcuts", "--spp", "4", *size]
    draw = random.Random(1)
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    whole = time.perf_counter() - start
    expected = np.array(mi.Bitmap(str(output)))
    for _ in range(10):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(draw.uniform(0.2, 1.05) * whole)
        process.kill()
        process.wait()
        assert np.allclose(np.array(mi.Bitmap(str(output))), expected, rtol=1e-3, atol=1e-3)
