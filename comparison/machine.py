"""Circumstances that a measurement depends on besides the scene: machine, load, software."""

import hashlib
import os
import platform
from pathlib import Path

from . import command_line

ROOT = Path(__file__).resolve().parent.parent
# What seconds and images depend on; the report may change without a run having to be made again.
SOURCES = (
    "integrators/*.py",
    "vpl/**/*.py",
    *(f"comparison/{name}.py" for name in ("worker", "rendering", "scene_files")),
)


def describe():
    """Return processor, cores that may be used, memory in bytes, and system."""
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # not Linux, or an architecture that has no names there
    return {
        "processor": processor,
        "cores": cores(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": platform.platform(),
    }


def identity():
    """Return what of the machine seconds depend on, and what stays the same for as long as it does: memory may be lent
    and taken back, systems are brought up to date."""
    return {key: value for key, value in describe().items() if key in ("processor", "cores")}


def cores():
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def load():
    """Return the load average of the last minute: how many threads of all processes wanted to run, our own included."""
    return os.getloadavg()[0]


def versions():
    """Return the versions (text) of what made a comparison; "sources" is a hash of this project's."""
    return command_line.versions() | {"python": platform.python_version(), "sources": sources()}


def sources(patterns=SOURCES):
    """Return a hash (hexadecimal) of those of this project's files that match one of some patterns."""
    digest = hashlib.sha256()
    for file in sorted({file for pattern in patterns for file in ROOT.glob(pattern)}):
        digest.update(f"{file.relative_to(ROOT)}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]
