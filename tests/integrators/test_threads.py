"""Two concurrent renders: a shared sensor is refused to the second thread, separate sensors give correct images."""

import threading

import mitsuba as mi
import numpy as np
import pytest

import manylights
from tests.support.marks import stress
from tests.support.processes import PATIENCE
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box

PLUGINS = ["adaptivedirect", "manylights", *stress("vpl")]
REFUSAL = "another thread is rendering with the same "


def box():
    return mi.load_dict(closed_box({"lamp": area_light()}, 8))


class Waiting:
    """A thread with a function that calls ``pause``: the block runs during the pause, and the function ends after the
    block."""

    def __init__(self, function):
        self._reached, self._go_on, self.result = threading.Event(), threading.Event(), None
        self._thread = threading.Thread(target=lambda: setattr(self, "result", function()))

    def pause(self, *_):
        if threading.current_thread() is self._thread:
            self._reached.set()
            assert self._go_on.wait(PATIENCE)

    def __enter__(self):
        self._thread.start()
        assert self._reached.wait(PATIENCE)
        return self

    def __exit__(self, *_):
        self._go_on.set()
        self._thread.join()


def paused(monkeypatch, plugin, function):
    """A thread that waits while a plugin works."""
    waiting, kind = Waiting(function), type(plugin)
    original = kind._sample
    monkeypatch.setattr(kind, "_sample", lambda *given: (waiting.pause(), original(*given))[1])
    return waiting


@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("wrapped", [False, True])
def test_the_second_thread_with_a_sensor_is_refused_and_the_first_goes_on(name, wrapped, monkeypatch, capfd):
    scene, plugin, other = box(), *(mi.load_dict({"type": name}) for _ in range(2))
    if wrapped:
        plugins = [mi.load_dict({"type": "moment", "image": one}) for one in (plugin, other)]
    else:
        plugins = [plugin, other]
    expected = render(scene, plugins[0])
    with paused(monkeypatch, plugin, lambda: render(scene, plugins[0])) as first:
        with pytest.raises(RuntimeError) as error:
            render(scene, plugins[1])
        assert f"{REFUSAL}{'sampler' if wrapped else 'sensor'}: " in str(error.value.__cause__)
    np.testing.assert_allclose(first.result, expected, rtol=1e-4)
    assert REFUSAL in "".join(capfd.readouterr())
    np.testing.assert_allclose(render(scene, plugins[1]), expected, rtol=1e-4)


def test_the_second_thread_with_an_integrator_is_refused(monkeypatch):
    plugin, scenes = mi.load_dict({"type": "adaptivedirect"}), [box(), box()]
    with paused(monkeypatch, plugin, lambda: render(scenes[0], plugin)), pytest.raises(RuntimeError) as error:
        render(scenes[1], plugin)
    assert f"{REFUSAL}integrator: " in str(error.value.__cause__)


@pytest.mark.parametrize("name", PLUGINS)
def test_threads_with_sensors_of_their_own_do_not_meet(name, monkeypatch):
    plugins, scenes = [mi.load_dict({"type": name}) for _ in range(2)], [box(), box()]
    expected = render(scenes[0], plugins[0])
    with paused(monkeypatch, plugins[0], lambda: render(scenes[0], plugins[0])) as first:
        np.testing.assert_allclose(render(scenes[1], plugins[1]), expected, rtol=1e-4)
    np.testing.assert_allclose(first.result, expected, rtol=1e-4)


def test_renders_in_passes_refuse_too_whatever_the_integrator():
    scene = box()
    waiting = Waiting(lambda: manylights.render(scene, "path", spp=4, pass_spp=2, progress=waiting.pause)[1].spp)
    with waiting, pytest.raises(RuntimeError, match=f"{REFUSAL}sensor: "):
        manylights.render(scene, "path", spp=4)
    assert waiting.result == 4
    assert manylights.render(scene, "path", spp=4)[1].spp == 4
