"""Iterative adaptive sampling of direct light: learned probabilities direct shadow rays to visible emitters."""

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

    Donikian et al. 2006, "Accurate direct illumination using iterative adaptive sampling" [IAS]. Every pixel samples
    clusters of emitters in passes. The results of the pixel and of its block of 8 x 8 pixels determine the
    probabilities of the clusters in the next pass, until the estimated error is below ``error``. The method suits many
    emitters with few visible from each point: occlusion is learned, and occluded emitters get few shadow rays.

    {direct estimate}

    **Departures from the paper.**

    - Initial probabilities are proportional to the clusters' unoccluded contribution, not uniform. Statistics store
      results relative to the unoccluded contribution.
    - The weights that combine passes are independent of the results, which avoids bias; the paper uses estimated
      variances.
    - Each half of a pixel's samples decides whether the other half continues, so that no pixel stops early by chance.
      Sums over few emitters (``lights``) end when their two halves agree.
    - Dark pixels need only reach the error at a fraction of the image's mean (``dark_floor``).
    - BSDF samples complement emitter samples on glossy surfaces and near emitters (``bsdf_share``).
    - Variances come from neighbouring strata.
    - A sample uses the point of a random camera ray of its pixel, which costs no more than one point per region of a
      pixel and has less variance.
    - Clusters with small contribution may be coarse (``cluster_angle``).
    - Cuts, groups and clusters differ in detail: see :mod:`vpl.direct.cluster_cuts`, :mod:`vpl.direct.sites` and
      :mod:`vpl.direct.emitter_clusters`.

    As in the paper, a black pixel ends after three passes and 250 samples without light.

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
            "``clusters``: adaptive sampling of clusters of emitters. ``all``: one shadow ray from every point to "
            "every emitter, repeated until the error due to emitters with an extent is below ``error``. ``auto``: the "
            "cheaper of the two for every group of points.",
            words=("auto", "clusters", "all"),
        ),
        Number(
            "cluster_angle", DirectOptions.cluster_angle,
            "Largest solid angle of a cluster at a point, in steradians. Clusters with an unoccluded contribution "
            "below 0.5% of the light may have up to 0.3 steradians.",
            minimum=0,
        ),
        Integer("max_passes", DirectOptions.max_passes, "Largest number of passes over a pixel.", minimum=1),
    )  # fmt: skip


mi.register_integrator("adaptivedirect", AdaptiveDirectIntegrator)
