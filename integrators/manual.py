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
         Point lights, spots and directional emitters are virtual lights already, exact and never clamped, in both
         ``nee`` and ``vpl``. (Default: ``nee``)

     * - emitter_samples
       - |int|
       - Pairs of an emitter and a BSDF sample per gather point with ``direct="nee"``. (Default: 4)

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
"""


def manual_page(plugin: type) -> type:
    """Class decorator: fill the places ``{common parameters}`` and ``{what is estimated}`` of a plugin's docstring."""
    channels = ", ".join(f"``{name}``" for name in plugin.offered_aovs)
    page = plugin.__doc__
    for place, text in (
        ("     {common parameters}\n", _PARAMETERS.replace("{aovs}", channels)),
        ("    {what is estimated}\n", _ESTIMATED),
    ):
        assert place in page, f"{plugin.__name__}: {place.strip()} is missing in the docstring"
        page = page.replace(place, text)
    plugin.__doc__ = page
    return plugin
