"""Random numbers: seeds derived from one another, and Mitsuba's sampler for any wavefront."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def derived_seed(seed: int, *stream: int) -> int:
    """A 32-bit seed for each (seed, stream...), by Mitsuba's own hash."""
    for number in stream:
        first, _ = mi.sample_tea_32(mi.UInt32(seed & 0xFFFFFFFF), mi.UInt32(number & 0xFFFFFFFF))
        seed = int(first[0])
    return seed


def independent_sampler(seed: int, count: int):
    """Mitsuba's ``independent`` sampler, seeded for a wavefront of ``count`` lanes."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return sampler


def stratified(sampler, count: int, first: int, total: int):
    """One uniform number in each of the parts first .. first + count - 1 of the ``total`` equal parts of [0, 1)."""
    lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    sample = (mi.Float(lane) + sampler.next_1d()) / dr.opaque(mi.Float, float(total))
    return dr.minimum(sample, dr.one_minus_epsilon(mi.Float))
