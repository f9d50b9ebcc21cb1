"""Samples per pixel of the next pass of a render with a limit of time: passes take two to five seconds, in parts ten.

A pass takes a third of the time limit, from two to five seconds, or five times the time of its start: samples are
stratified within a pass, and the start, such as recording kernels with the code of many shapes, is lost.

Passes in parts take longer, as they can be stopped between parts, and large passes are the most efficient. Such a pass
takes about ten seconds, or twice the time of its start, and the last pass up to twice that. With a time limit of ten
seconds a render has a small pass, one of about half of the time, and one that fills the rest.

Each pass after the first has the size of the pass before it, or grows by a factor that the measured time allows.
Compilation is measured and does not count. Even so, the first pass with a kernel takes up to twice as long as later
ones, so its time is an upper bound of the cost: growing by it is safe. Shrinking requires a second pass of equal size;
so does growth that risks twice the time, for passes that are slow to start.

Passes in parts report the time of their start, so that one pass tells the cost of any size. A second pass may have
virtual lights where the small first pass has none, and cost more. Up to the largest size for which the first pass
predicts the cost, it may take all of the remaining time; beyond this size, half. A pass that determines the samples of
pixels takes less. The samples of a pixel share the cuts of virtual lights, so a pass with lights costs less for each
sample than a smaller one, as the smaller one predicts.
"""

import math
from typing import NamedTuple

from .pass_sizes import PARTS, PROBE, USUAL, PassSizes, power_of_two

# Of a pass: a fraction of the time limit, within limits; minimum ratio of its rest to its start
PASS_SHARE, PASS_SECONDS, LONG_PASS_SECONDS, PASS_REST = 1 / 3, 2.0, 5.0, 4.0
PART_SECONDS, LEAST_REST = 10.0, 1.0  # of a pass in parts; minimum ratio of its rest to its start, which has priority
LEAST_GAIN = 1 / 16  # minimum size of a last pass with virtual lights, as a fraction of the intended size
LIT = 2.0  # usual cost of a sample with virtual lights over that without, at most: small passes have no lights
UNSURE = 1.1  # cost over a predicted one, usually at most: measured are 0.67 to 1.2 (decisions.md)
DOUBT = 0.5  # fraction of the remaining time for a second pass, which may have lights and cost more than expected
DIFFERENT = 1.08  # usual cost of a sample where pixels have different numbers: there are more at edges and on glass
LAST_SHARE = 0.75  # minimum fraction of the remaining time of a pass that will probably end the render
OVERRUN = 0.15  # largest fraction of the limit by which a pass may be expected to exceed it
LONGEST = 2.0  # times the wanted seconds: longer passes shrink
CHANGED = 1.5  # ratio of the times of two passes of equal size at which earlier times are discarded
MOST_GROWTH = 4  # maximum ratio of sizes: of unsafe growth, and of extrapolated times
KERNEL_SECONDS = 0.1  # to compile the kernel of the first size that is no power of two, if the first pass compiled any
LEAST_SHARE = 0.1  # minimum fraction of a pass's time that is assumed proportional to its samples


def sizes_of(progressive, spp=None, time=None, fixed=None, many=False):
    """Return the sizes of the passes of a `rendering.Progressive`: `PassSizes`, or `TimedSizes` if there is a limit of
    `time` seconds."""
    limits = {
        "spp": spp, "fixed": fixed, "many": many, "in_parts": progressive.in_parts, "accepts": progressive.accepts,
        "probes": progressive.differs, "multiple": progressive.density.probe_multiple, "least": progressive.parts**2,
    }  # fmt: skip
    if time is None:
        return PassSizes(progressive.pixels, **limits)
    return TimedSizes(progressive.pixels, time, **limits)


class Cost(NamedTuple):
    """Expected cost of passes of up to `most` samples per pixel: `fixed` + `each` × samples, over the cost of a sample
    of the pass that is the reference."""

    most: float
    fixed: float
    each: float


