"""Libraries underneath Mitsuba that have to be right, checked before they go wrong in ways that nobody can read.

Two libraries come from the system and not with the Python wheels. Without libatomic, ``import drjit`` (and so
``import mitsuba``) dies with a NameError that names neither. And libLLVM, which compiles every kernel of the ``llvm_*``
variants, is found but refused up to version 14, reported as missing, while versions 15 and 16 are accepted and then
abort the whole process at the first kernel that computes a minimum. This module turns each of these into one error that
says what to do.

It imports nothing but the standard library until a function is called, so that it can be asked first.
"""

import os
from types import ModuleType

OLDEST_LLVM = 17

_HOW_TO_GET_LLVM = (
    "Install one (Debian and Ubuntu: apt install libllvm19), or set the environment variable DRJIT_LIBLLVM_PATH to the "
    "path of one before starting Python, or start by ./run, which provides one."
)


def import_drjit() -> ModuleType:
    """Import and return ``drjit``; a missing system library is an ImportError that names it and the fix."""
    try:
        import drjit
    except NameError as error:
        # drjit's own handler of the failed import stumbles over a name; the loader's message is the error's context.
        raise ImportError(
            f"Dr.Jit could not load its binary part: {error.__context__ or error}. If this is about libatomic.so.1: "
            "install it (Debian and Ubuntu: apt install libatomic1), or start by ./run, which provides it."
        ) from error
    return drjit


def check_backend(variant: str) -> None:
    """Raise a RuntimeError with the fix if the kernels of a Mitsuba variant cannot be compiled on this machine.

    Call it before ``mi.set_variant(variant)``, or at least before the first kernel. Only libLLVM is checked; variants
    that do not need it, such as ``cuda_ad_rgb``, pass.
    """
    if not variant.startswith("llvm_"):
        return
    major = import_drjit().detail.llvm_version()[0]
    if major >= OLDEST_LLVM:
        return

    # Dr.Jit answers -1 for a library that is missing and for one that it refuses as too old.
    found = f"LLVM {major}, which Dr.Jit found, is too old" if major >= 0 else "Dr.Jit found none, or only an older one"
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    where = f" DRJIT_LIBLLVM_PATH is {path!r}." if path else ""
    raise RuntimeError(
        f"The variant {variant!r} needs libLLVM {OLDEST_LLVM} or newer; {found}.{where} {_HOW_TO_GET_LLVM}"
    )
