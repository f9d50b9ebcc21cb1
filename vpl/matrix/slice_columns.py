"""Lights of each slice: columns of the light matrix, clustered for the image, then refined for the slice [LS].

Global clustering samples a few rows of the matrix at many small clusters of lights, and joins clusters with little
effect on the image.  The remaining clusters are the shared columns.  Refinement samples one row of the shared columns
per slice.  The rows of a slice and of its nearest neighbours decide the columns that are joined for the slice.

Departures from the paper:

- Clusters are nodes of the light trees, split in order of cost (:mod:`vpl.matrix.light_matrix`).  The paper splits
  columns by their projections on a line.
- The representative light of a cluster is drawn by norm and keeps its colour.  The paper scales colours by ratios of
  norms per channel, which is biased for clusters of different colours.
- Weights include a fraction of upper bounds, so that lights hidden from the sampled rows are not lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, even_chunks, upload
from ..core.sampling import derived_seed, find_interval, independent_sampler, precise_sample
from ..lights.device_tree import DeviceTree
from ..lights.light_set import LightGroup, LightSet
from ..lights.light_tree import ESCAPE, cluster_sizes
from ..points.point_clusters import PointClusters
from ..points.slices import six_dimensional
from ..transport.evaluation import Transport
from .column_forest import ColumnForest, split_threshold
from .light_matrix import ColumnWeights, DeviceForest, NearRows, SampledRows

# Global clustering: number of small clusters per shared column; fraction of the slices with a sampled row
_FINE, _SAMPLED_SLICES = 8, 1 / 8
# Weight of upper bounds in the global clustering; 0.1 increased errors by a tenth (cornell)
_SHARED_UNSEEN = 0.01


@dataclass
class SliceLights:
    """Lights of one group that represent the clusters of slices.

    Slice s in set r has the lights ``first[i]`` to ``last[i]`` - 1, with i = r · slices + s.  ``light``: index in the
    group; ``scale``: factor on the intensity.
    """

    group: LightGroup
    first: mi.UInt32
    last: mi.UInt32
    light: mi.UInt32
    scale: mi.Float

    def picker(self, entry, sets: int, count: int):
        """Function from the index of a light to ``count`` candidates: the light, and its counterparts in other sets.

        ``entry``: list of lights of each lane, r · slices + s, UInt32; ``sets``: number of sets.
        """
        slices, places = (dr.opaque(mi.UInt32, dr.width(values) // sets) for values in (self.first, self.light))
        own, shifts = entry // slices, []
        for k in range(1, count):
            other = (own + dr.opaque(mi.UInt32, k * sets // count)) % dr.opaque(mi.UInt32, sets)
            # Differences of UInt32 wrap around, and so do the sums below
            shifts.append((other - own) * places)
        dr.eval(shifts)

        def candidates(j):
            """Candidate lights, and scales."""
            return [
                (self.group.lights.gather(dr.gather(mi.UInt32, self.light, at)), dr.gather(mi.Float, self.scale, at))
                for at in [j, *(j + shift for shift in shifts)]
            ]

        return candidates


def fine_forest(lights: LightSet, most: int) -> ColumnForest:
    """About ``most`` clusters, by splitting the largest: each group gets a number proportional to its lights."""
    parts = []
    for number, group in enumerate(lights.groups):
        records = group.tree.records()
        forest = ColumnForest.of_tree(records.view(np.uint32)[:, ESCAPE], number)
        parts.append(forest.pruned(cluster_sizes(records), max(most * group.count // lights.count, 1)))
    return ColumnForest.joined(parts)


def shared_columns(
    transport: Transport, clusters: PointClusters, points: np.ndarray, most: int, seed: int
) -> tuple[ColumnForest, int, int]:
    """Shared columns by global clustering [LS]: (at most ``most`` columns, shadow rays, evaluated bounds).

    ``points``: a point of each slice; rows are sampled at random points among these.
    """
    fine = fine_forest(transport.lights, _FINE * most)
    if len(fine.columns) <= most:
        return fine, 0, 0
    forest = DeviceForest(fine, transport.lights)
    points = np.random.default_rng(seed).permutation(points)[: max(round(_SAMPLED_SLICES * len(points)), 1)]
    rows = SampledRows(transport, clusters.batch, forest, points)
    rows.balance()
    weights = ColumnWeights(rows, NearRows.all_of(rows.count), clusters, dr.zeros(mi.UInt32, 1), _SHARED_UNSEEN)
    return fine.pruned(download(weights.cost), most), rows.rays, forest.columns


def slice_places(clusters: PointClusters) -> np.ndarray:
    """Positions and normals of slices in the space of :func:`vpl.points.slices.six_dimensional`: (slices, 6)."""
    receiver = clusters.gather(upload(mi.UInt32, clusters.tree.leaves)).receiver
    return six_dimensional(download(receiver.position), download(receiver.normal))


def slice_lights(
    rows: SampledRows, near: NearRows, clusters: PointClusters, columns: int, unseen: float, sets: int, seed: int
) -> list[SliceLights]:
    """At most ``columns`` lights for each slice and set, at least one per group of lights; a list entry per group.

    ``rows``: one per slice; ``near``: rows near each slice; ``unseen``: see :class:`ColumnWeights`.
    """
    forest, leaves = rows.forest, upload(mi.UInt32, clusters.tree.leaves)
    columns = min(columns, forest.columns)
    chosen = _Chosen(rows.count, max(columns, len(forest.forest.roots)), sets)
    for first, last in even_chunks(rows.count, forest.size):
        part = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
        weights = ColumnWeights(rows, near.part(first, last), clusters, dr.gather(mi.UInt32, leaves, part), unseen)
        chosen.choose(forest, weights, columns, first)
        chosen.draw_columns(forest, weights, first, derived_seed(seed, first))
    return chosen.lights(forest, derived_seed(seed, 1 << 20))


class _Chosen:
    """Clusters of slices, in up to ``most`` slots each, and their representative columns in every set.

    ``node``: forest node of each slot; ``used``: number of used slots per slice; ``column``, ``scale``: drawn column
    and inverse probability of each slot, set by set.
    """

    def __init__(self, slices: int, most: int, sets: int):
        self.slices, self.most, self.sets, self.places = slices, most, sets, slices * most
        self.node, self.used = dr.zeros(mi.UInt32, self.places), dr.zeros(mi.UInt32, slices)
        self.column, self.scale = dr.zeros(mi.UInt32, sets * self.places), dr.zeros(mi.Float, sets * self.places)
        dr.eval(self.node, self.used, self.column, self.scale)

    def choose(self, forest: DeviceForest, weights: ColumnWeights, columns: int, first: int) -> None:
        """Choose the clusters of consecutive slices from ``first`` on: the costliest clusters are split."""
        cost = download(weights.cost).reshape(weights.groups, -1)
        splits = columns - len(forest.forest.roots)
        threshold = split_threshold(cost[:, forest.forest.inner], splits)
        self._walk(forest, weights, upload(mi.Float, threshold), first)

    @dr.syntax
    def _walk(self, forest: DeviceForest, weights: ColumnWeights, threshold, first: int):
        """Descend from the roots, split nodes above the cost threshold, and leave out nodes without weight."""
        lane, size = dr.arange(mi.UInt32, weights.groups), dr.opaque(mi.UInt32, forest.size)
        piece = lane + dr.opaque(mi.UInt32, first)
        start = piece * dr.opaque(mi.UInt32, self.most)
        node, at = dr.zeros(mi.UInt32, weights.groups), mi.UInt32(start)
        while dr.hint(node < size, exclude=[self, forest, weights]):
            escape = dr.gather(mi.UInt32, forest.escape, node)
            split = (escape != node + 1) & (dr.gather(mi.Float, weights.cost, lane * size + node) > threshold)
            taken = ~split & (forest.node_sum(weights.cumulative, lane, node) > 0)
            dr.scatter(self.node, node, at, taken)
            at += dr.select(taken, 1, 0)
            node = dr.select(split, node + 1, escape)
        dr.scatter(self.used, at - start, piece)
        dr.eval(self.node, self.used)

    def draw_columns(self, forest: DeviceForest, weights: ColumnWeights, first: int, seed: int) -> None:
        """Draw a column of every cluster by weight, in each set, for consecutive slices from ``first`` on."""
        count, most, sums = weights.groups * self.most, dr.opaque(mi.UInt32, self.most), weights.cumulative
        for begin, end in even_chunks(self.sets, count):
            lane = dr.arange(mi.UInt32, (end - begin) * count)
            inside, number = lane % dr.opaque(mi.UInt32, count), lane // dr.opaque(mi.UInt32, count)
            row, place = inside // most, inside + dr.opaque(mi.UInt32, first * self.most)
            active = inside % most < dr.gather(mi.UInt32, self.used, row + dr.opaque(mi.UInt32, first))
            node = dr.gather(mi.UInt32, self.node, place, active)
            start = row * dr.opaque(mi.UInt32, forest.columns)
            low, high = (start + dr.gather(mi.UInt32, ends, node, active) for ends in (forest.first, forest.last))
            sample = precise_sample(independent_sampler(derived_seed(seed, begin), (end - begin) * count))
            chosen = find_interval(sums, low, high, sample)
            whole, own = (
                dr.gather(type(sums), sums, last, active) - dr.gather(type(sums), sums, one, active)
                for one, last in ((low, high), (chosen, chosen + 1))
            )
            target = place + (number + dr.opaque(mi.UInt32, begin)) * dr.opaque(mi.UInt32, self.places)
            dr.scatter(self.column, chosen - start, target, active)
            # Rounding may draw a column without weight, and so without light
            dr.scatter(self.scale, mi.Float(dr.select(own > 0, whole / own, 0)), target, active)
            dr.eval(self.column, self.scale)

    def lights(self, forest: DeviceForest, seed: int) -> list[SliceLights]:
        """Draw a light of each drawn column by intensity, for every group of lights."""
        used = np.arange(self.most) < download(self.used)[:, None]
        group = forest.forest.group[download(self.node)].reshape(used.shape)
        light, found = dr.zeros(mi.UInt32, len(self.column)), []
        dr.eval(light)
        begin, shift = np.arange(self.slices) * self.most, np.arange(self.sets)[:, None] * self.places
        for number, one in enumerate(forest.lights.groups):
            # The clusters of a slice are sorted by group
            end = begin + (used & (group == number)).sum(1)
            first, last = (upload(mi.UInt32, ends + shift) for ends in (begin, end))
            for low, high in even_chunks(self.sets, self.places):
                self._draw_lights(forest, one, first, last, light, (low, high), derived_seed(seed, number, low))
            found.append(SliceLights(one, first, last, light, self.scale))
            begin = end
        return found

    def _draw_lights(self, forest: DeviceForest, group: LightGroup, first, last, light, sets: tuple, seed: int) -> None:
        """Replace the columns of a group by lights, and ``scale`` by factors on the intensities of these lights."""
        lane = dr.arange(mi.UInt32, (sets[1] - sets[0]) * self.places) + dr.opaque(mi.UInt32, sets[0] * self.places)
        piece = lane // dr.opaque(mi.UInt32, self.most)
        active = (lane >= dr.gather(mi.UInt32, first, piece)) & (lane < dr.gather(mi.UInt32, last, piece))
        node = dr.gather(mi.UInt32, forest.node, dr.gather(mi.UInt32, self.column, lane), active)
        sample = precise_sample(independent_sampler(seed, dr.width(lane)))
        drawn, total = _drawn_lights(group.tree, node, sample, active)
        factor = total / channel_mean(group.lights.gather(drawn, active).intensity)
        scale = dr.gather(mi.Float, self.scale, lane) * factor
        dr.eval(scale)
        dr.scatter(light, drawn, lane, active)
        dr.scatter(self.scale, scale, lane, active)
        dr.eval(light, self.scale)


@dr.syntax
def _drawn_lights(tree: DeviceTree, nodes, sample, active=True):
    """(Light of each node, drawn by intensity; intensity of the node).

    ``sample``: uniform number in double precision, because every level of the tree consumes some of its bits.
    """
    precise = type(sample)
    node, sample, end = mi.UInt32(nodes), precise(sample), tree.escape(nodes, active)
    end = dr.select(active, end, node + 1)
    while dr.hint(end != node + 1, exclude=[tree]):
        second = tree.escape(node + 1)
        intensity = precise(tree.summed_intensity(node + 1))
        share = intensity / (intensity + precise(tree.summed_intensity(second)))
        stays = sample < share
        sample = dr.minimum(dr.select(stays, sample / share, (sample - share) / (1 - share)), 1 - 1e-15)
        end = dr.select(stays, second, end)
        node = dr.select(stays, node + 1, second)
    light, total = tree.representative(node, active), tree.summed_intensity(nodes, active)
    dr.eval(light, total)
    return light, total
