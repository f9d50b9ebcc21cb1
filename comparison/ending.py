"""What ends a render, and when that will be."""

from bisect import bisect_right
from operator import itemgetter

from .convergence import ErrorGoal


class Ending:
    """The end of a render by `spp` samples per pixel, `time` in seconds or an `error`, whichever comes first; each may
    be None. `after`: seconds that follow the last pass.

    Samples still to come are taken to cost what the second half of those that there are has cost: the first passes
    compile kernels, and are small. The error is taken to fall as one over the root of the samples, from where it was
    when it was last looked at (`ErrorGoal`), so that nothing is known of it before there are eight passes.
    """

    def __init__(self, spp=None, time=None, error=None, after=0.0):
        self.goal = ErrorGoal(error) if error else None
        self._spp, self._time, self._after, self._by_error = spp, time, after, None
        self._marks = []

    def mark(self, spp, seconds):
        """So many samples per pixel are there after so many seconds: called at the beginning, and after each pass."""
        self._marks.append((spp, seconds))

    def look(self, found, spp):
        """The error of `spp` samples per pixel is about `found` (None: it is not known)."""
        self._by_error = None if found is None else self.goal.samples(found, spp)

    def seconds_left(self, elapsed):
        """Return the seconds from `elapsed` seconds after the beginning to the end, None where they are not known."""
        wanted = min((spp for spp in (self._spp, self._by_error) if spp is not None), default=None)
        ends = [self._time] if self._time is not None else []
        if wanted is not None and len(self._marks) > 1:
            spp, seconds = self._marks[-1]
            ends.append(seconds + (wanted - spp) * self._cost())
        return max(0.0, min(ends) + self._after - elapsed) if ends else None

    def _cost(self):
        """Return the seconds of a sample per pixel."""
        last = self._marks[-1]
        # Of several passes not the first one
        earliest = 1 if len(self._marks) > 2 else 0
        after = bisect_right(self._marks, last[0] / 2, earliest, len(self._marks) - 1, key=itemgetter(0))
        first = self._marks[max(after - 1, earliest)]
        return (last[1] - first[1]) / (last[0] - first[0])
