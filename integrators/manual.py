"""Manual pages of the integrators: docstrings in which placeholders are filled with knobs and shared paragraphs."""

from __future__ import annotations

import inspect
import re
from textwrap import indent

from .knobs import knobs_of

_TEXTS = {
    "estimate": """\
What is estimated: emission, direct and indirect light, over the paths that ``path`` counts for the same ``max_depth``.
Camera rays continue through mirrors, glass and masks. Left out are caustics, scattering by sharp lobes from the second
surface on (virtual point lights cannot represent either), and the energy removed by ``clamping``. The scattering of
light paths by glossy lobes under bump and normal maps is approximated as diffuse.

- Surfaces only: a scene with a participating medium raises an error.
- ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
- Emitters: point, spot, directional, area on shapes that Mitsuba can sample, envmap, constant, sunsky; projectors,
  and spot emitters with a texture or an oval cone, with any ``direct`` but ``"vpl"``.
- Shadow rays pass surfaces that do not scatter (masks, thin glass) with their transmission; each is an edge of the
  path, as in ``path``. They block direct light of point, spot and directional emitters.
- Values that are negative, not a number or above 1e30 count as zero; dropped lights and samples are counted. A scene
  of infinite size and an environment map with such values, except negative ones, raise an error.
""",
    "direct estimate": """\
What is estimated: emission and direct light, over the paths that ``path`` counts for ``max_depth`` 2. With larger
``max_depth``, camera rays continue through mirrors, glass and masks. Left out is light reflected by a diffuse or glossy
surface before it reaches the visible point.

- Surfaces only: a scene with a participating medium raises an error.
- ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
- Every emitter of Mitsuba, area emitters on shapes that Mitsuba can sample. The size of kernels is independent of the
  number of point and spot emitters, and of area emitters of constant colour on meshes, rectangles, disks and spheres.
  It grows with the number of textured emitters and projectors.
- Masks and thin glass block point, spot and directional emitters, as in ``path``.
- The camera rays of a pixel share the incident light at surfaces of similar orientation, and each point reflects it
  with its own BSDF. With a box filter the expected image is that of independent rays. Wider filters preserve textures,
  and blur shadow edges and glossy highlights within a pixel.
""",
}
_PLACE = re.compile(r"^( *)\{([a-z ]+)\}\n", re.MULTILINE)


def manual_page(plugin: type) -> type:
    """Class decorator: fill the line ``{knobs}`` of the docstring with the class's knobs, and further lines in braces
    with shared paragraphs.  Raises ValueError for an unknown name in braces."""
    # None under python -OO
    if plugin.__doc__ is not None:
        # Python 3.13 strips indentation during compilation, earlier versions do not
        plugin.__doc__ = fill_page(inspect.cleandoc(plugin.__doc__), plugin)
    return plugin


def fill_page(page: str, plugin: type) -> str:
    """``page`` with its lines in braces replaced, at the same indentation."""

    def text(place) -> str:
        spaces, name = place.groups()
        if name == "knobs":
            return indent("\n".join(knob.entry() for knob in knobs_of(plugin)), spaces)
        if name not in _TEXTS:
            raise ValueError(f'{plugin.__name__}: unknown text "{name}": allowed are {", ".join(_TEXTS)}, knobs')
        return indent(_TEXTS[name], spaces)

    return _PLACE.sub(text, page + "\n")
