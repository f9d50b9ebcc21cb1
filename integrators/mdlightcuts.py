"""Multidimensional Lightcuts: one cut for the samples of a pixel."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import download
from vpl.core.clock import Clock
from vpl.core.stages import Stage
from vpl.cuts.light_cuts import Estimate, estimate_radiance
from vpl.cuts.pixel_cuts import PixelCuts
from vpl.cuts.product_cuts import BoundCounter, find_pairs, in_batches, raise_thresholds
from vpl.points.gather_tree import build_gather_tree
from vpl.points.point_clusters import PointClusters

from .common import DARK_FLOOR, ManyLightIntegrator, ShadeJob, ShadeResult
from .knobs import Fraction, Integer
from .manual import manual_page

# Least number of pairs shaded and traced at a time
_PAIRS_PER_KERNEL = 1 << 22
# Pixels per coarse cut of the radiance estimate
_ESTIMATE_PIXELS = 8
# Pixels per point that tests the size of its light cut
_TRIED_PIXELS = 32


@manual_page
class MultidimensionalLightcutsIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-mdlightcuts:

    Multidimensional Lightcuts (:monosp:`mdlightcuts`)
    --------------------------------------------------

    .. pluginparameters::

     {knobs}

    Walter et al. 2006, "Multidimensional lightcuts" [MDLC]. This method extends :ref:`lightcuts <integrator-lightcuts>`
    to cuts through the product of two trees: a gather tree over the gather points of a pixel's samples (over the
    pixel's area, and over lens and shutter, if present) and a light tree. One representative point is lit for
    neighbouring samples with common clusters: the cost of a pixel grows far more slowly than its number of samples.

    {estimate}

    The samples of a pixel share the incident light, and each point reflects it with its own BSDF. With a box filter the
    expected image is that of independent samples. Wider filters preserve textures, and blur shadow edges and glossy
    highlights within a pixel. Second moments over samples are meaningless. Pixels are known only for the scene's
    sensors; with any other sensor, every camera ray counts as a pixel, which is as slow as ``lightcuts``.

    **Departures from the paper.**

    - Thresholds come from a radiance estimate instead of a running total, and the upper levels of both trees are
      descended once for blocks of pixels; see :mod:`vpl.cuts.pixel_cuts`.
    - A representative light or point contributes with its own colour: cuts are unbiased for different colours.
    - Gather trees: see :mod:`vpl.points.gather_tree`.
    - ``dark_floor`` is an addition.
    - ``max_cut`` is approximate: at every 32nd pixel a point tests its light cut, and the bound is raised where the cut
      is larger.
    - Lambertian and non-Lambertian points have separate trees: a pixel with both has two cuts, each with a threshold
      for its points' contribution to the pixel.

    .. tabs::
        .. code-tab:: xml

            <integrator type="mdlightcuts">
                <integer name="max_depth" value="8"/>
                <float name="error" value="0.01"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "mdlightcuts", "max_depth": 8, "error": 0.01}
    """

    knobs = (
        Fraction(
            "error", 0.01,
            "Largest bound of a pair's contribution to its pixel, as a fraction of the pixel's radiance: 0.01 is 1%. "
            "0, with ``max_cut`` 0 and ``leaf_points`` 1, evaluates every light at every point.",
            minimum=0,
        ),
        DARK_FLOOR,
        Integer(
            "max_cut", 1000,
            "Approximate largest number of pairs per pixel; the error bound is raised where it needs more. 0 is no "
            "limit.",
            minimum=0,
        ),
        Integer(
            "leaf_points", 4,
            "Largest number of neighbouring samples of a pixel, on diffuse surfaces, in a leaf of the gather tree. One "
            "random sample per cluster of lights represents a leaf, at any ``error``. 1: every sample is a leaf.",
            minimum=1,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Gather trees, thresholds and cuts of the pixels of one batch."""
        clock = Clock(Stage.ESTIMATE)
        if not job.grid.known:
            mi.Log(mi.LogLevel.Warn, "The sensor does not belong to the scene: every camera ray counts as a pixel.")
        pixel = download(job.ray).astype(np.int64) // job.grid.samples
        per_pixel = job.batch.count / np.count_nonzero(np.bincount(pixel))
        estimate = estimate_radiance(
            job.transport, job.batch, job.direct, job.mean, self.max_cut,
            round(_ESTIMATE_PIXELS * per_pixel),
        )  # fmt: skip
        clock.begin(Stage.GATHER_TREE)
        leaf_size = 1 if job.batch.proxy.glossy else self.leaf_points
        clusters = PointClusters(job.batch, partial(build_gather_tree, pixel, job.grid.width, leaf_size))
        order = clusters.tree.order
        weight = dr.gather(type(job.weight), job.weight, clusters.order)
        cuts = PixelCuts(clusters, pixel[order], weight, job.grid.samples, job.seed)
        clock.begin(Stage.THRESHOLD)
        counter = BoundCounter(clusters, "upper_bounds" in self.aovs)
        allowed = self._allowed(job, estimate, pixel)[order]
        stride = round(_TRIED_PIXELS * per_pixel)
        rule = cuts.rule(raise_thresholds(job.lights, clusters, allowed, self.max_cut, stride, counter))
        clock.begin(Stage.PAIRS)
        for group, pairs in self._pairs(job, clusters, rule, counter):
            if job.stopped():
                break
            clock.begin(Stage.EVALUATE)
            cuts.evaluate(job.transport, group, pairs)
            clock.begin(Stage.PAIRS)
        clock.begin(Stage.SUM)
        radiance, pairs = cuts.per_point()
        radiance, rays, bounds, pairs = clusters.in_batch_order([radiance, cuts.rays, counter.per_point(), pairs])
        clock.stop()
        rays, bounds = rays + estimate.shadow_rays, bounds + mi.Float(estimate.upper_bounds)
        return ShadeResult(radiance, rays, bounds, pairs, clock.seconds, dropped=cuts.dropped)

    def _pairs(self, job: ShadeJob, clusters: PointClusters, rule, counter: BoundCounter):
        """Yield (group of lights, at least _PAIRS_PER_KERNEL pairs), fewer in the last of a group."""
        accept, points_first = rule
        for group in job.lights.groups:
            found = find_pairs(clusters, job.lights, group, accept, counter, points_first)
            for pairs in in_batches(found, _PAIRS_PER_KERNEL):
                yield group, pairs

    def _allowed(self, job: ShadeJob, estimate: Estimate, pixel: np.ndarray) -> np.ndarray:
        """Largest contribution of a pair to its pixel's radiance, for every point, (n,) float64."""
        weighted = estimate.radiance * download(job.weight).mean(1, dtype=np.float64)
        radiance = np.bincount(pixel, weighted)[pixel] / job.grid.samples
        return self.error * np.maximum(radiance, self.dark_floor * job.mean)


mi.register_integrator("mdlightcuts", MultidimensionalLightcutsIntegrator)
