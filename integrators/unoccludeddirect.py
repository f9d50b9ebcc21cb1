"""Direct light by emitter sampling in proportion to unoccluded contributions: what adaptive sampling is measured by."""

from __future__ import annotations

import mitsuba as mi

from vpl.direct.adaptive import DirectOptions

from . import properties
from .adaptivedirect import AdaptiveDirectIntegrator
from .manual import direct_manual_page


@direct_manual_page
class UnoccludedDirectIntegrator(AdaptiveDirectIntegrator):
    r"""
    .. _integrator-unoccludeddirect:

    Direct light by unoccluded contributions (:monosp:`unoccludeddirect`)
    ---------------------------------------------------------------------

    .. pluginparameters::

     * - samples_per_ray
       - |int|
       - Emitter samples for each camera ray of a pixel, before the next ray is taken. (Default: 100)

     {common parameters}

    The reference solution of Donikian et al. 2006 [IAS section 5.1], with which ``adaptivedirect`` is compared: at
    every point emitters are drawn in proportion to what each would send if nothing was between, one camera ray of the
    pixel after another, until its error is below ``error`` by the same rule. Needs a sampler with several samples a
    pixel to antialias; it goes round them as often as it has to.

    {what is estimated}

    **Departures from the paper.** Samples are stratified by jitter along the emitters and by an additive recurrence on
    them, instead of a Sobol sequence; a tenth of the samples is spread evenly over the emitters, because unoccluded
    contributions are estimated from the middle of each; emitter samples are combined with BSDF samples.

    .. tabs::
        .. code-tab:: xml

            <integrator type="unoccludeddirect">
                <float name="error" value="0.02"/>
            </integrator>

        .. code-tab:: python

            import integrators
            "integrator": {"type": "unoccludeddirect", "error": 0.02}
    """

    own_properties = ("samples_per_ray",)

    def _read_method(self, props) -> None:
        self.samples_per_ray = properties.integer(props, "samples_per_ray", 100, 2)

    def options(self) -> DirectOptions:
        """The properties as the renderer's core takes them."""
        # As many passes as the limit of samples allows
        return DirectOptions(
            error=self.error, dark_floor=self.dark_floor, lights="unoccluded", max_samples=self.max_samples,
            max_passes=1 << 20, least_samples=self.samples_per_ray, most_samples=self.samples_per_ray,
            bsdf_share=self.bsdf_share, time=self.time,
        )  # fmt: skip


mi.register_integrator("unoccludeddirect", UnoccludedDirectIntegrator)
