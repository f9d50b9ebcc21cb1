"""Suspension of the garbage collector: another thread must not free a scene while Mitsuba records or renders."""

import gc
import weakref

import mitsuba as mi
import pytest

import manylights
from comparison import features, one_image
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
    monkeypatch.setattr(features, "_feature_integrator", lambda *_: mi.load_dict({"type": "observer"}))
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


def test_the_collector_is_off_while_a_scene_is_created(tmp_path, observed):
    """A plugin in Python records the state of the collector when Mitsuba creates it."""

    class Watcher(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            observed.append(gc.isenabled())

    mi.register_integrator("watcher", Watcher)
    (tmp_path / "a.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"/><integrator type="watcher"/></scene>'
    )
    SceneFile(tmp_path / "a.xml").load()
    assert observed and not any(observed)


@pytest.mark.parametrize("way", ["render_forward", "render_backward"])
def test_the_collector_is_off_while_derivatives_are_rendered(way, scene, monkeypatch):
    seen, prb = [], type(mi.load_dict({"type": "prb"}))
    monkeypatch.setattr(prb, way, lambda *_: seen.append(gc.isenabled()) or mi.TensorXf([0.0]))
    arguments = (
        (scene, mi.traverse(scene)) if way == "render_forward" else (scene, mi.traverse(scene), mi.TensorXf([0.0]))
    )
    getattr(mi.load_dict({"type": "manylights"}), way)(*arguments)
    assert seen == [False] and gc.isenabled()


def test_files_of_images_are_in_no_cycle(tmp_path):
    with garbage_kept():
        output = one_image.Output(tmp_path / "a.exr")
        dead = weakref.ref(output)
        del output
        assert dead() is None


def test_renders_leave_no_scene_to_the_collector(scene, tmp_path):
    """A scene in a reference cycle would be freed by the collector, in any thread and at any time."""
    integrator = mi.load_dict({"type": "path"})
    with garbage_kept():
        checkpoint = Checkpoint(tmp_path / "a.checkpoint.npz", {})
        manylights.render(scene, integrator, spp=4, pass_spp=2, progress=lambda *_: False, checkpoint=checkpoint)
        dead = weakref.ref(checkpoint)
        del checkpoint
        assert dead() is None
