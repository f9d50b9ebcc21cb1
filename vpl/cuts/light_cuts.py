"""Light cuts by threshold: the coarsest clusters of a light tree with errors below a gather point's threshold.

Lightcuts [LC section 4] refines the cluster with the largest bound until every bound is at most ``error`` times the
radiance of the point.  For a given radiance the cut is independent of the order of refinement: from the root down, a
node is refined while its bound exceeds the threshold.  No heap and no stack is needed, because nodes are in preorder:
traversal continues at ``i + 1`` to refine and at ``escape[i]`` to accept or skip.

Departure from the paper, which compares bounds with the running total of the cut: thresholds follow from a radiance
estimate, computed in advance with coarse cuts at few points (:func:`estimate_radiance`).

The error of a cluster is the bound of its contribution, or for receivers with ``by_expected_error``, the expected error
(:mod:`vpl.transport.bounds`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, chunks, download, upload
from ..lights.light_set import LightGroup, LightSet
from ..points.surfaces import Batch
from ..transport.evaluation import Transport, evaluate_representatives
from .traversal import LARGEST_STORE, Cuts, collect, several, traverse

# Pairs shaded and traced at a time: bounds the memory for any size of image and cuts
_PAIRS_PER_CHUNK = 1 << 22
# Search for the threshold of a cut with limited size: first factor of the bracket, and number of bisections
_BRACKET, _BISECTIONS = 4.0, 3
# Error bound of the coarse cuts as a fraction of the image's mean: their radiance sets thresholds alone
_ESTIMATE_ERROR = 0.05


@dr.syntax
def _sum_segments(values, offset, count):
    """Sum ``count`` consecutive values from ``offset`` on, in order: independent of the number of threads."""
    total = dr.zeros(type(values), dr.width(offset))
    k = mi.UInt32(0)
    while dr.hint(k < count, exclude=[values]):
        total += dr.gather(type(values), values, offset + k)
        k += 1
    dr.eval(total)
    return total


@dataclass
class CutsOfGroups:
    """Cuts of points, one of :class:`vpl.cuts.traversal.Cuts` for each group of lights."""

    cuts: list[Cuts]

    def total(self) -> np.ndarray:
        """Nodes in the cut of every point over the groups, (n,) int64."""
        return sum(download(one.count).astype(np.int64) for one in self.cuts)

    @property
    def visits(self) -> mi.UInt32:
        """Nodes visited per point over the groups."""
        return sum(one.visits for one in self.cuts)


def cuts_at(lights: LightSet, batch: Batch, threshold, most: int = 0, stores: bool = True) -> CutsOfGroups:
    """Cuts at a threshold, the largest accepted error per point.

    Cuts end at the first node beyond ``most`` per group of lights (0: never).  ``stores``: whether to store the nodes,
    for :func:`collect_cuts`.
    """
    found, room = [], LARGEST_STORE if stores else 0
    for group in lights.groups:
        found.append(traverse(group, batch.receiver, threshold, lights.smallest_distance, most, room))
        room -= found[-1].entries
    return CutsOfGroups(found)


def upload_thresholds(values: np.ndarray):
    """Upload float64 thresholds; overflow becomes infinity, which is valid because unclamped bounds can be infinite."""
    with np.errstate(over="ignore"):
        return upload(mi.Float, values.astype(np.float32))


def limited_cuts(lights: LightSet, batch: Batch, threshold, max_cut: int, stores: bool = True):
    """(Thresholds, cuts), with thresholds raised for cuts of more than ``max_cut`` nodes (0: no limit).

    Refinement of the worst cluster up to ``max_cut`` nodes ([LC] section 4.2) is equivalent to a larger threshold.
    Growing steps bracket the threshold; they end because the roots form the cut at an infinite threshold.  Bisection of
    the logarithm narrows the bracket.
    """
    max_cut = max(max_cut, len(lights.groups)) if max_cut else 0  # the roots of the groups form the coarsest cut
    sizes = cuts_at(lights, batch, threshold, max_cut, stores)
    rows = several(np.flatnonzero(sizes.total() > max_cut))
    if max_cut == 0 or len(rows) == 0:
        return threshold, sizes
    index = upload(mi.UInt32, rows)
    part = batch.select(index)
    # NumPy, because the points are mostly few: kernels would take longer to compile than to run
    spent, fitting = ([np.zeros(len(rows), np.uint32) for _ in lights.groups] for _ in range(2))

    def too_large(values):
        """Mask of cuts above ``max_cut`` at the given thresholds; stores the sizes of the remaining cuts."""
        found = cuts_at(lights, part, upload_thresholds(values), max_cut, stores=False)
        over = found.total() > max_cut
        for number, one in enumerate(found.cuts):
            fitting[number] = np.where(over, fitting[number], download(one.count))
            spent[number] += download(one.visits)
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
    dr.eval(threshold)
    for one, count, visits in zip(sizes.cuts, fitting, spent, strict=True):
        one.replace(index, upload(mi.UInt32, count), upload(mi.UInt32, visits))
    return threshold, sizes


@dataclass
class CutChunk:
    """Part of the cuts of a batch in one group of lights, ``number`` of the set.

    ``batch``: points of this part; ``points``: their rows in the whole batch; ``rows`` (in ``batch``), ``nodes``:
    entries of the cuts, point by point; ``offset``, ``length``: range of each point's entries; ``visits``: number of
    visited nodes per point.
    """

    group: LightGroup
    number: int
    batch: Batch
    points: mi.UInt32
    offset: mi.UInt32
    length: mi.UInt32
    rows: mi.UInt32
    nodes: mi.UInt32
    visits: mi.UInt32

    @property
    def place(self) -> mi.UInt32:
        """Place of each entry in the cut of its point."""
        return dr.arange(mi.UInt32, dr.width(self.rows)) - dr.gather(mi.UInt32, self.offset, self.rows)

    @property
    def written(self) -> mi.Bool:
        """Mask of valid entries: rounding may shorten a cut that is not stored as a whole, and leave entries unused."""
        return self.place < dr.gather(mi.UInt32, self.length, self.rows)


def collect_cuts(lights: LightSet, batch: Batch, threshold, sizes: CutsOfGroups):
    """Yield the cuts of a batch as evaluated :class:`CutChunk` of bounded size."""
    for number, (group, cuts) in enumerate(zip(lights.groups, sizes.cuts, strict=True)):
        count = download(cuts.count).astype(np.int64)
        for first, last in chunks(count, _PAIRS_PER_CHUNK):
            length = count[first:last]
            if not length.any():
                continue
            points = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
            part = batch if last - first == batch.count else batch.select(points)
            rows, nodes, offset, written, visits = collect(
                group, part.receiver, threshold, lights.smallest_distance, cuts, first, length
            )
            yield CutChunk(group, number, part, points, offset, written, rows, nodes, visits)


def evaluate_cuts(
    transport: Transport, batch: Batch, threshold, sizes: CutsOfGroups, second=False, stopped=lambda: False
):  # fmt: skip
    """Radiance of every point from its cut: representative lights, scaled to their clusters' intensity [LC, section 3].

    ``second``: whether to use second representatives, for estimates that determine a later cut; ``stopped``: called
    between kernels; true ends the sum early.  Returns (radiance, shadow rays, nodes visited) per point of the batch.
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
    """Per point: ``radiance``, (n,) float64, mean over channels; numbers of ``shadow_rays`` and of ``upper_bounds``."""

    radiance: np.ndarray
    shadow_rays: mi.UInt32
    upper_bounds: mi.UInt32


