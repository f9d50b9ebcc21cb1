"""Table of numbers for shapes, emitters or materials, indexed by Mitsuba's registry."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import upload


@dataclass(init=False)
class RegistryTable:
    """Number of each listed object; 0 for unlisted objects.

    Indices and their count are arrays, not constants of kernels: Mitsuba loads shapes in parallel and registers them
    in a different order in each process, so constants would prevent the reuse of cached kernels. A dataclass, because
    Dr.Jit traverses it (e.g. in :class:`vpl.lights.perturbed.Perturbed`) as an argument of frozen functions.
    """

    _numbers: mi.UInt32
    _size: mi.UInt32

    def __init__(self, indices, numbers):
        """``indices`` (n,): registry indices, from 1, of objects of one kind; ``numbers``: the non-negative number of
        each, or one number for all."""
        indices = np.asarray(indices, np.int64)
        # At least two entries: an array of one entry changes the kernels
        table = np.zeros(max(int(indices.max(initial=0)) + 1, 2), np.uint32)
        table[indices] = numbers
        self._numbers, self._size = upload(mi.UInt32, table), dr.opaque(mi.UInt32, len(table))

    def at(self, pointers, active=True):
        """Number (UInt32) of the object behind each pointer; 0 for unlisted objects, null pointers and inactive
        lanes."""
        index = dr.reinterpret_array(mi.UInt32, pointers)
        return dr.gather(mi.UInt32, self._numbers, index, active & (index < self._size))
