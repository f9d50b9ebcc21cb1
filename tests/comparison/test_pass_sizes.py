"""Sizes of passes, with integrators whose cost is made up."""

import math
from collections import Counter

import numpy as np
import pytest

from comparison.pass_sizes import PassSizes
from comparison.single_pass import MAXIMUM_PASS_SAMPLES, Pass
from comparison.timed_sizes import LONG_PASS_SECONDS, PASS_SECONDS, TimedSizes, _cost_of_sample, _costs_by_size
from vpl.core.stages import Stage

SQUARE = 256 * 256
# Sizes, over that of a pass, of which the pass predicts the cost
RATIOS = 1 / 4, 1 / 2, 1, 1.5, 2, 4, 8, 16


def render(pixels, start, each, compilation=3.0, more=None, slow=None, **limits):
    """Passes that take `start` seconds and `each` per sample, three times that from number `slow` on, and once for each
    kernel `compilation`, or `more` but for the first: (passes, why the render ended)."""
    sizes = (TimedSizes if limits.get("time") else PassSizes)(pixels, **limits)
    passes, elapsed, kernels = [], 0.0, set()
    while len(passes) < 2000:
        spp = sizes.next(passes, elapsed)
        if isinstance(spp, str):
            return passes, spp
        kernel = spp if spp < 4 or spp & (spp - 1) else "usual"
        seconds = start + each * spp + (0 if kernel in kernels else compilation)
        compilation = compilation if more is None else more
        seconds *= 3 if slow is not None and len(passes) >= slow else 1
        kernels.add(kernel)
        traced = {"seconds": {Stage.TRACED: seconds - start, Stage.CUTS: 0.0}} if limits.get("in_parts") else {}
        passes.append(Pass(0, spp, seconds, traced))
        elapsed += seconds
    raise AssertionError("endless")


@pytest.mark.parametrize("spp", [*range(1, 20), 64, 100, 1023])
@pytest.mark.parametrize("limits, each", [({}, 1.0), ({"time": 1e9}, 0.001), ({"time": 1e9}, 40.0)])
def test_samples_are_those_that_were_asked_for(spp, limits, each):
    passes, ended_by = render(SQUARE, 0.1, each, spp=spp, **limits)
    assert sum(one.spp for one in passes) == spp and ended_by == "spp"


