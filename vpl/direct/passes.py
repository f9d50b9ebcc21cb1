"""The passes of iterative adaptive sampling over some groups of sites [IAS sections 4.1, 4.2, 5.8, 5.9].

A site has two halves, independent estimates with common probabilities.  The estimate of one half decides the number of
samples of the other.  A half thus never stops because its own estimate seems to have converged, which would bias the
image (termination bias, [IAS] section 2).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, ranges, upload
from ..core.sampling import derived_seed
from .cluster_probabilities import Mixture, sum_over_groups, update_importance, update_probabilities
from .cluster_sampling import draw_samples
from .site_table import Lanes, PassContext, Statistics

_LEAST_HALF = 4  # least samples of a half in a pass, for an estimate of the variance
_INCREMENT = 25  # least samples of a pixel in a pass near convergence [IAS section 5.8]
# A pixel is black after so many passes and samples without light [IAS section 5.9]; least number of samples of a site
_BLACK_PASSES, _BLACK_SAMPLES, _LEAST_BLACK_SAMPLES = 3, 250, 48
_LEAST_BSDF_SAMPLES = 2  # of a half in a pass
_NEIGHBOURS = 256  # consecutive sites that are sorted by number of samples
# Weight of the uniform function after the first pass; decay of the block function's weight per pass [IAS fig. 2]
_UNIFORM_SHARE, _BLOCK_DECAY = 0.1, 0.7


class SiteEstimates:
    """Estimates of both halves of each site, their costs, and the samples that they need to converge.

    ``context``: with a table of s sites; ``share`` (s,): fraction of the pixel's camera rays that belong to the
    site; ``bsdf_share`` (s,): BSDF samples per emitter sample; ``level``: mean radiance of the image, the unit of
    ``options.dark_floor``.
    """

    # Emitter samples of a pixel in a pass: per cluster, and minimum [IAS section 5.8]; a maximum, so that passes adapt
    samples_per_cluster, least_samples, most_samples = 1.5, 50, 400

    def __init__(self, context: PassContext, share, bsdf_share, level: float, options):
        self.context, self.share, self.bsdf_share = context, share, bsdf_share
        self.level, self.options = level, options
        table = context.table
        self.size = download(table.size).astype(np.int64)
        count = table.count
        # Per half and site: sums of weighted estimates, of weights, and of squared weights times variances
        self.total, self.weight, self.spread = np.zeros((2, count, 3)), np.zeros((2, count)), np.zeros((2, count))
        self.samples, self.seen = np.zeros((2, count), np.int64), np.zeros((2, count), np.int64)
        self.tried, self.rays, self.passes = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)

    def draw(self, wanted: np.ndarray, number: int, weight: float, seed: int) -> None:
        """Take ``wanted`` samples of each half and site, (2, s), and add the estimates.

        ``number``: of the pass; ``weight``: see :meth:`_weights`.
        """
        half, site = np.nonzero(wanted)
        # Lanes of a packet should be neighbours with similar numbers of samples
        order = np.lexsort((wanted[half, site], site // _NEIGHBOURS))
        half, site = half[order], site[order]
        samples = wanted[half, site]
        bsdf = np.maximum(np.ceil(wanted * self.bsdf_share), _LEAST_BSDF_SAMPLES)
        bsdf = np.where(self.bsdf_share > 0, bsdf, 0)[half, site]
        drawn = draw_samples(self.context, Lanes(*(upload(mi.UInt32, x) for x in (site, half, samples, bsdf))), seed)
        variance = download(drawn.variance).astype(np.float64)
        weight = self._weights(samples, variance, weight)
        self.total[half, site] += weight[:, None] * download(drawn.radiance)
        self.weight[half, site] += weight
        self.spread[half, site] += np.square(weight) * variance
        self.samples[half, site] += samples
        self.seen[half, site] += download(drawn.seen)
        np.add.at(self.tried, site, samples + bsdf)
        self.passes[site] = number + 1
        np.add.at(self.rays, site, download(drawn.rays))

    def _weights(self, samples: np.ndarray, variance: np.ndarray, weight: float) -> np.ndarray:
        """Weights of the estimates of a pass: number of samples times ``weight``, per sampled half and site.

        Weights that do not depend on the estimates keep their combination unbiased.  The paper weights passes by their
        inverse estimated variance (eq. 7, 8).
        """
        return samples * weight

    def full_pass(self) -> np.ndarray:
        """Samples of each half in a whole pass [IAS section 5.8], (2, s); 0 for sites without clusters."""
        of_pixel = np.clip(self.samples_per_cluster * self.size, self.least_samples, self.most_samples)
        of_pixel = np.minimum(of_pixel, self.options.max_samples)
        half = np.maximum(np.ceil(of_pixel * self.share / 2).astype(np.int64), _LEAST_HALF)
        return np.where(self.size > 0, half, 0) * np.ones((2, 1), np.int64)

    def halves(self):
        """(Radiance (2, s, 3), variance of the channel mean (2, s)) of both halves."""
        weight = np.where(self.weight > 0, self.weight, 1)
        return self.total / weight[..., None], self.spread / np.square(weight)

    def wanted(self, number: int, radiance: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Samples of each half in the next pass, (2, s), decided by the other half.

        ``number``: of the pass before; ``radiance``, ``variance``: see :meth:`halves`.  [IAS section 4.2] compares
        s² / L² with a threshold.  Here (``dark_floor`` × ``level``)² is added to L², and the threshold is divided by
        the fraction of the pixel that the site covers.
        """
        options, full = self.options, self.full_pass()
        level = radiance.mean(2)
        allowed = options.error**2 * (np.square(level) + (options.dark_floor * self.level) ** 2) / self.share
        # Variance of the mean of both halves, if the variances of single samples are equal
        samples = np.maximum(self.samples, 1)
        expected = variance * samples / samples[::-1] / 2
        excess = expected / np.maximum(allowed, np.finfo(np.float64).tiny)
        missing = np.ceil(np.minimum(excess - 1, 1) * samples[::-1])
        few = np.minimum(np.maximum(missing, np.ceil(_INCREMENT * self.share / 2)), full)
        wanted = np.where(excess >= 2, full, np.maximum(few, _LEAST_HALF))
        dark = self.seen == 0
        enough = np.maximum(_BLACK_SAMPLES * self.share, _LEAST_BLACK_SAMPLES)
        black = (number + 1 >= _BLACK_PASSES) & (2 * self.samples >= enough)
        wanted = np.where(dark, np.where(black, 0, full), np.where(excess <= 1, 0, wanted))
        wanted = np.where(self.size > 0, wanted, 0).astype(np.int64)[::-1]
        left = np.floor(options.max_samples * self.share / 2 - self.samples).astype(np.int64)
        return np.where(left >= _LEAST_HALF, np.minimum(wanted, left), 0)

    def result(self, radiance: np.ndarray, variance: np.ndarray):
        """Per site: radiance (s, 3), estimated variance, passes, rays, and the fraction of samples that found light.

        ``radiance``, ``variance``: see :meth:`halves`.
        """
        # A half without samples, because the render was stopped, does not count
        counted = self.weight > 0
        halves = np.maximum(counted.sum(0), 1)
        mean = np.where(counted[..., None], radiance, 0).sum(0) / halves[:, None]
        return (
            mean, np.where(counted, variance, 0).sum(0) / np.square(halves), self.passes, self.rays,
            self.seen.sum(0) / np.maximum(self.tried, 1),
        )  # fmt: skip


