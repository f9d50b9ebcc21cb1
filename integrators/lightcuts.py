"""Lightcuts: a few hundred clusters instead of every virtual light, with an error bound for each cluster."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from vpl.core.arrays import upload
from vpl.core.stages import Stage
from vpl.cuts.light_cuts import estimate_radiance, evaluate_cuts, limited_cuts

from .common import DARK_FLOOR, ManyLightIntegrator, ShadeJob, ShadeResult
from .gathering import Clock
from .knobs import Fraction, Integer
from .manual import manual_page

# Stride of the points with a coarse cut for the radiance estimate
_ESTIMATE_STRIDE = 8


@manual_page
class LightcutsIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-lightcuts:

    Lightcuts (:monosp:`lightcuts`)
    -------------------------------

    .. pluginparameters::

     {knobs}

    Walter et al. 2005, "Lightcuts: a scalable approach to illumination" [LC]. The virtual lights are clustered into one
    tree per kind (point, spot, oriented, directional, environment). Every gather point is lit by a *cut*: clusters that
    contain each light exactly once. A representative light with the cluster's intensity replaces each cluster. The cut
    is the coarsest in which every cluster's contribution has an upper bound of at most ``error`` times the radiance of
    the point.

    {estimate}

    **Departures from the paper.**

    - Bounds are compared with a radiance estimate instead of the running total of the cut. The estimate comes from
      coarse cuts at every eighth point plus direct light, averaged over sixteen neighbouring points. Thresholds are
      known in advance: cuts need no heap and no stack, and the shadow rays of many points are traced together.
    - ``dark_floor`` is an addition.
    - The representative has its own colour, not the cluster's: the cut is unbiased for lights of different colours.
    - Bounds and the cluster metric differ in detail: see :mod:`vpl.transport.bounds` and :mod:`vpl.lights.light_tree`.
    - There are no reconstruction cuts.

    .. tabs::
        .. code-tab:: xml

            <integrator type="lightcuts">
                <integer name="max_depth" value="8"/>
                <float name="error" value="0.01"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "lightcuts", "max_depth": 8, "error": 0.01}
    """

    knobs = (
        Fraction(
            "error", 0.01,
            "Largest error bound of a cluster, as a fraction of the estimated radiance of the point: 0.01 is 1%. 0 "
            "refines to single lights.",
            minimum=0,
        ),
        DARK_FLOOR,
        Integer(
            "max_cut", 1000,
            "Largest number of clusters in the cut of a point, at least one per kind of light; 0 is no limit.",
            minimum=0,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Choose a cut for every point of a batch and evaluate it."""
        clock = Clock(Stage.ESTIMATE)
        spent = estimate_radiance(job.transport, job.batch, job.direct, job.mean, self.max_cut, _ESTIMATE_STRIDE)
        clock.begin(Stage.CUT)
        wanted = upload(mi.Float, self.error * np.maximum(spent.radiance, self.dark_floor * job.mean))
        threshold, sizes = limited_cuts(job.lights, job.batch, wanted, self.max_cut)
        clock.begin(Stage.EVALUATE)
        radiance, rays, collected = evaluate_cuts(job.transport, job.batch, threshold, sizes, stopped=job.stopped)
        clock.stop()
        bounds = sizes.visits + collected + spent.upper_bounds
        return ShadeResult(
            radiance, rays + spent.shadow_rays, bounds, sum(one.count for one in sizes.cuts), clock.seconds
        )


mi.register_integrator("lightcuts", LightcutsIntegrator)
