"""IlluminationCut: clusters of gather points and clusters of lights, chosen together."""

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

# Pairs held before they are evaluated: bounds the memory whatever the image and the error
_PAIRS_HELD = 1 << 23
# One point in so many tells how large the cuts around it are
_TRIED_STRIDE = 32
_DEFAULT_ERROR = {"all": 0.015, "adaptive": 0.01}


@manual_page
class IlluminationCutIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-illuminationcut:

    IlluminationCut (:monosp:`illuminationcut`)
    -------------------------------------------

    .. pluginparameters::

     {knobs}

    Bus, Mustafa and Biri 2015, "IlluminationCut" [IC]. Like :ref:`lightcuts <integrator-lightcuts>`, but points are
    clustered too: a tree over all gather points and the trees over the lights are descended together, until every pair
    of a cluster of points and a cluster of lights has a bound of at most ``error`` times the radiance of its points
    (eq. 4, Algorithm 1). Bounds are computed once for many points, and the shadow rays of a pair leave from one place
    towards one light. A first, approximate image (Phase I) says how bright the points are.

    With ``visibility="adaptive"`` (Algorithm 2, "IlluminationCut-Sampling") a pair of 32 points or more is probed
    with 8 or 16 rays. If all arrive, or none does, no more are traced; otherwise the pair is divided and its parts
    are probed. An occluder that lies between the probes is missed: the result is biased at small shadows and where a
    shadow's edge passes between probes, by amounts that the error bound does not cover.

    {what is estimated}

    **Departures from the paper.** Order of refinement: see :mod:`vpl.cuts.product_cuts`. Tree of points: see
    :mod:`vpl.points.point_tree`. Phase I: see :mod:`vpl.cuts.phase_one`. Adaptive visibility: see
    :mod:`vpl.cuts.adaptive_visibility`. ``dark_floor`` and ``max_cut`` are ours: without the latter, sharp lobes take
    thousands of clusters; it is held by raising the bound around points for which a light cut at their bound is larger,
    tried at every 32nd point. A cluster's representative counts with its own colour, so that pairs are unbiased where
    colours differ. Lambertian points and all others are in trees of their own.

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
            "``all``: one shadow ray for every point of a pair. ``adaptive``: a few of them are traced, and where they "
            "agree the others are taken to see the same; fewer rays, and a bias (see below).",
            words=tuple(_DEFAULT_ERROR),
        ),
        Fraction(
            "error", lambda plugin: _DEFAULT_ERROR[plugin.visibility],
            "Largest bound of what a pair of clusters contributes to one of its points, as a fraction of the least "
            "radiance among them: 0.01 is 1%. 0 refines to single lights.",
            minimum=0, stated_default='0.015, with ``visibility="adaptive"`` 0.01',
        ),
        DARK_FLOOR,
        Integer(
            "max_cut", 1000,
            "About how many clusters a point may be lit by; where the bound asks for more, it is raised. 0 is no "
            "limit.",
            minimum=0,
        ),
        Number(
            "phase_one_error", 0.5,
            "Bound, as a fraction of the image's mean, up to which pairs of the first, approximate image are not "
            "refined. 0 leaves it to the paper's criterion alone.",
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
        """Phase I: approximate radiance at every leaf, (m,) float64, and the shadow rays it took, per point."""
        negligible = self.phase_one_error * job.mean
        generator = np.random.default_rng(job.seed)
        reflected, rays = approximate_radiance(job.transport, clusters, negligible, generator, counter)
        tree = clusters.tree
        direct = tree.reduce(download(job.direct).mean(1, dtype=np.float64), np.minimum)
        return reflected + direct, rays

    def _threshold(self, job: ShadeJob, clusters: PointClusters, bright: np.ndarray, counter: BoundCounter):
        """Largest bound that a pair may have, per point node: error × least radiance of its points ([IC] eq. 4)."""
        tree, leaves = clusters.tree, clusters.tree.leaves
        allowed = self.error * np.maximum(bright[leaves], self.dark_floor * job.mean)
        at_points = np.repeat(allowed, tree.count[leaves])
        allowed = raise_thresholds(job.lights, clusters, at_points, self.max_cut, _TRIED_STRIDE, counter)
        allowed = allowed[tree.first[leaves]]
        return upload_thresholds(tree.gather_up(allowed, leaves, np.minimum))

    def _pairs(self, job: ShadeJob, clusters: PointClusters, threshold, counter: BoundCounter):
        """Phase II: yield (group of lights, illumination-aware pairs), about _PAIRS_HELD of them at a time."""

        def illumination_aware(points, lights, bound, index):
            return bound <= dr.gather(mi.Float, threshold, index)  # [IC] Algorithm 1, line 26

        for group in job.lights.groups:
            for pairs in in_batches(find_pairs(clusters, job.lights, group, illumination_aware, counter), _PAIRS_HELD):
                yield group, pairs

    def _evaluate(self, job: ShadeJob, group, clusters, pairs: Pairs, shaded: ShadeResult, clock: Clock):
        """Add the light of some pairs to ``shaded``."""
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
