"""The standard that iterative adaptive sampling is compared with [IAS section 5.1].

For each point a fixed density over all sources, proportional to their unoccluded contribution; point after point of a
pixel, until its estimate converges by the same rule.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import download, upload
from .cluster_probabilities import Mixture, update_importance, update_probabilities
from .sampling import derived_seed
from .site_passes import SitePasses
from .site_table import Statistics


class UnoccludedPasses(SitePasses):
    """Passes over one point of every site after another.  ``options.least_samples``: emitter samples at each."""

    def run(self, two_sided, seed: int, stopped) -> None:
        """Sample until all sites are done.  ``two_sided``: Bool per point of the batch, lit from both sides."""
        whole = self.scenery.table
        if whole.entries == 0:
            return
        first, members = (download(column).astype(np.int64) for column in (whole.member_first, whole.members))
        self.scenery.importance = dr.zeros(mi.Float, whole.entries)
        self.scenery.probability = dr.empty(mi.Float, whole.entries)
        self.scenery.statistics = Statistics.empty(whole.entries)
        nothing = tuple(dr.zeros(mi.Float, dr.width(whole.node)) for _ in range(3))
        mixture = Mixture(*(dr.opaque(mi.Float, share) for share in (1.0, 0.0, 0.0, 1.0)))
        wanted = self._full_pass()
        for number in range(self.max_passes):
            active = np.flatnonzero(wanted.any(0))
            if len(active) == 0 or stopped():
                break
            self.scenery.table = replace(
                whole,
                member_first=upload(mi.UInt32, first + number % members),
                members=dr.full(mi.UInt32, 1, whole.count),
            )
            # Sites of one point keep their density
            changed = active if number == 0 else active[members[active] > 1]
            if len(changed):
                sites = upload(mi.UInt32, changed)
                update_importance(self.scenery, two_sided, sites)
                update_probabilities(self.scenery, nothing, mixture, sites)
            self._draw(wanted, number, 1.0, derived_seed(seed, number))
            wanted = self._wanted(number)

    def _full_pass(self) -> np.ndarray:
        half = np.maximum(np.ceil(self.options.least_samples * self.share / 2).astype(np.int64), 1)
        return np.where(self.size > 0, half, 0) * np.ones((2, 1), np.int64)
