"""Conditions of a measurement besides the scene: machine, load, software."""

import hashlib
import os
import platform
from pathlib import Path

from . import command_line

ROOT = Path(__file__).resolve().parent.parent
# Sources that seconds and images depend on; changes of the report do not invalidate finished runs
SOURCES = (
    "integrators/*.py", "vpl/**/*.py",
    "comparison/worker.py", "comparison/rendering.py", "comparison/single_pass.py", "comparison/measuring.py",
    "comparison/pass_sizes.py", "comparison/timed_sizes.py", "comparison/sample_density.py", "comparison/features.py",
    "comparison/fine_film.py", "comparison/denoising.py", "comparison/detail.py", "comparison/scene_files.py",
    "comparison/convergence.py", "comparison/images.py", "comparison/counters.py",
)  # fmt: skip


def describe():
    """Return processor, usable cores, memory in bytes, and operating system."""
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # not Linux, or an architecture without processor names
    return {
        "processor": processor,
        "cores": cores(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": platform.platform(),
    }


def identity():
    """Return the stable part of the machine's description that seconds depend on. Memory limits and system versions
    may change between runs."""
    return {key: value for key, value in describe().items() if key in ("processor", "cores")}


def cores():
    """Number of processor cores usable by this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def load():
    """Return the load average of the last minute: runnable threads of all processes, including this one."""
    return os.getloadavg()[0]


def software():
    """Return the versions (text) of the software of a comparison; "sources" is a hash of this project's sources."""
    return command_line.versions() | {"python": platform.python_version(), "sources": sources()}


def sources(patterns=SOURCES):
    """Return a hash (16 hexadecimal digits) of this project's files that match the glob patterns."""
    digest = hashlib.sha256()
    for file in sorted({file for pattern in patterns for file in ROOT.glob(pattern)}):
        digest.update(f"{file.relative_to(ROOT)}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]
