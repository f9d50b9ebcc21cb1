"""Random numbers: seeds derived from one another, and Mitsuba's sampler for any wavefront."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import upload

# Of Mitsuba's hash: after four, its default, the numbers of neighbouring lanes are alike (correlation 0.45)
HASH_ROUNDS = 8
# Mitsuba's samplers draw whole multiples of 2^-23
_SAMPLE_BITS = 23


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


def precise_sample(sampler):
    """Uniform numbers of 46 bits in double precision: of a hundred thousand rows, :func:`find_interval` draws each with
    its share by these, but with an error of 1% by a sampler's own numbers of 23 bits."""
    precise = dr.float64_array_t(mi.Float)
    return precise(sampler.next_1d()) + precise(sampler.next_1d()) * 2.0**-_SAMPLE_BITS


def stratified(sampler, count: int, first: int, total: int):
    """One uniform number in each of the parts first .. first + count - 1 of the ``total`` equal parts of [0, 1)."""
    lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    sample = (mi.Float(lane) + sampler.next_1d()) / dr.opaque(mi.Float, float(total))
    return dr.minimum(sample, dr.one_minus_epsilon(mi.Float))


# Steps of the additive recurrences: powers of 1/g, where g^4 = g + 1 is the golden ratio of three dimensions
_STEPS = [int(2**32 * 1.2207440846057596**-k) for k in (1, 2, 3)]


class SpreadSamples:
    """Triples of numbers that fill the unit cube evenly, one sequence for each lane: they leave less noise than
    independent ones, the less the more are taken.

    An additive recurrence [Roberts 2018, "The unreasonable effectiveness of quasirandom sequences"] from a random start
    [Cranley and Patterson 1976]: every number alone is uniform.  ``start``: Vector3u, fractions of 2^32.
    """

    def __init__(self, start):
        self.start = start

    @classmethod
    def of(cls, sequence, seed: int) -> SpreadSamples:
        """Lanes that have the same ``sequence`` (UInt32) take from the same one; another seed, other sequences."""
        first, second = (dr.opaque(mi.UInt32, derived_seed(seed, stream)) for stream in (0, 1))
        x, y = mi.sample_tea_32(sequence, first, HASH_ROUNDS)
        z, _ = mi.sample_tea_32(sequence, second, HASH_ROUNDS)
        return cls(mi.Vector3u(x, y, z))

    @classmethod
    def random(cls, sampler) -> SpreadSamples:
        """A sequence of its own for each lane of a sampler."""
        return cls(mi.Vector3u(*(mi.UInt32(sampler.next_1d() * 2.0**24) << 8 for _ in range(3))))

    def at(self, number) -> mi.Point3f:
        """Member ``number`` (UInt32) of each sequence, from [0, 1)."""
        # Wrapping integers are fractions that lose nothing; 24 bits of them are a float below 1
        members = (start + number * mi.UInt32(step) for start, step in zip(self.start, _STEPS, strict=True))
        return mi.Point3f(*(mi.Float(member >> 8) * 2.0**-24 for member in members))


def running_sums(values):
    """The sum of all values before each, and of all, in double precision, evaluated: one more entry than values."""
    precise = dr.float64_array_t(mi.Float)
    count = dr.width(values)
    sums = dr.zeros(precise, count + 1)
    dr.scatter(sums, dr.cumsum(precise(values)), dr.arange(mi.UInt32, count) + 1)
    dr.eval(sums)
    return sums


@dr.syntax
def find_interval(cumulative, first, last, sample):
    """The interval of ``cumulative[first] ... cumulative[last]`` that a uniform number falls into, first .. last - 1.

    ``cumulative``: sums in double precision, not falling; an interval is found with its share of the whole rise, and
    one that does not rise never, unless all do not.
    """
    precise = type(cumulative)
    start = dr.gather(precise, cumulative, first)
    target = start + precise(sample) * (dr.gather(precise, cumulative, last) - start)
    low, high = mi.UInt32(first), mi.UInt32(last)
    while dr.hint(high > low + 1, exclude=[cumulative]):
        middle = (low + high) >> 1
        below = dr.gather(precise, cumulative, middle) <= target
        low = dr.select(below, middle, low)
        high = dr.select(below, high, middle)
    return low


