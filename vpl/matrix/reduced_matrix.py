"""Reduced light matrices, with a row per pixel of a slice and a column per cluster of lights [MSR section 3].

An entry is E V: the unoccluded contribution E of a cluster's representative light to a row, times its visibility V.  E
is evaluated at a fixed point of the row, V is traced at a random point [MSR section 7.2].
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, upload
from ..core.sampling import HASH_ROUNDS
from ..lights.light_set import LightGroup
from ..points.point_clusters import PointClusters, unit_or_up
from ..points.slice_rows import golden_steps, rows_of, tangent_places
from ..transport.evaluation import Transport, probe_visibility, unoccluded


class MatrixRows:
    """Rows of the slices, slice after slice.

    - ``slices``, ``count``: numbers of slices and rows
    - ``first``: (slices + 1,) int64, first row of each slice
    - ``points``: UInt32, first point of each row along the tree, then the number of points
    - ``shown``: UInt32, point at which a row is shaded
    - ``places``: two arrays, Float, position of rows in the tangent plane of the slice, from 0 to 1
    """

    def __init__(self, clusters: PointClusters, pixel: np.ndarray, seed: int):
        self.clusters, tree = clusters, clusters.tree
        begin = rows_of(pixel[tree.order], tree.leaf)
        starts = tree.first[tree.leaves]
        self.first = np.append(np.searchsorted(begin, starts), len(begin) - 1)
        self.slices, self.count = len(starts), len(begin) - 1
        size = np.diff(begin)
        shown = begin[:-1] + (np.random.default_rng(seed).random(self.count) * size).astype(np.int64)
        self.points, self.shown = upload(mi.UInt32, begin), upload(mi.UInt32, shown)
        self._begin = upload(mi.UInt32, self.first)
        self._row = upload(mi.UInt32, np.repeat(np.arange(self.count), size))
        slice_of_row = np.repeat(np.arange(self.slices), np.diff(self.first))
        self._slice = upload(mi.UInt32, slice_of_row)
        self._step = upload(mi.UInt32, golden_steps(np.diff(self.first)))
        surfaces = (clusters.batch.position, unit_or_up(clusters.batch.normal))
        position, normal = (download(values)[shown] for values in surfaces)
        places = tangent_places(position, normal, self.first[:-1], slice_of_row)
        self.places = [upload(mi.Float, column) for column in places]

    @property
    def most(self) -> int:
        """Rows of the largest slice."""
        return int(np.diff(self.first).max())

    def range(self, piece):
        """(First row, number of rows) of slices."""
        first = dr.gather(mi.UInt32, self._begin, piece)
        return first, dr.gather(mi.UInt32, self._begin, piece + 1) - first

    def step(self, piece):
        """Distance in rows, modulo the size of the slice, between successive samples of a column."""
        return dr.gather(mi.UInt32, self._step, piece)

    def row_of(self, point):
        """Row of points along the tree."""
        return dr.gather(mi.UInt32, self._row, point)

    def slice_of(self, row):
        """The slice of rows."""
        return dr.gather(mi.UInt32, self._slice, row)

    def place(self, row):
        """Position of rows in the tangent plane of the slice, from 0 to 1: two arrays."""
        return tuple(dr.gather(mi.Float, column, row) for column in self.places)

    def shown_surface(self, row, active=True):
        """Surfaces at which rows are shaded."""
        return self.clusters.batch.surfaces_at(dr.gather(mi.UInt32, self.shown, row, active), active)

    def random_surface(self, row, number, active=True):
        """A random surface of every row, drawn by a hash of ``row`` and ``number``."""
        first = dr.gather(mi.UInt32, self.points, row, active)
        size = dr.gather(mi.UInt32, self.points, row + 1, active) - first
        draw, _ = mi.sample_tea_32(row, number, HASH_ROUNDS)
        return self.clusters.batch.surfaces_at(first + draw % dr.maximum(size, 1), active)


@dataclass
class Columns:
    """Columns of the matrices of some slices, sorted by slice, group of lights and tree node.

    ``piece``, ``group``, ``node``, ``light``: (c,) int64: slice, group of lights, tree node, representative light.
    """

    piece: np.ndarray
    group: np.ndarray
    node: np.ndarray
    light: np.ndarray

    @property
    def count(self) -> int:
        """Number of columns."""
        return len(self.piece)

    @property
    def segment(self) -> np.ndarray:
        """A number for every slice and group, (c,): equal for the columns of a slice in one tree."""
        return self.piece * (self.group.max(initial=0) + 1) + self.group

    def select(self, index: np.ndarray) -> Columns:
        """Some of the columns."""
        return Columns(*(column[index] for column in (self.piece, self.group, self.node, self.light)))

    @classmethod
    def none(cls) -> Columns:
        """No column."""
        return cls(*(np.zeros(0, np.int64) for _ in range(4)))

    def joined(self, other: Columns) -> Columns:
        """Concatenate columns."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Columns(*(np.concatenate(pair) for pair in pairs))

    def sorted(self) -> tuple[Columns, np.ndarray]:
        """(Sorted columns, their previous indices)."""
        order = np.lexsort((self.node, self.group, self.piece))
        return self.select(order), order


