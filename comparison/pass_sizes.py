"""How many samples per pixel the next pass of a render has: passes of about two seconds, whatever they cost.

Passes that are rendered in parts, and so can be stopped in between, are longer where they cost much to start: so long
that starting one is a quarter of it, but about ten seconds at most, or twice as long as it takes to start.

Sizes are powers of two, from 4 on if a pixel allows it: Mitsuba compiles one kernel for all of these, and others for
numbers between and, with some filters of the film, for fewer. To start another pass in parts takes longer than that, so
these may have 2 samples, and the last one what is missing. The first pass is small, since nothing is known; each later
one is as large as the one before, or larger by a factor that the time of that one allows. As the first pass of a kernel
compiles it, time says at most what a pass costs, so that growing by it is safe; shrinking needs a second pass of the
same size, and so does growing at the risk of twice the time, where passes cost much to start.
"""

import math

from .rendering import largest_pass

PASS_SECONDS = 2.0
START_SHARE = 0.25  # of the time of a pass in parts, which may go into starting it
MOST_SECONDS, LEAST_REST = 10.0, 1.0  # of such a pass; but what follows its start takes so many times as long
LONGEST = 2.0  # times the seconds that are wanted: only longer passes are made smaller
CHANGED = 1.5  # times as long, or as short, as a pass of the same size: others tell nothing any more
MOST_GROWTH = 4  # from one size to the next, where it is not safe; sizes that tell of each other
USUAL = 4  # samples per pixel from which on all powers of two have the same kernels
FIRST_SAMPLES = 2**19  # pixel samples that a first pass may have, unless one per pixel is more
LEAST_SHARE = 0.1  # of a pass's time that is taken to depend on its samples, at least
PARTS = 8  # where an error is asked for: no pass has more than this part of the samples that there are


class PassSizes:
    """Sizes of the passes of an image of `pixels` pixels, until `spp` samples per pixel or `time` seconds are used up;
    either may be None. `fixed`, if given, is the size of all passes but the last. `many` asks for at least eight passes
    of similar sizes, so that an error can be estimated from them. `in_parts`: whether passes are rendered in
    parts."""

    def __init__(self, pixels, spp=None, time=None, fixed=None, many=False, in_parts=False):
        self._spp, self._time, self._fixed, self._many, self._in_parts = spp, time, fixed, many, in_parts
        self._largest = _power_of_two(largest_pass(pixels, in_parts))
        self._least = USUAL if USUAL * pixels <= FIRST_SAMPLES else 1
        self._current, self._seconds, self._asked = fixed or self._least, {}, None
        self._known = {}  # by size, what the last pass took; but for the first of all here, which compiles most kernels
        self._before = None  # how many passes there were when this render began or went on

    def next(self, passes, elapsed):
        """Return the samples per pixel of the pass that follows `passes` (list of `Pass`) after `elapsed` seconds, or
        what has ended the render: "spp" or "time"."""
        done = sum(one.spp for one in passes)
        if self._before is None:  # it goes on from these
            self._before = len(passes)
            self._asked = passes[-1].spp if passes else None
        if passes:
            self._learn(passes[-1].seconds, done, compiles=len(passes) == self._before + 1)
        size = self._current
        if self._spp is not None:
            if done >= self._spp:
                return "spp"
            size = self._of_the_rest(size, self._spp - done)
        if self._time is not None and passes:
            size = self._in_time(size, self._time - elapsed)
            if size == 0:
                return "time"
        self._asked = size
        return size

    def _of_the_rest(self, size, left):
        """Return the size of the next pass, of about `size` samples, where `left` are missing."""
        if self._in_parts and not self._many and not self._fixed and left < 2 * size and left <= self._largest:
            return left
        return min(size, left if self._fixed or left < USUAL else _power_of_two(left))

    def _learn(self, seconds, done, compiles):
        """Take note of what the last pass took, and choose the usual size of those to come."""
        repeated = self._asked in self._seconds
        # The first of a size may have compiled its kernels
        self._seconds[self._asked] = min(seconds, self._seconds.get(self._asked, math.inf))
        if not compiles:
            before = self._known.get(self._asked, seconds)
            if not 1 / CHANGED < seconds / max(before, 1e-6) < CHANGED:
                self._known.clear()  # the machine is no longer what it was
            self._known[self._asked] = seconds
        if self._fixed or self._asked != self._current:
            return
        wanted, line = self._wanted(), self._in_parts and self._line()
        if repeated and seconds > LONGEST * wanted:
            self._current = max(1, _power_of_two(self._current * wanted / seconds))
            return
        grown = self._grown(seconds, wanted, repeated, line)
        grown = min(grown, self._largest, _power_of_two(max(1, done / PARTS)) if self._many else self._largest)
        if grown > self._current and (self._in_parts or grown >= min(USUAL, self._largest)):
            self._current = grown

    def _grown(self, seconds, wanted, repeated, line):
        """Return the size of a pass that may take `wanted` seconds, when one of the current size took `seconds`."""
        if line:
            start, each = line
            return min(_power_of_two((wanted - start) / each), MOST_GROWTH * self._current)
        grown = _power_of_two(self._current * wanted / max(seconds, 1e-6))
        if repeated and seconds < wanted:
            # Where starting a pass is most of it, its time would never let it grow
            times = MOST_GROWTH if seconds < wanted / 2 and not self._in_parts else 2
            grown = max(grown, times * self._current)
        return grown

    def _in_time(self, size, left):
        """Return the largest size up to `size` that the seconds `left` are enough for, or the least one where they are
        nearer to one more pass than to none, 0 where they are not."""
        least = size if self._fixed else min(size, self._least)
        while size > least and self._expected(size) > left:
            size = max(least, _power_of_two(size - 1))
        return size if self._expected(size) <= 2 * left else 0

    def _wanted(self):
        """Return the seconds that a pass is to take."""
        if not self._in_parts:
            return PASS_SECONDS
        line, seconds = self._line(), self._seconds[self._asked]
        if line:
            return max(min(line[0] / START_SHARE, MOST_SECONDS), (1 + LEAST_REST) * line[0], PASS_SECONDS)
        # All of it may have started the pass
        most = MOST_SECONDS if seconds < MOST_SECONDS else (1 + LEAST_REST) * seconds
        return max(min(seconds / START_SHARE, most), PASS_SECONDS)

    def _expected(self, size):
        """Return the seconds that a pass will take: those that one of this size took, or by a line, or, where that is
        not known, as if nothing of it started the pass."""
        if size in self._seconds:
            return self._seconds[size]
        line = self._line()
        if not line:
            large, longest = max((self._known or self._seconds).items())
            line = 0.0, longest / large
        start, each = line
        return start + each * size

    def _line(self):
        """Return the seconds that it takes to start a pass, and those of each sample per pixel, by the largest size and
        the least that is not far from it; None where it is not known."""
        large = max(self._known, default=0)
        small = min((size for size in self._known if MOST_GROWTH * size >= large), default=0)
        if small == large:
            return None
        longest = self._known[large]
        each = (longest - self._known[small]) / (large - small)
        each = min(max(each, LEAST_SHARE * longest / large), longest / large)
        return longest - each * large, each


def _power_of_two(number):
    """Return the largest power of two up to a number, at least 1."""
    return 2 ** math.floor(math.log2(number)) if number >= 1 else 1