class TimedSizes(PassSizes):
    """Sizes of the passes of an image that ends after `time` seconds, or by another limit of `PassSizes` before."""

    def __init__(self, pixels, time, **limits):
        super().__init__(pixels, **limits)
        self._time = time
        self._current, self._seconds, self._asked = self._fixed or self._least, {}, None
        self._known = {}  # size -> seconds of the last pass; not of the first pass, which is slower
        self._starts = {}  # size -> seconds to start the last pass, of passes that report them
        self._lit = False  # whether a pass had virtual lights
        self._growth = {}  # size -> costs of other sizes that the last pass predicted, see `Pass.growth`
        self._kernel_seconds = 0.0  # expected compilation of the next pass
        self._dearer = 1.0  # expected cost of a sample of the next pass over that of known passes
        self._before = None  # number of passes from a checkpoint; None until the first call

    def next(self, passes, elapsed):
        """See `PassSizes.next`; "time" if the time ends the render."""
        if self._before is None:
            self._before = len(passes)
            self._asked = passes[-1].spp if passes else None
        if passes:
            self._learn(passes[-1], sum(one.spp for one in passes), is_first=len(passes) == self._before + 1)
        self._dearer = DIFFERENT if self.is_probe else 1.0
        self._asked = super().next(passes, elapsed)
        if passes and isinstance(self._asked, int) and self._asked:
            self.is_last |= self._expected(self._asked) > LAST_SHARE * (self._time - elapsed)
        return self._asked or "time"

    def _expected_samples(self, done, elapsed):
        """See `PassSizes`: a low estimate where time ends the render and later passes may have virtual lights."""
        left = [self._spp - done] if self._spp is not None else []
        if self._line():
            rest = self._time - elapsed
            wanted = min(self._wanted(), rest)
            left.append(self._filling(wanted) * rest / wanted if wanted > 0 else 0)
        return done + min(left, default=math.inf)

    def _intended(self, done):
        """See `PassSizes`."""
        return self._current

    def _size(self, passes, done, elapsed):
        """Return the size of the next pass, 0 if the time ends the render."""
        size = super()._size(passes, done, elapsed)
        return self._in_time(size, self._time - elapsed) if passes else size

    def _learn(self, last, done, is_first):
        """Record the time of the `last` pass, and choose the size of later passes."""
        repeated, seconds = self._asked in self._seconds, last.repeated_seconds
        self._kernel_seconds = KERNEL_SECONDS if is_first and last.compile_seconds != 0 else 0.0
        if last.start_seconds is not None:
            self._starts[self._asked] = last.start_seconds
            self._lit |= last.has_lights
            self._growth[self._asked] = last.growth or []
        self._seconds[self._asked] = min(seconds, self._seconds.get(self._asked, math.inf))
        if not is_first:
            before = self._known.get(self._asked, seconds)
            if not 1 / CHANGED < seconds / before < CHANGED:
                self._known.clear()  # the speed of the machine has changed
            self._known[self._asked] = seconds
        if self._fixed or self._asked != self._current:
            return
        wanted, line = self._wanted(), self._in_parts and self._line()
        if repeated and seconds > LONGEST * wanted:
            self._current = max(self._minimum, power_of_two(self._current * wanted / seconds))
            return
        grown = self._grown(seconds, wanted, repeated, line)
        grown = min(grown, self._largest, power_of_two(max(1, done / PARTS)) if self._many else self._largest)
        if grown > self._current and (self._in_parts or grown >= min(USUAL, self._largest)):
            self._current = grown

    def _grown(self, seconds, wanted, repeated, line):
        """Return the size of a pass of at most `wanted` seconds, from the `seconds` of a pass of the current size."""
        if line:
            filling = self._filling(wanted)
            return self._kept(filling) if self._any_size else min(power_of_two(filling), MOST_GROWTH * self._current)
        grown = power_of_two(self._current * wanted / seconds)
        if repeated and seconds < wanted:
            # Without this, a pass with a dominant start would never grow
            times = MOST_GROWTH if seconds < wanted / 2 else 2
            grown = max(grown, times * self._current)
        return grown

    def _in_time(self, size, left):
        """Return the size, about `size` samples, of a pass within `left` seconds.

        If there is none, return the least size if `left` is at least half of its time and the limit of the render will
        hardly be exceeded, otherwise 0; also 0 if a last pass in parts would be far smaller than usual.
        """
        least = size if self._fixed else min(size, self._least)
        whole, predicted = left, 0
        if self.is_probe:
            left = PROBE * min(left, PART_SECONDS)
        elif self._any_size and self._may_be_lit:
            left, predicted = DOUBT * left, self._predicted[-2].most if self._predicted else 0
        if self._any_size and self._line():
            filling = max(self._filling(left), min(self._filling(whole), predicted))
            # Without virtual lights, small passes are as good as large ones
            if self._known and filling < (LEAST_GAIN * size if self._lit else least):
                return 0
            certain = self._kept(min(self._certain(filling), self._largest))
            # A single last pass, instead of several ever smaller ones
            if least <= certain and self._is_last(filling, size, whole):
                return certain
        while size > least and self._expected(size) > left:
            size = max(least, power_of_two(size - 1))
        longest = min(2 * left, whole + OVERRUN * self._time)
        return size if self._expected(size) <= max(longest, whole) else 0

    def _is_last(self, filling, size, left):
        """Return whether the next pass is the last one, of about `filling` samples that the `left` seconds allow: after
        a pass of the usual `size` there would be no time for another one."""
        return filling < size if self._spp else self._filling(left - self._expected(size)) < size

    @property
    def _may_be_lit(self):
        """Whether the next pass may be the first one with virtual lights, and its cost is not known."""
        return not self._known and not self._lit

    @property
    def _reference(self):
        """The size of the pass that others are compared with, 0 if there is none."""
        return max(self._known or self._starts, default=0)

    @property
    def _predicted(self):
        """Costs by size as the reference predicts them; empty if it predicts none."""
        return _costs_by_size(self._growth.get(self._reference, []), self._reference)

    @property
    def _with_lights(self):
        """Costs by size of passes that may have virtual lights where those so far have none."""
        return self._predicted or [Cost(math.inf, 0.0, LIT)]

    @property
    def _costs(self):
        """Costs by size: those of the reference for every sample if no pass had virtual lights."""
        if self._may_be_lit:
            return self._with_lights
        return (self._lit and self._predicted) or [Cost(math.inf, 0.0, 1.0)]

    def _filling(self, seconds):
        """Return the largest size of a pass of some `seconds`, by its expected cost."""
        start, each = self._line()
        affordable = (seconds - self._kernel_seconds - start) / (self._dearer * each)
        found = before = 0
        for cost in self._costs:
            size = int(min((affordable - cost.fixed) / cost.each, cost.most))
            # The cost is that of sizes beyond the range before
            found, before = size if size > before else found, cost.most
        return found

    def _certain(self, size):
        """Return the largest size up to `size` that takes no longer than expected if its pass has virtual lights."""
        known = max(self._known, default=0)
        if self._lit or not known:
            return size
        return int(min(size, max(known, size / _cost_of_sample(self._with_lights, max(size, 1)))))

    def _wanted(self):
        """Return the intended seconds of a pass."""
        line, rest = self._line(), LEAST_REST if self._in_parts else PASS_REST
        whole = min(max(PASS_SHARE * self._time, PASS_SECONDS), LONG_PASS_SECONDS)
        usual = PART_SECONDS if self._in_parts else whole
        return max(usual, (1 + rest) * line[0]) if line else usual

    def _expected(self, size):
        """Return the expected seconds of a pass: those of an earlier pass of this size, or by `_line`, or, if that is
        None, proportional to the size."""
        if size in self._seconds:
            return self._seconds[size]
        line = self._line()
        if not line:
            large, longest = max((self._known or self._seconds).items())
            line = 0.0, longest / large
        start, each = line
        return start + each * size * (_cost_of_sample(self._costs, size) if self._starts else 1.0)

    def _line(self):
        """Return the seconds to start a pass, and the seconds per sample per pixel of known passes; None if unknown.

        From the shortest start that passes report, or else from the largest size and the least one within
        `MOST_GROWTH` of it.
        """
        large = self._reference
        longest = self._known.get(large) or self._seconds.get(large)
        if large in self._starts:
            each = max((longest - self._starts[large]) / large, LEAST_SHARE * longest / large)
            # Some passes learn for all passes of their size. Larger passes than the first one may have virtual lights
            start = min(self._starts[size] for size in (self._known.keys() & self._starts.keys()) or self._starts)
            return start, each
        small = min((size for size in self._known if MOST_GROWTH * size >= large), default=0)
        if small == large:
            return None
        each = (longest - self._known[small]) / (large - small)
        each = min(max(each, LEAST_SHARE * longest / large), longest / large)
        return longest - each * large, each


