"""Light cuts by threshold: the largest clusters of a light tree whose error bound a gather point can accept.

Lightcuts [LC section 4] refines the cluster with the largest bound until every bound is at most ``error`` times the
radiance of the point.  For a given radiance that cut does not depend on the order of refinement: from the root down,
refine a node exactly while its bound is above the threshold.  So no heap and no stack is needed: nodes lie in preorder,
and one walks on to ``i + 1`` to refine and to ``escape[i]`` to take or to skip.

The paper compares bounds with the running total of the cut it is refining.  Here the radiance is estimated before, from
coarse cuts at a few points (:func:`estimate_radiance`), so that thresholds are known in advance.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NO_LIMIT, add_at, chunks, download, upload, upload_limit
from ..lights.light_set import LightGroup, LightSet
from ..points.surfaces import Batch
from ..transport.bounds import contribution_bound
from ..transport.evaluation import Transport, evaluate_representatives

# Pairs that are shaded and traced at a time: bounds the memory whatever the size of image and cuts
_PAIRS_PER_CHUNK = 1 << 22
# How the threshold that keeps a cut below its largest size is searched for
_BRACKET, _BISECTIONS = 4.0, 3
# Bounds of the coarse cuts are accepted up to this fraction of the image's mean
_ESTIMATE_ERROR = 0.05


@dataclass
class CutSizes:
    """Per point and group of lights: ``count`` of nodes in the cut, and ``visits``: nodes whose bound was computed."""

    count: list
    visits: list

    def total(self) -> np.ndarray:
        """Nodes in the whole cut of every point, (n,) int64."""
        return sum(download(count).astype(np.int64) for count in self.count)


def _step(group: LightGroup, batch: Batch, threshold, smallest_distance, i):
    """Look at node ``i``: (taken into the cut, next node).  A bound of zero skips the node: nothing can arrive."""
    node = group.tree.gather(i)
    bound = contribution_bound(group.kind, batch.receiver, node, smallest_distance)
    reached = bound > 0
    taken = reached & ((node.escape == i + 1) | (bound <= threshold))
    return taken, dr.select(taken | ~reached, node.escape, i + 1)


@dr.syntax
def _count_nodes(group: LightGroup, batch: Batch, threshold, smallest_distance: float, most: int):
    """Walk a group's tree for every point: (nodes taken, nodes visited).  Gives up beyond ``most`` nodes (0: never)."""
    end, limit = dr.opaque(mi.UInt32, group.tree.count), upload_limit(most or NO_LIMIT)
    clamp = dr.opaque(mi.Float, smallest_distance)
    i, count, visits = mi.UInt32(0), dr.zeros(mi.UInt32, batch.count), dr.zeros(mi.UInt32, batch.count)
    while dr.hint((i < end) & (count <= limit), exclude=[group, batch]):
        taken, i = _step(group, batch, threshold, clamp, i)
        count += dr.select(taken, 1, 0)
        visits += 1
    dr.eval(count, visits)
    return count, visits


@dr.syntax
def _collect_nodes(group: LightGroup, batch: Batch, threshold, smallest_distance: float, offset, length, total: int):
    """Walk as :func:`_count_nodes` does, writing (row of the batch, node) of every node taken: ``length`` of them from
    ``offset`` on.

    Returns (rows, nodes), how many were written per point, and how many were visited.  Should rounding make this walk
    take other nodes than the one that counted, nothing is written outside of a point's part.
    """
    end = dr.opaque(mi.UInt32, group.tree.count)
    clamp = dr.opaque(mi.Float, smallest_distance)
    rows, nodes = dr.zeros(mi.UInt32, total), dr.zeros(mi.UInt32, total)
    dr.eval(rows, nodes)
    row = dr.arange(mi.UInt32, batch.count)
    i, at, visits = mi.UInt32(0), mi.UInt32(offset), mi.UInt32(0)
    while dr.hint(i < end, exclude=[group, batch, rows, nodes]):
        taken, following = _step(group, batch, threshold, clamp, i)
        taken &= at < offset + length
        dr.scatter(rows, row, at, taken)
        dr.scatter(nodes, i, at, taken)
        at += dr.select(taken, 1, 0)
        visits += 1
        i = following
    written = at - offset
    dr.eval(rows, nodes, written, visits)
    return rows, nodes, written, visits


