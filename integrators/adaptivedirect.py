"""Iterative adaptive sampling of direct light: shadow rays go where light was found to arrive."""

from __future__ import annotations

import mitsuba as mi

from vpl.direct.adaptive import DirectOptions

from .direct import DirectLightIntegrator
from .knobs import Choice, Integer, Number
from .manual import manual_page


@manual_page
class AdaptiveDirectIntegrator(DirectLightIntegrator):
    r"""
    .. _integrator-adaptivedirect:

    Iterative adaptive direct light (:monosp:`adaptivedirect`)
    ----------------------------------------------------------

    .. pluginparameters::

     {knobs}

    Donikian et al. 2006, "Accurate direct illumination using iterative adaptive sampling" [IAS]. In passes, every pixel
    samples clusters of emitters; what the samples of the pixel and of the 8 x 8 pixels around it found decides which
    clusters the next pass samples, until the estimated error is below ``error``. It is for many emitters of which each
    point sees a few: occlusion is learned instead of paid for again and again.

    {what direct light is estimated}

    **Departures from the paper.** Probabilities start from the clusters' unoccluded contribution instead of uniform
    ones, and statistics hold what samples found in relation to it; passes are combined by weights that do not depend on
    what they found, which leaves no bias, instead of by their estimated variances; each half of a pixel's samples
    decides whether the other half goes on, so that no pixel ends because it happened to look converged; dark pixels are
    held to a fraction of the image's mean (``dark_floor``); emitter samples are combined with BSDF samples for glossy
    surfaces and near emitters (``bsdf_share``); variances come from neighbouring strata; a sample takes the point of
    any camera ray of its pixel, which costs no more than one point for each region of a pixel and is less noisy; faint
    clusters may be coarse (``cluster_angle``). Cuts, groups and clusters differ in detail: see
    :mod:`vpl.direct.cluster_cuts`, :mod:`vpl.direct.sites` and :mod:`vpl.direct.emitter_clusters`. A black pixel is
    given up after three passes and 250 samples without light, as in the paper.

    .. tabs::
        .. code-tab:: xml

            <integrator type="adaptivedirect">
                <float name="error" value="0.02"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "adaptivedirect", "error": 0.02}
    """

    knobs = (
        Choice(
            "lights", DirectOptions.lights,
            "``clusters``: clusters of emitters are sampled adaptively. ``all``: every emitter gets one shadow ray at "
            "every point, again and again until the noise of those with an extent is low enough. ``auto``: for every "
            "group of points the cheaper of both.",
            words=("auto", "clusters", "all"),
        ),
        Number(
            "cluster_angle", DirectOptions.cluster_angle,
            "Largest solid angle of a cluster as seen from a point, in steradians. Clusters whose unoccluded "
            "contribution is less than 0.5% of the light may fill up to 0.3.",
            minimum=0,
        ),
        Integer("max_passes", DirectOptions.max_passes, "Most passes over a pixel.", minimum=1),
    )  # fmt: skip


mi.register_integrator("adaptivedirect", AdaptiveDirectIntegrator)
