"""LightSlice: common clusters of lights for the gather points of a slice, from sampled rows of the light matrix."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import download, upload
from vpl.core.clock import Clock
from vpl.core.morton import interleave
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.matrix.light_matrix import DeviceForest, NearRows, SampledRows
from vpl.matrix.slice_columns import SliceLights, shared_columns, slice_lights, slice_places
from vpl.points.point_clusters import PointClusters
from vpl.points.slices import build_slices
from vpl.transport.evaluation import sum_lights

from .common import ManyLightIntegrator, ShadeJob, ShadeResult
from .knobs import Integer, Number
from .manual import manual_page

# Lights per point that one kernel sums; the render can be stopped between kernels
_COLUMNS_PER_KERNEL = 256


@manual_page
class LightSliceIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-lightslice:

    LightSlice (:monosp:`lightslice`)
    ---------------------------------

    .. pluginparameters::

     {knobs}

    Ou and Pellacini 2011, "LightSlice: matrix slice sampling for the many-lights problem" [LS]. The contributions of
    every light to every gather point form a large matrix. A slice of its rows, for close points with similar normals,
    is lit by common clusters of lights. One row of each slice is sampled, with shadow rays. The sampled rows of a slice
    and of its neighbours determine the clusters: lights that are visible together, or occluded together, are joined.
    Occluded lights cost next to nothing, no bound is computed during shading, and the points of a slice trace shadow
    rays to common lights, which is three to five times faster than tracing the cuts of single points. A glossy lobe
    that varies between points is not resolved: one row does not predict its neighbours, and errors are several times
    the errors of :ref:`lightcuts <integrator-lightcuts>`.

    {estimate}

    There is no error bound. On diffuse surfaces the error is about proportional to 1 / ``columns``. Next to corners and
    on glossy surfaces single pixels can be far too bright, because no sampled row is equally close to a light or has
    the light in its lobe. With few gather points per slice (small images) the sampled rows cost more than they save;
    use fewer slices.

    **Departures from the paper.**

    - Clusters are nodes of the light trees, split where the sampled rows predict the largest benefit, instead of sets
      of columns divided by projections on lines. The lights of a shared column are represented by one traced light.
    - The light of a cluster is drawn with a probability proportional to the norm of its column plus a fraction of its
      upper bound, and contributes with its own colour. The expected image includes every light, even lights occluded
      from the sampled rows.
    - The weight of neighbours' rows falls with their distance.
    - Neighbouring pixels use different lights of a cluster (interleaved sampling), which replaces seams between slices
      by noise; ``sets`` 1 is the paper's method.
    - At glossy points one of several lights of a cluster is traced (``candidates``; resampled importance sampling). At
      diffuse points the gain was smaller than the cost.
    - Lambertian and non-Lambertian points have separate slices.

    See :mod:`vpl.points.slices`, :mod:`vpl.matrix.light_matrix` and :mod:`vpl.matrix.slice_columns`.

    .. tabs::
        .. code-tab:: xml

            <integrator type="lightslice">
                <integer name="max_depth" value="8"/>
                <integer name="columns" value="200"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "lightslice", "max_depth": 8, "columns": 200}
    """

    knobs = (
        Integer(
            "slices", 1500,
            "Number of slices: groups of neighbouring gather points with common clusters of lights. Fewer, larger "
            "slices need less time for sampling and more columns for equal error.",
            minimum=1,
        ),
        Integer(
            "columns", 200,
            "Largest number of clusters of lights per slice, at least one per kind of light. More columns reduce the "
            "error and increase the time.",
            minimum=1,
        ),
        Integer(
            "shared_columns", 8192,
            "Largest number of clusters of lights that slices can distinguish; each is sampled at one point of each "
            "slice, and stored in 12 bytes. The paper uses one per light.",
            minimum=1,
        ),
        Integer(
            "neighbours", 6,
            "Number of nearest slices, including itself, whose sampled rows determine the clusters of a slice.",
            minimum=1,
        ),
        Number(
            "unseen", 1.0,
            "Weight of upper bounds in the choice of lights, relative to sampled contributions: it keeps lights that "
            "are occluded from every sampled point.",
            minimum=1e-6,
        ),
        Integer(
            "sets", 16,
            "Number of lights drawn for each cluster. The samples of a pixel and the pixels of 4 × 4 blocks use "
            "different sets. With 1, the points of a slice have a common error, and slices appear as blotches.",
            minimum=1,
        ),
        Integer(
            "candidates", 4,
            "Number of lights of a cluster, from different sets, that are shaded at glossy points; one is drawn by its "
            "unoccluded contribution, and traced. This reduces the number of far too bright pixels. At most ``sets``.",
            minimum=1,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Slices of one batch, their lights, and the radiance of their points."""
        clock, light_set = Clock(Stage.SLICES), self._light_sets(job)
        slices, seeds = max(round(self.slices * job.share), 1), [derived_seed(job.seed, k) for k in range(4)]
        clusters = PointClusters(job.batch, partial(build_slices, slices=slices, seed=seeds[0], rank=light_set))
        tree = clusters.tree
        first, size = (of_node[tree.leaves].astype(np.int64) for of_node in (tree.first, tree.count))
        # One random point of each slice samples a row of the light matrix
        points = first + (np.random.default_rng(seeds[1]).random(len(size)) * size).astype(np.int64)
        clock.begin(Stage.SHARED_COLUMNS)
        forest, rays, bounds = shared_columns(job.transport, clusters, points, self.shared_columns, seeds[2])
        clock.begin(Stage.ROWS)
        rows = SampledRows(job.transport, clusters.batch, DeviceForest(forest, job.lights), points)
        clock.begin(Stage.COLUMNS)
        near = NearRows.nearest(slice_places(clusters), self.neighbours)
        chosen = slice_lights(rows, near, clusters, self.columns, self.unseen, self.sets, seeds[3])
        clock.begin(Stage.EVALUATE)
        entry = upload(mi.UInt32, light_set[tree.order] * rows.count + np.repeat(np.arange(rows.count), size))
        radiance, traced, columns = self._light(job, clusters, chosen, entry)
        clock.stop()
        radiance, traced, columns = clusters.in_batch_order([radiance, traced, columns])
        # Rays and bounds of the choice of lights are divided equally between the points
        shared = [(rays + rows.rays) / clusters.count, (bounds + rows.count * rows.forest.columns) / clusters.count]
        rays, bounds = (dr.opaque(mi.Float, number, clusters.count) for number in shared)
        return ShadeResult(radiance, traced + rays, bounds, columns, clock.seconds, counts={"slices": rows.count})

    def _light_sets(self, job: ShadeJob) -> np.ndarray:
        """Set of lights of each point, (n,): varies over the samples of a pixel, then over the pixels of a block."""
        ray, grid = download(job.ray).astype(np.int64), job.grid
        pixel = ray // grid.samples
        x, y = pixel % grid.width, pixel // grid.width
        tile = interleave(np.stack([x, y, np.zeros_like(x)], axis=1) % 4)
        # Bits 0, 1, 3 and 4 of the Morton code are the position within the block
        block = (tile & np.uint64(3) | (tile >> np.uint64(1)) & np.uint64(12)).astype(np.int64)
        return (ray % grid.samples + grid.samples * block) % self.sets

    def _light(self, job: ShadeJob, clusters: PointClusters, chosen: list[SliceLights], entry):
        """(Radiance, shadow rays, columns) of every point in slice order; ``entry``: light list of each point."""
        radiance = dr.zeros(mi.UnpolarizedSpectrum, clusters.count)
        traced, columns = dr.zeros(mi.UInt32, clusters.count), dr.zeros(mi.UInt32, clusters.count)
        candidates = self.candidates if job.batch.proxy.glossy else 1
        for lights in chosen:
            first, last = (dr.gather(mi.UInt32, ends, entry) for ends in (lights.first, lights.last))
            columns += last - first
            pick = lights.picker(entry, self.sets, min(candidates, self.sets))
            dr.eval(first, last, columns)
            for _ in range(0, int(download(lights.last - lights.first).max()), _COLUMNS_PER_KERNEL):
                if job.stopped():
                    break
                end = dr.minimum(first + _COLUMNS_PER_KERNEL, last)
                value, rays = sum_lights(job.transport, lights.group, clusters.batch.surfaces, first, end, pick)
                radiance, traced, first = radiance + value, traced + rays, end
                dr.eval(radiance, traced, first)
        return radiance, traced, columns


mi.register_integrator("lightslice", LightSliceIntegrator)