@dr.syntax
def _sum_segments(values, offset, count):
    """Sum ``count`` consecutive values from ``offset`` on, in order: the same result on any number of threads."""
    total = dr.zeros(type(values), dr.width(offset))
    k = mi.UInt32(0)
    while dr.hint(k < count, exclude=[values]):
        total += dr.gather(type(values), values, offset + k)
        k += 1
    dr.eval(total)
    return total


def cut_sizes(lights: LightSet, batch: Batch, threshold, most: int = 0) -> CutSizes:
    """Sizes of the cuts at a threshold: the largest bound that is accepted, per point.

    Points whose cut has more than ``most`` nodes are not counted to the end (0: all are).
    """
    found = [_count_nodes(group, batch, threshold, lights.smallest_distance, most) for group in lights.groups]
    return CutSizes([count for count, _ in found], [visits for _, visits in found])


def upload_thresholds(values: np.ndarray):
    """Thresholds in double precision to the device; beyond float32 they are infinite, as unclamped bounds may be."""
    with np.errstate(over="ignore"):
        return upload(mi.Float, values.astype(np.float32))


def limited_cuts(lights: LightSet, batch: Batch, threshold, max_cut: int):
    """Sizes of the cuts, with thresholds raised where a cut would have more than ``max_cut`` nodes (0: nowhere).

    Refining the worst cluster until ``max_cut`` nodes are reached ([LC] section 4.2) gives a threshold cut too, with a
    larger threshold: it is bracketed by growing steps, which end because the roots alone are a cut at an infinite
    threshold, and narrowed by bisection of its logarithm.  Returns (threshold, sizes, nodes visited in all).
    """
    max_cut = max(max_cut, len(lights.groups)) if max_cut else 0  # the roots of all kinds are the coarsest cut
    sizes = cut_sizes(lights, batch, threshold, max_cut)
    visits = sum(sizes.visits)
    rows = np.flatnonzero(sizes.total() > max_cut)
    if max_cut == 0 or len(rows) == 0:
        return threshold, sizes, visits
    index = upload(mi.UInt32, rows)
    part = batch.select(index)
    # In NumPy: they are mostly few, and as kernels they would take longer to compile than to compute
    spent, fitting = np.zeros(len(rows), np.uint32), [np.zeros(len(rows), np.uint32) for _ in sizes.count]

    def too_large(values):
        """Mask of the cuts that are too large at these thresholds; keeps the sizes of those that are not."""
        nonlocal spent, fitting
        found = cut_sizes(lights, part, upload_thresholds(values), max_cut)
        over = found.total() > max_cut
        fitting = [np.where(over, old, download(new)) for new, old in zip(found.count, fitting, strict=True)]
        spent = spent + sum(map(download, found.visits))
        return over

    low = np.maximum(download(dr.gather(mi.Float, threshold, index)).astype(np.float64), np.finfo(np.float32).tiny)
    step = _BRACKET
    high = low * step
    while (over := too_large(high)).any():
        step = min(step * step, 1e30)
        low, high = np.where(over, high, low), np.where(over, high * step, high)
    for _ in range(_BISECTIONS):
        middle = np.sqrt(low * high)
        over = too_large(middle)
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    threshold = mi.Float(threshold)
    dr.scatter(threshold, upload_thresholds(high), index)
    for target, count in zip(sizes.count, fitting, strict=True):
        dr.scatter(target, upload(mi.UInt32, count), index)
    add_at(visits, upload(mi.UInt32, spent), index)
    dr.eval(threshold, sizes.count, visits)
    return threshold, sizes, visits


@dataclass
class CutChunk:
    """Part of the cuts of a batch in one group of lights: ``rows`` (in ``batch``) and ``nodes``, point by point.

    ``points``: the rows of the whole batch that ``batch`` holds; ``offset``, ``length``: where the nodes of each are;
    ``visits``: nodes visited to collect them.
    """

    group: LightGroup
    batch: Batch
    points: object
    offset: object
    length: object
    rows: object
    nodes: object
    visits: object

    @property
    def written(self):
        """Mask of the ``rows`` and ``nodes`` that are part of a cut: rounding may leave one shorter than was counted,
        and the rest of its part 0."""
        row = dr.arange(mi.UInt32, dr.width(self.rows))
        place = row - dr.gather(mi.UInt32, self.offset, self.rows)
        return place < dr.gather(mi.UInt32, self.length, self.rows)


