"""How bright gather points are, roughly, from coarse light cuts at a few of them: what error bounds are compared with.

Lightcuts [LC] compares bounds with the running total of the cut it is refining.  Here the radiance is estimated before,
so that thresholds are known in advance and cuts need no heap.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..lights.light_set import LightSet
from ..points.camera_paths import SceneTraits
from ..points.surfaces import Batch
from .light_cuts import evaluate_cuts, limited_cuts

# Bounds of the coarse cuts are accepted up to this fraction of the image's mean
_ESTIMATE_ERROR = 0.05


@dataclass
class Estimate:
    """Per point: ``radiance``, (n,) float64, the mean over channels; ``shadow_rays`` and ``upper_bounds`` that finding
    it took, UInt32."""

    radiance: np.ndarray
    shadow_rays: object
    upper_bounds: object


def estimate_radiance(
    scene, traits: SceneTraits, lights: LightSet, batch: Batch, direct, mean: float, max_cut: int, stride: int
) -> Estimate:
    """Coarse cuts at every ``stride``-th point, averaged, with the direct light of all, over the blocks of 2 strides.

    Points should lie along a curve, so that those of a block are neighbours.  ``direct``: radiance per point that is
    known already; ``mean``: of the image; ``max_cut``: most clusters of a cut, 0 is no limit.
    """
    count = batch.count
    rows = np.arange(0, count, stride)
    index = upload(mi.UInt32, rows)
    part = batch.select(index)
    threshold = dr.opaque(mi.Float, _ESTIMATE_ERROR * mean, len(rows))
    threshold, sizes, searched = limited_cuts(lights, part, threshold, max_cut)
    # Second representatives: the thresholds must not depend on the lights that the final cuts are made of
    radiance, rays, collected = evaluate_cuts(scene, traits, lights, part, threshold, sizes, second=True)
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
