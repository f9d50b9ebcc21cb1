"""Multidimensional Lightcuts: one cut for all samples of a pixel."""

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

# Pairs that are shaded and traced at a time, at least
_PAIRS_PER_KERNEL = 1 << 22
# A coarse cut of one point for so many pixels tells how bright they are
_ESTIMATE_PIXELS = 8
# One pixel in so many tells how large the cuts around it are
_TRIED_PIXELS = 32


@manual_page
class MultidimensionalLightcutsIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-mdlightcuts:

    Multidimensional Lightcuts (:monosp:`mdlightcuts`)
    --------------------------------------------------

    .. pluginparameters::

     {knobs}

    Walter et al. 2006, "Multidimensional lightcuts" [MDLC]. Like :ref:`lightcuts <integrator-lightcuts>`, but what is
    cut is the product of two trees: the gather points of all samples of a pixel (over its area, the lens and the
    shutter, as far as the sensor and the scene have them) and the lights. Where neighbouring samples would be lit by
    the same clusters, one of them is lit for all: the cost of a pixel grows far slower than its samples.

    {what is estimated}

    The samples of a pixel share the light that arrives at them, and each reflects it by itself: with a box filter the
    image is that of all samples in expectation; wider filters leave textures as they are and blur edges of shadows and
    glossy highlights inside of a pixel, and second moments over samples mean nothing. Pixels are told apart only for
    the sensors of the scene; with another one every camera ray counts as a pixel, which is as slow as ``lightcuts``.

    **Departures from the paper.** Thresholds come from an estimate made before instead of from a running total, and the
    upper levels of both trees are descended for blocks of pixels at once; see :mod:`vpl.cuts.pixel_cuts`. A
    representative counts with its own colour, light or point, so that cuts are unbiased where colours differ. Gather
    trees: see :mod:`vpl.points.gather_tree`. ``dark_floor`` is ours. ``max_cut`` is held only about, by raising the
    bound where the light cut of a point at every 32nd pixel is larger. Lambertian points and all others are in trees of
    their own, so a pixel that sees both has two cuts, each held to what its own points give to the pixel.

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
            "Largest bound of what a pair of clusters contributes to its pixel, as a fraction of the pixel's radiance: "
            "0.01 is 1%. 0, with ``max_cut`` 0 and ``leaf_points`` 1, takes every light at every point.",
            minimum=0,
        ),
        DARK_FLOOR,
        Integer(
            "max_cut", 1000,
            "About how many pairs a pixel may be lit by; where the bound asks for more, it is raised. 0 is no limit.",
            minimum=0,
        ),
        Integer(
            "leaf_points", 4,
            "Neighbouring samples of a pixel, on diffuse surfaces, that are never told apart: for every cluster "
            "of lights one of them, drawn at random, stands for all, whatever ``error`` says. 1: there are none.",
            minimum=1,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Gather trees, thresholds, and the cut of every pixel, for one batch."""
        clock = Clock(Stage.ESTIMATE)
        if not job.grid.known:
            mi.Log(mi.LogLevel.Warn, "The sensor is not one of the scene's: every camera ray counts as a pixel.")
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
        """Yield (group of lights, pairs), at least _PAIRS_PER_KERNEL of them at a time but for the last."""
        accept, points_first = rule
        for group in job.lights.groups:
            found = find_pairs(clusters, job.lights, group, accept, counter, points_first)
            for pairs in in_batches(found, _PAIRS_PER_KERNEL):
                yield group, pairs

    def _allowed(self, job: ShadeJob, estimate: Estimate, pixel: np.ndarray) -> np.ndarray:
        """Most that a pair may add to the radiance of its pixel, for every point, (n,) float64."""
        weighted = estimate.radiance * download(job.weight).mean(1, dtype=np.float64)
        radiance = np.bincount(pixel, weighted)[pixel] / job.grid.samples
        return self.error * np.maximum(radiance, self.dark_floor * job.mean)


mi.register_integrator("mdlightcuts", MultidimensionalLightcutsIntegrator)
