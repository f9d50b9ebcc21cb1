"""Kernel loops recorded as rarely as possible."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import drjit as dr


def recorded_once(function: Callable) -> Callable:
    """Decorate a function so that Dr.Jit records its loops once.

    By default Dr.Jit searches for loop invariants and records the body again without them. In a path-tracing loop this
    repeats the code of all shapes and materials. The loops must ``exclude`` their invariants explicitly, and also the
    arrays that they scatter to, which Dr.Jit would remove from the loop state by another recording.
    """

    @wraps(function)
    def once(*arguments):
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            return function(*arguments)

    return once
