"""How many samples per pixel the next pass of a render has: passes of about two seconds, whatever they cost.

Sizes are powers of two, from 4 on if a pixel allows it: Mitsuba compiles one kernel for all of these, and others for
numbers between and, with some filters of the film, for fewer. The first pass is small, since nothing is known; each
later one is as large as the one before, or larger by a factor that the time of that one allows. As the first pass of a
kernel compiles it, time says at most what a pass costs, so that growing by it is safe; shrinking needs a second pass of
the same size, and so does growing at the risk of twice the time, where passes cost much to start.
"""

import math

from .rendering import largest_pass

PASS_SECONDS = 2.0
LONGEST = 2.0  # times that: only longer passes are made smaller
USUAL = 4  # samples per pixel from which on all powers of two have the same kernels
FIRST_SAMPLES = 2**19  # pixel samples that a first pass may have, unless one per pixel is more
LEAST_SHARE = 0.1  # of a pass's time that is taken to depend on its samples, at least
PARTS = 8  # where an error is asked for: no pass has more than this part of the samples that there are


class PassSizes:
    """Sizes of the passes of an image of `pixels` pixels, until `spp` samples per pixel or `time` seconds are used up;
    either may be None. `fixed`, if given, is the size of all passes but the last. `many` asks for at least eight passes
    of similar sizes, so that an error can be estimated from them."""

    def __init__(self, pixels, spp=None, time=None, fixed=None, many=False):
        self._spp, self._time, self._fixed, self._many = spp, time, fixed, many
        self._largest = _power_of_two(largest_pass(pixels))
        self._least = USUAL if USUAL * pixels <= FIRST_SAMPLES else 1
        self._current, self._seconds, self._asked = fixed or self._least, {}, None

    def next(self, passes, elapsed):
        """Return the samples per pixel of the pass that follows `passes` (list of `Pass`) after `elapsed` seconds, or
        what has ended the render: "spp" or "time"."""
        done = sum(one.spp for one in passes)
        if passes and self._asked is None:  # it goes on from these
            self._asked = passes[-1].spp
        if passes:
            self._learn(passes[-1].seconds, done)
        size = self._current
        if self._spp is not None:
            if done >= self._spp:
                return "spp"
            left = self._spp - done
            size = min(size, left if self._fixed or left < USUAL else _power_of_two(left))
        if self._time is not None and passes:
            size = self._in_time(size, self._time - elapsed)
            if size == 0:
                return "time"
        self._asked = size
        return size

    def _learn(self, seconds, done):
        """Take note of what the last pass took, and choose the usual size of those to come."""
        repeated = self._asked in self._seconds
        # The first of a size may have compiled its kernels.
        self._seconds[self._asked] = min(seconds, self._seconds.get(self._asked, math.inf))
        if self._fixed or self._asked != self._current:
            return
        if repeated and seconds > LONGEST * PASS_SECONDS:
            self._current = max(1, _power_of_two(self._current * PASS_SECONDS / seconds))
            return
        grown = _power_of_two(max(1, self._current * PASS_SECONDS / max(seconds, 1e-6)))
        if repeated and seconds < PASS_SECONDS:
            # Where starting a pass is most of it, its time would never let it grow
            grown = max(grown, (4 if seconds < PASS_SECONDS / 2 else 2) * self._current)
        grown = min(grown, self._largest, _power_of_two(max(1, done / PARTS)) if self._many else self._largest)
        if grown > self._current and grown >= min(USUAL, self._largest):
            self._current = grown

    def _in_time(self, size, left):
        """Return the largest size up to `size` that the seconds `left` are enough for, or the least one where they are
        nearer to one more pass than to none, 0 where they are not."""
        least = size if self._fixed else min(size, self._least)
        while size > least and self._expected(size) > left:
            size = max(least, size // 2)
        return size if self._expected(size) <= 2 * left else 0

    def _expected(self, size):
        """Return the seconds that a pass will take: those that one of this size took, or by a line through the smallest
        and the largest that there were."""
        if size in self._seconds:
            return self._seconds[size]
        small, large = min(self._seconds), max(self._seconds)
        longest = self._seconds[large]
        each = longest / large
        if small < large:
            slope = (longest - self._seconds[small]) / (large - small)
            each = min(max(slope, LEAST_SHARE * each), each)
        return longest + each * (size - large)


def _power_of_two(number):
    """Return the largest power of two up to a number, at least 1."""
    return 2 ** math.floor(math.log2(number)) if number >= 1 else 1