def rounded_shares(share: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Sums of the shares of a row up to each, (n,) float64: whole multiples of 2^-23.

    ``share`` (n,) float64: of the members of all rows, one row after the other; ``length`` (rows,): members of each, at
    least one; those of a row sum to one.  Numbers of 23 bits or more fall between two such sums with exactly the
    probability that is their difference: at least 2^-23 where the share is positive (of up to 2^22 in a row), and
    within some 1e-7 of the share.
    """
    row, first = np.repeat(np.arange(len(length)), length), np.cumsum(length) - length
    positive, member = share > 0, np.arange(len(share))
    number = np.add.reduceat(positive.astype(np.int64), first)
    # Sums that differ by a whole multiple still do when they are rounded
    least = np.minimum(2.0**-_SAMPLE_BITS, 0.5 / np.maximum(number, 1))
    total = np.cumsum((1 - least * number)[row] * share + least[row] * positive)
    total -= np.concatenate([[0.0], total])[first][row]
    total = np.round(total * 2.0**_SAMPLE_BITS) * 2.0**-_SAMPLE_BITS
    # What is drawn last has all that is left
    last = np.maximum.reduceat(np.where(positive, member, -1), first)
    total[member >= last[row]] = 1
    return total


class RowChoice:
    """Choose a member of a row with its share, in a few steps however long the row: guided search [Chen and Asau 1974,
    "On generating random variates from an empirical distribution"].

    ``share`` (n,) float64: of the members of all rows, one row after the other; ``length`` (rows,): members of each, at
    least one; those of a row sum to one.  ``pmf`` (n,) float64: the probabilities with which they are drawn, exactly
    (see :func:`rounded_shares`).  ``place`` (n,): of each in the table, where a row has one entry more than members.
    """

    def __init__(self, share: np.ndarray, length: np.ndarray):
        rows, row = len(length), np.repeat(np.arange(len(length)), length)
        first = np.cumsum(length + 1) - (length + 1)
        self.place = np.arange(len(share)) + row
        after = rounded_shares(share, length)
        before = np.zeros(len(share) + rows)
        before[self.place + 1] = after
        self.pmf = after - before[self.place]
        # Half as many guides to a row as it has members, or more; of a power of two, so that a number finds its own
        # without rounding, and two at least, because arrays of one entry make other kernels
        guides = 2 ** max(int(np.log2(len(share) / rows)), 1)
        steps = np.arange(rows)[:, None] + np.arange(guides) / guides
        order = np.repeat(np.arange(rows), length + 1) + before
        low = np.searchsorted(order, steps.ravel(), side="right") - 1
        # Up to the last member that begins before the next guide
        high = np.append(low[1:], 0)
        high[guides - 1 :: guides] = first + length - 1
        self._guides = dr.opaque(mi.UInt32, guides)
        self._bounds = upload(mi.UInt32, np.stack([low, high + 1], 1).ravel())
        self._before = upload(mi.Float, before)

    def draw(self, row, number, active=True):
        """The place of a member of each row, for a uniform number in [0, 1)."""
        guide = row * self._guides + mi.UInt32(number * mi.Float(self._guides))
        low, high = dr.gather(mi.Vector2u, self._bounds, guide, active)
        return self._search(low, high, number)

    def probability(self, place, active=True):
        """Probability of the members with these places (0 where not active)."""
        # Side by side: mostly one access to memory
        return dr.gather(mi.Float, self._before, place + 1, active) - dr.gather(mi.Float, self._before, place, active)

    def rest(self, place, number, active=True):
        """Uniform numbers in [0, 1), made of those by which members with these places were drawn."""
        before = dr.gather(mi.Float, self._before, place, active)
        rest = (number - before) / self.probability(place, active)
        return dr.clip(rest, 0, dr.one_minus_epsilon(mi.Float))

    @dr.syntax
    def _search(self, low, high, number):
        table = self._before
        while dr.hint(high > low + 1, exclude=[table]):
            middle = (low + high) >> 1
            below = dr.gather(mi.Float, table, middle) <= number
            low = dr.select(below, middle, low)
            high = dr.select(below, high, middle)
        return low


class Choice:
    """Choose a row with probability proportional to a weight; exact zero weights are never chosen.

    ``weight`` (n,) float64, not negative, with a positive sum.  ``pmf`` (n,) float64 sums to one: the probabilities
    with which rows are drawn, exactly, by numbers of 23 bits or more.  They are whole multiples of 2^-23, and at least
    that where the weight is positive (of up to 2^22 rows), so they differ from the weights' shares by some 1e-7.
    """

    def __init__(self, weight: np.ndarray):
        total = weight.sum(dtype=np.float64)
        if not (np.isfinite(total) and total > 0):
            raise ValueError(f"weights must be finite with a positive sum, got a sum of {total}")
        cumulative = rounded_shares(weight / total, np.array([len(weight)]))
        self.pmf = np.diff(cumulative, prepend=0.0)
        # The search's kernel holds its bounds: the same for all lengths up to a power of two
        padding = (1 << len(weight).bit_length()) - len(weight)
        self._cumulative = upload(mi.Float, np.append(cumulative, np.ones(padding)))
        self._pmf = upload(mi.Float, self.pmf)
        self.count = len(weight)

    def row(self, sample):
        """Row for a uniform number in [0, 1): the first whose cumulative probability exceeds it."""
        length = dr.width(self._cumulative)
        return dr.binary_search(0, length, lambda i: dr.gather(mi.Float, self._cumulative, i) <= sample)

    def probability(self, row, active=True):
        """Probability of a row (0 where not active)."""
        return dr.gather(mi.Float, self._pmf, row, active)
