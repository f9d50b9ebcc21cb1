"""Limits of a render, and the expected time until its end."""

from bisect import bisect_right
from numbers import Integral, Real
from operator import itemgetter

from .convergence import ErrorGoal


class Ending:
    """Limits of a render: `spp` samples per pixel, `time` in seconds, `error`; each may be None. `after`: seconds after
    the last pass.

    The prediction assumes that future samples cost as much as the second half of the finished samples: the first passes
    compile kernels, and are small. The error is assumed proportional to 1 / √samples, from its last estimate
    (`ErrorGoal`), so that its end is unknown before eight passes.
    """

    def __init__(self, spp=None, time=None, error=None, after=0.0):
        self.goal = ErrorGoal(error) if error else None
        self._spp, self._time, self._after, self._by_error = spp, time, after, None
        self._marks = []

    def mark(self, spp, seconds):
        """Record the samples per pixel and the seconds so far, at the start and after each pass."""
        self._marks.append((spp, seconds))

    def look(self, found, spp):
        """Record the estimated error `found` (None: unknown) of `spp` samples per pixel."""
        self._by_error = None if found is None else self.goal.samples(found, spp)

    def seconds_left(self, elapsed):
        """Return the expected seconds from `elapsed` seconds after the start until the end, None if unknown."""
        wanted = min((spp for spp in (self._spp, self._by_error) if spp is not None), default=None)
        ends = [self._time] if self._time is not None else []
        if wanted is not None and len(self._marks) > 1:
            spp, seconds = self._marks[-1]
            ends.append(seconds + (wanted - spp) * self._cost())
        return max(0.0, min(ends) + self._after - elapsed) if ends else None

    def _cost(self):
        """Return the seconds per sample per pixel."""
        last = self._marks[-1]
        # Without the first of several passes
        earliest = 1 if len(self._marks) > 2 else 0
        after = bisect_right(self._marks, last[0] / 2, earliest, len(self._marks) - 1, key=itemgetter(0))
        first = self._marks[max(after - 1, earliest)]
        return (last[1] - first[1]) / (last[0] - first[0])


def checked(**values):
    """Return limits of a render by name as numbers of Python, as those of NumPy would overflow. Raises ValueError for
    limits that are neither positive nor None."""
    numbers = []
    for name, value in values.items():
        kind, number = (Integral, int) if name.endswith("spp") else (Real, float)
        if value is not None and not (isinstance(value, kind) and 0 < value < float("inf")):
            raise ValueError(f"{name} must be a positive {'whole ' if kind is Integral else ''}number, got {value!r}")
        numbers.append(None if value is None else number(value))
    return numbers
