"""Stratified random numbers for the vertices of paths: a lattice over the samples of a pixel at each vertex.

Rank-1 lattices with a random shift of the unit square, so every single number is uniform [Cranley and Patterson 1976;
Sloan and Joe 1994, "Lattice Methods for Multiple Integration"].  Each dimension, vertex and pixel takes the points in
an independent random order: with a common order, products of two dimensions would have up to twice the variance of
independent numbers.  Pixels may have different numbers of samples, see :mod:`vpl.split.pixel_rays`.

Where a pixel has several cells of the film, each cell takes points that are spread as a lattice of their own: a residue
class of the lattice of the pixel.  Denoisers work on cells, and on the lattice of the pixel alone the points of a cell
would be a random choice.

Passes of a render may share the lattices of a pixel.  A pass then takes the next points of an extensible lattice: the
first 2^m points are a lattice for each m [Cools, Kuo and Nuyens 2006, "Constructing embedded lattice rules for
multivariate integration"], and the samples of all passes are spread like those of one.  Numbers of points that are no
powers of two are spread less evenly than in a lattice of their own, but better than in several ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.sampling import HASH_ROUNDS, derived_seed
from .pixel_rays import RayNumbers

# Multipliers of a hash with full avalanche: every bit depends on every input bit [Wellons 2018, "Prospecting for hash
# functions"]
_MIXING = (0x7FEB352D, 0x846CA68B)
# 2^32 over the golden ratio, made odd: far from any simple fraction
_STEP = 0x9E3779B9
# For vertices, 2^32 over the golden ratio and the root of 2, made odd: no small multiples of both steps are equal
_VERTEX_STEP = 0x6FE0483D
# Multiplier of the extensible lattice, built bit by bit [Cools, Kuo and Nuyens 2006]: P_2 of the first 2^4 to 2^16
# points is at most 2.3 times that of the best lattice with as many points, and 1.4 times up to 2^8
EXTENSIBLE = 29401
# Largest number of orders and of entries (1 MB) in the table, with a minimum of 1 order; two dimensions share an order
# and a start with a probability of 1 / entries. Number of candidate multipliers of a lattice
_ORDERS, _ENTRIES, _TRIED = 256, 1 << 18, 64
# Most values of the kernel that the search for a multiplier computes, at 10 ns each: fewer candidates for more points
_SEARCHED = 1 << 24


def _mixed(bits, stream: int):
    """Hash ``bits``: 32-bit numbers, independent for each stream."""
    bits = bits + (stream * _STEP & 0xFFFFFFFF)
    bits = (bits ^ (bits >> 16)) * _MIXING[0]
    bits = (bits ^ (bits >> 15)) * _MIXING[1]
    return bits ^ (bits >> 16)


@lru_cache(maxsize=64)
def lattice_multiplier(count: int, cells: int = 1) -> int:
    """Multiplier g of the lattice (i, g i) / ``count`` modulo 1.

    Of the candidates nearest to the golden ratio, the one with the least P_2, the worst-case error over smooth periodic
    functions [Sloan and Joe 1994, section 4.2]; with several ``cells``, the least product of P_2 for the pixel and for
    a cell.
    """
    candidates = np.arange(1, max(count, 2))
    candidates = candidates[np.gcd(candidates, count) == 1]
    tried = min(_TRIED, max(_SEARCHED // count, 1))
    nearest = np.argsort(np.abs(candidates * (1 + 5**0.5) / 2 - count), kind="stable")[:tried]
    errors = np.prod([_worst_errors(size, candidates[nearest]) for size in {count, count // cells}], axis=0)
    return int(candidates[nearest][np.argmin(errors)])


def _worst_errors(count: int, multipliers: np.ndarray) -> np.ndarray:
    """P_2 of the lattices with some multipliers."""
    number = np.arange(count)

    def kernel(numerator):
        x = numerator / count
        return 1 + 2 * np.pi**2 * (x * x - x + 1 / 6)

    along = kernel(number)
    return np.array([np.mean(along * kernel(number * g % count)) - 1 for g in multipliers.tolist()])


@lru_cache(maxsize=16)
def _orders(count: int, cells: int, first_step: int, cell_step: int) -> np.ndarray:
    """Random orders of ``count`` points, in sequence; fixed, like a hash function.

    An order has the points of one of the ``cells`` after those of another one: its points have numbers in steps of
    ``first_step``, from a multiple of ``cell_step`` on.
    """
    orders, each, random = max(min(_ORDERS, _ENTRIES // count), 1), count // cells, np.random.default_rng(0)
    points = random.permuted(np.tile(np.arange(each, dtype=np.uint32), (orders * cells, 1)), axis=1)
    starts = random.permuted(np.tile(np.arange(cells, dtype=np.uint32), (orders, 1)), axis=1)
    return (points * np.uint32(first_step) + starts.reshape(-1, 1) * np.uint32(cell_step)).reshape(-1)


def _fraction(bits):
    return mi.Float(bits >> 8) * 2**-24


def _points(sizes: Sequence[int], cells: int):
    """(For each of ``sizes``, points of its lattice in random orders, numbered; steps between the points along both
    dimensions, units of 2^-32)."""
    multipliers = [1] * len(sizes), [lattice_multiplier(size, cells) for size in sizes]
    steps = ([round(g * 2**32 / size) % 2**32 for g, size in zip(row, sizes, strict=True)] for row in multipliers)
    # Every `cells`-th point belongs to the same cell
    return [_orders(size, cells, cells, 1) for size in sizes], steps


def _next_points(sizes: Sequence[int], earlier: Sequence[int], cells: int):
    """As :func:`_points`, for the points of the extensible lattice after the ``earlier`` ones: their places along the
    first dimension, the bits of their numbers in reverse order [van der Corput 1935].  Successive points, which are
    spread best, belong to the same cell."""
    tables = [
        _bits_reversed(np.arange(first, first + size, dtype=np.uint32))[_orders(size, cells, 1, size // cells)]
        for size, first in zip(sizes, earlier, strict=True)
    ]
    return tables, ([step] * len(sizes) for step in (1, EXTENSIBLE))


def _bits_reversed(numbers: np.ndarray) -> np.ndarray:
    """The 32 bits of ``numbers``, uint32, in reverse order."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        numbers = ((numbers >> shift) & mask) | ((numbers & mask) << shift)
    return (numbers >> 16) | (numbers << 16)


