"""Cuts through the product of a pixel's gather tree and the light trees [MDLC].

A pixel's radiance is the sum of the lights' contributions over pairs of a gather point and a light, weighted by the
point's fraction of the pixel.  A pair of a gather node and a light node represents the pairs below.  It is refined
while its bound, times the fraction of its gather node, exceeds ``error`` times the pixel's radiance.  A representative
point and a representative light, drawn in proportion to their strengths, make the cut unbiased.  The representative
point gives the incident light of the node.  Every point reflects it with its own reflectance, so that filters wider
than a pixel do not blur textures.

Departures from the paper: thresholds come from a radiance estimate before refinement instead of the running total of a
heap, so that the pixels are refined in parallel (:mod:`vpl.cuts.product_cuts`).  Gather nodes above pixels (blocks)
participate.  A pair with a block is never accepted.  Clusters of lights invisible to a whole block are skipped once for
the block, and clusters too coarse for every pixel of a block are split once.
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

# A threshold below every bound
_NEVER = -1.0


class PixelCuts:
    """Radiance of pixels, accumulated pair by pair.

    ``pairs``: number of pairs per node; ``rays``: shadow rays per point; ``dropped``: number of non-finite values.

    Arguments: ``clusters``: points in gather tree order; ``pixel``: (n,) NumPy array, pixel of every point in tree
    order; ``weight``: throughput of every point to the camera; ``samples``: camera rays per pixel.
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
        # Largest channel, because with coloured weights a pair's contribution can exceed the mean over channels
        channels = np.stack([download(running_sums(channel)) for channel in weight])
        self._fraction = (channels[:, end] - channels[:, tree.first]).max(0) / samples
        self._parent, self._leaf = upload(mi.UInt32, tree.parent), upload(mi.UInt32, tree.leaf)
        self._light = dr.zeros(mi.UnpolarizedSpectrum, tree.size)
        self.dropped = 0
        self.pairs, self.rays = dr.zeros(mi.Float, tree.size), dr.zeros(mi.UInt32, clusters.count)
        dr.eval(self._light, self.pairs, self.rays)

    def rule(self, allowed: np.ndarray):
        """(``accept``, ``points_first``) for :func:`vpl.cuts.product_cuts.find_pairs`.

        ``allowed`` (n,): largest contribution of a pair to its pixel's radiance, for every point in tree order.
        """
        tree = self.clusters.tree
        least = tree.gather_up(allowed[tree.first[tree.leaves]], tree.leaves, np.minimum)
        # Bounds are for one point of unit weight
        fraction = np.maximum(self._fraction, np.finfo(np.float64).tiny)
        of_pixels = upload_thresholds(np.where(self._of_pixel, least / fraction, _NEVER))
        of_blocks = upload_thresholds(np.where(self._of_pixel, _NEVER, least))

        def accept(points, lights, bound, index):
            """Whether a pair's bound is small enough; never for a block of pixels."""
            return bound <= dr.gather(mi.Float, of_pixels, index)

        def points_first(points, lights, bound, index):
            """Whether the light node of a pair is fine enough for every pixel of a block."""
            return bound <= dr.gather(mi.Float, of_blocks, index)

        return accept, points_first

    def evaluate(self, transport: Transport, group: LightGroup, pairs: Pairs) -> None:
        """Add the contributions of accepted pairs, from a representative point and light for each."""
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
        # A non-finite value would invalidate every sample of its pixel
        self.dropped += int(dr.sum(bad)[0])

    def _representative(self, pairs: Pairs):
        """(Point of every pair's gather node, factor on its incident light), drawn by weight times reflectance.

        The factor is a spectrum, because the probability of a point is a mean over channels.
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
        """(Radiance, pairs) of every point in tree order; a node's pairs are divided equally between its points."""
        per_point = dr.rcp(mi.Float(upload(mi.UInt32, self.clusters.tree.count)))
        radiance = self._reflectance * self._sum_to_root(self._light)
        return radiance, self._sum_to_root(self.pairs * per_point)

    @dr.syntax
    def _sum_to_root(self, values):
        """Sum of node values over the leaf of each point and the leaf's ancestors, evaluated."""
        dr.eval(values)
        node = mi.UInt32(self._leaf)
        total = dr.gather(type(values), values, node)
        while dr.hint(node > 0, exclude=[self, values]):
            node = dr.gather(mi.UInt32, self._parent, node)
            total += dr.gather(type(values), values, node)
        dr.eval(total)
        return total
