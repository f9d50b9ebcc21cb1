"""Columns of the reduced matrices: clusters of lights for every slice, split by contribution [MSR section 4.2].

A slice starts with the light cut of its bounding box, by upper bounds [MSR section 4.2.1].  A cluster is split if its
estimated largest contribution (equation 7) exceeds a fraction of the sum over clusters (equation 8), until no cluster
does (algorithm 1).  No column then dominates its matrix.  The estimate traces few rows of each column.

Departures from the paper:

- Clusters are split in rounds, several at once, instead of one by one.
- Clusters share samples with their neighbours along the light tree.  The paper searches by intensity, by a method in a
  supplement that was not available.
- A cluster without a lit sample may be split, too.  Otherwise a cluster would stay whole, and dark, if its
  representative light happens to be in shadow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..cuts.light_cuts import collect_cuts, limited_cuts, upload_thresholds
from ..lights.light_tree import ESCAPE, INTENSITY
from ..points.point_clusters import PointClusters
from .reduced_matrix import Columns, MatrixEntries
from .visibility_samples import FirstSamples, VisibilitySamples

# Neighbours to either side along the light tree that share samples
_NEARBY = 2
# Initial error bound of the cuts of slices, relative to the mean radiance
_START = 1e-4


@dataclass
class _SliceBatch:
    """Bounding boxes of slices, with the interface of gather points in :mod:`vpl.cuts.light_cuts`."""

    clusters: PointClusters
    nodes: mi.UInt32

    def __post_init__(self):
        self.receiver = self.clusters.gather(self.nodes).receiver
        dr.eval(vars(self.receiver), vars(self.receiver.proxy))

    @property
    def count(self) -> int:
        return dr.width(self.nodes)

    def select(self, index) -> _SliceBatch:
        return _SliceBatch(self.clusters, dr.gather(mi.UInt32, self.nodes, index))


def initial_columns(entries: MatrixEntries, mean: float, most: int) -> tuple[Columns, int]:
    """At most ``most`` clusters for every slice by upper bounds [MDLC], and the number of evaluated bounds.

    ``mean``: mean radiance of the image.
    """
    clusters = entries.rows.clusters
    slices = _SliceBatch(clusters, upload(mi.UInt32, clusters.tree.leaves))
    threshold = upload_thresholds(np.full(slices.count, max(_START * mean, np.finfo(np.float32).tiny)))
    threshold, sizes = limited_cuts(entries.lights, slices, threshold, most)
    bounds, parts = int(dr.sum(mi.UInt64(sizes.visits))[0]), []
    numbers = {id(group): number for number, group in enumerate(entries.lights.groups)}
    for chunk in collect_cuts(entries.lights, slices, threshold, sizes):
        piece, node, written = (
            download(x) for x in (dr.gather(mi.UInt32, chunk.points, chunk.rows), chunk.nodes, chunk.written)
        )
        piece, node = piece[written], node[written]
        parts.append(entries.columns_of(piece.astype(np.int64), numbers[id(chunk.group)], node.astype(np.int64)))
    return reduce(Columns.joined, parts, Columns.none()).sorted()[0], bounds


def split_columns(
    entries: MatrixEntries, columns: Columns, alpha: float, most: int, count: int, seed: int
) -> tuple[Columns, FirstSamples]:
    """Split clusters until each contributes at most ``alpha`` times the sum over the slice [MSR algorithm 1].

    ``most``: largest number of clusters of a slice; ``count``: samples of every column.  Returns the columns with a
    positive unoccluded contribution, and their samples.
    """
    largest, samples = entries.largest(columns), VisibilitySamples.first(entries, columns, count, seed)
    while True:
        records = _records(entries, columns)
        gamma = _largest_contributions(columns, records[:, INTENSITY], largest, samples.values)
        inner = records.view(np.uint32)[:, ESCAPE] > columns.node + 1
        split = _to_split(columns, inner, gamma, alpha, most)
        if not len(split):
            lit = np.flatnonzero(largest > 0)
            return columns.select(lit), samples.select(lit)
        kept = np.delete(np.arange(columns.count), split)
        children, parents = _children(entries, columns, split)
        # The child with the representative of its parent keeps the parent's samples
        other = np.flatnonzero(children.light != columns.light[parents])
        source = np.concatenate([kept, parents])
        source[len(kept) + other] = columns.count + np.arange(len(other))
        fresh = children.select(other)
        largest = np.concatenate([largest, entries.largest(fresh)])[source]
        samples = samples.joined(VisibilitySamples.first(entries, fresh, count, seed)).select(source)
        columns, order = columns.select(kept).joined(children).sorted()
        largest, samples = largest[order], samples.select(order)


def _records(entries: MatrixEntries, columns: Columns) -> np.ndarray:
    """Records of the nodes of columns: see :class:`vpl.lights.light_tree.LightTree`."""
    found = np.zeros((columns.count, entries.records[0].shape[1]), np.float32)
    for number, records in enumerate(entries.records):
        inside = columns.group == number
        found[inside] = records[columns.node[inside]]
    return found


def _children(entries: MatrixEntries, columns: Columns, split: np.ndarray):
    """(Children of the clusters to be split, column number of each child's parent)."""
    parts, parents = [], []
    for number, records in enumerate(entries.records):
        inside = split[columns.group[split] == number]
        first = columns.node[inside] + 1
        second = records.view(np.uint32)[first, ESCAPE].astype(np.int64)
        for node in (first, second):
            parts.append(entries.columns_of(columns.piece[inside], number, node))
            parents.append(inside)
    return reduce(Columns.joined, parts), np.concatenate(parents)


def _largest_contributions(columns: Columns, intensity: np.ndarray, largest: np.ndarray, values: np.ndarray):
    """Γ of every column [MSR equation 7], (c,) float64."""
    known, segment = values >= 0, columns.segment
    seen = _nearby(np.maximum, np.where(known, values, 0).max(1).astype(np.float64), segment)
    # After n samples in shadow, the next sample is lit with a probability of at most 1 / (n + 1)
    possible = 1 / (1 + _nearby(np.add, known.sum(1).astype(np.float64), segment))
    return _nearby(np.maximum, largest, segment) * np.maximum(seen, possible) * intensity


def _nearby(combine: np.ufunc, values: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Combine the value of each column with the values of its neighbours in the segment."""
    result = values.copy()
    for shift in range(1, min(_NEARBY, len(values) - 1) + 1):
        same = segment[shift:] == segment[:-shift]
        combine(result[shift:], values[:-shift], out=result[shift:], where=same)
        combine(result[:-shift], values[shift:], out=result[:-shift], where=same)
    return result


def _to_split(columns: Columns, inner: np.ndarray, gamma: np.ndarray, alpha: float, most: int) -> np.ndarray:
    """Columns to split [MSR equation 8], the largest first, up to ``most`` columns in a slice.

    ``inner``: mask of columns of several lights.
    """
    threshold = alpha * np.bincount(columns.piece, gamma)
    over = np.flatnonzero(inner & (gamma > threshold[columns.piece]))
    room = most - np.bincount(columns.piece)
    over = over[np.lexsort((-gamma[over], columns.piece[over]))]
    piece = columns.piece[over]
    rank = np.arange(len(over)) - np.searchsorted(piece, piece)
    return over[rank < room[piece]]
