"""Registry table: numbers of shapes or emitters, by the index that Mitsuba's registry has given to each."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import upload


@dataclass(init=False)
class RegistryTable:
    """A number for each of some objects, 0 for all others.

    Kernels hold neither indices nor how many there are: shapes are loaded in parallel, and registered in another order
    in every process, which would have to compile them anew.  A dataclass, as :class:`vpl.lights.perturbed.Perturbed`,
    which holds one, is given to functions that Dr.Jit freezes.
    """

    _numbers: object
    _size: object

    def __init__(self, indices, numbers):
        """``indices`` (n,) of objects of one kind in the registry, which counts each kind by itself, from 1;
        ``numbers``: that of each, not negative, or one for all."""
        indices = np.asarray(indices, np.int64)
        # An array of one entry would make other kernels
        table = np.zeros(max(int(indices.max(initial=0)) + 1, 2), np.uint32)
        table[indices] = numbers
        self._numbers, self._size = upload(mi.UInt32, table), dr.opaque(mi.UInt32, len(table))

    def at(self, pointers, active=True):
        """Number (UInt32) of the object that each pointer of that kind leads to; 0 of others and of none, and where not
        active."""
        index = dr.reinterpret_array(mi.UInt32, pointers)
        return dr.gather(mi.UInt32, self._numbers, index, active & (index < self._size))
