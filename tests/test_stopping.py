"""Integrators that are cancelled while they render: they do not go on to the end."""

import mitsuba as mi
import numpy as np
import pytest

from vpl.cuts import light_cuts
from vpl.transport import evaluation

from .conftest import area_light, closed_box, render


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
