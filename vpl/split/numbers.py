"""Well spread random numbers for the first vertex that scatters: one point set for all samples of a pixel.

Sobol' points, shuffled and scrambled by hashes that keep their strata [Burley 2020, "Practical hash-based Owen
scrambling"]: any power of two of a pixel's samples falls into as many strata of every shape, other dimensions take the
points in another order, and every number alone is uniform.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.sampling import HASH_ROUNDS, derived_seed

# Multipliers of the hash whose every bit depends on lower ones alone [Laine and Karras 2011; Burley 2020, section 3]
_MULTIPLIERS = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)


def _hash_upwards(bits, seed):
    bits = bits + seed
    for multiplier in _MULTIPLIERS:
        bits = bits ^ (bits * multiplier)
    return bits


def _nested_scramble(bits, seed):
    """A permutation of 32-bit numbers that keeps those together that share their leading bits [Owen 1995]."""
    return dr.brev(_hash_upwards(dr.brev(bits), seed))


def _second_sobol(index):
    """The second Sobol' dimension as a 32-bit fraction."""
    # As a float it has 24 bits, more than there are samples of a pixel
    return mi.UInt32(mi.sobol_2(index, mi.UInt32(0)) * 2**24) << 8


def _fraction(bits):
    return mi.Float(bits >> 8) * 2**-24


def spread_numbers(lane, samples: int, seed: int):
    """Numbers for each lane (UInt32), of which ``samples`` consecutive ones are a pixel: (number, pair, number, pair),
    evaluated, from [0, 1)."""
    count = dr.opaque(mi.UInt32, samples)
    pixel, number = lane // count, lane % count
    found = []
    for stream in range(4):
        order, first = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, derived_seed(seed, stream)), HASH_ROUNDS)
        # The low bits count the samples of a pixel: what has to stay together are those with equal higher bits
        index = _nested_scramble(number, order)
        numbers = [_fraction(_nested_scramble(dr.brev(index), first))]
        if stream % 2:
            second, _ = mi.sample_tea_32(first, order, HASH_ROUNDS)
            numbers.append(_fraction(_nested_scramble(_second_sobol(index), second)))
        found.append(mi.Point2f(*numbers) if stream % 2 else numbers[0])
    dr.make_opaque(found)
    return tuple(found)