def _costs_by_size(growth, size):
    """Return the costs of passes, a list of `Cost` by size up to infinity, as a pass of this `size` predicts them by
    its `growth`: (ratio of the sizes, cost of a sample over that in this pass) by size; empty for an empty `growth`."""
    costs, before, total, last = [], 0, 0.0, 0.0
    for times, predicted in growth:
        # Samplers take integers only
        most, cost = round(times * size), predicted
        if times > 1:
            cost = UNSURE * predicted if predicted > 1 else min(UNSURE * predicted, 1.0)
        # Where the samples of a pixel share cuts, the whole cost grows in proportion to samples beyond a fixed part
        shares = 0 < cost < last and cost * most > total
        each = (cost * most - total) / (most - before) if shares else cost
        costs.append(Cost(most, total - each * before if shares else 0.0, each))
        before, total, last = most, cost * most, cost
    if len(costs) > 1 and costs[1].fixed:
        # The fixed part of smaller passes is the same
        costs[0] = costs[1]._replace(most=costs[0].most)
    return [*costs, Cost(math.inf, 0.0, last)] if costs else []


def _cost_of_sample(costs, size):
    """Return the cost of a sample of a pass of this `size`, by `costs` by size."""
    found = next(cost for cost in costs if size <= cost.most)
    return found.fixed / size + found.each
