"""Checks of the system libraries below Mitsuba, with errors that state the remedy.

Two libraries come from the system, not from the Python wheels:

- libatomic: if absent, ``import drjit`` and ``import mitsuba`` fail with a NameError that does not mention libatomic.
- libLLVM, the compiler of all kernels of the ``llvm_*`` variants: Dr.Jit refuses versions up to 14 and reports them as
  missing. It accepts versions 15 and 16, which abort the process at the first kernel with a minimum.

On import, this module uses the standard library alone, so that other modules can call it before Dr.Jit is loaded.
"""

import os
from types import ModuleType

OLDEST_LLVM = 17

_HOW_TO_GET_LLVM = (
    "Install one (Debian and Ubuntu: apt install libllvm19), or set the environment variable DRJIT_LIBLLVM_PATH to the "
    "path of one before starting Python, or start by ./run, which provides one."
)


def import_drjit() -> ModuleType:
    """Import ``drjit``; raises an ImportError that names a missing system library and the remedy."""
    try:
        import drjit
    except NameError as error:
        # The exception handler in drjit fails itself; the context of its error is the loader's message
        raise ImportError(
            f"Dr.Jit could not load its binary part: {error.__context__ or error}. If this is about libatomic.so.1: "
            "install it (Debian and Ubuntu: apt install libatomic1), or start by ./run, which provides it."
        ) from error
    return drjit


def check_backend(variant: str) -> None:
    """Raise a RuntimeError with the remedy if this machine cannot compile the kernels of a Mitsuba variant.

    Call it before ``mi.set_variant(variant)``, or at the latest before the first kernel. Only libLLVM is checked;
    variants without it, such as ``cuda_ad_rgb``, pass.
    """
    if not variant.startswith("llvm_"):
        return
    major = import_drjit().detail.llvm_version()[0]
    if major >= OLDEST_LLVM:
        return

    # Dr.Jit returns -1 both for a missing library and for a refused old version
    found = f"LLVM {major}, which Dr.Jit found, is too old" if major >= 0 else "Dr.Jit found none, or only an older one"
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    where = f" DRJIT_LIBLLVM_PATH is {path!r}." if path else ""
    raise RuntimeError(
        f"The variant {variant!r} needs libLLVM {OLDEST_LLVM} or newer; {found}.{where} {_HOW_TO_GET_LLVM}"
    )
