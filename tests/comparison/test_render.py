"""`manylights.render`: conditions that end a render, and results."""

import itertools
import re
import signal
import subprocess
import sys
import threading
import traceback
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import convergence, rendering, single_pass
from comparison import render as render_module
from tests.support.paths import CORNELL, ROOT
from tests.support.rendering import render_with_statistics
from tests.support.scenes import area_light, closed_box, cornell, sensor


@pytest.fixture
def scene():
    return cornell().load()


def clock(monkeypatch, seconds):
    """Replace the clock by a clock that advances by some seconds at each call."""
    ticks = itertools.count()
    monkeypatch.setattr(render_module.clock, "perf_counter", lambda: next(ticks) * seconds)


def test_a_render_of_one_pass_is_mitsubas(scene):
    image, took = manylights.render(scene, spp=4, seed=7)
    assert isinstance(image, mi.TensorXf) and image.shape == (16, 16, 3)
    np.testing.assert_allclose(image.numpy(), mi.render(scene, spp=4, seed=7).numpy(), rtol=1e-5)
    assert (took.spp, took.passes, took.ended_by, took.error) == (4, 1, "spp", None)
    assert took.channels == ["R", "G", "B"] and took.raw is None and took.seconds > 0


def test_the_image_is_the_average_of_its_passes(scene):
    image, took = manylights.render(scene, spp=10, pass_spp=4, seed=3)
    assert (took.spp, took.passes) == (10, 3)
    parts = [
        spp * mi.render(scene, spp=spp, seed=single_pass.pass_seed(3, k)).numpy() for k, spp in enumerate((4, 4, 2))
    ]
    np.testing.assert_allclose(image.numpy(), sum(parts) / 10, rtol=1e-5)
    assert took.error > 0


def test_passes_of_manylights_are_rendered_in_parts(scene):
    plugins = (mi.load_dict({"type": name}) for name in ("manylights", "lightcuts", "path"))
    assert [rendering.Progressive(scene, 0, integrator=plugin).in_parts for plugin in plugins] == [True, False, False]


def test_passes_of_integrators_that_clone_the_sampler_have_the_samples_that_were_asked_for(scene):
    image, took = manylights.render(scene, "prb", spp=5, pass_spp=4, seed=3)
    assert (took.spp, took.passes) == (5, 2)
    prb = mi.load_dict({"type": "prb"})
    parts = [
        spp * mi.render(scene, integrator=prb, spp=spp, seed=single_pass.pass_seed(3, k)).numpy()
        for k, spp in enumerate((4, 1))
    ]
    np.testing.assert_allclose(image.numpy(), sum(parts) / 5, rtol=1e-5)


@pytest.mark.parametrize("integrator", ["path", "prb"])
def test_samples_that_strata_round_up_are_counted(integrator):
    box = closed_box({"lamp": area_light()}) | {"sensor": sensor(8, sampler={"type": "stratified"})}
    scene = mi.load_dict(box)
    assert manylights.render(scene, integrator, spp=5, pass_spp=5)[1].spp == 9


def test_a_render_leaves_the_scenes_samples_as_they_were(scene):
    wanted = scene.sensors()[0].sampler().sample_count()
    manylights.render(scene, spp=3)
    assert manylights.render(scene)[1].spp == wanted


def test_later_passes_compile_nothing(scene):
    compiled = []

    def progress(took, image):
        compiled.append(sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history()))

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        _, took = manylights.render(scene, spp=400, progress=progress)
    assert len(compiled) == took.passes > 2
    assert sum(compiled[1:]) == 0


def test_threads_other_than_the_main_one_render_too(scene):
    found = []
    thread = threading.Thread(target=lambda: found.append(manylights.render(scene, spp=4)[1].spp))
    thread.start()
    thread.join()
    assert found == [4]


def test_without_limits_the_samples_are_the_scenes(scene):
    wanted = scene.sensors()[0].sampler().sample_count()
    assert manylights.render(scene)[1].spp == wanted


def test_integrators_are_given_by_name_or_as_they_are(scene):
    image, took = manylights.render(scene, "direct", spp=4)
    np.testing.assert_allclose(image.numpy(), manylights.render(scene, mi.load_dict({"type": "direct"}), spp=4)[0])
    assert took.statistics == {}
    plugin = {"vpl_count": 200, "max_depth": 3}
    image, took = manylights.render(scene, mi.load_dict({"type": "vpl", **plugin}), spp=8, pass_spp=4)
    counted = [
        render_with_statistics("vpl", scene, 4, single_pass.pass_seed(0, k), **plugin)[1]["shadow_rays"] for k in (0, 1)
    ]
    assert took.statistics["shadow_rays"] == sum(counted)


