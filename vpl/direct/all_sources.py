"""Direct light by the plain sum over the sources, with one shadow ray for each: cheapest for few sources.

The points of a group loop over the sources in step, with coherent rays.  One round is exact for sites of a
single point lit by sources without extent.  Otherwise every round draws new points on the site and on the sources, and
rounds continue until the estimates of two halves agree.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..core.sampling import derived_seed
from .cluster_sampling import Drawn, sum_sources
from .site_table import Lanes, PassContext
from .sites import Sites

_LEAST_ROUNDS = 2  # rounds of each half before the difference of the halves can end the sum


class SourceRounds:
    """Sums over all sources, in rounds, for the sites of a table with single sources as clusters.

    ``share``, ``bsdf_share``, ``level``: see :class:`vpl.direct.passes.SiteEstimates`.
    """

    def __init__(self, context: PassContext, sites: Sites, share, bsdf_share, level: float, options):
        self.context, self.sites, self.share, self.bsdf_share = context, sites, share, bsdf_share
        self.level, self.options = level, options
        count = context.table.count
        self.total, self.rounds = np.zeros((2, count, 3)), np.zeros((2, count), np.int64)
        self.rays, self.seen, self.samples = np.zeros(count), np.zeros(count), np.zeros(count)

    def run(self, seed: int, halted) -> None:
        """Sum until all groups converge.  ``halted``: called with the number of every round before it; True stops."""
        table = self.context.table
        if table.entries == 0:
            return
        size = download(table.size).astype(np.int64)
        extended = self.context.sources.nodes.extended[download(table.node)].any() or self.bsdf_share.any()
        noisy = (size > 0) & (extended | (self.sites.points > 1))
        active = np.flatnonzero(size)
        for number in range(2 * self.options.max_samples):
            if len(active) == 0 or halted(number):
                break
            half = number % 2
            drawn = self._round(active, half, size, derived_seed(seed, number))
            self.total[half, active] += download(drawn.radiance)
            self.rounds[half, active] += 1
            self.rays[active] += download(drawn.rays)
            self.seen[active] += download(drawn.seen)
            self.samples[active] += size[active]
            if number == 0:
                active = np.flatnonzero(noisy)
            if half == 1 and number + 1 >= 2 * _LEAST_ROUNDS:
                affordable = self.samples + 2 * size <= self.options.max_samples
                active = np.flatnonzero(noisy & affordable & self._unfinished()[self.sites.group])

    def _round(self, active, half: int, size, seed: int) -> Drawn:
        bsdf = np.ceil(size[active] * self.bsdf_share[active])
        columns = (active, np.full(len(active), half), np.ones(len(active)), bsdf)
        return sum_sources(self.context, Lanes(*(upload(mi.UInt32, column) for column in columns)), seed)

    def _unfinished(self) -> np.ndarray:
        """Mask of the groups with an estimated mean squared error above the allowed one, (g,) bool."""
        level, variance = self._estimate()
        first = self.sites.group_first[:-1]
        allowed = np.square(level.mean(1)) + (self.options.dark_floor * self.level) ** 2
        error, limit = (np.add.reduceat(x, first) for x in (variance * self.share, self.options.error**2 * allowed))
        return error > limit

    def _estimate(self):
        """(Radiance (s, 3), its variance (s,): a quarter of the squared difference of the halves' channel means)."""
        rounds = np.maximum(self.rounds, 1)
        means = self.total / rounds[..., None]
        counted = self.rounds > 0
        both = np.maximum(counted.sum(0), 1)
        difference = np.where(counted.all(0), means[0].mean(1) - means[1].mean(1), 0)
        return means.sum(0) / both[:, None], np.square(difference) / 4

    def result(self):
        """Per site: radiance (s, 3), variance, rounds, rays, and the fraction of samples that found light."""
        radiance, variance = self._estimate()
        seen = self.seen / np.maximum(self.samples, 1)
        return radiance, variance, self.rounds.max(0), self.rays, np.minimum(seen, 1)
