"""Cancelled renders end early.  Ctrl-C."""

import subprocess
import sys
import time

import mitsuba as mi
import numpy as np
import pytest

from integrators import bands
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box
from vpl.cuts import light_cuts
from vpl.transport import evaluation


@pytest.fixture
def scene():
    return mi.load_dict(closed_box({"lamp": area_light()}, size=24))


def create(name):
    return mi.load_dict({"type": name, "vpl_count": 2000, "max_depth": 4})


def small_kernels(monkeypatch):
    monkeypatch.setattr(light_cuts, "_PAIRS_PER_CHUNK", 3000)
    monkeypatch.setattr(evaluation, "_RAYS_PER_KERNEL", 24 * 24 * 4 * 100)


@pytest.mark.parametrize("name", ["vpl", "lightcuts"])
def test_a_render_stops_between_kernels(monkeypatch, scene, name):
    small_kernels(monkeypatch)
    whole, counted = create(name), []
    monkeypatch.setattr(type(whole), "should_stop", lambda self: counted.append(1) and False)
    render(scene, whole)
    assert len(counted) > 8
    plugin, asked = create(name), []
    monkeypatch.setattr(type(plugin), "should_stop", lambda self: asked.append(1) or len(asked) > 4)
    render(scene, plugin)
    assert len(asked) < 8
    assert plugin.statistics["shadow_rays"] < 0.7 * whole.statistics["shadow_rays"]


@pytest.mark.parametrize("name", ["vpl", "lightcuts"])
def test_sizes_of_kernels_do_not_change_the_image(monkeypatch, scene, name):
    expected = render(scene, create(name))
    small_kernels(monkeypatch)
    np.testing.assert_allclose(render(scene, create(name)), expected, rtol=1e-4, atol=1e-6)


def test_bands_have_the_samples_of_a_sampler_that_rounds_up(monkeypatch):
    box = closed_box({"lamp": area_light()}, size=24)
    box["sensor"]["sampler"] = {"type": "stratified"}
    scene, plugin = mi.load_dict(box), mi.load_dict({"type": "adaptivedirect"})
    expected = render(scene, plugin, 9)
    monkeypatch.setattr(bands, "LARGEST_BAND", 24 * 4 * 9)
    np.testing.assert_allclose(render(scene, plugin, 8).mean(), expected.mean(), rtol=0.05)


def test_an_image_in_bands_does_not_stop_because_of_an_earlier_render(monkeypatch, scene):
    plugin = mi.load_dict({"type": "adaptivedirect"})
    expected = render(scene, plugin)
    monkeypatch.setattr(bands, "LARGEST_BAND", 24 * 4 * 8)
    plugin.cancel()
    assert plugin.should_stop()
    np.testing.assert_allclose(render(scene, plugin).mean(), expected.mean(), rtol=0.05)


def test_the_time_of_an_image_in_bands_begins_with_its_render(scene):
    plugin = mi.load_dict({"type": "adaptivedirect", "timeout": 0.5, "aovs": "noise"})
    time.sleep(0.6)
    assert plugin.should_stop()
    plugin._clear_stop(scene)
    assert not plugin.should_stop()


def test_timeout_ends_an_image_in_bands(monkeypatch, scene):
    monkeypatch.setattr(bands, "LARGEST_BAND", 24 * 4 * 8)
    whole, limited = (mi.load_dict({"type": "adaptivedirect", "timeout": seconds}) for seconds in (60.0, 0.01))
    assert render(scene, limited).mean() < 0.9 * render(scene, whole).mean()


@pytest.mark.parametrize("name", ["lightcuts", "manylights"])
def test_below_a_wrapper_nothing_stops_because_of_an_earlier_render(scene, name):
    plugin = mi.load_dict({"type": name, "max_depth": 4})
    wrapper = mi.load_dict({"type": "moment", "nested": plugin})
    expected = render(scene, wrapper)[..., :3].mean()
    plugin.cancel()
    np.testing.assert_allclose(render(scene, wrapper)[..., :3].mean(), expected, rtol=1e-3)


# A separate process, which a stale handler would end
INTERRUPTED = """
import signal
import mitsuba as mi
import manylights

mi.set_variant("llvm_ad_rgb")
mi.set_log_level(mi.LogLevel.Error)
signal.signal(signal.SIGINT, signal.default_int_handler)
camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
scene = {"type": "scene", "camera": camera, "bulb": {"type": "point"}, "ball": {"type": "sphere"}}
scene = mi.load_dict(scene)

def interrupted(work):
    try:
        work()
    except KeyboardInterrupt:
        return True

for name in ("adaptivedirect", "lightcuts", "manylights"):
    plugin = mi.load_dict({"type": name})
    sample = type(plugin)._sample
    type(plugin)._sample = lambda *given: (signal.raise_signal(signal.SIGINT), sample(*given))[1]
    print(name, "during", interrupted(lambda: plugin.render(scene, spp=1)))
    type(plugin)._sample = sample
    plugin.render(scene, spp=1)
    del plugin
    print(name, "after", interrupted(lambda: signal.raise_signal(signal.SIGINT)))
"""


def test_ctrl_c_is_heard_during_and_after_a_render():
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE
    )
    heard = [
        f"{name} {when} True" for name in ("adaptivedirect", "lightcuts", "manylights") for when in ("during", "after")
    ]
    assert done.returncode == 0 and done.stdout.splitlines() == heard, done.stdout + done.stderr
