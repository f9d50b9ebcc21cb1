"""Which workers may take part in a render.

A pass must be the pass that any other worker would have made, but for the rounding of its sums. Python sources of this
project, Mitsuba and Dr.Jit decide what is computed, and dask.distributed what is understood: a worker with others is
refused. NumPy, Python, LLVM and the processor (whose vectors may be longer) decide in which order numbers are added: a
worker with others takes part, with a note.
"""

import platform
from importlib import metadata

import drjit as dr

from .. import machine

SOURCES = ("integrators/*.py", "vpl/**/*.py", "comparison/**/*.py")
MUST_BE_EQUAL = ("sources", "manylights", "mitsuba", "drjit", "distributed")
ARE_NOTED = ("numpy", "python", "llvm", "processor")


def identity():
    """Return what is compared, name -> text, of this process."""
    found = machine.versions() | {
        "sources": machine.sources(SOURCES),
        "distributed": metadata.version("distributed"),
        "python": ".".join(platform.python_version_tuple()[:2]),
        "llvm": ".".join(map(str, dr.detail.llvm_version())),
        "processor": machine.describe()["processor"],
    }
    return {name: found[name] for name in (*MUST_BE_EQUAL, *ARE_NOTED)}


def judge(own, other):
    """Compare the identity of a worker, `other`, with this process's. Return why it is refused (None if it is not) and
    what is noted (None if there is nothing)."""
    refused, noted = (_differences(names, own, other) for names in (MUST_BE_EQUAL, ARE_NOTED))
    return refused, noted


def _differences(names, own, other):
    different = [name for name in names if own[name] != other.get(name)]
    return ", ".join(f"{name} {other.get(name)} instead of {own[name]}" for name in different) or None
