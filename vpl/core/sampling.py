"""Derived seeds, samplers for any wavefront, discrete distributions, low-discrepancy samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import upload

# Rounds of Mitsuba's hash: after four, the default, adjacent lanes are correlated (0.45)
HASH_ROUNDS = 8
# Mitsuba's samplers return multiples of 2^-23
_SAMPLE_BITS = 23


def derived_seed(seed: int, *stream: int) -> int:
    """Derive a 32-bit seed from (seed, stream...) by Mitsuba's hash."""
    for number in stream:
        first, _ = mi.sample_tea_32(mi.UInt32(seed & 0xFFFFFFFF), mi.UInt32(number & 0xFFFFFFFF))
        seed = int(first[0])
    return seed


def independent_sampler(seed: int, count: int):
    """Mitsuba's ``independent`` sampler, seeded for ``count`` lanes."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return sampler


def precise_sample(sampler):
    """Uniform double-precision numbers of 46 bits.

    With a hundred thousand rows :func:`find_interval` then samples each in proportion to its share; with a sampler's
    own numbers of 23 bits the error is 1%.
    """
    precise = dr.float64_array_t(mi.Float)
    return precise(sampler.next_1d()) + precise(sampler.next_1d()) * 2.0**-_SAMPLE_BITS


class PairNumbers:
    """Uniform numbers for the pairs of n sequences and an index or a place, by Mitsuba's hash.

    ``size`` (n,) UInt32: number of equal intervals of each sequence, see :meth:`systematic`.  Packed records hold the
    hashes of the sequences, which many pairs share.
    """

    def __init__(self, seed: int, size: mi.UInt32):
        count = dr.width(size)
        sequence = dr.arange(mi.UInt32, count)
        own, key = mi.sample_tea_32(sequence, dr.opaque(mi.UInt32, seed), HASH_ROUNDS)
        start, _ = mi.sample_tea_32(sequence, dr.opaque(mi.UInt32, derived_seed(seed, 1)), HASH_ROUNDS)
        # The lanes that fill a packet hold zeros, by which processors do not divide
        step = dr.opaque(mi.UInt32, 2**32 - 1) // dr.maximum(size, 1)
        self._records = dr.zeros(mi.UInt32, 4 * count)
        dr.scatter(self._records, mi.Vector4u(own, key, start, step), sequence)
        dr.eval(self._records)

    def random(self, sequence, second) -> mi.Float64:
        """A number of 32 bits for each pair of a ``sequence`` and an index ``second`` (UInt32).

        The number depends on both indices and not on the lane.  A ray that passes exactly between two shapes meets
        either of them, because Mitsuba loads shapes in an order that changes with the process.  If this adds a pair,
        the numbers of other pairs remain.
        """
        record = dr.gather(mi.Vector4u, self._records, sequence)
        number, _ = mi.sample_tea_32(record.x, second ^ record.y, HASH_ROUNDS)
        return dr.float64_array_t(mi.Float)(number) * 2.0**-32

    def systematic(self, sequence, place) -> mi.Float64:
        """The numbers at ``place`` (UInt32) of the systematic samples of each ``sequence``.

        The samples begin at a random number in [0, 1), have the step 1 / ``size``, and wrap around at 1.  Successive
        samples select successive ones of ``size`` equal intervals.  A number depends on the place, so another place
        changes it, unlike those of :meth:`random`.
        """
        record = dr.gather(mi.Vector4u, self._records, sequence)
        return dr.float64_array_t(mi.Float)(record.z + place * record.w) * 2.0**-32


def stratified(sampler, count: int, first: int, total: int):
    """One uniform number in each of the strata first .. first + count - 1 out of ``total`` equal strata of [0, 1)."""
    lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    sample = (mi.Float(lane) + sampler.next_1d()) / dr.opaque(mi.Float, float(total))
    return dr.minimum(sample, dr.one_minus_epsilon(mi.Float))


# Steps of the additive recurrences: powers of 1/g, where g is the root of g^4 = g + 1, the 3D golden ratio [Roberts
# 2018, "The unreasonable effectiveness of quasirandom sequences"]
SPREAD_STEPS = tuple(1.2207440846057596**-k for k in (1, 2, 3))


class SpreadSamples:
    """Low-discrepancy sequences in the unit cube, one per lane, with less variance than independent samples.

    An additive recurrence with the steps :data:`SPREAD_STEPS` and a random start [Cranley and Patterson 1976], so that
    each single number is uniform. ``start``: Vector3u, multiples of 2^-32.
    """

    def __init__(self, start):
        self.start = start

    @classmethod
    def of(cls, sequence, seed: int) -> SpreadSamples:
        """Lanes with equal ``sequence`` (UInt32) share a sequence; another seed gives other sequences."""
        first, second = (dr.opaque(mi.UInt32, derived_seed(seed, stream)) for stream in (0, 1))
        x, y = mi.sample_tea_32(sequence, first, HASH_ROUNDS)
        z, _ = mi.sample_tea_32(sequence, second, HASH_ROUNDS)
        return cls(mi.Vector3u(x, y, z))

    @classmethod
    def random(cls, sampler) -> SpreadSamples:
        """An independent sequence for each lane of a sampler."""
        return cls(mi.Vector3u(*(mi.UInt32(sampler.next_1d() * 2.0**24) << 8 for _ in range(3))))

    def at(self, number) -> mi.Point3f:
        """Element ``number`` (UInt32) of each sequence, in [0, 1)^3."""
        # Fixed-point fractions wrap around without rounding; their upper 24 bits convert to a float below 1
        steps = (mi.UInt32(int(2**32 * step)) for step in SPREAD_STEPS)
        members = (start + number * step for start, step in zip(self.start, steps, strict=True))
        return mi.Point3f(*(mi.Float(member >> 8) * 2.0**-24 for member in members))


def running_sums(values):
    """Exclusive prefix sums and the total (n + 1 entries) in double precision, evaluated."""
    precise = dr.float64_array_t(mi.Float)
    count = dr.width(values)
    sums = dr.zeros(precise, count + 1)
    dr.scatter(sums, dr.cumsum(precise(values)), dr.arange(mi.UInt32, count) + 1)
    dr.eval(sums)
    return sums


@dr.syntax
def last_at_most(values, first, last, limit):
    """Last of the ascending ``values`` from ``first`` to ``last`` - 1 that is at most ``limit``, else the first."""
    low, high = mi.UInt32(first), mi.UInt32(last)
    while dr.hint(high > low + 1, exclude=[values, limit]):
        middle = (low + high) >> 1
        below = dr.gather(type(values), values, middle) <= limit
        low = dr.select(below, middle, low)
        high = dr.select(below, high, middle)
    return low


def find_interval(cumulative, first, last, sample):
    """Interval, first .. last - 1, of ``cumulative[first] ... cumulative[last]`` that contains a uniform number.

    ``cumulative``: non-decreasing sums in double precision. The probability of an interval is its share of the total
    increase; an interval without increase is never chosen, unless the total is zero.
    """
    precise = type(cumulative)
    start = dr.gather(precise, cumulative, first)
    target = start + precise(sample) * (dr.gather(precise, cumulative, last) - start)
    return last_at_most(cumulative, first, last, target)


class GuidedSums:
    """Running sums of weights, searched like :func:`find_interval`, but by guided search [Chen and Asau 1974, "On
    generating random variates from an empirical distribution"].

    A search among all intervals takes constant expected time; in a part of them, it never takes longer than a bisection
    of the part.  ``weight`` (n,) float64, non-negative: n intervals.
    """

    def __init__(self, weight: np.ndarray):
        sums = np.concatenate([[0.0], np.cumsum(weight)])
        # A power of two, and at least two, because arrays of one entry change the kernels
        guides = 1 << max(int(len(weight) - 1).bit_length(), 1)
        scale = guides / sums[-1] if sums[-1] > 0 else 0.0
        # The product is rounded alike on the device, and grows with the sum: a sum with a smaller guide than a number
        # lies below the number, a sum with a larger guide above it
        guide = np.minimum((sums * scale).astype(np.int64), guides - 1)
        last = np.cumsum(np.bincount(guide, minlength=guides)) - 1
        first = np.maximum(np.concatenate([[0], last[:-1]]), 0)
        self._bounds = upload(mi.UInt32, np.stack([first, last + 1], 1).ravel())
        precise = dr.float64_array_t(mi.Float)
        self._sums, self._scale = upload(precise, sums), dr.opaque(precise, scale)
        self._most = dr.opaque(mi.UInt32, guides - 1)

    def find(self, first, last, sample):
        """The interval of ``first`` .. ``last`` - 1 for a uniform number, as by :func:`find_interval`."""
        precise = type(self._sums)
        start = dr.gather(precise, self._sums, first)
        target = start + precise(sample) * (dr.gather(precise, self._sums, last) - start)
        guide = dr.minimum(mi.UInt32(target * self._scale), self._most)
        low, high = dr.gather(mi.Vector2u, self._bounds, guide)
        return last_at_most(self._sums, dr.maximum(first, low), dr.minimum(last, high), target)


def rounded_shares(share: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Inclusive prefix sums (n,) float64 of the shares in each row, rounded to multiples of 2^-23.

    ``share`` (n,) float64: shares of the members, row after row, with sum one in each row; ``length`` (rows,): members
    of each row, at least one. A uniform number of 23 bits or more falls between two adjacent sums with exactly the
    probability of their difference. The difference deviates from the share by some 1e-7 and is at least 2^-23 for a
    positive share (with up to 2^22 members in a row).
    """
    row, first = np.repeat(np.arange(len(length)), length), np.cumsum(length) - length
    positive, member = share > 0, np.arange(len(share))
    number = np.add.reduceat(positive.astype(np.int64), first)
    # Rounding keeps the difference of two sums at a multiple of 2^-23 or more
    least = np.minimum(2.0**-_SAMPLE_BITS, 0.5 / np.maximum(number, 1))
    # In place: filling new memory takes longer than the sums
    total = (1 - least * number)[row]
    total *= share
    total += least[row] * positive
    np.cumsum(total, out=total)
    total -= np.concatenate([[0.0], total])[first][row]
    total *= 2.0**_SAMPLE_BITS
    np.round(total, out=total)
    total *= 2.0**-_SAMPLE_BITS
    # The last positive member receives the remainder
    last = np.maximum.reduceat(np.where(positive, member, -1), first)
    total[member >= last[row]] = 1
    return total


class RowChoice:
    """Discrete distributions, one per row, sampled in constant expected time by guided search, see
    :class:`GuidedSums`.

    ``share`` (n,) float64: shares of the members, row after row, with sum one in each row; ``length`` (rows,): members
    of each row, at least one. ``pmf`` (n,) float64: exact sampling probabilities (see :func:`rounded_shares`).
    ``place`` (n,): index of each member in the table, where a row has one entry more than members.
    """

    def __init__(self, share: np.ndarray, length: np.ndarray):
        rows, row = len(length), np.repeat(np.arange(len(length)), length)
        first = np.cumsum(length + 1) - (length + 1)
        self.place = np.arange(len(share)) + row
        after = rounded_shares(share, length)
        before = np.zeros(len(share) + rows)
        before[self.place + 1] = after
        self.pmf = after - before[self.place]
        # At least half as many guides per row as members: a power of two, so that the product with a uniform number
        # is exact, and at least two, because arrays of one entry change the kernels
        guides = 2 ** max(int(np.log2(len(share) / rows)), 1)
        # For each guide, the last member that starts there or before. A search takes ten times as long as counting
        start = np.repeat(np.arange(rows) * guides, length + 1) + np.ceil(before * guides).astype(np.int64)
        low = np.cumsum(np.bincount(start, minlength=rows * guides)[: rows * guides]) - 1
        # Up to the last member that starts before the next guide
        high = np.append(low[1:], 0)
        high[guides - 1 :: guides] = first + length - 1
        self._guides = dr.opaque(mi.UInt32, guides)
        self._bounds = upload(mi.UInt32, np.stack([low, high + 1], 1).ravel())
        self._before = upload(mi.Float, before)

    def draw(self, row, number, active=True):
        """Sample the place of a member of each row by a uniform number in [0, 1)."""
        guide = row * self._guides + mi.UInt32(number * mi.Float(self._guides))
        low, high = dr.gather(mi.Vector2u, self._bounds, guide, active)
        return last_at_most(self._before, low, high, number)

    def probability(self, place, active=True):
        """Probability of the members at these places (0 where not active)."""
        # Adjacent entries: usually one memory access
        return dr.gather(mi.Float, self._before, place + 1, active) - dr.gather(mi.Float, self._before, place, active)

    def rest(self, place, number, active=True):
        """Uniform numbers in [0, 1), reused from the numbers that sampled the members at these places."""
        before = dr.gather(mi.Float, self._before, place, active)
        rest = (number - before) / self.probability(place, active)
        return dr.clip(rest, 0, dr.one_minus_epsilon(mi.Float))


class Choice:
    """Discrete distribution proportional to weights; a zero weight is never chosen.

    ``weight`` (n,) float64, non-negative, with a positive sum. ``pmf`` (n,) float64, with sum one: exact probabilities
    of the rows for uniform numbers of 23 bits or more. They are multiples of 2^-23, positive for positive weights (up
    to 2^22 rows), and deviate from the shares of the weights by some 1e-7.
    """

    def __init__(self, weight: np.ndarray):
        total = weight.sum(dtype=np.float64)
        if not (np.isfinite(total) and total > 0):
            raise ValueError(f"weights must be finite with a positive sum, got a sum of {total}")
        cumulative = rounded_shares(weight / total, np.array([len(weight)]))
        self.pmf = np.diff(cumulative, prepend=0.0)
        # The kernel contains the search bounds: padding to a power of two reduces the number of distinct kernels
        padding = (1 << len(weight).bit_length()) - len(weight)
        self._cumulative = upload(mi.Float, np.append(cumulative, np.ones(padding)))
        self._pmf = upload(mi.Float, self.pmf)
        self.count = len(weight)

    def row(self, sample):
        """Row for a uniform number in [0, 1): the first with a cumulative probability above it."""
        length = dr.width(self._cumulative)
        return dr.binary_search(0, length, lambda i: dr.gather(mi.Float, self._cumulative, i) <= sample)

    def probability(self, row, active=True):
        """Probability of a row (0 where not active)."""
        return dr.gather(mi.Float, self._pmf, row, active)
