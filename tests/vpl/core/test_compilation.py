"""The time of compilation: measured apart from the stages of a render, and only on request."""

from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from comparison import single_pass
from comparison.rendering import Progressive
from tests.support.scenes import cornell
from vpl.core.clock import Clock
from vpl.core.compilation import compilation_measured, compiled_since_last, unrecorded
from vpl.core.stages import Stage


def launch(number):
    """Launch a kernel with a constant of its own."""
    value = dr.opaque(mi.Float, 2.0, 100)
    for power in range(50):
        value = dr.sin(value * mi.Float(number + power)) + value
    dr.eval(value)


@pytest.fixture
def number(variant):
    """A constant that no kernel in the cache has."""
    return np.random.default_rng().random()


def test_a_kernel_is_compiled_once(number):
    with compilation_measured() as first:
        launch(number)
    with compilation_measured() as again:
        launch(number)
    assert 0.001 < first.seconds < 10 and again.seconds == 0.0


def test_kernels_of_a_block_without_a_record_do_not_count(number):
    with compilation_measured() as compilation:
        with unrecorded():
            launch(number)
        assert compilation.since_last() == 0.0
        launch(number + 1000)
    assert compilation.seconds > 0.001


def test_a_clock_tells_compilation_apart_from_the_stage(number):
    with compilation_measured() as compilation:
        clock = Clock(Stage.TRACED)
        launch(number)
        clock.begin(Stage.CUTS)
        launch(number)
        clock.stop()
    assert clock.seconds[Stage.COMPILE] == compilation.seconds > 0 and clock.seconds[Stage.TRACED] > 0
    assert list(clock.seconds) == [Stage.TRACED, Stage.COMPILE, Stage.CUTS]
    clock = Clock(Stage.TRACED)
    launch(number + 1)
    clock.stop()
    assert list(clock.seconds) == [Stage.TRACED]


@dr.syntax
def work(steps):
    """Launch a kernel that takes tenths of a second if `steps` suit the device, whatever it computes."""
    value, k = dr.opaque(mi.Float, 0.5, 1 << 22), mi.UInt32(0)
    while k < steps:
        value, k = dr.sin(value), k + 1
    dr.eval(value)


def test_a_stage_that_is_handed_over_ends_before_the_device_does(variant):
    # A GPU does a step in a thousandth of the time
    steps = dr.opaque(mi.UInt32, 200_000 if variant.startswith("cuda") else 200)
    work(steps)
    dr.sync_thread()
    clock = Clock(Stage.RECORDED)
    work(steps)
    clock.hand_over(Stage.TRACED)
    clock.stop()
    assert 3 * clock.seconds[Stage.RECORDED] < clock.seconds[Stage.TRACED]


def test_compilation_is_part_of_the_stage_that_was_handed_over(number):
    with compilation_measured() as compilation:
        clock = Clock(Stage.RECORDED)
        launch(number)
        clock.hand_over(Stage.TRACED)
        clock.stop()
    assert clock.seconds[Stage.COMPILE] == compilation.seconds > 0.001
    assert list(clock.seconds) == [Stage.RECORDED, Stage.COMPILE, Stage.TRACED]


def test_the_history_of_a_caller_is_left_alone(number):
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        with compilation_measured() as compilation:
            launch(number)
        assert compilation is None
        assert sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history()) == 1
    assert not dr.flag(dr.JitFlag.KernelHistory)


def test_one_thread_measures_at_a_time(number):
    """The history of Dr.Jit is common to all threads."""

    def other():
        with compilation_measured() as compilation:
            launch(number + 1)
            return compilation, compiled_since_last()

    with ThreadPoolExecutor(1) as pool, compilation_measured() as compilation:
        assert pool.submit(other).result() == (None, 0.0)
        launch(number)
    assert compilation.seconds > 0
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(other).result()[0] is not None


def test_an_exception_ends_the_measurement(number):
    with pytest.raises(RuntimeError, match="stop"), compilation_measured():
        raise RuntimeError("stop")
    assert not dr.flag(dr.JitFlag.KernelHistory) and dr.kernel_history() == []
    with compilation_measured() as compilation:
        assert compilation is not None


def test_first_passes_tell_their_compilation(number):
    class Constant(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            return mi.Color3f(number * dr.sin(sampler.next_1d())), mi.Bool(True), []

    scene, plugin = cornell(16).load(), Constant(mi.Properties())
    first, again = (single_pass.render_pass(scene, 0, plugin, 4, seed).taken for seed in (0, 1))
    assert 0 < first.compile_seconds < first.seconds and again.compile_seconds == 0
    assert first.repeated_seconds == first.seconds - first.compile_seconds
    later = single_pass.render_pass(scene, 0, plugin, 4, 1, first=(4, 0)).taken
    assert later.compile_seconds is None and later.repeated_seconds == later.seconds


def test_passes_tell_their_compilation_until_one_compiles_nothing(number):
    class Growing(mi.SamplingIntegrator):
        constant = number

        def sample(self, scene, sampler, ray, medium=None, active=True):
            return mi.Color3f(self.constant * dr.sin(sampler.next_1d())), mi.Bool(True), []

    plugin = Growing(mi.Properties())
    passes = Progressive(cornell(16).load(), 0, integrator=plugin)
    for added in (0, 1, 0, 1):
        plugin.constant += added
        passes.render(4)
    first, second, third, last = (one.compile_seconds for one in passes.passes)
    assert first > 0 and second > 0 and third == 0 and last is None


def test_a_pass_that_compiles_longer_than_it_takes_has_the_least_time():
    """Another thread may compile at the same time."""
    assert single_pass.Pass(0, 4, 1.0, {}, 1.5).repeated_seconds == single_pass.LEAST_SECONDS > 0
