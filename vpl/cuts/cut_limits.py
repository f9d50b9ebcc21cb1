"""How a largest cut is held where pairs of clusters are refined, which know no cut of a single point."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..lights.light_set import LightSet
from ..points.point_clusters import PointClusters
from .light_cuts import limited_cuts, upload_thresholds
from .product_cuts import BoundCounter


def raise_thresholds(
    lights: LightSet, clusters: PointClusters, allowed: np.ndarray, max_cut: int, stride: int, counter: BoundCounter
) -> np.ndarray:
    """Largest bounds that points accept, raised where cuts would be about larger than ``max_cut`` (0: nowhere).

    ``allowed``, (n,) float64: what each point along the tree would accept.  Cuts are tried at every ``stride``-th
    point; those up to the next one take after it.  Cuts grow about as fast as thresholds fall at most, so one that is
    not full leaves that much room below.  Returns the same for all points.
    """
    if max_cut == 0:
        return allowed
    rows = np.arange(0, clusters.count, stride)
    # What is 0 could not be raised by any factor
    tried = np.maximum(allowed[rows], np.finfo(np.float32).tiny)
    index = upload(mi.UInt32, rows)
    raised, sizes, visits = limited_cuts(lights, clusters.batch.select(index), upload_thresholds(tried), max_cut)
    counter.add_at_points(index, visits)
    least = download(raised).astype(np.float64) * np.minimum(sizes.total() / max_cut, 1)
    return np.maximum(allowed, np.repeat(least, stride)[: clusters.count])
