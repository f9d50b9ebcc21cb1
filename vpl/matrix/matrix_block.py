"""Reduced matrices of some slices in one dense array, padded to one size.

Entry (slice s, column j, row i) has the index (s · width + j) · height + i.  Padding is 0.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, upload
from ..lights.light_set import LightGroup
from ..transport.evaluation import unoccluded
from .reduced_matrix import Columns, MatrixEntries


class MatrixBlock:
    """Matrices of the slices ``begin`` to ``end`` - 1, with their c columns, sorted.

    ``shape``: (slices, width, height); ``slot``: (c,) int64, s · width + j of every column; ``counts``: (slices, 2)
    int64, numbers of columns and rows of each slice.
    """

    def __init__(self, entries: MatrixEntries, columns: Columns, begin: int, end: int):
        self.entries, self.columns, self.begin, self.slices = entries, columns, begin, end - begin
        piece = columns.piece - begin
        number = np.bincount(piece, minlength=self.slices)
        self._first = np.cumsum(number) - number
        rows = np.diff(entries.rows.first[begin : end + 1])
        self.counts = np.stack([number, rows], axis=1)
        self.shape = (self.slices, max(int(number.max()), 1), int(rows.max()))
        self.slot = piece * self.shape[1] + np.arange(columns.count) - self._first[piece]
        scale = np.zeros(columns.count)
        for group, index in entries.by_group(columns):
            scale[index] = download(group.representatives(upload(mi.UInt32, columns.node[index]))[1])
        self.scale, self.light = upload(mi.Float, scale), upload(mi.UInt32, columns.light)

    @property
    def size(self) -> int:
        """Number of entries, including padding."""
        return int(np.prod(self.shape))

    def lanes(self, index: np.ndarray):
        """One lane per row of some columns: (column, row within the slice, row of :class:`MatrixRows`, whether the row
        exists, index of the entry)."""
        height = dr.opaque(mi.UInt32, self.shape[2])
        lane = dr.arange(mi.UInt32, len(index) * self.shape[2])
        column = dr.gather(mi.UInt32, upload(mi.UInt32, index), lane // height)
        inside = lane % height
        piece = dr.gather(mi.UInt32, upload(mi.UInt32, self.columns.piece), column)
        first, count = self.entries.rows.range(piece)
        place = dr.gather(mi.UInt32, upload(mi.UInt32, self.slot), column) * height + inside
        return column, inside, first + inside, inside < count, place

    def unoccluded(self):
        """E of every entry, mean over channels [MSR equation 3]: Float, evaluated."""
        matrix = dr.zeros(mi.Float, self.size)
        dr.eval(matrix)
        for group, index in self.entries.by_group(self.columns):
            column, _, row, active, place = self.lanes(index)
            light = group.lights.gather(dr.gather(mi.UInt32, self.light, column))
            surface = self.entries.rows.shown_surface(row, active)
            value = channel_mean(unoccluded(self.entries.lights, group, surface, light))
            value *= dr.gather(mi.Float, self.scale, column)
            dr.scatter(matrix, dr.select(value > 0, value, 0), place, active)
            dr.eval(matrix)
        return matrix

    def trace(self, visibility, wanted, number) -> None:
        """Trace the entries with the indices ``wanted``, UInt32, and store their V if E is positive.

        ``visibility``: V of every entry, Float; ``number``: seed for the points of rows.
        """
        slot = wanted // dr.opaque(mi.UInt32, self.shape[2])
        column_at = np.zeros(self.slices * self.shape[1], np.int64)
        column_at[self.slot] = np.arange(self.columns.count)
        column = dr.gather(mi.UInt32, upload(mi.UInt32, column_at), slot)
        kind = dr.gather(mi.UInt32, upload(mi.UInt32, self.columns.group), column)
        piece = dr.gather(mi.UInt32, upload(mi.UInt32, self.columns.piece), column)
        row = self.entries.rows.range(piece)[0] + wanted % dr.opaque(mi.UInt32, self.shape[2])
        light = dr.gather(mi.UInt32, self.light, column)
        for group_number, group in enumerate(self.entries.lights.groups):
            inside = dr.compress(kind == group_number)
            if len(inside) == 0:
                continue
            one_light, one_row, place = (dr.gather(mi.UInt32, values, inside) for values in (light, row, wanted))
            passed, traced = self.entries.trace(group, one_light, one_row, number)
            dr.scatter(visibility, passed, place, traced)
            dr.eval(visibility)

    def light_points(self, visibility, first: int, last: int):
        """(Radiance, number of columns) of the points ``first`` to ``last`` - 1 along the tree, by V of their rows."""
        rows = self.entries.rows
        point = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
        row = rows.row_of(point)
        piece = rows.slice_of(row)
        surface = rows.clusters.batch.surfaces_at(point)
        dr.eval(vars(surface))
        entry = (piece - self.begin) * dr.opaque(mi.UInt32, self.shape[1] * self.shape[2]) + row - rows.range(piece)[0]
        radiance, used = dr.zeros(mi.UnpolarizedSpectrum, last - first), dr.zeros(mi.UInt32, last - first)
        for number, group in enumerate(self.entries.lights.groups):
            before = np.bincount(self.columns.piece - self.begin, self.columns.group < number, self.slices)
            inside = np.bincount(self.columns.piece - self.begin, self.columns.group == number, self.slices)
            if not inside.any():
                continue
            begin, count, start = (
                dr.gather(mi.UInt32, upload(mi.UInt32, values), piece - self.begin)
                for values in (self._first + before, inside, before)
            )
            place = entry + start * dr.opaque(mi.UInt32, self.shape[2])
            dr.eval(begin, count, place)
            radiance += self._sum_columns(group, surface, visibility, begin, begin + count, place)
            used += count
            dr.eval(radiance, used)
        return radiance, used

    @dr.syntax
    def _sum_columns(self, group: LightGroup, surface, visibility, first, last, place):
        """Radiance from the columns ``first`` to ``last`` - 1; ``place``: index of the entry of column ``first``."""
        j, at, height = mi.UInt32(first), mi.UInt32(place), dr.opaque(mi.UInt32, self.shape[2])
        total = dr.zeros(mi.UnpolarizedSpectrum, dr.width(first))
        while dr.hint(j < last, exclude=[self, group, surface, visibility]):
            light = group.lights.gather(dr.gather(mi.UInt32, self.light, j))
            passed = dr.gather(mi.Float, visibility, at) * dr.gather(mi.Float, self.scale, j)
            total += unoccluded(self.entries.lights, group, surface, light) * passed
            j += 1
            at += height
        return total
