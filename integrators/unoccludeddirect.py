"""Direct light by emitter sampling in proportion to unoccluded contributions: the baseline of adaptive sampling."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from vpl.direct.adaptive import DirectOptions

from .direct import DirectLightIntegrator
from .knobs import Integer
from .manual import manual_page


@manual_page
class UnoccludedDirectIntegrator(DirectLightIntegrator):
    r"""
    .. _integrator-unoccludeddirect:

    Direct light by unoccluded contributions (:monosp:`unoccludeddirect`)
    ---------------------------------------------------------------------

    .. pluginparameters::

     {knobs}

    The reference solution of Donikian et al. 2006 [IAS section 5.1], the baseline of ``adaptivedirect``. At every point
    emitters are drawn in proportion to their unoccluded contribution. The camera rays of a pixel take turns, in several
    rounds if needed, until the pixel's error is below ``error`` by the rule of ``adaptivedirect``. Antialiasing needs a
    sampler with several samples per pixel.

    {direct estimate}

    **Departures from the paper.**

    - Instead of a Sobol sequence, jitter stratifies samples along the emitters, and an additive recurrence on them.
    - A tenth of the samples is distributed uniformly over the emitters, because unoccluded contributions are evaluated
      at the emitters' centres.
    - BSDF samples complement emitter samples.

    .. tabs::
        .. code-tab:: xml

            <integrator type="unoccludeddirect">
                <float name="error" value="0.02"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "unoccludeddirect", "error": 0.02}
    """

    knobs = (
        Integer(
            "samples_per_ray", DirectOptions.samples_per_ray,
            "Emitter samples for each camera ray of a pixel before the next ray's turn.",
            minimum=2,
        ),
    )  # fmt: skip

    def options(self) -> DirectOptions:
        """Options without a limit on passes: only the number of samples is limited."""
        return replace(super().options(), lights="unoccluded", max_passes=1 << 20)


mi.register_integrator("unoccludeddirect", UnoccludedDirectIntegrator)
