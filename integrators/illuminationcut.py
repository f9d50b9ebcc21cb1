"""IlluminationCut: pairs of a cluster of gather points and a cluster of lights, by simultaneous refinement."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import download, upload
from vpl.core.stages import Stage
from vpl.cuts.adaptive_visibility import decide_visibility
from vpl.cuts.light_cuts import upload_thresholds
from vpl.cuts.pair_lists import evaluate_lists, list_pairs
from vpl.cuts.phase_one import approximate_radiance
from vpl.cuts.product_cuts import BoundCounter, Pairs, find_pairs, in_batches, raise_thresholds
from vpl.points.point_clusters import PointClusters

from .common import AOVS, AOVS_TEXT, DARK_FLOOR, ManyLightIntegrator, ShadeJob, ShadeResult
from .gathering import Clock
from .knobs import Choice, Fraction, Integer, Number, Words
from .manual import manual_page

# Pairs collected before evaluation: bounds the memory for any image and error
_PAIRS_HELD = 1 << 23
# Stride of the points that test the size of light cuts
_TRIED_STRIDE = 32
# Default errors by ``visibility``: those of [IC] section 4
_DEFAULT_ERROR = {"all": 0.015, "adaptive": 0.01}


@manual_page
class IlluminationCutIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-illuminationcut:

    IlluminationCut (:monosp:`illuminationcut`)
    -------------------------------------------

    .. pluginparameters::

     {knobs}

    Bus, Mustafa and Biri 2015, "IlluminationCut" [IC]. This method extends :ref:`lightcuts <integrator-lightcuts>` by
    clusters of points: a tree over the gather points and the trees over the lights are descended simultaneously, until
    every pair of a cluster of points and a cluster of lights has a bound of at most ``error`` times the least radiance
    of its points (eq. 4, Algorithm 1). A bound is computed once for many points, and the shadow rays of a pair have
    close origins and a common light. A first, approximate image (Phase I) estimates the radiance of the points.

    With ``visibility="adaptive"`` (Algorithm 2, "IlluminationCut-Sampling") a pair of 32 points or more, and of
    several lights, is probed with 8 or 16 shadow rays. If every probe is unoccluded, or every probe is occluded,
    the result counts for the whole pair; otherwise the pair is divided and its parts are probed. An occluder
    between the probes is missed: the result is biased at small shadows and at shadow edges between probes, by
    amounts that the error bound does not cover.

    {estimate}

    **Departures from the paper.**

    - Order of refinement: see :mod:`vpl.cuts.product_cuts`.
    - Tree of points: see :mod:`vpl.points.point_tree`.
    - Phase I: see :mod:`vpl.cuts.phase_one`.
    - Adaptive visibility: see :mod:`vpl.cuts.adaptive_visibility`.
    - ``dark_floor`` and ``max_cut`` are additions. Without ``max_cut``, sharp lobes need thousands of clusters. Every
      32nd point tests the size of its light cut, and the bounds around points with larger cuts are raised.
    - A cluster's representative light contributes with its own colour: pairs of lights with different colours are
      unbiased.
    - Lambertian and non-Lambertian points have separate trees.

    .. tabs::
        .. code-tab:: xml

            <integrator type="illuminationcut">
                <integer name="max_depth" value="8"/>
                <string name="visibility" value="adaptive"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "illuminationcut", "max_depth": 8, "visibility": "adaptive"}
    """

    offered_aovs = (*AOVS, "phase_one")
    knobs = (
        Choice(
            "visibility", "all",
            "``all``: one shadow ray for every point of a pair. ``adaptive``: a few probe rays per pair, whose result "
            "counts for the whole pair if they agree; fewer rays, and a bias (see below).",
            words=tuple(_DEFAULT_ERROR),
        ),
        Fraction(
            "error", lambda plugin: _DEFAULT_ERROR[plugin.visibility],
            "Largest bound of a pair's contribution to one of its points, as a fraction of the least radiance of its "
            "points: 0.01 is 1%. 0 refines to single lights.",
            minimum=0, stated_default='0.015, with ``visibility="adaptive"`` 0.01',
        ),
        DARK_FLOOR,
        Integer(
            "max_cut", 1000,
            "Approximate largest number of clusters per point; the error bound is raised where it needs more. 0 is no "
            "limit.",
            minimum=0,
        ),
        Number(
            "phase_one_error", 0.5,
            "Bound, as a fraction of the image's mean, up to which pairs of Phase I are not refined. 0 uses the "
            "paper's criterion alone.",
            minimum=0,
        ),
        Words("aovs", "", AOVS_TEXT, words=offered_aovs),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Phase I, Phase II and the evaluation of the pairs, for one batch ([IC] section 3)."""
        clock = Clock(Stage.POINT_TREE)
        clusters = PointClusters(job.batch)
        clock.begin(Stage.PHASE_ONE)
        counter = BoundCounter(clusters, "upper_bounds" in self.aovs)
        bright, rays = self._approximate(job, clusters, counter)
        threshold = self._threshold(job, clusters, bright, counter)
        clock.begin(Stage.PHASE_TWO)

        shaded = ShadeResult(
            dr.zeros(mi.UnpolarizedSpectrum, clusters.count), rays, None, dr.zeros(mi.UInt32, clusters.count)
        )
        for group, pairs in self._pairs(job, clusters, threshold, counter):
            if job.stopped():
                break
            self._evaluate(job, group, clusters, pairs, shaded, clock)
            clock.begin(Stage.PHASE_TWO)
        clock.stop()
        shaded.upper_bounds = counter.per_point()
        shaded.phase_one = upload(mi.Float, bright[clusters.tree.leaf])
        shaded.seconds = clock.seconds
        names = ("radiance", *self.offered_aovs)
        found = clusters.in_batch_order([getattr(shaded, name) for name in names])
        return replace(shaded, **dict(zip(names, found, strict=True)))

    def _approximate(self, job: ShadeJob, clusters: PointClusters, counter: BoundCounter):
        """Phase I: (approximate radiance of every node, (m,) float64, shadow rays per point)."""
        negligible = self.phase_one_error * job.mean
        generator = np.random.default_rng(job.seed)
        reflected, rays = approximate_radiance(job.transport, clusters, negligible, generator, counter)
        tree = clusters.tree
        direct = tree.reduce(download(job.direct).mean(1, dtype=np.float64), np.minimum)
        return reflected + direct, rays

    def _threshold(self, job: ShadeJob, clusters: PointClusters, bright: np.ndarray, counter: BoundCounter):
        """Largest accepted bound per point node: error × least radiance of its points ([IC] eq. 4)."""
        tree, leaves = clusters.tree, clusters.tree.leaves
        allowed = self.error * np.maximum(bright[leaves], self.dark_floor * job.mean)
        at_points = np.repeat(allowed, tree.count[leaves])
        allowed = raise_thresholds(job.lights, clusters, at_points, self.max_cut, _TRIED_STRIDE, counter)
        allowed = allowed[tree.first[leaves]]
        return upload_thresholds(tree.gather_up(allowed, leaves, np.minimum))

    def _pairs(self, job: ShadeJob, clusters: PointClusters, threshold, counter: BoundCounter):
        """Phase II: yield (group of lights, about _PAIRS_HELD illumination-aware pairs)."""

        def illumination_aware(points, lights, bound, index):
            return bound <= dr.gather(mi.Float, threshold, index)  # [IC] Algorithm 1, line 26

        for group in job.lights.groups:
            for pairs in in_batches(find_pairs(clusters, job.lights, group, illumination_aware, counter), _PAIRS_HELD):
                yield group, pairs

    def _evaluate(self, job: ShadeJob, group, clusters, pairs: Pairs, shaded: ShadeResult, clock: Clock):
        """Add the contributions of ``pairs`` to ``shaded``."""
        seen, traced = [], [pairs]
        if self.visibility == "adaptive":
            clock.begin(Stage.VISIBILITY)
            seen, traced = decide_visibility(job.transport, group, clusters, pairs, shaded.shadow_rays)
        if not seen and not traced:
            return
        clock.begin(Stage.EVALUATE)
        lists = list_pairs(group, clusters, traced, seen)
        rows = dr.arange(mi.UInt32, clusters.count)
        radiance, rays = evaluate_lists(job.transport, group, clusters.batch, lists, rows)
        shaded.radiance += radiance
        shaded.shadow_rays += rays
        shaded.cut_size += lists.length
        dr.eval(shaded.radiance, shaded.shadow_rays, shaded.cut_size)


mi.register_integrator("illuminationcut", IlluminationCutIntegrator)