def test_a_render_ends_by_its_error(scene):
    _, took = manylights.render(scene, error=0.2, spp=10**6)
    assert took.ended_by == "error" and 0.1 < took.error <= 0.2
    assert took.passes >= convergence.LEAST_PASSES
    more = manylights.render(scene, error=0.05)[1]
    assert 6 < more.spp / took.spp < 40  # four times less error is sixteen times the samples


def test_the_error_is_the_distance_from_the_converged_image():
    scene = cornell(max_depth="2").load()
    exact = manylights.render(scene, spp=1 << 13, seed=100)[0].numpy().mean(-1)
    scale = np.sqrt(exact**2 + (0.1 * exact.mean()) ** 2)
    runs = [manylights.render(scene, error=0.1, seed=seed) for seed in range(8)]
    errors = np.array([(image.numpy().mean(-1) - exact) / scale for image, _ in runs])
    truth = np.percentile(np.sqrt(np.square(errors).mean(0)), 95)
    # The percentile of a deviation that is itself known from eight runs is a little too high
    assert truth < 1.35 * np.mean([took.error for _, took in runs])
    assert (np.abs(errors) < 0.2).mean() > 0.95


def test_a_render_ends_between_passes_when_its_time_is_over(scene, monkeypatch):
    clock(monkeypatch, 1.0)
    told = []
    _, took = manylights.render(scene, time=20, progress=lambda took, image: told.append(took.seconds))
    assert took.ended_by == "time" and took.passes == len(told) > 2
    assert told[-2] < 20


def test_there_is_one_pass_however_short_the_time(scene):
    _, took = manylights.render(scene, time=1e-9, spp=100)
    assert took.passes == 1 and took.ended_by == "time"


def test_an_error_that_looks_like_a_percentage_is_doubted(scene, capfd):
    manylights.render(scene, error=2.0, spp=1)
    assert "error is a fraction, 2 means 200%; 2% would be 0.02" in "".join(capfd.readouterr())


@pytest.mark.parametrize(("limits", "ended_by"), [({"spp": 8}, "spp"), ({"spp": 10**6}, "error")])
def test_whatever_is_reached_first_ends_a_render(scene, limits, ended_by):
    assert manylights.render(scene, error=0.3, time=1000, **limits)[1].ended_by == ended_by


def test_progress_is_told_after_each_pass_and_may_end_the_render(scene):
    told = []

    def progress(took, image):
        told.append((took.spp, took.passes, took.ended_by, image.shape))
        return len(told) < 3

    _, took = manylights.render(scene, spp=100, pass_spp=2, progress=progress)
    assert told == [(2 * k, k, None, (16, 16, 3)) for k in (1, 2, 3)]
    assert took.ended_by == "progress" and took.spp == 6


def after(monkeypatch, passes, action):
    """Do something at the end of `mi.render` number `passes`."""
    original, calls = mi.render, []

    def render(*arguments, **keywords):
        image = original(*arguments, **keywords)
        calls.append(1)
        if len(calls) == passes:
            action()
        return image

    monkeypatch.setattr(mi, "render", render)


def test_a_cancelled_pass_is_left_out(scene, monkeypatch):
    expected = manylights.render(scene, spp=4, pass_spp=2)[0].numpy()
    after(monkeypatch, 3, scene.integrator().cancel)
    image, took = manylights.render(scene, spp=100, pass_spp=2)
    assert took.ended_by == "interruption" and took.spp == 4
    np.testing.assert_allclose(image.numpy(), expected, rtol=1e-6)
    # The next render does not remember it
    assert manylights.render(scene, spp=4, pass_spp=2)[1].ended_by == "spp"


def test_a_render_that_is_cancelled_at_once_has_no_image(scene, monkeypatch):
    after(monkeypatch, 1, scene.integrator().cancel)
    with pytest.raises(RuntimeError, match="cancelled before the first pass"):
        manylights.render(scene, spp=100)