class Lattice:
    """Numbers for paths; ``places`` of the paths in pixels; ``sizes``: different numbers of paths in a pixel;
    ``earlier``: for each of them, the number of points that earlier passes took from lattices with the same ``seed``;
    None for lattices of this pass alone; ``cells`` of the film that a pixel has, with equal numbers of paths."""

    def __init__(
        self, places: RayNumbers, sizes: Sequence[int], seed: int, earlier: Sequence[int] | None = None, cells: int = 1
    ):  # fmt: skip
        self._cells = dr.opaque(mi.UInt32, cells)
        self._cell, self._number = places.in_cells(self._cells)
        # A good hash of the pixel, once for each path; cheap hashes derive the numbers of each vertex
        self._bits, _ = mi.sample_tea_32(places.pixel, dr.opaque(mi.UInt32, derived_seed(seed, 0)), HASH_ROUNDS)
        tables, steps = _points(sizes, cells) if earlier is None else _next_points(sizes, earlier, cells)
        self._orders = upload(mi.UInt32, np.concatenate(tables))
        begins = np.cumsum([0, *(len(table) for table in tables[:-1])])
        rows = [len(table) // size for table, size in zip(tables, sizes, strict=True)]
        # In the orders of the pass before, pairs of points of different dimensions would occur again
        self._turn = dr.opaque(mi.UInt32, derived_seed(max(earlier), 1) if earlier else 0)
        each = [size // cells for size in sizes]
        self._samples, self._each, self._begin, self._rows, *self._steps = (
            # Two entries at least: Dr.Jit makes a table of one a constant, which would take another kernel
            dr.gather(mi.UInt32, upload(mi.UInt32, np.resize(list(values), max(len(sizes), 2))), places.level)
            for values in (sizes, each, begins, rows, *steps)
        )

    @classmethod
    def of_lanes(cls, lane, samples: int, seed: int) -> Lattice:
        """For paths in the lanes ``lane`` (UInt32); ``samples`` consecutive lanes belong to a pixel."""
        dr.eval(lane)
        places = RayNumbers.of_lanes(lane, samples)
        # All numbers of rays, and counted and chosen lanes, use the same kernel
        dr.eval(places)
        return cls(places, (samples,), seed)

    def at(self, vertex):
        """Numbers of a path at a ``vertex`` (UInt32, counted): (number, pair, number, pair) in [0, 1)."""
        found = []
        bits = self._bits + vertex * _VERTEX_STEP
        for stream in range(4):
            point = self._point(_mixed(bits + self._turn, 3 * stream))
            shift = _mixed(bits, 3 * stream + 1)
            numbers = [_fraction(point * self._steps[0] + shift)]
            if stream % 2:
                # Mirrored with probability 1/2, because every lattice is coarse in some directions
                mirrored = dr.select((shift & 1) == 0, point, 0 - point)
                numbers.append(_fraction(mirrored * self._steps[1] + _mixed(bits, 3 * stream + 2)))
            found.append(mi.Point2f(*numbers) if stream % 2 else numbers[0])
        return tuple(found)

    def _point(self, bits):
        """Number of the point of a sample: random ``bits`` choose an order, and starts among cells and in a cell."""
        order, bits = dr.mul_hi(bits, self._rows), bits * self._rows
        cell, bits = dr.mul_hi(bits, self._cells) + self._cell, bits * self._cells
        place = dr.mul_hi(bits, self._each) + self._number
        cell = dr.select(cell < self._cells, cell, cell - self._cells)
        place = dr.select(place < self._each, place, place - self._each)
        return dr.gather(mi.UInt32, self._orders, self._begin + order * self._samples + cell * self._each + place)
