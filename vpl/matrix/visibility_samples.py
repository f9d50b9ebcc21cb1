"""Samples of the visibility of columns: traced rows, in lists and bit masks.

Only rows with a positive unoccluded contribution are traced.  Their order is a golden-ratio sequence along the
space-filling curve through the rows of the slice, without large gaps.  Its start is a hash of slice and light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..core.sampling import HASH_ROUNDS
from ..lights.light_set import LightGroup
from ..transport.evaluation import unoccluded
from .reduced_matrix import Columns, MatrixEntries

_WORD = 32  # bits of a word of the masks
# Marks the end of a column's rows
NO_ROW = 0xFFFFFFFF


@dataclass
class FirstSamples:
    """Samples of c columns: ``rows`` and ``values``, (c, count), with value -1 after the last sample; ``following``,
    (c,): next step of the sequence of each column."""

    rows: np.ndarray
    values: np.ndarray
    following: np.ndarray

    def select(self, index) -> FirstSamples:
        """Select columns."""
        return FirstSamples(self.rows[index], self.values[index], self.following[index])

    def joined(self, other: FirstSamples) -> FirstSamples:
        """Concatenate columns."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return FirstSamples(*(np.concatenate(pair) for pair in pairs))


class VisibilitySamples:
    """Samples of columns, at most ``most`` of each.

    ``columns``: sorted; ``number``: UInt32, number of samples of each column.  Sample k of column c has the index
    c · most + k in ``row``: UInt32, row within the slice; ``x``, ``y``: Float, position in the slice's tangent plane;
    ``value``: Float, V.
    """

    def __init__(self, entries: MatrixEntries, columns: Columns, most: int, seed: int):
        self.entries, self.columns, self.most, self._seed = entries, columns, most, seed
        self._piece, self._light = (upload(mi.UInt32, values) for values in (columns.piece, columns.light))
        self._words, count = -(-entries.rows.most // _WORD), columns.count
        self.number, self._next = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
        self.row = dr.zeros(mi.UInt32, count * most)
        self.x, self.y, self.value = (dr.zeros(mi.Float, count * most) for _ in range(3))
        self._seen, self._lit = (dr.zeros(mi.UInt32, count * self._words) for _ in range(2))
        dr.eval(self.number, self._next, self.row, self.x, self.y, self.value, self._seen, self._lit)

    @classmethod
    def first(cls, entries: MatrixEntries, columns: Columns, count: int, seed: int) -> FirstSamples:
        """Take the first ``count`` samples of columns."""
        if not columns.count:
            return FirstSamples(
                np.zeros((0, count), np.uint32), np.zeros((0, count), np.float32), np.zeros(0, np.uint32)
            )
        samples = cls(entries, columns, count, seed)
        index = np.arange(columns.count)
        rows = samples.draw(index, count)
        values = samples.trace(index, rows, count)
        found = (download(array).reshape(-1, count) for array in (rows, values))
        return FirstSamples(*found, download(samples._next))

    def resume(self, first: FirstSamples) -> None:
        """Start from samples taken before."""
        self._next = upload(mi.UInt32, first.following)
        count = first.rows.shape[1]
        rows, values = upload(mi.UInt32, first.rows), upload(mi.Float, first.values)
        self._remember(dr.arange(mi.UInt32, self.columns.count), rows, values, count)

    def draw(self, index: np.ndarray, count: int):
        """Next ``count`` rows of some columns, UInt32, column by column; NO_ROW after the last row."""
        found = dr.full(mi.UInt32, NO_ROW, len(index) * count)
        dr.eval(found)
        for group, inside in self.entries.by_group(self.columns.select(index)):
            column, target = upload(mi.UInt32, index[inside]), upload(mi.UInt32, inside * count)
            self._draw_rows(group, column, found, target, dr.opaque(mi.UInt32, count))
        return found

    @dr.syntax
    def _draw_rows(self, group: LightGroup, column, found, target, count):
        piece, number = dr.gather(mi.UInt32, self._piece, column), dr.gather(mi.UInt32, self._light, column)
        light, step = group.lights.gather(number), self.entries.rows.step(piece)
        first, rows = self.entries.rows.range(piece)
        start, _ = mi.sample_tea_32(number, piece ^ dr.opaque(mi.UInt32, self._seed), HASH_ROUNDS)
        # Padding lanes of the last packet divide, too, and read zeros
        divisor = dr.maximum(rows, 1)
        k, taken = dr.gather(mi.UInt32, self._next, column), mi.UInt32(0)
        while dr.hint((k < rows) & (taken < count), exclude=[self, group, light, found]):
            row = (start % divisor + k * step) % divisor
            surface = self.entries.rows.random_surface(first + row, number)
            lit = dr.any(unoccluded(self.entries.lights, group, surface, light) > 0)
            dr.scatter(found, row, target + taken, lit)
            taken += dr.select(lit, 1, 0)
            k += 1
        dr.scatter(self._next, k, column)
        dr.eval(found, self._next)

    def trace(self, index: np.ndarray, rows, count: int):
        """Trace V at drawn rows, and store the samples: Float, -1 for NO_ROW."""
        value = dr.full(mi.Float, -1, len(index) * count)
        dr.eval(value)
        for group, inside in self.entries.by_group(self.columns.select(index)):
            lane = dr.arange(mi.UInt32, len(inside) * count)
            owner, number = lane // dr.opaque(mi.UInt32, count), lane % dr.opaque(mi.UInt32, count)
            column = dr.gather(mi.UInt32, upload(mi.UInt32, index[inside]), owner)
            place = dr.gather(mi.UInt32, upload(mi.UInt32, inside * count), owner) + number
            row = dr.gather(mi.UInt32, rows, place)
            light = dr.gather(mi.UInt32, self._light, column)
            first, _ = self.entries.rows.range(dr.gather(mi.UInt32, self._piece, column))
            passed, traced = self.entries.trace(group, light, first + row, light, row != NO_ROW)
            dr.scatter(value, passed, place, traced)
            dr.eval(value)
        self._remember(upload(mi.UInt32, index), rows, value, count)
        return value

    @dr.syntax
    def _remember(self, column, rows, values, count: int):
        first = dr.arange(mi.UInt32, dr.width(column)) * dr.opaque(mi.UInt32, count)
        begin, _ = self.entries.rows.range(dr.gather(mi.UInt32, self._piece, column))
        number, k = dr.gather(mi.UInt32, self.number, column), mi.UInt32(0)
        most, words = dr.opaque(mi.UInt32, self.most), dr.opaque(mi.UInt32, self._words)
        while dr.hint(k < dr.opaque(mi.UInt32, count), exclude=[self, rows, values]):
            row, value = dr.gather(mi.UInt32, rows, first + k), dr.gather(mi.Float, values, first + k)
            known = (value >= 0) & (number < most)
            x, y = self.entries.rows.place(begin + dr.select(known, row, 0))
            fields = ((self.row, row), (self.x, x), (self.y, y), (self.value, value))
            for target, source in fields:
                dr.scatter(target, source, column * most + number, known)
            word, bit = column * words + (row >> 5), mi.UInt32(1) << (row & 31)
            dr.scatter_reduce(dr.ReduceOp.Or, self._seen, bit, word, known, dr.ReduceMode.Direct)
            lit = known & (value > 0.5)
            dr.scatter_reduce(dr.ReduceOp.Or, self._lit, bit, word, lit, dr.ReduceMode.Direct)
            number += dr.select(known, 1, 0)
            k += 1
        dr.scatter(self.number, number, column)
        dr.eval(self.number, self.row, self.x, self.y, self.value, self._seen, self._lit)

    def at(self, column, row):
        """(1 if the row was traced, 1 if the row was lit), UInt32, for some columns and rows of their slices."""
        word = column * dr.opaque(mi.UInt32, self._words) + (row >> 5)
        bit = row & 31
        seen, lit = (dr.gather(mi.UInt32, bits, word) >> bit & 1 for bits in (self._seen, self._lit))
        return seen, lit
