"""Lightcuts: a few hundred clusters instead of all virtual lights, with a bound on the error of each."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from vpl.core.arrays import upload
from vpl.cuts.light_cuts import evaluate_cuts, limited_cuts
from vpl.cuts.radiance_estimate import estimate_radiance

from . import properties
from .common import ManyLightIntegrator, Shaded, Shading
from .gathering import Clock
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

     * - error
       - |float|
       - Largest bound of the error of one cluster, as a fraction of the radiance around the point: 0.01 is 1%.
         0 refines to single lights. (Default: 0.01)

     * - dark_floor
       - |float|
       - Points darker than this fraction of the image's mean are refined as if they had it; 0 holds the bound
         everywhere, at several times the cost in dark corners. (Default: 0.5)

     * - max_cut
       - |int|
       - Most clusters in the cut of a point, at least one per kind of light; 0 is no limit. (Default: 1000)

     {common parameters}

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

            import integrators
            "integrator": {"type": "lightcuts", "max_depth": 8, "error": 0.01}
    """

    def __init__(self, props):
        super().__init__(props)
        self.error = properties.number(props, "error", 0.01, 0)
        self.dark_floor = properties.number(props, "dark_floor", 0.5, 0)
        self.max_cut = properties.integer(props, "max_cut", 1000, 0)

    def shade(self, job: Shading) -> Shaded:
        """Choose a cut for every point of a batch and evaluate it."""
        clock = Clock()
        spent = estimate_radiance(
            job.scene, job.traits, job.lights, job.batch, job.direct, job.mean, self.max_cut, _ESTIMATE_STRIDE
        )
        clock.lap("estimate")
        wanted = upload(mi.Float, self.error * np.maximum(spent.radiance, self.dark_floor * job.mean))
        threshold, sizes, searched = limited_cuts(job.lights, job.batch, wanted, self.max_cut)
        clock.lap("cut")
        radiance, rays, collected = evaluate_cuts(
            job.scene, job.traits, job.lights, job.batch, threshold, sizes, stopped=job.stopped
        )
        clock.lap("evaluate")
        bounds = searched + collected + spent.upper_bounds
        return Shaded(radiance, rays + spent.shadow_rays, bounds, sum(sizes.count), clock.seconds)

    def describe(self):
        """All properties and their values."""
        return super().describe() | {"error": self.error, "dark_floor": self.dark_floor, "max_cut": self.max_cut}


mi.register_integrator("lightcuts", LightcutsIntegrator)
