"""Many-light integrators for Mitsuba 3: ``import manylights`` and use them like any other plugin.

``manylights`` renders the image of Mitsuba's ``path``, with less noise in the same time; the others are the methods of
papers.

That imports this package, which registers them for the current variant, and again whenever ``mi.set_variant`` changes
it; and it finds out whether another module of the same name is in the way.  They exist for the vectorised ``*_rgb`` and
``*_mono`` variants; elsewhere loading one fails with an error that says so.

Mitsuba 3.10 will do without the import: for each variant it imports or reloads the modules that the entry points of the
group ``mitsuba`` name, in the order of their names, among all that call ``mi.set_variant``.  Ours are the plugins' own
modules, each of which registers its plugin.  Whichever of the two is the last, all classes are of the variant then.
"""

from __future__ import annotations

import importlib
import sys

from vpl.core.backend import check_backend, import_drjit

import_drjit()

import mitsuba as mi  # noqa: E402  (after the check that turns its import error into advice)

PLUGINS = (
    "manylights",
    "vpl",
    "lightcuts",
    "mdlightcuts",
    "lightslice",
    "matrixrecovery",
    "illuminationcut",
    "adaptivedirect",
    "unoccludeddirect",
)
VARIANTS = (
    "llvm_ad_rgb",
    "llvm_ad_mono",
    "cuda_ad_rgb",
    "cuda_ad_mono",
    "llvm_rgb",
    "llvm_mono",
    "cuda_rgb",
    "cuda_mono",
)


def _register(_old: str | None, variant: str) -> None:
    """Register all plugins for ``variant``; classes are made anew because their base class belongs to the variant."""
    if variant in VARIANTS:
        check_backend(variant)
    for name in ("gathering", "bands", "common", "direct", *PLUGINS):
        full_name = f"{__name__}.{name}"
        if full_name in sys.modules:
            importlib.reload(sys.modules[full_name])
        else:
            importlib.import_module(full_name)


if mi.variant() is not None:
    _register(None, mi.variant())
mi.detail.add_variant_callback(_register)
