"""Sums of the integrators' counters over the passes of a render."""

from copy import deepcopy

import numpy as np


def total_statistics(passes):
    """Return the sum of the integrators' counters over passes (see `TotalStatistics`)."""
    return TotalStatistics().of(passes)


class TotalStatistics:
    """Sum of the integrators' counters over passes.

    Numbers are summed, also in nested dicts ("seconds"); the sum of "precision" is that of the image. Descriptions,
    such as the text "plan", the dict "lights" and the list "costs", come from the pass with the most samples, the
    last of equal passes.
    """

    def __init__(self):
        self._total, self._count, self._most = {}, 0, 0

    def of(self, passes):
        """Return the total of a list of passes that begins with the list of the last call; {} without counters."""
        for one in passes[self._count :]:
            _add(self._total, one.statistics, describe=one.spp >= self._most)
            self._most = max(self._most, one.spp)
        self._count = len(passes)
        return deepcopy(self._total)


def _add(total, statistics, describe):
    for key, value in statistics.items():
        if isinstance(value, dict) and key != "lights":
            _add(total.setdefault(key, {}), value, describe)
        elif isinstance(value, int | float | np.number) and not isinstance(value, bool):
            total[key] = total.get(key, 0) + (value.item() if isinstance(value, np.number) else value)
        elif describe or key not in total:
            total[key] = value
