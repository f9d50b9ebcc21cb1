"""What the manual pages of all many-light integrators have in common, written once and put into their docstrings."""

from __future__ import annotations

_PARAMETERS = """\
     * - max_depth
       - |int|
       - Longest path from camera to emitter, in edges, counted as Mitsuba's ``path`` counts them: 1 shows emitters
         only, 2 adds direct light, and -1 is no limit. (Default: -1)

     * - rr_depth
       - |int|
       - Edges after which paths may end by Russian roulette. (Default: 5)

     * - hide_emitters
       - |bool|
       - Do not show area emitters and environments to the camera. (Default: no)

     * - vpl_count
       - |int|
       - How many virtual point lights to aim for. (Default: 200000)

     * - direct
       - |string|
       - Light that comes straight from emitters. ``nee``: area emitters and environments by emitter and BSDF sampling
         with multiple importance sampling. ``vpl``: they become virtual lights, as in the papers. ``none``: left out.
         ``adaptive``: area emitters and environments by iterative adaptive sampling, as in ``adaptivedirect``.
         Point lights, spots and directional emitters are virtual lights already, exact and never clamped, in all of
         these but ``none``. (Default: ``nee``)

     * - emitter_samples
       - |int|
       - Pairs of an emitter and a BSDF sample per gather point with ``direct="nee"``. More of them cost little beside
         virtual lights, and their noise is often most of what is left. (Default: 16)

     * - direct_error
       - |float|
       - Standard error of the direct light, relative to it, with ``direct="adaptive"``. (Default: 0.05)

     * - direct_count
       - |int|
       - Virtual lights on area emitters, and as many for the environment, with ``direct="vpl"``. (Default: 4096)

     * - clamping
       - |float|
       - Smallest distance to a virtual light that stands for a surface, as a fraction of the radius of the scene's
         bounding sphere; light from nearer is dimmed instead of becoming a bright spot. 0 turns it off.
         (Default: 0.01; papers that use fewer lights clamp at 0.05)

     * - lobe_limit
       - |float|
       - A glossy lobe stores virtual lights where its density is at most this, per steradian, as though it were
         diffuse (which has at most 1/pi); 0 stores the light of diffuse lobes only. (Default: 1.0)

     * - aovs
       - |string|
       - Comma-separated channels to return, per camera ray and from the same pass: {aovs}.
         (Default: none)
"""

_ESTIMATED = """\
    What is estimated: emission + direct + indirect light, over the paths that ``path`` counts for the
same ``max_depth``. Camera rays go on through mirrors, glass and masks. Left out are caustics and light that sharp
lobes send on from the second surface (they would need another kind of light), and what ``clamping`` cuts off.

    - Surfaces only: a scene with a participating medium is refused.
    - ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
    - Emitters: point, spot, directional, area on any shape, envmap, constant, sunsky; projectors and textured spots
      with ``direct="nee"``.
    - Shadow rays pass surfaces that do not scatter (masks, thin glass) with their transmission.
    - Values that are negative, not a number or above 1e30 count as nothing, and are counted where a whole light or
      sample is lost; a scene of no finite size, and an environment map that holds such values, are refused.
"""


_DIRECT_PARAMETERS = """\
     * - error
       - |float|
       - Standard error to reach in each pixel, as a fraction of its radiance: 0.03 is 3%. (Default: 0.03)

     * - dark_floor
       - |float|
       - Pixels darker than this fraction of the image's mean are rendered about as precisely as if they had it.
         (Default: 0.1)

     * - max_depth
       - |int|
       - Longest path from camera to emitter, in edges, as Mitsuba's ``path`` counts them: 1 shows emitters only, 2 adds
         direct light at the surfaces that the camera sees; more follows mirrors, glass and masks to the surface behind
         them, whose direct light is shown. -1 is no limit. (Default: 2)

     * - rr_depth
       - |int|
       - Edges after which paths may end by Russian roulette. (Default: 5)

     * - hide_emitters
       - |bool|
       - Do not show area emitters and environments to the camera. (Default: no)

     * - max_samples
       - |int|
       - Most emitter samples of a pixel, up to 100000; at least four are taken for each half of the estimate.
         (Default: 20000)

     * - bsdf_share
       - |float|
       - BSDF samples for each emitter sample, where surfaces are glossy or emitters near; 0 leaves them out, which is
         noisy there and loses lamps behind glass. (Default: 0.125)

     * - regions
       - |int|
       - Regions that an environment is divided into. (Default: 300)

     * - time
       - |float|
       - Seconds after which to stop, at whatever error; 0 is no limit. (Default: 0)

     * - aovs
       - |string|
       - Comma-separated channels to return, per camera ray: {aovs}. ``noise`` is the estimated standard error relative
         to the radiance, ``visible`` the share of samples that found light. (Default: none)
"""

_DIRECT_ESTIMATED = """\
    What is estimated: emission and direct light, over the paths that ``path`` counts for ``max_depth`` 2; with more,
mirrors, glass and masks are followed, but no light that was reflected by a matt or glossy surface is counted.

    - Surfaces only: a scene with a participating medium is refused.
    - ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
    - All emitters of Mitsuba. Kernels do not grow with the number of points, spots, and areas of one colour on meshes,
      rectangles, disks and spheres; they do with textured areas, projectors and textured spots.
    - Point lights, spots and directional emitters are blocked by masks and thin glass, as in ``path``.
"""


def manual_page(plugin: type) -> type:
    """Class decorator for integrators with virtual lights: fill ``{common parameters}`` and ``{what is estimated}``."""
    return _fill(plugin, _PARAMETERS, _ESTIMATED)


def direct_manual_page(plugin: type) -> type:
    """The same for integrators of direct light alone."""
    return _fill(plugin, _DIRECT_PARAMETERS, _DIRECT_ESTIMATED)


def _fill(plugin: type, parameters: str, estimated: str) -> type:
    channels = ", ".join(f"``{name}``" for name in plugin.offered_aovs)
    page = plugin.__doc__
    for place, text in (
        ("     {common parameters}\n", parameters.replace("{aovs}", channels)),
        ("    {what is estimated}\n", estimated),
    ):
        assert place in page, f"{plugin.__name__}: {place.strip()} is missing in the docstring"
        page = page.replace(place, text)
    plugin.__doc__ = page
    return plugin