def estimate_radiance(transport: Transport, batch: Batch, direct, mean: float, max_cut: int, stride: int) -> Estimate:
    """Radiance estimate from coarse cuts at every ``stride``-th point plus direct light, averaged over 2 strides.

    Points must lie along a curve, because the average is over consecutive points.  ``direct``: known radiance per
    point; ``mean``: mean radiance of the image; ``max_cut``: most clusters of a cut, 0 is no limit.
    """
    count = batch.count
    rows = np.arange(0, count, stride)
    index = upload(mi.UInt32, rows)
    part = batch.select(index)
    threshold = dr.opaque(mi.Float, _ESTIMATE_ERROR * mean, len(rows))
    threshold, sizes = limited_cuts(transport.lights, part, threshold, max_cut)
    # Second representatives, because thresholds must be independent of the final cuts' representatives
    radiance, rays, collected = evaluate_cuts(transport, part, threshold, sizes, second=True)
    reflected = np.repeat(download(radiance).mean(1, dtype=np.float64), stride)[:count]
    level = block_mean(reflected + download(direct).mean(1, dtype=np.float64), 2 * stride)
    estimate = Estimate(level, *(dr.zeros(mi.UInt32, count) for _ in range(2)))
    dr.scatter(estimate.shadow_rays, rays, index)
    dr.scatter(estimate.upper_bounds, collected + sizes.visits, index)
    return estimate


def block_mean(values: np.ndarray, block: int) -> np.ndarray:
    """Replace values by the mean over blocks of ``block`` consecutive values; the last block may be shorter."""
    start = np.arange(0, len(values), block)
    length = np.diff(np.append(start, len(values)))
    return np.repeat(np.add.reduceat(values, start) / length, length)
