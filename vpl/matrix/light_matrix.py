"""Sampled rows of the light matrix: contributions of light clusters to some gather points, with visibility [LS].

Columns are clusters of lights (:mod:`vpl.matrix.column_forest`), evaluated at their representative lights.  If a column
x, drawn in proportion to its norm n, represents a cluster of columns, the variance is (Σ n)² − ‖Σ x‖².  [LS] and
earlier work minimise this cost of clusters, here estimated from the sampled rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, even_chunks, finite_or_zero, upload
from ..core.sampling import running_sums
from ..lights.light_set import LightSet
from ..points.point_clusters import PointClusters
from ..points.surfaces import Batch
from ..transport.bounds import contribution_bound
from ..transport.evaluation import Transport, evaluate_pairs
from .column_forest import ColumnForest

# Largest weight of an upper bound, relative to the light seen by the sampled rows
_BOUND_LIMIT = 10.0
# Largest finite bound: sums of bounds stay within float32
_LARGEST = 1e30
# Rows below this fraction of the mean sum keep a smaller weight
_DARK_ROW = 0.5


class DeviceForest:
    """A forest on the device: ``first``, ``last`` column and ``escape`` of every node; tree ``node`` of every column.

    ``size``, ``columns``: numbers of nodes and columns; ``parts``: (first column, number of columns) per group of
    lights.
    """

    def __init__(self, forest: ColumnForest, lights: LightSet):
        self.forest, self.lights = forest, lights
        self.first, self.last, self.escape, self.node = (
            upload(mi.UInt32, column)
            for column in (forest.first[:-1], forest.last, forest.escape, forest.node[forest.columns])
        )
        self.size, self.columns = forest.size, len(forest.columns)
        count = np.bincount(forest.group[forest.columns], minlength=len(lights.groups))
        self.parts = list(zip((np.cumsum(count) - count).tolist(), count.tolist(), strict=True))

    def fill(self, rows: int, entry):
        """Evaluate a matrix, Float, row by row.

        ``entry``: called with (group of lights, nodes of the group's tree, rows), one entry of the matrix per lane;
        returns the values, Float.
        """
        matrix = dr.empty(mi.Float, rows * self.columns)
        for group, (first, count) in zip(self.lights.groups, self.parts, strict=True):
            width, columns = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, self.columns)
            for begin, end in even_chunks(rows, count):
                lane = dr.arange(mi.UInt32, (end - begin) * count)
                row, column = lane // width, lane % width + dr.opaque(mi.UInt32, first)
                row += dr.opaque(mi.UInt32, begin)
                value = entry(group, dr.gather(mi.UInt32, self.node, column), row)
                dr.scatter(matrix, value, row * columns + column)
                dr.eval(matrix)
        return matrix

    def node_sum(self, cumulative, row, node):
        """Sum of the columns of a node in a row, from double-precision running sums over rows."""
        start = row * dr.opaque(mi.UInt32, self.columns)
        first, last = (start + dr.gather(mi.UInt32, ends, node) for ends in (self.first, self.last))
        return dr.gather(type(cumulative), cumulative, last) - dr.gather(type(cumulative), cumulative, first)

    def node_sums(self, cumulative, rows: int):
        """:meth:`node_sum` for every node, row by row, Float."""
        lane, size = dr.arange(mi.UInt32, rows * self.size), dr.opaque(mi.UInt32, self.size)
        return mi.Float(self.node_sum(cumulative, lane // size, lane % size))


class SampledRows:
    """Rows of the matrix at ``points``, in units of the mean row sum, so that squares neither overflow nor underflow.

    ``scale``: inverse of the mean, or 1 for ``dark`` rows, without light; ``values``: entries, Float, row by row;
    ``sums``: sums over the columns of every node, Float, row by row; ``rays``: number of shadow rays.
    """

    def __init__(self, transport: Transport, batch: Batch, forest: DeviceForest, points: np.ndarray):
        self.forest, self.count, self.rays = forest, len(points), 0
        index = upload(mi.UInt32, points)

        def entry(group, node, row):
            """Mean over channels, with visibility."""
            surface = batch.surfaces_at(dr.gather(mi.UInt32, index, row))
            light, scale = group.representatives(node)
            value, traced = evaluate_pairs(transport, group, surface, light, scale)
            # A non-finite value would spoil the running sums after it
            value, traced = channel_mean(finite_or_zero(value)), dr.select(traced, mi.UInt32(1), 0)
            dr.eval(value, traced)
            self.rays += int(dr.sum(mi.UInt64(traced))[0])
            return value

        self.values = forest.fill(self.count, entry)
        mean = float(dr.sum(dr.float64_array_t(mi.Float)(self.values))[0]) / self.count
        # The inverse of a denormal mean would overflow
        self.dark = mean <= np.finfo(np.float32).tiny
        self.scale = 1.0 if self.dark else 1 / mean
        self.values *= dr.opaque(mi.Float, self.scale)
        dr.eval(self.values)
        self.sums = dr.empty(mi.Float, self.count * forest.size)
        for first, last in even_chunks(self.count, forest.size):
            rows = last - first
            part = dr.arange(mi.UInt32, rows * forest.columns) + dr.opaque(mi.UInt32, first * forest.columns)
            cumulative = running_sums(dr.gather(mi.Float, self.values, part))
            place = dr.arange(mi.UInt32, rows * forest.size) + dr.opaque(mi.UInt32, first * forest.size)
            dr.scatter(self.sums, forest.node_sums(cumulative, rows), place)
            dr.eval(self.sums)

    def balance(self) -> None:
        """Scale rows to a sum of 1, and rows below _DARK_ROW times the mean to less: every point counts the same in the
        cost of clusters.  ``scale`` is unchanged."""
        total = dr.block_sum(self.values, self.forest.columns)
        # The mean over rows is 1
        scale = dr.rcp(dr.maximum(total, _DARK_ROW))

        def scaled(matrix, width: int):
            row = dr.arange(mi.UInt32, dr.width(matrix)) // dr.opaque(mi.UInt32, width)
            return matrix * dr.gather(mi.Float, scale, row)

        self.values, self.sums = scaled(self.values, self.forest.columns), scaled(self.sums, self.forest.size)
        dr.eval(self.values, self.sums)


@dataclass(frozen=True)
class NearRows:
    """Sampled rows near each group of gather points, (groups, k) int64, and their weights, (groups, k) float64."""

    rows: np.ndarray
    relevance: np.ndarray

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.rows)

    @classmethod
    def all_of(cls, rows: int) -> NearRows:
        """A single group, with equal weights of the rows."""
        return cls(np.arange(rows)[None], np.ones((1, rows)))

    @classmethod
    def nearest(cls, places: np.ndarray, most: int) -> NearRows:
        """The ``most`` nearest places of each of n places, (n, k), including itself.

        The weights are 1 / (1 + d² / d₁²), with d₁ the distance to the nearest different place.
        """
        most = min(most, len(places))
        squares, rows, found = (places**2).sum(1), [], []
        for first, last in even_chunks(len(places), len(places)):
            part = np.arange(first, last)
            distance2 = np.maximum(squares + squares[part, None] - 2 * places[part] @ places.T, 0)
            distance2[np.arange(len(part)), part] = -1
            rows.append(np.argpartition(distance2, most - 1, axis=1)[:, :most])
            found.append(np.take_along_axis(distance2, rows[-1], axis=1))
        distance2 = np.maximum(np.concatenate(found), 0)
        unit = np.sort(distance2, axis=1)[:, min(1, most - 1), None]
        # Coincident places have equal weights
        relevance = np.divide(unit, unit + distance2, out=np.ones_like(distance2), where=unit + distance2 > 0)
        return cls(np.concatenate(rows), relevance)

    def part(self, first: int, last: int) -> NearRows:
        """Rows near the groups ``first`` to ``last`` - 1."""
        return NearRows(self.rows[first:last], self.relevance[first:last])


class ColumnWeights:
    """Weights of columns and costs of nodes, for some groups of gather points.

    ``cumulative``: float64, running sums of the weights of columns, group by group.  The weights of a group sum to 1,
    or to 0 if no light can arrive.  Lights are drawn in proportion to the weights.  ``cost``: Float, cost of every
    node, group by group.

    ``near``: sampled rows near each group; ``clusters``, ``nodes`` (UInt32): nodes of the point tree, one per group.
    ``unseen``: total weight of upper bounds relative to sampled rows, for lights that are hidden from the sampled rows
    only.  A bound counts at most _BOUND_LIMIT times the light seen by the rows of the group, or the mean row sum if
    larger: an unlimited bound of a box around a light would take the whole weight.
    """

    def __init__(self, sampled: SampledRows, near: NearRows, clusters: PointClusters, nodes, unseen: float):
        self._forest, self.groups = sampled.forest, near.count
        self._rows, self._relevance = upload(mi.UInt32, near.rows), upload(mi.Float, near.relevance)
        self._nearby = dr.opaque(mi.UInt32, near.rows.shape[1])
        bounds = self._bounds(clusters, nodes, dr.opaque(mi.Float, sampled.scale))
        norms = dr.sqrt(self._squares(sampled.values, self._forest.columns))
        self.cumulative, scale = self._weigh(norms, bounds, unseen, sampled.dark)
        total = self._forest.node_sums(self.cumulative, self.groups)
        group = dr.arange(mi.UInt32, dr.width(total)) // dr.opaque(mi.UInt32, self._forest.size)
        scale = dr.gather(mi.Float, mi.Float(scale), group)
        # Scaled before squaring, against overflow of float32
        squares = dr.square(dr.sqrt(self._squares(sampled.sums, self._forest.size)) * scale)
        self.cost = dr.maximum(dr.square(total) - squares, 0)
        dr.eval(self.cost)

    def _bounds(self, clusters: PointClusters, nodes, scale):
        """Upper bound of each column's contribution to any point of each group, in the units of the rows."""
        clamp = self._forest.lights.clamp

        def entry(group, node, row):
            receiver = clusters.gather(dr.gather(mi.UInt32, nodes, row)).receiver
            bound = scale * contribution_bound(group.kind, receiver, group.tree.gather(node), clamp)
            # Bounds may be infinite without clamping
            return dr.select(bound > 0, dr.minimum(bound, _LARGEST), 0)

        return self._forest.fill(self.groups, entry)

    @dr.syntax
    def _squares(self, matrix, width: int):
        """Weighted sum of squares over the rows near each group, for every position in a row."""
        lane, columns = dr.arange(mi.UInt32, self.groups * width), dr.opaque(mi.UInt32, width)
        start, column = lane // columns * self._nearby, lane % columns
        total, k = dr.zeros(mi.Float, self.groups * width), mi.UInt32(0)
        while dr.hint(k < self._nearby, exclude=[self, matrix]):
            row = dr.gather(mi.UInt32, self._rows, start + k)
            weight = dr.gather(mi.Float, self._relevance, start + k)
            total += weight * dr.square(dr.gather(mi.Float, matrix, row * columns + column))
            k += 1
        return total

    def _weigh(self, norms, bounds, unseen: float, dark: bool):
        """(Running sums of the weights, normalised to 1 in each group; factor of the normalisation, per group)."""
        precise = dr.float64_array_t(mi.Float)
        columns = dr.opaque(mi.UInt32, self._forest.columns)
        group = dr.arange(mi.UInt32, dr.width(norms)) // columns

        def total(values):
            return dr.block_sum(precise(values), self._forest.columns)

        seen = total(norms)
        if dark:
            # Without light there is no unit for bounds
            bounds = dr.select(bounds > 0, mi.Float(1), 0)
        else:
            most = mi.Float(dr.maximum(_BOUND_LIMIT * seen, 1))
            bounds = dr.minimum(bounds, dr.gather(mi.Float, most, group))
        possible = total(bounds)
        share = dr.select(seen > 0, dr.opaque(precise, unseen) * seen, 1) / dr.select(possible > 0, possible, 1)
        weights = precise(norms) + dr.gather(precise, share, group) * precise(bounds)
        whole = total(weights)
        scale = dr.select(whole > 0, dr.rcp(whole), 0)
        return running_sums(weights * dr.gather(precise, scale, group)), scale
