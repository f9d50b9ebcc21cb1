"""Admission of workers to a render.

A pass must be equal on all workers except for rounding. The sources of this project, Mitsuba and Dr.Jit determine the
computation, and dask.distributed the protocol: a worker with a different version is refused. NumPy, Python, LLVM and
the processor, with its vector width, determine the order of summation: a worker with a different version takes part,
with a warning.
"""

import platform
from importlib import metadata

import drjit as dr

from .. import machine

SOURCES = ("integrators/*.py", "vpl/**/*.py", "comparison/**/*.py")
MUST_BE_EQUAL = ("sources", "manylights", "mitsuba", "drjit", "distributed")
ARE_NOTED = ("numpy", "python", "llvm", "processor")


def identity():
    """Return the compared properties of this process, a dict from name to text."""
    found = machine.software() | {
        "sources": machine.sources(SOURCES),
        "distributed": metadata.version("distributed"),
        "python": ".".join(platform.python_version_tuple()[:2]),
        "llvm": ".".join(map(str, dr.detail.llvm_version())),
        "processor": machine.describe()["processor"],
    }
    return {name: found[name] for name in (*MUST_BE_EQUAL, *ARE_NOTED)}


def judge(own, other):
    """Compare the identity of a worker, `other`, with that of this process. Return the reason for a refusal and the
    text of a warning, each None if there is none."""
    refused, noted = (_differences(names, own, other) for names in (MUST_BE_EQUAL, ARE_NOTED))
    return refused, noted


def _differences(names, own, other):
    different = [name for name in names if own[name] != other.get(name)]
    return ", ".join(f"{name} {other.get(name)} instead of {own[name]}" for name in different) or None
