"""Kernels that are long, recorded no more often than need be."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import drjit as dr


def recorded_once(function: Callable) -> Callable:
    """A function whose loops are recorded once.

    Dr.Jit looks for what a loop does not change, and records the body again without it: where paths are followed, all
    shapes and materials of the scene once more.  What these loops do not change they have to ``exclude`` themselves,
    and arrays that they scatter to, which Dr.Jit takes out of the loop's state by recording it again.
    """

    @wraps(function)
    def once(*arguments):
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            return function(*arguments)

    return once
