"""Lightcuts: a few hundred clusters instead of all virtual lights, with a bound on the error of each."""

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

# A point's radiance is estimated from coarse cuts at every eighth point, averaged over sixteen neighbours on the curve
_ESTIMATE_STRIDE = 8


@manual_page
class LightcutsIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-lightcuts:

    Lightcuts (:monosp:`lightcuts`)
    -------------------------------

    .. pluginparameters::

     {knobs}

    Walter et al. 2005, "Lightcuts: a scalable approach to illumination" [LC]. All virtual lights are clustered into
    one tree per kind (point, spot, oriented, directional, environment); every gather point is lit by a *cut*: clusters
    that together hold each light once, each stood for by one representative light with the cluster's intensity. The cut
    is the coarsest whose clusters all have an upper bound of their contribution of at most ``error`` times the radiance
    of the point.

    {what is estimated}

    **Departures from the paper.** The radiance that bounds are compared with is not the running total of the cut but an
    estimate made before, from coarse cuts of every eighth point and the direct light, averaged over sixteen
    neighbouring points: thresholds are known in advance, so that cuts need no heap and no stack, and all shadow rays of
    many points can be traced together. ``dark_floor`` is ours. The representative's colour is its own, not the
    cluster's, so that the cut is unbiased for lights of different colours. Bounds and the cluster metric differ in
    detail: see :mod:`vpl.transport.bounds` and :mod:`vpl.lights.light_tree`. There are no reconstruction cuts.

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
            "Largest bound of the error of one cluster, as a fraction of the radiance around the point: 0.01 is 1%. 0 "
            "refines to single lights.",
            minimum=0,
        ),
        DARK_FLOOR,
        Integer(
            "max_cut", 1000,
            "Most clusters in the cut of a point, at least one per kind of light; 0 is no limit.",
            minimum=0,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Choose a cut for every point of a batch and evaluate it."""
        clock = Clock(Stage.ESTIMATE)
        spent = estimate_radiance(job.transport, job.batch, job.direct, job.mean, self.max_cut, _ESTIMATE_STRIDE)
        clock.begin(Stage.CUT)
        wanted = upload(mi.Float, self.error * np.maximum(spent.radiance, self.dark_floor * job.mean))
        threshold, sizes, searched = limited_cuts(job.lights, job.batch, wanted, self.max_cut)
        clock.begin(Stage.EVALUATE)
        radiance, rays, collected = evaluate_cuts(job.transport, job.batch, threshold, sizes, stopped=job.stopped)
        clock.stop()
        bounds = searched + collected + spent.upper_bounds
        return ShadeResult(radiance, rays + spent.shadow_rays, bounds, sum(sizes.count), clock.seconds)


mi.register_integrator("lightcuts", LightcutsIntegrator)