class MatrixEntries:
    """Evaluates entries: E without rays, V by shadow rays; ``rays``: number of shadow rays so far."""

    def __init__(self, transport: Transport, rows: MatrixRows):
        self._transport, self.lights, self.rows, self.rays = transport, transport.lights, rows, 0
        # NumPy records of the light trees
        self.records = [group.tree.records() for group in self.lights.groups]

    def columns_of(self, piece, group: int, node) -> Columns:
        """Columns for tree nodes, with their representative lights."""
        if not len(node):
            return Columns.none()
        tree = self.lights.groups[group].tree
        light = download(tree.representative(upload(mi.UInt32, node))).astype(np.int64)
        return Columns(piece, np.full(len(node), group), node, light)

    def by_group(self, columns: Columns):
        """Yield (group of lights, indices of its columns) for every group with columns."""
        for number, group in enumerate(self.lights.groups):
            index = np.flatnonzero(columns.group == number)
            if len(index):
                yield group, index

    def largest(self, columns: Columns, part: int = 32) -> np.ndarray:
        """Largest E over the rows of the slice, for unit intensity, of every column: (c,) float64.

        ``part``: number of rows per lane.
        """
        found = np.zeros(columns.count)
        parts = -(-self.rows.most // part)
        for group, index in self.by_group(columns):
            piece, light = (upload(mi.UInt32, values[index]) for values in (columns.piece, columns.light))
            lane = dr.arange(mi.UInt32, len(index) * parts)
            column, number = lane // dr.opaque(mi.UInt32, parts), lane % dr.opaque(mi.UInt32, parts)
            first, count = self.rows.range(dr.gather(mi.UInt32, piece, column))
            begin = number * part
            end = dr.minimum(begin + part, count)
            record = group.lights.gather(dr.gather(mi.UInt32, light, column))
            value = self._largest_of(group, record, first + begin, first + end)
            value /= channel_mean(record.intensity)
            dr.eval(value)
            found[index] = download(value).reshape(len(index), parts).max(1)
        return found

    @dr.syntax
    def _largest_of(self, group: LightGroup, light, first, last):
        row, most = mi.UInt32(first), dr.zeros(mi.Float, dr.width(first))
        while dr.hint(row < last, exclude=[self, group, light]):
            surface = self.rows.shown_surface(row)
            most = dr.maximum(most, channel_mean(unoccluded(self.lights, group, surface, light)))
            row += 1
        return most

    def trace(self, group: LightGroup, light, row, number, active=True):
        """Trace V at some rows: (V, whether a ray was traced), one per lane, evaluated.

        ``light``: index in the group; ``number``: seed for the point of a row.  Rays are traced only if E is positive.
        """
        surface = self.rows.random_surface(row, number, active)
        light = group.lights.gather(light, active)
        passed, traced = probe_visibility(self._transport, group, surface, light, active)
        passed = channel_mean(passed)
        dr.eval(passed, traced)
        self.rays += int(dr.count(traced)[0])
        return passed, traced
