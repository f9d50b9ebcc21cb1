"""The light matrix, sampled at some rows: what clusters of lights send to some gather points, with visibility [LS].

Columns are clusters of lights (:mod:`vpl.matrix.column_forest`), of which the representative is traced.  From sampled
rows follows how much is lost where one light stands for a cluster, for all clusters of the forest at once: drawn with a
probability proportional to the norms n of their columns x, it has the variance (Σ n)² − ‖Σ x‖², which is the cost of
clusters that [LS] and the work before it minimise.
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

# What a bound counts for at most, relative to the light that was seen; and what float32 still squares or adds up
_BOUND_LIMIT, _LARGEST = 10.0, 1e30
# Rows that are darker than this fraction of the mean count for less
_DARK_FLOOR = 0.5


class DeviceForest:
    """A forest on the device: for every node ``first``, ``last`` column and ``escape``; ``node`` of every column.

    ``size``, ``columns``: how many of both; ``parts``: of every group of lights, its first column and how many it has.
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
        """A matrix, Float, row by row, evaluated: ``entry`` is called with (group of lights, nodes of its tree, row),
        arrays of one entry per lane, and returns what to store."""
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
        """The sum of the columns of a node in a row, from running sums over whole rows, in double precision."""
        start = row * dr.opaque(mi.UInt32, self.columns)
        first, last = (start + dr.gather(mi.UInt32, ends, node) for ends in (self.first, self.last))
        return dr.gather(type(cumulative), cumulative, last) - dr.gather(type(cumulative), cumulative, first)

    def node_sums(self, cumulative, rows: int):
        """These sums for every node, row by row, Float."""
        lane, size = dr.arange(mi.UInt32, rows * self.size), dr.opaque(mi.UInt32, self.size)
        return mi.Float(self.node_sum(cumulative, lane // size, lane % size))


class SampledRows:
    """Some rows of the matrix, evaluated, in units of their mean sum, so that squares neither overflow nor vanish.

    ``scale``: one over that mean, or 1 where they are ``dark``, without any light; ``values``: Float, row by row;
    ``sums``: Float, of the columns of every node, row by row; ``rays``: shadow rays that were traced for them.
    """

    def __init__(self, transport: Transport, batch: Batch, forest: DeviceForest, points: np.ndarray):
        self.forest, self.count, self.rays = forest, len(points), 0
        index = upload(mi.UInt32, points)

        def entry(group, node, row):
            """Mean over channels, with visibility."""
            surface = batch.surfaces_at(dr.gather(mi.UInt32, index, row))
            light, scale = group.representatives(node)
            value, traced = evaluate_pairs(transport, group, surface, light, scale)
            # One value that is not finite would spoil the sums of all that follow
            value, traced = channel_mean(finite_or_zero(value)), dr.select(traced, mi.UInt32(1), 0)
            dr.eval(value, traced)
            self.rays += int(dr.sum(mi.UInt64(traced))[0])
            return value

        self.values = forest.fill(self.count, entry)
        mean = float(dr.sum(dr.float64_array_t(mi.Float)(self.values))[0]) / self.count
        # The inverse of the least of numbers is not finite
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
        """Scale rows to the same sum of 1, those darker than _DARK_FLOOR times the mean to less, so that clusters are
        judged by what they are to all points; ``scale`` remains what it was."""
        total = dr.block_sum(self.values, self.forest.columns)
        # The mean over rows is 1
        scale = dr.rcp(dr.maximum(total, _DARK_FLOOR))

        def scaled(matrix, width: int):
            row = dr.arange(mi.UInt32, dr.width(matrix)) // dr.opaque(mi.UInt32, width)
            return matrix * dr.gather(mi.Float, scale, row)

        self.values, self.sums = scaled(self.values, self.forest.columns), scaled(self.sums, self.forest.size)
        dr.eval(self.values, self.sums)


@dataclass(frozen=True)
class NearRows:
    """Of some groups of gather points, the sampled rows that tell about each, and how much they count: (groups, k)."""

    rows: np.ndarray
    relevance: np.ndarray

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.rows)

    @classmethod
    def all_of(cls, rows: int) -> NearRows:
        """A single group, of which all rows tell the same."""
        return cls(np.arange(rows)[None], np.ones((1, rows)))

    @classmethod
    def nearest(cls, places: np.ndarray, most: int) -> NearRows:
        """For each of some places, (n, k), the ``most`` nearest ones, its own among them.

        They count 1 / (1 + d² / d₁²), d₁ being the distance to the nearest one of the others.
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
        # Places that coincide tell the same
        relevance = np.divide(unit, unit + distance2, out=np.ones_like(distance2), where=unit + distance2 > 0)
        return cls(np.concatenate(rows), relevance)

    def part(self, first: int, last: int) -> NearRows:
        """Rows near some consecutive groups."""
        return NearRows(self.rows[first:last], self.relevance[first:last])


class ColumnWeights:
    """Weights of every column, and costs of every cluster of them, for some groups of gather points.

    ``cumulative``: float64, the running sums of the weights of the columns, group by group, each of which adds 1, or 0
    if nothing can arrive: lights are drawn with probabilities proportional to weights.  ``cost``: Float, of every node,
    group by group.

    ``near``: the sampled rows that tell about each group; ``clusters``, ``nodes`` (UInt32): the groups as nodes of a
    point tree.  ``unseen``: how much goes by upper bounds, relative to what goes by sampled rows: a light that no row
    saw may yet be seen.  A bound counts for no more than _BOUND_LIMIT times all light that was seen, or all that rows
    see on average: those of boxes with a light inside would leave nothing to the others.
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
        # Scaled before they are squared, which float32 holds for any light
        squares = dr.square(dr.sqrt(self._squares(sampled.sums, self._forest.size)) * scale)
        self.cost = dr.maximum(dr.square(total) - squares, 0)
        dr.eval(self.cost)

    def _bounds(self, clusters: PointClusters, nodes, scale):
        """The most that each column can send to a point of each group, in the units of the rows."""
        clamp = self._forest.lights.clamp

        def entry(group, node, row):
            receiver = clusters.gather(dr.gather(mi.UInt32, nodes, row)).receiver
            bound = scale * contribution_bound(group.kind, receiver, group.tree.gather(node), clamp)
            # Without clamping some are infinite
            return dr.select(bound > 0, dr.minimum(bound, _LARGEST), 0)

        return self._forest.fill(self.groups, entry)

    @dr.syntax
    def _squares(self, matrix, width: int):
        """For every group and every place in a row, the sum of squares over the rows that tell about the group."""
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
        """(Running sums of the weights, scaled to 1 for each group; what they were scaled by, float64 per group)."""
        precise = dr.float64_array_t(mi.Float)
        columns = dr.opaque(mi.UInt32, self._forest.columns)
        group = dr.arange(mi.UInt32, dr.width(norms)) // columns

        def total(values):
            return dr.block_sum(precise(values), self._forest.columns)

        seen = total(norms)
        if dark:
            # Nothing tells which bounds are much
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
