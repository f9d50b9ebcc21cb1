"""Cuts through the product of a pixel's gather tree and the light trees [MDLC].

A pixel's radiance is the sum, over all pairs of one of its gather points and a light, of what the light sends to the
point, weighted by the point's share of the pixel.  A pair of a gather node and a light node stands for all pairs below;
it is refined while its bound, times the share of its gather node, is above ``error`` times the radiance of the pixel.
One point and one light represent it, each drawn by its strength, so that the cut is unbiased.  A point stands for what
arrives at the others: each reflects it by itself, so that textures are not blurred under filters wider than a pixel.

Departures from the paper: thresholds are known before refinement begins, from estimates of the pixels' radiance,
instead of following from the running total of a heap, so that all pixels refine at once (:mod:`vpl.cuts.product_cuts`);
and gather nodes above a pixel take part.  Pairs with blocks of pixels are never accepted, but what no pixel of a block
can see is left out once for all of them, and a cluster of lights that is too coarse for every pixel of a block is
divided once.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, channel_mean, download, upload
from ..core.sampling import derived_seed, find_interval, independent_sampler, precise_sample, running_sums
from ..lights.light_set import LightGroup
from ..points.point_clusters import PointClusters
from ..transport.evaluation import Transport, evaluate_pairs
from .light_cuts import upload_thresholds
from .product_cuts import Pairs

# A threshold that no bound is below
_NONE = -1.0


class PixelCuts:
    """Light of some pixels, found pair by pair, and what it took: ``pairs``, ``rays``, and how many values were
    ``dropped`` because they were not finite.

    ``clusters``: points along their gather trees; ``pixel``, (n,) of NumPy: of every point along the tree; ``weight``:
    the factor on its radiance in its camera ray; ``samples``: camera rays of a pixel.
    """

    def __init__(self, clusters: PointClusters, pixel: np.ndarray, weight, samples: int, seed: int):
        self.clusters, self._seed, self._kernels = clusters, seed, 0
        tree = clusters.tree
        end = tree.first.astype(np.int64) + tree.count
        self._of_pixel = pixel[tree.first] == pixel[end - 1]
        self._reflectance = clusters.batch.surfaces.reflectance()
        dr.eval(self._reflectance)
        strength = weight * self._reflectance
        self._cumulative, *self._channels = (running_sums(x) for x in (channel_mean(strength), *strength))
        # Of the channel with most weight: where weights have colours, a pair may add more than the mean suggests
        channels = np.stack([download(running_sums(channel)) for channel in weight])
        self._share = (channels[:, end] - channels[:, tree.first]).max(0) / samples
        self._parent, self._leaf = upload(mi.UInt32, tree.parent), upload(mi.UInt32, tree.leaf)
        self._light = dr.zeros(mi.UnpolarizedSpectrum, tree.size)
        self.dropped = 0
        self.pairs, self.rays = dr.zeros(mi.Float, tree.size), dr.zeros(mi.UInt32, clusters.count)
        dr.eval(self._light, self.pairs, self.rays)

    def rule(self, allowed: np.ndarray):
        """(accept, points first) for :func:`vpl.cuts.product_cuts.find_pairs`.

        ``allowed`` (n,): what a pair may add to the radiance of a pixel at most, for every point along the tree.
        """
        tree = self.clusters.tree
        least = tree.gather_up(allowed[tree.first[tree.leaves]], tree.leaves, np.minimum)
        # Bounds hold for one point of unit weight
        share = np.maximum(self._share, np.finfo(np.float64).tiny)
        of_pixels = upload_thresholds(np.where(self._of_pixel, least / share, _NONE))
        of_blocks = upload_thresholds(np.where(self._of_pixel, _NONE, least))

        def accept(points, lights, bound, index):
            """Whether a pair is fine enough; with a block of pixels, none is."""
            return bound <= dr.gather(mi.Float, of_pixels, index)

        def points_first(points, lights, bound, index):
            """Whether the lights of a pair are fine enough for every pixel of a block."""
            return bound <= dr.gather(mi.Float, of_blocks, index)

        return accept, points_first

    def evaluate(self, transport: Transport, group: LightGroup, pairs: Pairs) -> None:
        """Add the light of accepted pairs: one point and one light stand for each."""
        self._kernels += 1
        point, factor = self._representative(pairs)
        light, scale = group.representatives(pairs.lights)
        surface = self.clusters.batch.surfaces_at(point)
        value, traced = evaluate_pairs(transport, group, surface, light, scale)
        reflectance = dr.gather(type(self._reflectance), self._reflectance, point)
        value = mi.UnpolarizedSpectrum(dr.select(reflectance > 0, value / reflectance, 0) * factor)
        bad = ~dr.all(dr.isfinite(value))
        add_at(self._light, dr.select(bad, 0, value), pairs.points)
        add_at(self.pairs, dr.ones(mi.Float, pairs.count), pairs.points)
        add_at(self.rays, dr.select(traced, mi.UInt32(1), 0), point)
        bad = dr.select(bad, mi.UInt32(1), 0)
        dr.eval(self._light, self.pairs, self.rays, bad)
        # One such value would spoil all samples of its pixel
        self.dropped += int(dr.sum(bad)[0])

    def _representative(self, pairs: Pairs):
        """A point of every pair's gather node, drawn by weight and reflectance, and the factor on what arrives there.

        Where these have colours, the factor makes up for those of the point that was drawn.
        """
        first, count = self.clusters.ranges(pairs.points)
        last = first + count
        sample = precise_sample(independent_sampler(derived_seed(self._seed, self._kernels), pairs.count))
        point = find_interval(self._cumulative, first, last, sample)

        def ratio(cumulative):
            low, high, begin, end = (
                dr.gather(type(cumulative), cumulative, index) for index in (point, point + 1, first, last)
            )
            return dr.select(end > begin, (high - low) / (end - begin), 0)

        drawn = ratio(self._cumulative)
        factor = [mi.Float(dr.select(drawn > 0, ratio(channel) / drawn, 0)) for channel in self._channels]
        return point, mi.UnpolarizedSpectrum(*factor)

    def per_point(self):
        """(Radiance, pairs): for every point along the tree, from all nodes that hold it; pairs are shared out."""
        share = dr.rcp(mi.Float(upload(mi.UInt32, self.clusters.tree.count)))
        radiance = self._reflectance * self._sum_from_root(self._light)
        return radiance, self._sum_from_root(self.pairs * share)

    @dr.syntax
    def _sum_from_root(self, values):
        dr.eval(values)
        node = mi.UInt32(self._leaf)
        total = dr.gather(type(values), values, node)
        while dr.hint(node > 0, exclude=[self, values]):
            node = dr.gather(mi.UInt32, self._parent, node)
            total += dr.gather(type(values), values, node)
        dr.eval(total)
        return total
