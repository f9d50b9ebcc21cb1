"""Which lights light a slice: columns of the light matrix, clustered for all slices together, then for each [LS].

First some rows of the matrix are sampled at clusters of lights that are as small as can be afforded, and of those only
the clusters that matter for the image are kept apart: the columns that all slices share.  Then each slice gets a row of
these, sampled at one of its points.  The rows of a slice and of its nearest neighbours tell which columns it can join.

Departures from the paper: clusters are nodes of the light trees, the costliest (:mod:`vpl.light_matrix`) split first;
the paper divides columns by where they project on a line.  A light is drawn for each cluster by norm, and counts with
its own colour: the paper's ratios of norms, channel by channel, are biased where the colours of a cluster differ.  And
no light is lost for not having been seen: weights have a share of upper bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import channel_mean, download, upload
from .bounds import DeviceTree
from .column_forest import ColumnForest, split_threshold
from .gather import SceneTraits
from .light_matrix import ColumnWeights, DeviceForest, NearRows, SampledRows, chunks
from .light_set import LightGroup, LightSet
from .light_tree import ESCAPE, cluster_sizes
from .point_clusters import PointClusters
from .sampling import derived_seed, find_interval, independent_sampler

# For each column that all slices share: clusters that were compared; and of all slices, those whose rows decided
_FINE, _DECIDING = 8, 1 / 8
# How much bounds decide there: with 0.1 errors were a tenth larger (cornell)
_SHARED_UNSEEN = 0.01


@dataclass
class SliceLights:
    """Lights of one group that light slices: those of slice s in set r are ``first[r * slices + s]`` up to ``last``.

    ``light``: index in the group, ``scale``: the factor on its intensity.
    """

    group: LightGroup
    first: object
    last: object
    light: object
    scale: object

    def pick(self, j):
        """The light in place j and its scale."""
        return self.group.lights.gather(dr.gather(mi.UInt32, self.light, j)), dr.gather(mi.Float, self.scale, j)


def fine_forest(lights: LightSet, most: int) -> ColumnForest:
    """The largest clusters of lights by size alone: about ``most``, shared out to the groups by number of lights."""
    parts = []
    for number, group in enumerate(lights.groups):
        records = group.tree.records()
        forest = ColumnForest.of_tree(records.view(np.uint32)[:, ESCAPE], number)
        parts.append(forest.pruned(cluster_sizes(records), max(most * group.count // lights.count, 1)))
    return ColumnForest.joined(parts)


def shared_columns(
    scene, traits: SceneTraits, lights: LightSet, clusters: PointClusters, points: np.ndarray, most: int, seed: int
) -> tuple[ColumnForest, int, int]:
    """At most ``most`` clusters of lights that all slices share [LS: global clustering], rays and bounds spent on them.

    ``points``: one of each slice, along the slices; at some of them, drawn at random, rows are sampled.
    """
    fine = fine_forest(lights, _FINE * most)
    if len(fine.columns) <= most:
        return fine, 0, 0
    forest = DeviceForest(fine, lights)
    points = np.random.default_rng(seed).permutation(points)[: max(round(_DECIDING * len(points)), 1)]
    rows = SampledRows(scene, traits, clusters.batch, forest, points)
    rows.balance()
    weights = ColumnWeights(rows, NearRows.all_of(rows.count), clusters, dr.zeros(mi.UInt32, 1), _SHARED_UNSEEN)
    return fine.pruned(download(weights.cost), most), rows.rays, forest.columns


def slice_lights(
    rows: SampledRows, near: NearRows, clusters: PointClusters, columns: int, unseen: float, sets: int, seed: int
) -> list[SliceLights]:
    """At most ``columns`` lights for each slice and set, but one of each kind at least; one entry for every kind.

    ``rows``: one for each slice, ``near``: which of them tell about each; ``unseen``: see :class:`ColumnWeights`.
    """
    forest, leaves = rows.forest, upload(mi.UInt32, clusters.tree.leaves)
    found = []
    for number, (first, last) in enumerate(chunks(rows.count, forest.size)):
        nodes = dr.gather(mi.UInt32, leaves, dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first))
        weights = ColumnWeights(rows, near.part(first, last), clusters, nodes, unseen)
        chosen, node = _chosen_nodes(forest, weights, columns)
        column, scale = _drawn_columns(forest, weights, chosen, node, sets, derived_seed(seed, number))
        found.append((chosen + first, column, scale))
    chosen = np.concatenate([one[0] for one in found])
    column, scale = (np.concatenate([one[k] for one in found], axis=1) for k in (1, 2))
    return [
        _lights_of_group(rows, group, part, chosen, column, scale, derived_seed(seed, 1 << 20, number))
        for number, (group, part) in enumerate(zip(forest.lights.groups, forest.parts, strict=True))
    ]


def _chosen_nodes(forest: DeviceForest, weights: ColumnWeights, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """The clusters of each slice, those without weight left out: (slices, nodes of the forest), slice by slice."""
    slices, roots = weights.groups, len(forest.forest.roots)
    cost = download(weights.cost).reshape(slices, -1)
    threshold = split_threshold(cost[:, forest.forest.inner], columns - roots)
    most = max(columns, roots)
    nodes, count = _walk(forest, weights, upload(mi.Float, threshold), most)
    used = np.arange(most) < download(count)[:, None]
    return np.repeat(np.arange(slices), used.sum(1)), download(nodes).reshape(slices, most)[used]


@dr.syntax
def _walk(forest: DeviceForest, weights: ColumnWeights, threshold, most: int):
    """From the roots down, split what costs more than the threshold: (nodes, ``most`` places a slice; how many)."""
    lane, size = dr.arange(mi.UInt32, weights.groups), dr.opaque(mi.UInt32, forest.size)
    nodes, start = dr.zeros(mi.UInt32, weights.groups * most), lane * dr.opaque(mi.UInt32, most)
    dr.eval(nodes)
    node, at = dr.zeros(mi.UInt32, weights.groups), mi.UInt32(start)
    while dr.hint(node < size, exclude=[forest, weights, nodes]):
        place = lane * size + node
        escape = dr.gather(mi.UInt32, forest.escape, node)
        split = (escape != node + 1) & (dr.gather(mi.Float, weights.cost, place) > threshold)
        taken = ~split & (forest.node_sum(weights.cumulative, lane, node) > 0)
        dr.scatter(nodes, node, at, taken)
        at += dr.select(taken, 1, 0)
        node = dr.select(split, node + 1, escape)
    dr.eval(nodes, at)
    return nodes, at - start


def _drawn_columns(forest: DeviceForest, weights: ColumnWeights, chosen, node, sets: int, seed: int):
    """A column of every cluster, drawn by weight, and one over its probability: (sets, clusters) each."""
    row, node = upload(mi.UInt32, chosen), upload(mi.UInt32, node)
    first, last = (row * forest.columns + dr.gather(mi.UInt32, ends, node) for ends in (forest.first, forest.last))
    cumulative, found = weights.cumulative, []
    total = dr.gather(type(cumulative), cumulative, last) - dr.gather(type(cumulative), cumulative, first)
    for number in range(sets):
        sample = independent_sampler(derived_seed(seed, number), len(chosen)).next_1d()
        place = find_interval(cumulative, first, last, sample)
        weight = dr.gather(type(cumulative), cumulative, place + 1) - dr.gather(type(cumulative), cumulative, place)
        found.append((download(place - row * forest.columns), download(mi.Float(total / weight))))
    return tuple(np.stack(column) for column in zip(*found, strict=True))


def _lights_of_group(rows: SampledRows, group: LightGroup, part, chosen, column, scale, seed: int) -> SliceLights:
    """The lights of one group: of every column that was drawn, one by intensity.  ``part``: its columns."""
    forest, sets = rows.forest, len(column)
    begin, count = part
    # Clusters are of one kind each, whatever columns are drawn of them
    own = (column[0] >= begin) & (column[0] < begin + count)
    node = dr.gather(mi.UInt32, forest.node, upload(mi.UInt32, column[:, own]))
    light, factor = _drawn_lights(group.tree, node, _precise_sample(seed, dr.width(node)))
    lights = np.bincount(chosen[own], minlength=rows.count)
    last = np.cumsum(lights)[None] + np.arange(sets)[:, None] * lights.sum()
    ends = (upload(mi.UInt32, last - lights), upload(mi.UInt32, last))
    factor = upload(mi.Float, scale[:, own]) * factor * dr.rcp(channel_mean(group.lights.gather(light).intensity))
    dr.eval(light, factor)
    return SliceLights(group, *ends, light, factor)


def _precise_sample(seed: int, count: int):
    """Uniform numbers of 48 bits in double precision."""
    sampler = independent_sampler(seed, count)
    precise = dr.float64_array_t(mi.Float)
    return precise(sampler.next_1d()) + precise(sampler.next_1d()) * 2.0**-24


@dr.syntax
def _drawn_lights(tree: DeviceTree, nodes, sample):
    """A light of each node, drawn by intensity, and the intensity of the node.

    ``sample``: in double precision, for every level of the tree takes its part of it.
    """
    precise = type(sample)
    node, sample, end = mi.UInt32(nodes), precise(sample), tree.escape(nodes)
    while dr.hint(end != node + 1, exclude=[tree]):
        second = tree.escape(node + 1)
        intensity = precise(tree.summed_intensity(node + 1))
        share = intensity / (intensity + precise(tree.summed_intensity(second)))
        stays = sample < share
        sample = dr.minimum(dr.select(stays, sample / share, (sample - share) / (1 - share)), 1 - 1e-15)
        end = dr.select(stays, second, end)
        node = dr.select(stays, node + 1, second)
    light, total = tree.representative(node), tree.summed_intensity(nodes)
    dr.eval(light, total)
    return light, total
