"""Well spread random numbers for vertices that scatter: a point set for all samples of a pixel at each.

Rank-1 lattices with a random shift of the unit square, by which every number alone is uniform [Cranley and Patterson
1976; Sloan and Joe 1994, "Lattice Methods for Multiple Integration"].  Other dimensions, vertices and pixels take the
points in other random orders: if samples that are far apart in one dimension were so in all, the noise of what depends
on two of them would be up to twice that of random numbers.
"""

from __future__ import annotations

from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.sampling import HASH_ROUNDS, derived_seed

# Multipliers of a hash in which every bit of the result depends on all [Wellons 2018, "Prospecting for hash functions"]
_MIXING = (0x7FEB352D, 0x846CA68B)
# Odd, far from any simple fraction of 2^32: the golden ratio's
_STEP = 0x9E3779B9
# Orders in the table at most, and its entries, but for one order at least; multipliers that are tried for a lattice.
# Two dimensions whose order is the same from the same point on, one time in as many as there are entries, are alike
_ORDERS, _ENTRIES, _TRIED = 256, 1 << 18, 64


def _mixed(bits, stream: int):
    """32-bit numbers that have nothing to do with ``bits`` nor with those of another stream."""
    bits = bits + (stream * _STEP & 0xFFFFFFFF)
    bits = (bits ^ (bits >> 16)) * _MIXING[0]
    bits = (bits ^ (bits >> 15)) * _MIXING[1]
    return bits ^ (bits >> 16)


@lru_cache(maxsize=64)
def lattice_multiplier(count: int) -> int:
    """g of the lattice (i, g i) / ``count`` modulo 1: of some near the golden ratio that with the least P_2, its worst
    error over smooth periodic functions [Sloan and Joe 1994, section 4.2]."""
    candidates = np.arange(1, max(count, 2))
    candidates = candidates[np.gcd(candidates, count) == 1]
    nearest = np.argsort(np.abs(candidates * (1 + 5**0.5) / 2 - count), kind="stable")[:_TRIED]
    number = np.arange(count)

    def kernel(numerator):
        x = numerator / count
        return 1 + 2 * np.pi**2 * (x * x - x + 1 / 6)

    along = kernel(number)
    errors = [np.mean(along * kernel(number * g % count)) for g in candidates[nearest]]
    return int(candidates[nearest][np.argmin(errors)])


@lru_cache(maxsize=8)
def _orders(count: int) -> np.ndarray:
    """Random orders of so many points, one after the other; what they are matters as little as what a hash is."""
    rows = np.tile(np.arange(count, dtype=np.uint32), (max(min(_ORDERS, _ENTRIES // count), 1), 1))
    return np.random.default_rng(0).permuted(rows, axis=1).reshape(-1)


def _fraction(bits):
    return mi.Float(bits >> 8) * 2**-24


class SpreadNumbers:
    """Numbers for paths, of which ``samples`` consecutive ones are those of a pixel; ``lane``: of each path."""

    def __init__(self, lane, samples: int, seed: int):
        # One kernel follows paths, whether their lanes are counted or chosen
        dr.eval(lane)
        self._samples = dr.opaque(mi.UInt32, samples)
        self._pixel, self._number = lane // self._samples, lane % self._samples
        # Derived, as vertices count on from it
        self._seed = dr.opaque(mi.UInt32, derived_seed(seed, 0))
        orders = _orders(samples)
        self._orders, self._rows = upload(mi.UInt32, orders), dr.opaque(mi.UInt32, len(orders) // samples)
        # From one point of the lattice to the next, 2^32 being one
        steps = (round(times * 2**32 / samples) for times in (1, lattice_multiplier(samples)))
        self._steps = [dr.opaque(mi.UInt32, step % 2**32) for step in steps]

    def at(self, vertex):
        """Numbers that a path uses at its vertex of a number (UInt32): (number, pair, number, pair), from [0, 1)."""
        found = []
        # A good hash for all, of which cheap ones make the rest
        orders, shifts = mi.sample_tea_32(self._pixel, self._seed + vertex, HASH_ROUNDS)
        for stream in range(4):
            point = self._point(_mixed(orders, stream))
            shift = _mixed(shifts, 2 * stream)
            numbers = [_fraction(point * self._steps[0] + shift)]
            if stream % 2:
                # In a mirror as often as not, because every lattice has directions in which it is coarse
                mirrored = dr.select((shift & 1) == 0, point, 0 - point)
                numbers.append(_fraction(mirrored * self._steps[1] + _mixed(shifts, 2 * stream + 1)))
            found.append(mi.Point2f(*numbers) if stream % 2 else numbers[0])
        return tuple(found)

    def _point(self, bits):
        """Which point of its pixel a sample takes: random ``bits`` choose an order, and where in it it begins."""
        order, begin = dr.mul_hi(bits, self._rows), dr.mul_hi(bits * self._rows, self._samples)
        place = begin + self._number
        place = dr.select(place < self._samples, place, place - self._samples)
        return dr.gather(mi.UInt32, self._orders, order * self._samples + place)
