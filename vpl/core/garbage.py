"""Python's cyclic collector, kept from letting go of what is in use."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from threading import Lock

# Blocks that run with the collector stopped, and whether it ran before the first of them
_STOPPED = {"blocks": 0, "ran": True}
_LOCK = Lock()


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