@pytest.mark.parametrize("start", [0.0, 0.5])
@pytest.mark.parametrize("each", [0.001, 0.02, 0.3])
def test_passes_of_long_renders_take_about_five_seconds_and_repeat(start, each):
    passes, _ = render(SQUARE // 16, start, each, time=240)
    usual, count = Counter(one.spp for one in passes).most_common(1)[0]
    assert count > 0.7 * len(passes)
    seconds = start + each * usual
    assert seconds <= 2 * LONG_PASS_SECONDS
    assert 2 * seconds > LONG_PASS_SECONDS or usual * SQUARE // 16 == MAXIMUM_PASS_SAMPLES


@pytest.mark.parametrize(("time", "wanted"), [(3, PASS_SECONDS), (12, 4.0), (60, LONG_PASS_SECONDS)])
def test_passes_are_intended_to_take_a_third_of_the_time_within_limits(time, wanted):
    sizes = TimedSizes(SQUARE // 16, time)
    assert sizes._wanted() == wanted
    # The first pass takes three seconds more
    passes, _ = render(SQUARE // 16, 0.0, 0.02, time=time + 3)
    # Sizes are powers of two
    assert max(one.seconds for one in passes) < 2 * max(wanted, 3.2)


def test_passes_that_take_long_to_start_are_longer():
    passes, _ = render(SQUARE // 16, 2.0, 0.02, time=60)
    assert max(one.seconds for one in passes) > 8 and sum(one.spp for one in passes) > 1800
    assert len({one.spp for one in passes if one.spp < 4}) == 0


def test_passes_that_take_long_are_as_small_as_can_be():
    passes, _ = render(SQUARE, 1.0, 5.0, time=400)
    assert passes[0].spp == passes[1].spp == 4
    assert {one.spp for one in passes[2:]} == {1}


@pytest.mark.parametrize("limits", [{"spp": 1000}, {"spp": 300, "many": True}])
@pytest.mark.parametrize("in_parts", [False, True])
def test_without_a_limit_of_time_the_speed_of_the_machine_does_not_matter(limits, in_parts):
    fast, slow = (
        [one.spp for one in render(SQUARE, each, each, in_parts=in_parts, **limits)[0]] for each in (0.001, 10.0)
    )
    assert fast == slow and len(fast) > 2


@pytest.mark.parametrize("spp", [16, 32, 100, 999])
def test_no_pass_has_more_samples_than_all_before_it(spp):
    passes, done = render(SQUARE, 0.1, 0.1, spp=spp)[0], 0
    for one in passes:
        assert one.spp <= max(4, done)
        done += one.spp
    assert len(passes) <= 2 * math.log2(spp) + spp * SQUARE / MAXIMUM_PASS_SAMPLES


@pytest.mark.parametrize("spp, sizes", [(100, [4, 96]), (184, [4, 96, 84]), (180, [4, 88, 88]), (140, [4, 72, 64])])
def test_in_parts_a_rest_above_the_largest_size_is_halved_if_the_sampler_keeps_halves(spp, sizes):
    """Pixels have numbers of samples in multiples of 8, and a pass at most 128 samples."""
    passes, _ = render(4 * MAXIMUM_PASS_SAMPLES // 128, 0.1, 0.1, spp=spp, in_parts=True, accepts=lambda n: n % 8 == 0)
    assert [one.spp for one in passes] == sizes


def test_in_parts_every_size_is_one_that_the_sampler_keeps():
    kept = [round(n**2) for n in range(1, 40)]
    passes, ended_by = render(SQUARE, 0.1, 0.1, spp=1000, in_parts=True, accepts=lambda n: n in kept)
    assert ended_by == "spp" and all(one.spp in kept for one in passes[:-1])


def test_large_images_begin_with_one_sample():
    passes, _ = render(1 << 21, 0.1, 0.2, spp=20)
    assert [one.spp for one in passes] == [1] * 20
    passes, _ = render(1 << 19, 0.1, 0.1, compilation=0.1, spp=20)
    assert [one.spp for one in passes] == [1, 4, 4, 4, 4, 3]


@pytest.mark.parametrize("start", [0.7, 1.4, 2.4])
@pytest.mark.parametrize("each", [0.01, 0.2, 1.0])
def test_in_parts_the_start_is_less_than_half_of_a_pass(start, each):
    passes, _ = render(SQUARE // 16, start, each, time=200, more=0.1, in_parts=True)
    usual, count = Counter(one.spp for one in passes).most_common(1)[0]
    assert count > 0.5 * len(passes)
    assert start / (start + each * usual) < 0.4 or usual * SQUARE // 16 == 4 * MAXIMUM_PASS_SAMPLES
    assert max(one.seconds for one in passes[:-1]) < 1.5 * 10


@pytest.mark.parametrize("start", [0.0, 0.3])
@pytest.mark.parametrize("each", [0.02, 0.3])
def test_in_parts_passes_take_about_ten_seconds_from_the_third_on(start, each):
    passes, _ = render(SQUARE // 16, start, each, time=120, more=0.1, in_parts=True)
    assert all(4 < one.seconds < 1.5 * 10 for one in passes[2:-1])
    assert 8 < len(passes) < 30


@pytest.mark.parametrize("lit", [1.0, 1.6])
@pytest.mark.parametrize("time", [3, 10])
def test_in_parts_a_short_render_has_one_small_pass_and_few_large_ones(time, lit):
    """Samples of passes above 20 cost `lit` times those of smaller ones, as with virtual lights."""
    sizes, passes, elapsed = TimedSizes(SQUARE // 2, time, in_parts=True), [], 0.0
    while not isinstance(spp := sizes.next(passes, elapsed), str):
        traced = 0.05 * spp * (lit if spp > 20 else 1)
        stages = {Stage.TRACED: traced} | ({Stage.CUTS: 0.0} if lit > 1 and spp > 20 else {})
        passes.append(Pass(0, spp, 0.3 + traced, {"seconds": stages}))
        elapsed += 0.3 + traced
    assert passes[0].spp == 4 and len(passes) <= 5 and -0.8 < elapsed - time < 0.3
    assert max(one.spp for one in passes) > 0.3 * sum(one.spp for one in passes)


@pytest.mark.parametrize("start, each", [(0.2, 0.3), (0.5, 0.1)])
def test_in_parts_large_images_use_the_time(start, each):
    """The first pass has one sample, and compiles for most of its time."""
    passes, _ = render(4 * SQUARE, start, each, time=10, more=0.1, in_parts=True)
    assert passes[0].spp == 1 and 8.5 < sum(one.seconds for one in passes) < 10.5 and len(passes) < 8


@pytest.mark.parametrize("lit", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("time", [5, 10, 20])
def test_in_parts_costly_lights_hardly_exceed_the_time(lit, time):
    """Samples of passes above 8 cost `lit` times those of smaller ones, and kernels of lights compile for half a
    second."""
    sizes, passes, elapsed = TimedSizes(SQUARE // 2, time, in_parts=True), [], 0.0
    while not isinstance(spp := sizes.next(passes, elapsed), str):
        has_lights = lit > 1 and spp > 8
        first = has_lights and not any(one.has_lights for one in passes)
        traced = 0.05 * spp * (lit if has_lights else 1) + 0.5 * first
        stages = {Stage.TRACED: traced} | ({Stage.CUTS: 0.0} if has_lights else {})
        passes.append(Pass(0, spp, 0.3 + traced, {"seconds": stages}))
        elapsed += 0.3 + traced
    assert 0.8 * time < elapsed < 1.2 * time


def test_in_parts_large_images_are_not_left_with_one_sample():
    passes, _ = render(1 << 20, 2.4, 0.9, time=60, more=0.1, in_parts=True)
    assert len(passes) > 4 and {one.spp for one in passes[3:-1]} <= {4, 8}
    passes, _ = render(1 << 20, 6.0, 1.5, time=60, more=0.1, in_parts=True)
    assert len(passes) > 4 and {one.spp for one in passes[3:-1]} <= {2, 4}


@pytest.mark.parametrize("spp", [*range(1, 20), 64, 100, 1023])
def test_in_parts_samples_are_those_that_were_asked_for_and_no_small_pass_ends_them(spp):
    passes, ended_by = render(SQUARE // 2, 0.7, 0.05, spp=spp, more=0.1, in_parts=True)
    assert sum(one.spp for one in passes) == spp and ended_by == "spp"
    assert passes[-1].spp >= passes[-2].spp / 2 if len(passes) > 1 else passes[-1].spp < 8
    assert max(one.spp for one in passes) <= 4 * MAXIMUM_PASS_SAMPLES // (SQUARE // 2)


@pytest.mark.parametrize("start", [9.0, 12.0, 25.0])
def test_in_parts_a_start_of_ten_seconds_is_worth_many_samples(start):
    passes, _ = render(SQUARE // 4, start, 0.01, time=600, more=0.1, in_parts=True)
    usual = Counter(one.spp for one in passes).most_common(1)[0][0]
    # A pass has at most 512 samples
    assert usual >= 256
    assert max(one.seconds for one in passes) < 3 * start


@pytest.mark.parametrize("in_parts", [False, True])
@pytest.mark.parametrize("start", [0.1, 1.0])
def test_sizes_settle_when_the_machine_gets_slower(start, in_parts):
    passes, _ = render(SQUARE // 16, start, 0.1, time=300, slow=10, more=0.1, in_parts=in_parts)
    assert len({one.spp for one in passes[-10:-2]}) == 1


@pytest.mark.parametrize("spp", [5, 6, 7, 60])
def test_in_parts_an_error_has_more_than_one_pass_however_few_the_samples(spp):
    passes, _ = render(SQUARE, 1.0, 0.1, spp=spp, many=True, more=0.1, in_parts=True)
    assert len(passes) > 1 and sum(one.spp for one in passes) == spp


@pytest.mark.parametrize("time", [10, 12, 13, 14, 20])
def test_in_parts_a_limit_of_samples_and_of_time(time):
    passes, ended_by = render(SQUARE, 0.3, 0.1, spp=100, time=time, more=0.1, in_parts=True)
    assert sum(one.spp for one in passes) <= 100 and len(passes) <= 4
    assert 0.8 * time < sum(one.seconds for one in passes) < time + 0.5 or ended_by == "spp"


def test_in_parts_the_last_pass_has_a_size_that_the_sampler_keeps():
    passes, ended_by = render(
        SQUARE, 0.3, 0.1, time=20, more=0.1, in_parts=True, accepts=lambda spp: math.isqrt(spp) ** 2 == spp
    )
    odd = [one.spp for one in passes if one.spp & (one.spp - 1)]
    assert ended_by == "time" and odd and all(math.isqrt(spp) ** 2 == spp for spp in odd)
    assert len(passes) < 8


def test_in_parts_ten_seconds_hold_few_passes():
    passes, _ = render(SQUARE // 2, 0.3, 0.06, time=10, more=0.1, compilation=0.7, in_parts=True)
    assert len(passes) <= 4


def test_in_parts_an_error_still_has_many_passes():
    passes, done = render(SQUARE, 2.0, 0.01, time=300, many=True, more=0.1, in_parts=True)[0], 0
    assert len(passes) >= 8
    for one in passes:
        assert one.spp <= max(4, done / 8)
        done += one.spp


@pytest.mark.parametrize("start", [0.05, 1.0])
@pytest.mark.parametrize("each", [0.002, 0.1, 0.4])
@pytest.mark.parametrize("time", [5, 11, 60])
@pytest.mark.parametrize("in_parts", [False, True])
def test_time_is_used_and_not_exceeded_by_much(start, each, time, in_parts):
    passes, ended_by = render(SQUARE // 4, start, each, time=time, more=0.1 if in_parts else None, in_parts=in_parts)
    assert ended_by == "time"
    least = min(one.seconds for one in passes)
    assert abs(sum(one.seconds for one in passes) - time) <= least + 0.1


def test_there_is_always_one_pass():
    passes, ended_by = render(SQUARE, 5.0, 1.0, time=1)
    assert len(passes) == 1 and ended_by == "time"


def test_what_comes_first_ends_a_render():
    assert render(SQUARE, 0.0, 0.1, time=1000, spp=20)[1] == "spp"
    assert render(SQUARE, 0.0, 0.1, time=10, spp=2000)[1] == "time"


def test_sizes_that_are_given_stay():
    passes, _ = render(SQUARE, 0.0, 0.1, spp=20, fixed=6)
    assert [one.spp for one in passes] == [6, 6, 6, 2]


@pytest.mark.parametrize("stage", [Stage.PILOT, Stage.SCENE])
def test_in_parts_shared_work_of_the_first_pass_is_not_expected_again(stage):
    found = []
    for shared in (0.0, 3.0):
        sizes = TimedSizes(SQUARE // 2, 10 + shared, in_parts=True)
        stages = {stage: shared, Stage.TRACED: 0.4, Stage.CUTS: 0.0}
        first = Pass(0, sizes.next([], 0.0), 0.6 + shared, {"seconds": stages, "pilots": 1})
        found.append(sizes.next([first], first.seconds))
    assert found[0] == found[1] > 60


def test_in_parts_measurements_of_a_later_pass_are_not_expected_again():
    stages = {Stage.PILOT: 0.3, Stage.TRACED: 0.4, Stage.CUTS: 0.0}
    one = Pass(0, 8, 1.0, {"seconds": stages, "pilots": 0, "measured": 1})
    assert one.repeated_seconds == pytest.approx(0.7) and one.start_seconds == pytest.approx(0.3)
    assert Pass(0, 8, 1.0, {"seconds": stages, "pilots": 0, "measured": 0}).repeated_seconds == 1.0


def test_in_parts_the_time_to_record_belongs_to_the_start():
    stages = {Stage.RECORDED: 0.1, Stage.TRACED: 0.6, Stage.CUTS: 0.2}
    assert Pass(0, 8, 1.0, {"seconds": stages}).start_seconds == pytest.approx(0.2)


@pytest.mark.parametrize("in_parts", [False, True])
def test_compilation_that_is_measured_does_not_count(in_parts):
    found = []
    for compilation in (0.5, 5.0):
        sizes = TimedSizes(SQUARE // 2, 10 + compilation, in_parts=in_parts)
        statistics = {"seconds": {Stage.TRACED: 0.3, Stage.CUTS: 0.0, Stage.COMPILE: compilation}} if in_parts else {}
        first = Pass(0, sizes.next([], 0.0), 0.4 + compilation, statistics, compilation)
        assert first.repeated_seconds == pytest.approx(0.4)
        assert first.start_seconds == (pytest.approx(0.1) if in_parts else None)
        found.append(sizes.next([first], first.seconds))
    assert found[0] == found[1] > 4


def second_size(growth=(), compiled=0.0, time=10.0, **limits):
    """Size of the second pass, after one of 4 samples that takes 0.4 s without compilation, of which 0.1 s are a start,
    and predicts the costs `growth` of 16, 32, ... samples; the rest of `time` is left."""
    sizes = TimedSizes(SQUARE // 2, time, in_parts=True, **limits)
    # Ratios of sizes, as the integrator gives them
    costs = [(1.0, (1.0, 0.0, 0.0)), *((4.0 * 2**index, (cost, 0.0, 0.0)) for index, cost in enumerate(growth))]
    statistics = {"seconds": {Stage.TRACED: 0.3}} | ({"costs": costs} if growth else {})
    first = Pass(0, sizes.next([], 0.0), 0.4 + (compiled or 0), statistics, compiled)
    size = sizes.next([first], 0.4)
    # Samplers refuse other numbers
    assert isinstance(size, int)
    return size


def test_in_parts_a_predicted_cost_makes_the_second_pass_larger():
    """One second is left. Without a prediction, half of it is for samples of twice the cost; with one, 16 samples may
    take all of it."""
    assert second_size(time=1.4) == 4
    assert second_size([1.0], time=1.4) == 12
    # 1.1 times the predicted cost is expected
    assert second_size([1.2], time=1.4) == 9
    # Beyond four times the first size nothing is predicted
    assert second_size([1.0], time=2.4) == 16
    assert second_size([1.0], time=10.4) == 65


def test_in_parts_costs_may_be_predicted_for_several_sizes():
    assert second_size([1.0, 1.0], time=2.4) == 25
    # 32 samples may cost so much that 16 are the most that surely fit
    assert second_size([1.0, 3.0], time=2.4) == 16
    assert second_size([1.0, 1.2], time=2.4) == 19
    # The cost at 32 samples does not tell that of 12
    assert second_size([3.0, 1.0], time=1.4) == 4
    assert second_size([3.0, 1.0], time=2.4) == 25


def other_sizes(size):
    """Sizes of which a pass of a `size` predicts the cost."""
    return sorted({max(round(ratio * size), 1) for ratio in RATIOS})


def lit_passes(time, traced, cuts, pixels=SQUARE, predicts=True):
    """Sizes and seconds of passes with virtual lights: `traced` seconds for each sample, and `cuts` for a pass of any
    size, as predicted."""
    sizes, passes, elapsed = TimedSizes(pixels, time, in_parts=True), [], 0.0

    def seconds_of(size):
        return size * traced + cuts

    while not isinstance(spp := sizes.next(passes, elapsed), str):
        # In a unit of which the model knows nothing
        costs = [(size / spp, (1.0, 0.0, 0.3 / size)) for size in other_sizes(spp)]
        stages = {"seconds": {Stage.TRACED: spp * traced, Stage.CUTS: cuts}} | ({"costs": costs} if predicts else {})
        passes.append(Pass(0, spp, seconds_of(spp) + 0.1, stages, 0.0))
        elapsed += passes[-1].seconds
    return [one.spp for one in passes], elapsed


def test_in_parts_samples_share_the_cuts_of_their_pixel():
    """Passes of one sample would take 6.1 seconds each, four samples 8.8."""
    sizes, elapsed = lit_passes(30, 0.9, 5.1, pixels=1280 * 720)
    assert sizes == [1, 4, 8] and elapsed < 30
    assert max(lit_passes(30, 0.9, 5.1, pixels=1280 * 720, predicts=False)[0]) < 4


@pytest.mark.parametrize("size", (1, 3, 4, 37))
@pytest.mark.parametrize("fixed", (0.0, 0.5, 0.9, 0.95))
def test_predicted_costs_are_those_of_passes_with_a_fixed_part(size, fixed):
    """Larger passes are expected to cost up to a tenth more."""
    ratios = [other / size for other in other_sizes(size)]
    costs = _costs_by_size([(ratio, fixed / ratio + 1 - fixed) for ratio in ratios], size)
    for other in range(1, 16 * size + 1):
        expected = fixed * size / other + 1 - fixed
        # To within the steps by which an unsure cost grows
        assert 0.99 * expected < _cost_of_sample(costs, other) < 1.11 * expected
    whole = [other * _cost_of_sample(costs, other) for other in range(1, 16 * size + 1)]
    assert (np.diff(whole) > 0).all()


def test_the_seconds_of_each_part_of_the_cost_grow_with_it():
    stages = {Stage.TRACED: 2.0, Stage.LIGHTS: 0.5, Stage.TREE: 0.5, Stage.CLUSTERS: 0.25, Stage.CUTS: 0.75}
    costs = [(1, (1.0, 2.0, 0.5)), (4, (1.1, 0.5, 0.25))]
    # A quarter of the lights of a sample, and half of its cuts
    lit = Pass(0, 4, 9.0, {"seconds": stages, "costs": costs})
    assert lit.growth == [(1, 1.0), (4, pytest.approx((2.2 + 0.25 + 0.5) / 4))]
    # Without lights, their cost is relative to that of the paths
    dark = Pass(0, 4, 9.0, {"seconds": {Stage.TRACED: 2.0}, "costs": [(1, (1.0, 0.0, 0.0)), costs[1]]})
    assert dark.growth == [(1, 1.0), (4, pytest.approx(1.1 + 0.5 + 0.25))]
    assert Pass(0, 4, 9.0, {"seconds": stages}).growth is None


def test_costs_are_those_of_the_pass_that_others_are_compared_with():
    """A checkpoint may end with a small pass, and the first pass after it may be larger."""
    costs = [(1, (1.0, 0.0, 1.0)), (4, (1.0, 0.0, 0.28)), (16, (1.0, 0.0, 0.04))]
    stages = {"seconds": {Stage.TRACED: 0.4, Stage.CUTS: 2.0}, "costs": costs}
    sizes = TimedSizes(SQUARE, 60, in_parts=True)
    passes = [Pass(0, 4, 2.5, stages, 0.0)]
    sizes.next(passes, 2.5)
    costs = [(0.25, (1.0, 0.0, 3.9)), (1, (1.0, 0.0, 1.0)), (4, (1.0, 0.0, 0.28))]
    larger = {"seconds": {Stage.TRACED: 1.6, Stage.CUTS: 2.0}, "costs": costs}
    sizes._asked = 16
    passes.append(Pass(0, 16, 3.7, larger, 0.0))
    sizes.next(passes, 6.2)
    assert sizes._expected(64) == pytest.approx(0.1 + 2.4 * 16 * 1.1 * 0.2, rel=0.01)


@pytest.mark.parametrize("cuts", (0.0, 0.5, 2.0, 5.0))
@pytest.mark.parametrize("time", (10, 20, 60))
def test_in_parts_shared_cuts_hardly_exceed_the_time(time, cuts):
    _, elapsed = lit_passes(time, 0.1, cuts)
    assert 0.7 * time < elapsed < 1.15 * time


def test_in_parts_samples_after_a_probe_are_expected_to_cost_more():
    """Samples of pixels with different numbers cost 8% more."""
    sizes, passes, elapsed = TimedSizes(SQUARE // 2, 10, in_parts=True, probes=True), [], 0.0
    while not isinstance(spp := sizes.next(passes, elapsed), str):
        traced = (0.05 if len(passes) < 2 else 0.054) * spp
        passes.append(Pass(0, spp, 0.1 + traced, {"seconds": {Stage.TRACED: traced, Stage.CUTS: 0.0}}, 0.0))
        elapsed += passes[-1].seconds
        assert sizes.is_probe == (len(passes) == 2)
    assert 9.6 < elapsed < 10 and len(passes) <= 4


def test_in_parts_time_for_kernels_is_left_if_the_first_pass_compiled_or_was_not_measured():
    assert second_size([1.0], 0.0, 1.4) == 12
    assert second_size([1.0], 0.2, 1.4) == second_size([1.0], None, 1.4) == 10


@pytest.mark.parametrize("in_parts", [False, True])
def test_a_costly_pass_does_not_begin_if_it_would_exceed_the_time_by_far(in_parts):
    for time, size in ((19, 4), (15, "time")):
        sizes = TimedSizes(SQUARE, time, in_parts=in_parts, least=4)
        assert sizes.next([], 0.0) == 4
        first = Pass(0, 4, 10.0, {"seconds": {Stage.TRACED: 9.9, Stage.CUTS: 0.0}} if in_parts else {})
        assert sizes.next([first], 10.0) == size


@pytest.mark.parametrize("in_parts", [False, True])
def test_a_pass_of_a_given_size_begins_if_half_of_it_fits(in_parts):
    for time, size in ((8, 8), (6, "time")):
        sizes = TimedSizes(SQUARE, time, fixed=8, in_parts=in_parts)
        assert sizes.next([], 0.0) == 8
        first = Pass(0, 8, 4.5, {"seconds": {Stage.TRACED: 4.0}} if in_parts else {})
        assert sizes.next([first], 4.5) == size


def test_for_an_error_there_are_many_passes_of_similar_sizes():
    passes, done = render(SQUARE // 16, 0.0, 1e-4, time=20, many=True)[0], 0
    assert len(passes) >= 8
    for one in passes[:100]:
        assert one.spp <= max(4, done / 8)
        done += one.spp
