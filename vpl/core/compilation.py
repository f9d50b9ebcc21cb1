"""Time that Dr.Jit spends compiling kernels, which the first renders of a scene need and later ones do not.

Kernels that Dr.Jit finds in memory or in its cache on disk count nothing.
"""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock

import drjit as dr


class Compilation:
    """Seconds of compilation so far (``seconds``), as of the last call of :meth:`since_last`."""

    def __init__(self):
        self.seconds = 0.0

    def since_last(self) -> float:
        """Return the seconds of compilation since the last call."""
        # Dr.Jit reports milliseconds, and only for kernels of its own; reading the history clears it
        found = sum(kernel.get("backend_time", 0.0) for kernel in dr.kernel_history()) / 1000
        self.seconds += found
        return found


_MEASURED: ContextVar[Compilation | None] = ContextVar("compilation", default=None)
# Dr.Jit has one history for all threads
_HISTORY = Lock()


@contextmanager
def compilation_measured():
    """Measure compilation while the block runs; yield a :class:`Compilation`, None if it is not measured.

    Compilation is not measured if the caller records the kernel history of Dr.Jit, which is then left to the caller, or
    if another thread measures: Dr.Jit has a single history, so the threads would count each other's kernels.  Measuring
    takes 10 to 40 ms for a pass of one to two seconds (kitchen; ``manylights``, ``lightcuts``, ``illuminationcut``,
    ``adaptivedirect``).
    """
    if dr.flag(dr.JitFlag.KernelHistory) or not _HISTORY.acquire(blocking=False):
        yield None
        return
    compilation = Compilation()
    token = _MEASURED.set(compilation)
    try:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            yield compilation
            compilation.since_last()
    finally:
        dr.kernel_history_clear()
        _MEASURED.reset(token)
        _HISTORY.release()


@contextmanager
def unrecorded():
    """Within the block, Dr.Jit does not record kernels, and compilation is not measured.

    Each number that Python reads is an entry of the history: with the history of 108 000 numbers of 8000 emitters,
    reading them takes 0.4 s instead of 0.2.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, False):
        yield


def compiled_since_last() -> float:
    """Return the seconds of compilation in this thread since the last call, 0 if they are not measured."""
    compilation = _MEASURED.get()
    return 0.0 if compilation is None else compilation.since_last()