def collect_cuts(lights: LightSet, batch: Batch, threshold, sizes: CutSizes):
    """Yield the cuts of a batch as :class:`CutChunk`, evaluated, each of bounded size."""
    for group, group_count in zip(lights.groups, sizes.count, strict=True):
        count = download(group_count).astype(np.int64)
        for first, last in chunks(count, _PAIRS_PER_CHUNK):
            total = int(count[first:last].sum())
            if total == 0:
                continue
            points = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
            part = batch if last - first == batch.count else batch.select(points)
            offset = upload(mi.UInt32, np.cumsum(count[first:last]) - count[first:last])
            chosen = dr.gather(mi.Float, threshold, points)
            length = dr.gather(mi.UInt32, group_count, points)
            rows, nodes, written, visits = _collect_nodes(
                group, part, chosen, lights.smallest_distance, offset, length, total
            )
            yield CutChunk(group, part, points, offset, written, rows, nodes, visits)


def evaluate_cuts(
    transport: Transport, batch: Batch, threshold, sizes: CutSizes, second=False, stopped=lambda: False
):  # fmt: skip
    """Radiance of every point from its cut: representatives, scaled to the intensity of their clusters.

    ``second``: use the second representative of every cluster, for an estimate that another cut may depend on;
    ``stopped``: asked between kernels; once true the sum ends early.  Returns (radiance, shadow rays, nodes visited)
    per point of the batch.
    """
    radiance = dr.zeros(mi.UnpolarizedSpectrum, batch.count)
    rays, visits = dr.zeros(mi.UInt32, batch.count), dr.zeros(mi.UInt32, batch.count)
    for chunk in collect_cuts(transport.lights, batch, threshold, sizes):
        if stopped():
            break
        tree = chunk.group.tree
        light, intensity = tree.representative(chunk.nodes, second=second), tree.summed_intensity(chunk.nodes)
        value, traced = evaluate_representatives(transport, chunk.group, chunk.batch, chunk.rows, light, intensity)
        traced = dr.select(traced, mi.UInt32(1), mi.UInt32(0))
        add_at(radiance, _sum_segments(value, chunk.offset, chunk.length), chunk.points)
        add_at(rays, _sum_segments(traced, chunk.offset, chunk.length), chunk.points)
        add_at(visits, chunk.visits, chunk.points)
    dr.eval(radiance, rays, visits)
    return radiance, rays, visits


@dataclass
class Estimate:
    """Per point: ``radiance``, (n,) float64, the mean over channels; ``shadow_rays`` and ``upper_bounds`` that finding
    it took, UInt32."""

    radiance: np.ndarray
    shadow_rays: object
    upper_bounds: object


def estimate_radiance(transport: Transport, batch: Batch, direct, mean: float, max_cut: int, stride: int) -> Estimate:
    """Coarse cuts at every ``stride``-th point, averaged, with the direct light of all, over the blocks of 2 strides.

    Points should lie along a curve, so that those of a block are neighbours.  ``direct``: radiance per point that is
    known already; ``mean``: of the image; ``max_cut``: most clusters of a cut, 0 is no limit.
    """
    count = batch.count
    rows = np.arange(0, count, stride)
    index = upload(mi.UInt32, rows)
    part = batch.select(index)
    threshold = dr.opaque(mi.Float, _ESTIMATE_ERROR * mean, len(rows))
    threshold, sizes, searched = limited_cuts(transport.lights, part, threshold, max_cut)
    # Second representatives: the thresholds must not depend on the lights that the final cuts are made of
    radiance, rays, collected = evaluate_cuts(transport, part, threshold, sizes, second=True)
    reflected = np.repeat(download(radiance).mean(1, dtype=np.float64), stride)[:count]
    level = block_mean(reflected + download(direct).mean(1, dtype=np.float64), 2 * stride)
    estimate = Estimate(level, *(dr.zeros(mi.UInt32, count) for _ in range(2)))
    dr.scatter(estimate.shadow_rays, rays, index)
    dr.scatter(estimate.upper_bounds, collected + searched, index)
    return estimate


def block_mean(values: np.ndarray, block: int) -> np.ndarray:
    """Replace values by the mean over their block of consecutive ones; the last block may be shorter."""
    start = np.arange(0, len(values), block)
    length = np.diff(np.append(start, len(values)))
    return np.repeat(np.add.reduceat(values, start) / length, length)
