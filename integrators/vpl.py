"""Every virtual point light at every gather point: the oracle of all other methods."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from vpl.core.clock import Clock
from vpl.core.stages import Stage
from vpl.transport.evaluation import sum_all_lights

from .common import ManyLightIntegrator, ShadeJob, ShadeResult
from .manual import manual_page


@manual_page
class VPLIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-vpl:

    All virtual point lights (:monosp:`vpl`)
    ----------------------------------------

    .. pluginparameters::

     {knobs}

    Instant radiosity without any approximation but the virtual lights themselves: every light, one shadow ray each, at
    every gather point. It is what ``lightcuts`` and its relatives converge to, and slow: the time grows as pixels times
    lights. With the same seed and parameters it uses the same lights as they do.

    {what is estimated}

    .. tabs::
        .. code-tab:: xml

            <integrator type="vpl">
                <integer name="max_depth" value="8"/>
                <integer name="vpl_count" value="1000"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "vpl", "max_depth": 8, "vpl_count": 1000}
    """

    needs_trees = False

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Sum over all lights; see :func:`vpl.transport.evaluation.sum_all_lights`."""
        count, clock = job.batch.count, Clock(Stage.EVALUATE)
        radiance, rays = sum_all_lights(job.transport, job.batch, job.stopped)
        clock.stop()
        lights = dr.opaque(mi.UInt32, job.lights.count, count)
        return ShadeResult(radiance, rays, dr.zeros(mi.UInt32, count), lights, clock.seconds)


mi.register_integrator("vpl", VPLIntegrator)