@pytest.mark.parametrize("passes", [1, 3])
def test_ctrl_c_returns_what_is_finished(scene, monkeypatch, passes):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        after(monkeypatch, passes, lambda: signal.raise_signal(signal.SIGINT))
        if passes == 1:
            with pytest.raises(KeyboardInterrupt):
                manylights.render(scene, spp=100, pass_spp=2)
        else:
            took = manylights.render(scene, spp=100, pass_spp=2)[1]
            assert took.ended_by == "interruption" and took.spp == 4
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"error": 0}, "error must be a positive number, got 0"),
        ({"error": float("nan")}, "error must be a positive number, got nan"),
        ({"time": -1.0}, "time must be a positive number, got -1.0"),
        ({"time": float("inf")}, "time must be"),
        ({"spp": 0}, "spp must be a positive whole number, got 0"),
        ({"spp": 2.5}, "spp must be a positive whole number, got 2.5"),
        ({"pass_spp": "4"}, "pass_spp must be a positive whole number, got '4'"),
        ({"sensor": 1}, "sensor must be from 0 to 0, got 1"),
    ],
)
def test_bad_values_are_refused(scene, arguments, message):
    with pytest.raises(ValueError, match=message):
        manylights.render(scene, **arguments)


def test_limits_may_be_numbers_of_numpy(scene):
    _, took = manylights.render(scene, "path", spp=np.int16(4), time=np.float32(100), sensor=np.int32(0))
    assert took.spp == 4


@pytest.mark.parametrize(("limits", "ended_by"), [({"time": 1e-9}, "time"), ({"spp": 16}, "spp")])
def test_an_error_that_is_not_reached_is_a_warning(scene, capfd, limits, ended_by):
    _, took = manylights.render(scene, "path", error=1e-4, pass_spp=1, **limits)
    said = "".join(capfd.readouterr())
    found = "an unknown error, as there is one pass" if took.error is None else f"an error of {took.error:.2%}"
    assert took.ended_by == ended_by and (took.error is None) == (ended_by == "time")
    assert f"The error of 0.01% was not reached: {ended_by} ended the render at {found}." in said


def test_an_error_that_is_reached_is_no_warning(scene, capfd):
    assert manylights.render(scene, "path", error=0.5)[1].ended_by == "error"
    assert manylights.render(scene, "path", error=0.9, spp=64, pass_spp=16)[1].ended_by == "spp"
    assert "was not reached" not in "".join(capfd.readouterr())


def test_a_scene_may_be_a_path(scene, tmp_path):
    expected = manylights.render(mi.load_file(CORNELL), spp=1, seed=2)[0].numpy()
    for path in (CORNELL, Path(CORNELL)):
        np.testing.assert_allclose(manylights.render(path, spp=1, seed=2)[0].numpy(), expected, rtol=1e-5)
    with pytest.raises(FileNotFoundError, match=r"no scene file 'nosuch\.xml'"):
        manylights.render("nosuch.xml")
    with pytest.raises(TypeError, match=r"scene must be a mi\.Scene or the path of a scene file, got 3"):
        manylights.render(3)


def test_a_render_without_a_variant_is_told_to_set_one():
    code = "import manylights; manylights.render('scenes/cornell.xml')"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert 'RuntimeError: no variant is set: call mi.set_variant("llvm_ad_rgb")' in found.stderr


FOG = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}


@pytest.mark.parametrize("name", ["manylights", "lightcuts", "adaptivedirect"])
def test_a_participating_medium_is_refused_by_name(name):
    scene = mi.load_dict(closed_box({"lamp": area_light(), "fog": FOG}, 8))
    reason = r'\("fog", Sphere\) bounds a participating medium; many-light integrators support surfaces only'
    with pytest.raises(ValueError, match=reason):
        manylights.render(scene, name, spp=1)
    with pytest.raises(RuntimeError) as error:
        mi.render(scene, integrator=mi.load_dict({"type": name}), spp=1)
    assert re.search(reason, "".join(traceback.format_exception(error.value)))


@pytest.mark.parametrize("name", ["manylights", "lightcuts"])
@pytest.mark.stress  # Dr.Jit may abort the process when an error ends a recording
def test_frozen_functions_are_refused_by_name(scene, name):
    plugin = mi.load_dict({"type": name})

    @dr.freeze
    def frozen(scene, seed):
        return mi.render(scene, integrator=plugin, spp=1, seed=seed)

    with pytest.raises(RuntimeError) as error:
        frozen(scene, mi.UInt32(0))
    said = "".join(traceback.format_exception(error.value))
    assert f"{type(plugin).__name__} cannot be recorded by dr.freeze" in said
    assert mi.render(scene, integrator=plugin, spp=1).shape == (16, 16, 3)


def test_a_scene_without_an_integrator_needs_one():
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}})
    with pytest.raises(ValueError, match="no integrator"):
        manylights.render(scene, spp=1)
