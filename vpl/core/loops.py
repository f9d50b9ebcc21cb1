"""Kernels that are long, recorded no more often than need be."""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import contextmanager
from functools import wraps
from threading import Lock

import drjit as dr

# Blocks that run with Python's collector stopped, and whether it ran before the first of them
_STOPPED = {"blocks": 0, "ran": True}
_LOCK = Lock()


def recorded_once(function: Callable) -> Callable:
    """A function whose loops are recorded once.

    Dr.Jit looks for what a loop does not change, and records the body again without it: where paths are followed, all
    shapes and materials of the scene once more.  What these loops do not change they have to ``exclude`` themselves.
    """

    @wraps(function)
    def once(*arguments):
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            return function(*arguments)

    return once


@contextmanager
def garbage_kept():
    """Keep Python's cyclic collector from running while the block runs, in any thread.

    A scene that it lets go while a frozen function is recorded makes that fail, or ends the process; between two calls,
    Dr.Jit records anew.
    """
    with _LOCK:
        if not _STOPPED["blocks"]:
            _STOPPED["ran"] = gc.isenabled()
            gc.disable()
        _STOPPED["blocks"] += 1
    try:
        yield
    finally:
        with _LOCK:
            _STOPPED["blocks"] -= 1
            if not _STOPPED["blocks"] and _STOPPED["ran"]:
                gc.enable()