class SitePasses:
    """Passes over the sites of a table, each of which adapts the next.  Arguments: see :class:`SiteEstimates`."""

    # Number of imaginary samples that found everything visible
    prior = 1.0

    def __init__(self, context: PassContext, share, bsdf_share, level: float, options):
        self.estimates = SiteEstimates(context, share, bsdf_share, level, options)
        self.context, self.options, self.max_passes = context, options, options.max_passes
        self._cut = download(context.table.cut).astype(np.int64)

    def run(self, two_sided, seed: int, halted: Callable[[int], bool]) -> None:
        """Sample until the sites converge.

        ``two_sided``: Bool per point of the batch; ``halted``: called with the number of every pass before it; True
        stops.
        """
        context, table, estimates = self.context, self.context.table, self.estimates
        if table.entries == 0:
            return
        context.importance = dr.ones(mi.Float, table.entries)
        dr.eval(context.importance)
        self._evaluate_importance(two_sided)
        context.statistics = Statistics.empty(table.entries)
        context.probability = dr.empty(mi.Float, table.entries)
        of_groups = tuple(dr.zeros(mi.Float, dr.width(table.node)) for _ in range(3))
        wanted = estimates.full_pass()
        for number in range(self.max_passes):
            active = np.flatnonzero(wanted.any(0))
            if len(active) == 0 or halted(number):
                break
            sum_over_groups(table, context.statistics, of_groups, upload(mi.UInt32, self._places(active)))
            update_probabilities(context, of_groups, self._mixture(number), upload(mi.UInt32, active))
            # Square root rule: near optimal for later passes that are better by an unknown amount [Owen and Zhou 2020,
            # "The square root rule for adaptive importance sampling"]
            estimates.draw(wanted, number, np.sqrt(number + 1.0), derived_seed(seed, number))
            wanted = estimates.wanted(number, *estimates.halves())

    def _evaluate_importance(self, two_sided) -> None:
        """Set the importance of clusters to their unoccluded contributions."""
        update_importance(self.context, two_sided, dr.arange(mi.UInt32, self.context.table.count))

    def _places(self, active: np.ndarray) -> np.ndarray:
        """Indices in ``table.node`` of the cuts of some sites' groups."""
        first, at = np.unique(self._cut[active], return_index=True)
        return ranges(first, self.estimates.size[active[at]])

    def _mixture(self, number: int) -> Mixture:
        """Weights of the three functions in a pass [IAS fig. 2]: uniform at first, then mostly the block function,
        increasingly the pixel function."""
        uniform = 1.0 if number == 0 else _UNIFORM_SHARE
        pixel = (1 - uniform) * (1 - _BLOCK_DECAY**number)
        shares = (uniform, 1 - uniform - pixel, pixel, self.prior)
        return Mixture(*(dr.opaque(mi.Float, share) for share in shares))

    def result(self):
        """See :meth:`SiteEstimates.result`."""
        return self.estimates.result(*self.estimates.halves())
