"""LightSlice: one set of clusters for all gather points of a slice, from sampled rows of the light matrix."""

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

# Lights of every point that one kernel adds up; between kernels the render may be stopped
_COLUMNS_PER_KERNEL = 256


@manual_page
class LightSliceIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-lightslice:

    LightSlice (:monosp:`lightslice`)
    ---------------------------------

    .. pluginparameters::

     {knobs}

    Ou and Pellacini 2011, "LightSlice: matrix slice sampling for the many-lights problem" [LS]. What every light sends
    to every gather point is a large matrix; slices of its rows, for points that are near to each other and face alike,
    are lit by the same clusters of lights. One row of each slice is sampled, with shadow rays, and the rows around a
    slice tell which lights can be joined for it: those that arrive together, or not at all. So occluded lights cost
    next to nothing, no bound is computed while points are lit, and all points of a slice trace towards the same lights,
    which is three to five times faster than tracing the cuts of single points. What it cannot do is follow a glossy
    lobe that differs from point to point: one row says little about its neighbours there, and errors are several times
    those of :ref:`lightcuts <integrator-lightcuts>`.

    {what is estimated}

    There is no bound on the error. On diffuse surfaces it falls about as 1 / ``columns``; next to corners and on glossy
    surfaces single pixels can be far too bright, because no sampled row was as near to a light or in its lobe.
    With few gather points to a slice (small images) the sampled rows cost more than they save; take fewer slices.

    **Departures from the paper.** Clusters are nodes of the light trees, split where the sampled rows say that it
    matters most, instead of sets of columns divided by projections on lines; all lights of a shared column count as
    one, whose representative is traced. A light is drawn for every cluster with a probability proportional to the norm
    of its column plus a share of its upper bound, and counts with its own colour: the image is that of all lights in
    expectation, and no light is lost because no row saw it. Rows of neighbours count less the farther away they are.
    Neighbouring pixels take different lights of a cluster (interleaved sampling), which makes noise of what would be
    seams between slices; ``sets`` 1 is the paper's. At glossy points one of several lights of a cluster is traced
    (``candidates``; resampled importance sampling); at diffuse ones that gained less than it cost. See
    :mod:`vpl.points.slices`, :mod:`vpl.matrix.light_matrix`, :mod:`vpl.matrix.slice_columns`. Lambertian points and all
    others are in slices of their own.

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
            "Groups of neighbouring gather points that are lit by the same clusters. Fewer make larger ones, which "
            "take less time to prepare and more columns to light well.",
            minimum=1,
        ),
        Integer(
            "columns", 200,
            "Most clusters of lights that a slice is lit by, at least one per kind of light. The error falls and the "
            "time grows with it.",
            minimum=1,
        ),
        Integer(
            "shared_columns", 8192,
            "Most clusters of lights that all slices together tell apart; what is sampled at one point of each slice "
            "are these, in 12 bytes for each. As many as there are lights is what the paper does.",
            minimum=1,
        ),
        Integer(
            "neighbours", 6,
            "The sampled points of so many slices, its own among them, tell how lights are clustered for a slice.",
            minimum=1,
        ),
        Number(
            "unseen", 1.0,
            "How much of the choice of lights goes by upper bounds, relative to what goes by the sampled points: the "
            "lights that none of these saw are chosen with it.",
            minimum=1e-6,
        ),
        Integer(
            "sets", 16,
            "Lights that are drawn for each cluster; the samples of a pixel take turns with them, and the pixels of "
            "blocks of 4 × 4. With 1 all points of a slice share one error, and slices show as blotches.",
            minimum=1,
        ),
        Integer(
            "candidates", 4,
            "Lights of a cluster, from as many sets, that are shaded at glossy points; one is drawn by what it would "
            "send, and traced. So fewer pixels are far too bright. At most ``sets`` are used.",
            minimum=1,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Slices, the lights of each, and what these send to its points, for one batch."""
        clock, turn = Clock(Stage.SLICES), self._turns(job)
        slices, seeds = max(round(self.slices * job.share), 1), [derived_seed(job.seed, k) for k in range(4)]
        clusters = PointClusters(job.batch, partial(build_slices, slices=slices, seed=seeds[0], rank=turn))
        tree = clusters.tree
        first, size = (of_node[tree.leaves].astype(np.int64) for of_node in (tree.first, tree.count))
        # A row of the light matrix is sampled at one random point of each slice
        points = first + (np.random.default_rng(seeds[1]).random(len(size)) * size).astype(np.int64)
        clock.begin(Stage.SHARED_COLUMNS)
        forest, rays, bounds = shared_columns(job.transport, clusters, points, self.shared_columns, seeds[2])
        clock.begin(Stage.ROWS)
        rows = SampledRows(job.transport, clusters.batch, DeviceForest(forest, job.lights), points)
        clock.begin(Stage.COLUMNS)
        near = NearRows.nearest(slice_places(clusters), self.neighbours)
        chosen = slice_lights(rows, near, clusters, self.columns, self.unseen, self.sets, seeds[3])
        clock.begin(Stage.EVALUATE)
        entry = upload(mi.UInt32, turn[tree.order] * rows.count + np.repeat(np.arange(rows.count), size))
        radiance, traced, columns = self._light(job, clusters, chosen, entry)
        clock.stop()
        radiance, traced, columns = clusters.in_batch_order([radiance, traced, columns])
        # What was spent on choosing is shared by all points
        shared = [(rays + rows.rays) / clusters.count, (bounds + rows.count * rows.forest.columns) / clusters.count]
        rays, bounds = (dr.opaque(mi.Float, number, clusters.count) for number in shared)
        return ShadeResult(radiance, traced + rays, bounds, columns, clock.seconds, counts={"slices": rows.count})

    def _turns(self, job: ShadeJob) -> np.ndarray:
        """The set of lights that each point takes, (n,): another one for each sample, then each pixel of a block."""
        ray, grid = download(job.ray).astype(np.int64), job.grid
        pixel = ray // grid.samples
        x, y = pixel % grid.width, pixel // grid.width
        tile = interleave(np.stack([x, y, np.zeros_like(x)], axis=1) % 4)
        # Bits 0, 1, 3 and 4 are those of the place within the block
        block = (tile & np.uint64(3) | (tile >> np.uint64(1)) & np.uint64(12)).astype(np.int64)
        return (ray % grid.samples + grid.samples * block) % self.sets

    def _light(self, job: ShadeJob, clusters: PointClusters, chosen: list[SliceLights], entry):
        """(Radiance, shadow rays, columns) of all points along the slices; ``entry``: the list of lights of each."""
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
