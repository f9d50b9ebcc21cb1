"""Passes of an image for a time budget or a number of samples, and the measured passes among them."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import pytest

from comparison import measuring, rendering, single_pass, worker
from tests.support.scenes import cornell
from vpl.core.stages import Stage
from vpl.direct import environment_regions
from vpl.direct.environment_regions import regions_of


class Recorded(rendering.Progressive):
    """A render with prescribed durations, by default one second per sample after ``start``; it records requests."""

    def __init__(self, pixels, *seconds, start=0.0):
        self._pixels, self._seconds, self._start, self.asked = pixels, list(seconds), start, []
        self.restart()

    pixels, integrator = property(lambda self: self._pixels), SimpleNamespace(renders_in_parts=False)
    _denoise, _rays, differs, parts = None, {}, False, 1

    def render(self, spp, seed=None, is_probe=False, is_last=False):
        self.asked.append((spp, seed is not None))
        seconds = self._seconds.pop(0) if self._seconds else self._start + spp
        self.passes.append(single_pass.Pass(seed or 0, spp, seconds))
        return self.passes[-1]

    def accepts(self, spp):
        return True


def test_kernels_of_every_size_of_pass_are_compiled_before_the_clock_runs():
    job = worker.Job("p", "path", "s.xml", "a.exr", spp=19)
    progressive = Recorded(single_pass.MAXIMUM_PASS_SAMPLES // 9, 2.0)
    assert measuring.measure(progressive, job) == 2.0
    assert progressive.asked == [(5, True), (1, True), (5, True), (9, True), (9, False), (9, False), (1, False)]
    assert sum(one.spp for one in progressive.passes) == 19


def test_measured_passes_make_the_regions_of_an_environment():
    kept = regions_of(mi.load_dict({"type": "constant"}), 4)

    class Looks(Recorded):
        def render(self, spp, seed=None, is_probe=False, is_last=False):
            self.found = environment_regions._previous
            return super().render(spp, seed)

    progressive = Looks(9, 2.0)
    assert environment_regions._previous[1] is kept
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", spp=1))
    assert progressive.found is None


class InParts(Recorded):
    """The same in parts, with a pilot of two seconds in the first pass after a restart."""

    in_parts = True

    def render(self, spp, seed=None, is_probe=False, is_last=False):
        self.asked.append((spp, seed is not None))
        pilot = 0.0 if self.passes else 2.0
        stages = {Stage.PILOT: pilot, Stage.TRACED: 0.01 * spp, Stage.CUTS: 0.0}
        statistics = {"seconds": stages, "pilots": int(pilot > 0)}
        self.passes.append(single_pass.Pass(seed or 0, spp, pilot + 0.1 + 0.01 * spp, statistics))
        return self.passes[-1]


def test_passes_of_images_for_denoising_include_one_that_determines_numbers():
    scene, plugin = cornell().load(), mi.load_dict({"type": "manylights", "denoised": True})
    for parts in (1, 2):
        progressive = rendering.Progressive(scene, 0, 0, plugin, lambda image, *_: image, parts)
        measuring.measure(progressive, worker.Job("p", "manylights", "s.xml", "a.exr", budget=0.5))
        assert progressive.density.relative is not None


def test_passes_in_parts_are_those_of_a_render_by_time_and_include_a_pilot():
    progressive = InParts(10_000)
    measuring.measure(progressive, worker.Job("p", "manylights", "s.xml", "a.exr", budget=10.0))
    number = len(progressive.passes)
    warm, measured = progressive.asked[:-number], progressive.asked[-number:]
    assert [spp for spp, _ in warm] == [spp for spp, _ in measured] and number <= 4
    assert all(is_unused for _, is_unused in warm) and not any(is_unused for _, is_unused in measured)
    assert sum(one.statistics["pilots"] for one in progressive.passes) == 1
    assert 9 < progressive.seconds < 10.2


def test_small_passes_alone_compile_kernels_that_do_not_depend_on_the_samples():
    progressive = InOneKernel(8 * single_pass.MAXIMUM_PASS_SAMPLES // 9)
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", spp=19))
    assert progressive.asked == [(5, True), (1, True), (9, False), (9, False), (1, False)]


@pytest.mark.parametrize(("sampler", "shares"), [("independent", True), ("multijitter", False), ("stratified", False)])
def test_kernels_of_samplers_that_stratify_depend_on_the_samples(sampler, shares):
    file = cornell(16)
    file.set_sampler(sampler)
    progressive = rendering.Progressive(file.load(), 0, integrator=mi.load_dict({"type": "path"}))
    assert progressive.shares_kernels is shares
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for spp in (1, 4, 64):  # the first pass also compiles what the scene needs once
            dr.kernel_history_clear()
            progressive.render(spp)
            kernels.append({one["hash"] for one in dr.kernel_history([dr.KernelType.JIT])})
    assert (kernels[2] <= kernels[1]) is shares


def test_kernels_of_this_project_are_compiled_for_every_size():
    scene = cornell(16).load()
    assert not rendering.Progressive(scene, 0, integrator=mi.load_dict({"type": "vpl"})).shares_kernels


def test_only_small_passes_compile_where_passes_are_long():
    job = worker.Job("p", "path", "s.xml", "a.exr", spp=16)
    progressive = Recorded(single_pass.MAXIMUM_PASS_SAMPLES // 16, measuring.LONG_PASS + 1, measuring.LONG_PASS / 2)
    measuring.measure(progressive, job)
    assert progressive.asked == [(4, True), (4, True), (16, False)]


def test_what_compiles_for_longer_than_the_budget_is_measured_warm():
    progressive = Recorded(100, 60.0)
    cold = measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=30))
    assert cold == 60 and progressive.seconds == 30 == progressive.spp
    progressive = Recorded(100, 60.0, start=40.0)
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=30))
    assert progressive.seconds == 41 and progressive.spp == 1


@pytest.mark.parametrize(
    ("effort", "passes"),
    [
        ({"spp": 20}, [16, 4]),
        ({"budget": 8.0, "pass_spp": 2}, [2, 2]),
        ({"budget": 20.0}, [4, 4, 4, 4, 2]),
        ({"budget": 5.0}, [4]),
    ],
)
def test_cold_images_hold_every_pass(effort, passes):
    progressive = Recorded(single_pass.MAXIMUM_PASS_SAMPLES // 16, 6.0)
    assert measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", cold=True, **effort)) == 6
    assert progressive.asked == [(spp, False) for spp in passes]
    assert [one.spp for one in progressive.passes] == passes


@pytest.mark.parametrize(
    ("budget", "pass_spp", "passes"),
    [
        (35, 10, [10, 10, 10, 5]),
        (30, 10, [10, 10, 10]),
        (33, 10, [10, 10, 10, 4]),  # 4 are nearer to 3 than none
        (31, 10, [10, 10, 10]),
        (4.9, 2, [2, 2]),
        (5.6, 2, [2, 2, 2]),
        (3.4, 1, [1, 1, 1]),
        (12, 10, [10]),
    ],
)
def test_the_last_pass_fills_the_budget(budget, pass_spp, passes):
    progressive = Recorded(100)
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=budget, pass_spp=pass_spp))
    assert [one.spp for one in progressive.passes] == passes
    assert abs(progressive.seconds - budget) <= min(pass_spp, measuring.WARM_SPP) / 2


@pytest.mark.parametrize(
    ("budget", "start", "passes"),
    [
        (30, 2, [8, 8, 8]),
        (30, 4, [11, 11]),  # starting them takes no more than three tenths
        (30, 15, [1, 1]),  # one sample takes half of it
        (10_000, 0, [2048, 2048, 2048, 2048, 1808]),  # the largest pass
    ],
)
def test_passes_are_as_large_as_the_cost_of_starting_one_asks_for(budget, start, passes):
    progressive = Recorded(single_pass.MAXIMUM_PASS_SAMPLES // 2048, start=float(start))
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=budget))
    assert [one.spp for one in progressive.passes] == passes and abs(progressive.seconds - budget) <= 2


def test_integrators_of_mitsuba_have_larger_passes_than_those_that_store_points():
    scene = cornell(16).load()
    largest = {
        name: rendering.Progressive(scene, 0, integrator=mi.load_dict({"type": name})).largest_pass
        for name in ("path", "volpath", "manylights", "lightcuts")
    }
    assert largest == {"path": 2**16, "volpath": 2**16, "manylights": 2**15, "lightcuts": 2**13}


class InOneKernel(Recorded):
    """The same by an integrator of Mitsuba, with the sampler `independent`."""

    integrator, shares_kernels = None, True


@pytest.mark.parametrize(("budget", "start", "passes"), [(60, 0, [18, 18, 18, 6]), (30, 4, [11, 11]), (30, 15, [1, 1])])
def test_passes_of_large_images_by_mitsuba_have_many_samples(budget, start, passes):
    """Those of a single sample would not be stratified, and pay each start."""
    progressive = InOneKernel(1280 * 720, start=float(start))
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=budget))
    assert [one.spp for one in progressive.passes] == passes


@pytest.mark.parametrize(("largest", "passes"), [(3, [3, 3, 3]), (2, [2, 2, 2, 2]), (1, [1, 1, 1, 1, 1])])
def test_passes_that_memory_limits_to_few_samples_have_all_of_them(largest, passes):
    progressive = Recorded(single_pass.MAXIMUM_PASS_SAMPLES // largest, start=2.0)
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=15.0))
    assert [one.spp for one in progressive.passes] == passes
    assert max(spp for spp, _ in progressive.asked) == largest


def test_passes_of_a_number_of_samples_have_sizes_that_the_sampler_keeps():
    file = cornell(16)
    file.set_sampler("multijitter")
    progressive = rendering.Progressive(file.load(), 0)
    job = worker.Job("p", "path", "s.xml", "a.exr", spp=64)
    for largest, sizes in ((18, [16] * 4), (64, [64]), (100, [64])):
        progressive.__class__ = type("Limited", (rendering.Progressive,), {"largest_pass": largest})
        assert measuring._sizes_of_samples(progressive, job) == sizes
    assert measuring._sizes_of_samples(progressive, replace(job, pass_spp=18)) == [18, 18, 18, 10]


def test_passes_may_turn_out_to_be_slower_or_faster():
    assert measuring._samples_of_a_pass(Recorded(100, 1.0, 4.0, 5.0, 4.0, 50.0, 50.0), 30, iter(range(100)))[0] == 2
    # Of two passes of one size, the first may have compiled
    assert measuring._samples_of_a_pass(Recorded(100, 1.0, 4.0, 5.0, 4.0, 50.0, 10.0), 30, iter(range(100)))[0] == 10
    progressive = Recorded(100, 13.0, 13.0, 16.0, 17.0, 16.0, 30.0, 25.5, start=12.0)
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=30))
    assert progressive.seconds == 25.5  # four more samples would take 15 seconds


def test_cold_images_go_on_after_a_size_that_compiled():
    progressive = Recorded(single_pass.MAXIMUM_PASS_SAMPLES // 64, 2.0, 0.04, 2.0, 0.08, 0.16, 0.16)
    measuring.measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", cold=True, budget=8.0))
    assert [spp for spp, _ in progressive.asked][:7] == [4, 4, 8, 8, 16, 16, 32]
