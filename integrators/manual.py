"""Manual pages of the integrators: their docstrings, with what is declared or written elsewhere put in its place."""

from __future__ import annotations

import inspect
import re
from textwrap import indent

from .knobs import knobs_of

_TEXTS = {
    "what is estimated": """\
What is estimated: emission + direct + indirect light, over the paths that ``path`` counts for the same ``max_depth``.
Camera rays go on through mirrors, glass and masks. Left out are caustics and light that sharp lobes send on from the
second surface (they would need another kind of light), and what ``clamping`` cuts off. What glossy lobes under bump and
normal maps send on is spread evenly.

- Surfaces only: a scene with a participating medium is refused.
- ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
- Emitters: point, spot, directional, area on any shape, envmap, constant, sunsky; projectors and textured spot
  emitters with ``direct="nee"``.
- Shadow rays pass surfaces that do not scatter (masks, thin glass) with their transmission; each is an edge of the
  path, as in ``path``. Light straight from a point, spot or directional emitter is blocked by them.
- Values that are negative, not a number or above 1e30 count as nothing, and are counted where a whole light or sample
  is lost; a scene of no finite size, and an environment map that holds such values, are refused.
""",
    "what direct light is estimated": """\
What is estimated: emission and direct light, over the paths that ``path`` counts for ``max_depth`` 2; with more,
mirrors, glass and masks are followed, but no light that was reflected by a diffuse or glossy surface is counted.

- Surfaces only: a scene with a participating medium is refused.
- ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
- All emitters of Mitsuba. Kernels do not grow with the number of point and spot emitters, and of area emitters of one
  colour on meshes, rectangles, disks and spheres; they do with textured ones and projectors.
- Point, spot and directional emitters are blocked by masks and thin glass, as in ``path``.
- The camera rays of a pixel that meet surfaces of about the same orientation share the light that arrives there, and
  each reflects it by itself: with a box filter the image is that of all rays in expectation; wider filters leave
  textures as they are, and blur edges of shadows and glossy highlights inside of a pixel.
""",
}
_PLACE = re.compile(r"^( *)\{([a-z ]+)\}\n", re.MULTILINE)


def manual_page(plugin: type) -> type:
    """Class decorator: fill a line ``{knobs}`` of the docstring with all knobs of the class, others with what is said
    in many pages.  Raises ValueError for a line of another name."""
    # None where Python was told to drop docstrings
    if plugin.__doc__ is not None:
        # Python 3.13 strips indentation when it compiles, earlier ones leave it
        plugin.__doc__ = fill_page(inspect.cleandoc(plugin.__doc__), plugin)
    return plugin


def fill_page(page: str, plugin: type) -> str:
    """``page`` with its lines in braces filled, as indented as these are."""

    def text(place) -> str:
        spaces, name = place.groups()
        if name == "knobs":
            return indent("\n".join(knob.entry() for knob in knobs_of(plugin)), spaces)
        if name not in _TEXTS:
            raise ValueError(f'{plugin.__name__}: no text is called "{name}": there are {", ".join(_TEXTS)}, knobs')
        return indent(_TEXTS[name], spaces)

    return _PLACE.sub(text, page + "\n")
