"""Suspension of the garbage collector: another thread must not free a scene while Mitsuba records or renders."""

import gc
import weakref

import mitsuba as mi
import pytest

import manylights
from comparison import features
from comparison.checkpoint import Checkpoint
from comparison.scene_files import SceneFile
from tests.support.distributed_renders import TINY
from tests.support.paths import CORNELL
from vpl.core.garbage import garbage_kept


@pytest.fixture
def observed():
    """Records whether the collector is on during renders by the integrator `observer`."""
    seen = []

    class Observer(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            seen.append(gc.isenabled())
            return mi.Spectrum(0.5), active, []

    mi.register_integrator("observer", Observer)
    yield seen
    assert gc.isenabled()


@pytest.fixture
def scene():
    return SceneFile(CORNELL, TINY).load()


def test_the_collector_is_off_in_a_block_and_as_before_afterwards():
    assert gc.isenabled()
    with garbage_kept():
        with garbage_kept():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with garbage_kept():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_the_collector_is_on_again_after_an_error():
    with pytest.raises(ZeroDivisionError), garbage_kept():
        raise ZeroDivisionError
    assert gc.isenabled()


def test_the_collector_is_off_in_passes_of_any_integrator(scene, observed):
    manylights.render(scene, mi.load_dict({"type": "observer"}), spp=2, pass_spp=1)
    assert observed == [False, False]


def test_the_collector_is_off_while_features_are_rendered(scene, observed, monkeypatch):
    monkeypatch.setattr(features, "_feature_integrator", lambda _: mi.load_dict({"type": "observer"}))
    with pytest.raises(ValueError, match="is not in list"):
        features.auxiliary_features(scene, scene.sensors()[0], 0, 1)
    assert observed == [False]


@pytest.mark.parametrize("name", ["manylights", "lightcuts"])
def test_the_collector_is_off_in_renders_of_our_integrators(name, scene, monkeypatch):
    integrator, seen = mi.load_dict({"type": name}), []
    original = type(integrator)._render

    def render(self, *arguments):
        seen.append(gc.isenabled())
        return original(self, *arguments)

    monkeypatch.setattr(type(integrator), "_render", render)
    mi.render(scene, integrator=integrator, spp=1)
    assert seen and not any(seen) and gc.isenabled()


def test_renders_leave_no_scene_to_the_collector(scene, tmp_path):
    """A scene in a reference cycle would be freed by the collector, in any thread and at any time."""
    integrator = mi.load_dict({"type": "path"})
    with garbage_kept():
        checkpoint = Checkpoint(tmp_path / "a.checkpoint.npz", {})
        manylights.render(scene, integrator, spp=4, pass_spp=2, progress=lambda *_: False, checkpoint=checkpoint)
        dead = weakref.ref(checkpoint)
        del checkpoint
        assert dead() is None
