"""The standard that iterative adaptive sampling is compared with [IAS section 5.1].

Each point samples the sources with a fixed density, proportional to unoccluded contributions.  Points of a pixel are
sampled one after another, until the estimate converges by the same rule.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..core.sampling import derived_seed
from .cluster_probabilities import Mixture, update_importance, update_probabilities
from .passes import SiteEstimates
from .site_table import Statistics

_LEAST_PASSES = 4  # least passes of each half for an estimate of the variance between points


class UnoccludedPasses:
    """Passes over the points of every site, one point a pass, with ``options.samples_per_ray`` emitter samples each.

    Arguments as in :class:`vpl.direct.passes.SiteEstimates`.
    """

    def __init__(self, context, share, bsdf_share, level, options):
        self.estimates = SiteEstimates(context, share, bsdf_share, level, options)
        self.estimates.least_samples = self.estimates.most_samples = options.samples_per_ray
        self.context, self.options = context, options
        self.several = download(context.table.members) > 1
        # Sums over the passes of each half and site: of channel means, of their squares, and of passes
        self.levels, self.squares, self.done = (np.zeros((2, len(share))) for _ in range(3))

    def run(self, two_sided, seed: int, halted) -> None:
        """Sample until the sites converge.  Arguments as in :meth:`vpl.direct.passes.SitePasses.run`."""
        whole = self.context.table
        if whole.entries == 0:
            return
        first, members = (download(column).astype(np.int64) for column in (whole.member_first, whole.members))
        self.context.importance = dr.zeros(mi.Float, whole.entries)
        self.context.probability = dr.empty(mi.Float, whole.entries)
        self.context.statistics = Statistics.empty(whole.entries)
        nothing = tuple(dr.zeros(mi.Float, dr.width(whole.node)) for _ in range(3))
        mixture = Mixture(*(dr.opaque(mi.Float, share) for share in (1.0, 0.0, 0.0, 1.0)))
        wanted = self.estimates.full_pass()
        for number in range(self.options.max_passes):
            active = np.flatnonzero(wanted.any(0))
            if len(active) == 0 or halted(number):
                break
            for half in (0, 1):
                # The halves use different points if the site has several
                member = (2 * number + half) % members
                changed = np.flatnonzero(wanted[half])
                if number + half > 0:
                    changed = changed[members[changed] > 1]
                self._select_points(whole, first + member, changed, two_sided, nothing, mixture)
                self._draw_half(wanted, half, number, derived_seed(seed, number, half))
            wanted = self.estimates.wanted(number, *self._halves())

    def _select_points(self, whole, place, changed, two_sided, nothing, mixture) -> None:
        """Select one point of every site, and update the densities of the sites ``changed``."""
        one = dr.full(mi.UInt32, 1, whole.count)
        self.context.table = replace(whole, member_first=upload(mi.UInt32, place), members=one)
        if len(changed):
            sites = upload(mi.UInt32, changed)
            update_importance(self.context, two_sided, sites)
            update_probabilities(self.context, nothing, mixture, sites)

    def _draw_half(self, wanted: np.ndarray, half: int, number: int, seed: int) -> None:
        """Draw a pass of one half, and record its mean for the variance between points."""
        taken = wanted[half]
        if not taken.any():
            return
        before = self.estimates.total[half].mean(1)
        self.estimates.draw(np.where(np.arange(2)[:, None] == half, wanted, 0), number, 1.0, seed)
        found = np.where(taken > 0, (self.estimates.total[half].mean(1) - before) / np.maximum(taken, 1), 0)
        self.levels[half] += found
        self.squares[half] += np.square(found)
        self.done[half] += taken > 0

    def _halves(self):
        """Radiance and variance of both halves; for sites of several points the variance between passes."""
        radiance, variance = self.estimates.halves()
        passes = np.maximum(self.done, 2)
        between = np.maximum(self.squares / passes - np.square(self.levels / passes), 0) / (passes - 1)
        several = self.several & (self.done >= _LEAST_PASSES)
        unknown = self.several & (self.done < _LEAST_PASSES) & (self.done > 0)
        return radiance, np.where(several, between, np.where(unknown, np.inf, variance))

    def result(self):
        """See :meth:`vpl.direct.passes.SiteEstimates.result`."""
        return self.estimates.result(*self._halves())
