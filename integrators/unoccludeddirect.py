"""Direct light by emitter sampling in proportion to unoccluded contributions: what adaptive sampling is measured by."""

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

    The reference solution of Donikian et al. 2006 [IAS section 5.1], with which ``adaptivedirect`` is compared: at
    every point emitters are drawn in proportion to their unoccluded contribution, one camera ray of the pixel after
    another, until its error is below ``error`` by the same rule. Needs a sampler with several samples a pixel to
    antialias; it goes round them as often as it has to.

    {what direct light is estimated}

    **Departures from the paper.** Samples are stratified by jitter along the emitters and by an additive recurrence on
    them, instead of a Sobol sequence; a tenth of the samples is spread evenly over the emitters, because unoccluded
    contributions are estimated from the middle of each; emitter samples are combined with BSDF samples.

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
            "Emitter samples for each camera ray of a pixel, before the next ray is taken.",
            minimum=2,
        ),
    )  # fmt: skip

    def options(self) -> DirectOptions:
        """As many passes as the limit of samples allows."""
        return replace(super().options(), lights="unoccluded", max_passes=1 << 20)


mi.register_integrator("unoccludeddirect", UnoccludedDirectIntegrator)
