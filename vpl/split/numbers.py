"""Well spread random numbers for vertices that scatter: a point set for all samples of a pixel at each.

Sobol' points, shuffled and scrambled by hashes that keep their strata [Burley 2020, "Practical hash-based Owen
scrambling"]: any power of two of a pixel's samples falls into as many strata of every shape, other dimensions take the
points in another order, and every number alone is uniform.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.sampling import HASH_ROUNDS, derived_seed

# Multipliers of a hash in which every bit of the result depends on all [Wellons 2018, "Prospecting for hash functions"]
_MIXING = (0x7FEB352D, 0x846CA68B)
# Odd, far from any simple fraction of 2^32: the golden ratio's
_STEP = 0x9E3779B9
# Multipliers of the hash whose every bit depends on lower ones alone [Laine and Karras 2011; Burley 2020, section 3]
_MULTIPLIERS = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)


def _mixed(bits, stream: int):
    """32-bit numbers that have nothing to do with ``bits`` nor with those of another stream."""
    bits = bits + (stream * _STEP & 0xFFFFFFFF)
    bits = (bits ^ (bits >> 16)) * _MIXING[0]
    bits = (bits ^ (bits >> 15)) * _MIXING[1]
    return bits ^ (bits >> 16)


def _hash_upwards(bits, seed):
    bits = bits + seed
    for multiplier in _MULTIPLIERS:
        bits = bits ^ (bits * multiplier)
    return bits


def _nested_scramble(bits, seed):
    """A permutation of 32-bit numbers that keeps those together that share their leading bits [Owen 1995]."""
    return dr.brev(_hash_upwards(dr.brev(bits), seed))


def _second_sobol(index):
    """The second Sobol' dimension as a 32-bit fraction: Pascal's triangle modulo 2 times the index, back to front."""
    # Bit i is the parity of the bits whose number has all bits of i [Lucas 1878]. Not ``mi.sobol_2``, which only knows
    # the types of the variant that was set first.
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        index = index ^ ((index >> shift) & mask)
    # To the 24 bits of a float, which are more than there are samples of a pixel
    return mi.UInt32(mi.Float(dr.brev(index)) * 2**-8) << 8


def _fraction(bits):
    return mi.Float(bits >> 8) * 2**-24


class SpreadNumbers:
    """Numbers for paths, of which ``samples`` (UInt32, opaque) consecutive ones are those of a pixel; ``lane``: of each
    path."""

    def __init__(self, lane, samples: int, seed: int):
        count = dr.opaque(mi.UInt32, samples)
        # One kernel follows paths, whether their lanes are counted or chosen
        dr.eval(lane)
        self._pixel, self._number = lane // count, lane % count
        # Derived, as vertices count on from it
        self._seed = dr.opaque(mi.UInt32, derived_seed(seed, 0))

    def at(self, vertex):
        """Numbers that a path uses at its vertex of a number (UInt32): (number, pair, number, pair), from [0, 1)."""
        found = []
        # A good hash for all, of which cheap ones make the rest
        orders, scrambles = mi.sample_tea_32(self._pixel, self._seed + vertex, HASH_ROUNDS)
        for stream in range(4):
            # The low bits count the samples of a pixel: what has to stay together are those with equal higher bits
            index = _nested_scramble(self._number, _mixed(orders, stream))
            numbers = [_fraction(_nested_scramble(dr.brev(index), _mixed(scrambles, 2 * stream)))]
            if stream % 2:
                second = _mixed(scrambles, 2 * stream + 1)
                numbers.append(_fraction(_nested_scramble(_second_sobol(index), second)))
            found.append(mi.Point2f(*numbers) if stream % 2 else numbers[0])
        return tuple(found)
