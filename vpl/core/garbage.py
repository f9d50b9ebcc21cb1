"""Suspension of Python's cyclic garbage collector."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from threading import Lock

# Number of active blocks, and whether the collector was enabled before the first
_STOPPED = {"blocks": 0, "ran": True}
_LOCK = Lock()


@contextmanager
def garbage_kept():
    """Suspend Python's cyclic garbage collector in all threads while the block runs.

    The collector runs in any thread, for example in the event loop of a notebook or of Dask.  Mitsuba renders without
    Python's global lock and records calls of all objects in Dr.Jit's registry: a scene that another thread collects at
    this time ends the process or makes the render wait forever.  A collection that another thread has begun before the
    block goes on, which matters only if one of its finalizers releases Python's lock.  A scene collected during the
    recording of a frozen function makes the recording fail, and a scene collected between two calls makes Dr.Jit record
    again.
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
