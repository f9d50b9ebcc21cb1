"""Many-light integrators for Mitsuba 3: ``import manylights`` registers them as Mitsuba plugins.

``manylights`` renders the image of Mitsuba's ``path``, with less error in equal time.  The remaining plugins implement
methods of papers.

``import manylights`` checks for another module named ``manylights``, then imports this package.  This package registers
the plugins for the current variant, and again after every ``mi.set_variant``.  The module of a plugin is imported when
its first integrator is created.  Supported are the vectorised ``*_rgb`` and ``*_mono`` variants; in any other variant,
creating an integrator raises an error.

Mitsuba 3.10 will not need the import: for every variant it imports or reloads the modules of the entry points in the
group ``mitsuba``, in the order of their names.  Each plugin's module is an entry point and registers its plugin.  The
order of this mechanism and of the callback below is irrelevant: after both, every class belongs to the variant.
"""

from __future__ import annotations

import importlib
import sys
from functools import partial

from vpl.core.backend import check_backend, import_drjit

import_drjit()

import mitsuba as mi  # noqa: E402  (import_drjit explains import errors)

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
# Shared modules: each follows the modules that it imports
_BASES = ("camera_samples", "gathering", "longer_renders", "bands", "common", "direct")
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
    """Register the plugins for ``variant``: reload modules, because the base class belongs to the variant, and register
    functions that import the modules of the remaining plugins."""
    if variant in VARIANTS:
        check_backend(variant)
    for name in (*_BASES, *PLUGINS):
        full_name = f"{__name__}.{name}"
        if full_name in sys.modules:
            importlib.reload(sys.modules[full_name])
        elif name in PLUGINS:
            mi.register_integrator(name, _LOADERS[name])


def _load(name: str, props: mi.Properties) -> mi.Integrator:
    """Import the module of a plugin, which registers its class in place of this function, and make an integrator."""
    importlib.import_module(f"{__name__}.{name}")
    return mi.PluginManager.instance().create_object(props)


# Kept: another thread may still call a function after the plugin's class has replaced it
_LOADERS = {name: partial(_load, name) for name in PLUGINS}


if mi.variant() is not None:
    _register(None, mi.variant())
mi.detail.add_variant_callback(_register)
