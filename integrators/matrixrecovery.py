"""Matrix sampling and recovery: slices with mostly predicted visibility."""

from __future__ import annotations

import math
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import ENTRIES, download
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.matrix.matrix_block import MatrixBlock
from vpl.matrix.recovery import STEPS, recover
from vpl.matrix.reduced_columns import initial_columns, split_columns
from vpl.matrix.reduced_matrix import MatrixEntries, MatrixRows
from vpl.matrix.visibility_prediction import PREDICTORS, predict_columns
from vpl.matrix.visibility_samples import VisibilitySamples
from vpl.points.point_clusters import PointClusters
from vpl.points.slice_rows import build_row_slices

from .common import ManyLightIntegrator, ShadeJob, ShadeResult
from .gathering import Clock
from .knobs import Integer, Number, Words
from .manual import manual_page

# Slices sampled together: bounds the memory of their samples
_SLICES = 128


@manual_page
class MatrixRecoveryIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-matrixrecovery:

    Matrix sampling and recovery (:monosp:`matrixrecovery`)
    -------------------------------------------------------

    .. pluginparameters::

     {knobs}

    Huo et al. 2015, "A matrix sampling-and-recovery approach for many-lights rendering" [MSR]. The contributions of a
    slice's clusters of lights to its pixels form a matrix. Most entries differ from adjacent entries only by smooth
    factors that need no shadow ray. Visibility is traced for a few percent of the entries, and predicted for the rest.
    Prediction errors are detected as deviations from a matrix of low rank, and traced. The number of shadow rays is
    about a tenth of the number of entries. In scenes of moderate size, predicting an entry costs as much as a few rays:
    unless a ray takes microseconds, :ref:`lightslice <integrator-lightslice>` and :ref:`mdlightcuts
    <integrator-mdlightcuts>` are faster at equal error.

    {estimate}

    There is no error bound.

    - One light represents each cluster in a whole slice. ``alpha`` limits this error, and the mean over seeds has none
      of it; with a large ``alpha``, slices appear as blotches.
    - Prediction errors do not average out. Most of them predict visible light as occluded, because near a lamp there
      are fewer traced rows with light than without. Compared to images of the same virtual lights, 64 pixels wide, the
      Cornell box is brighter by 0.8%; the scenes ``arcade``, ``banquet`` and ``kitchen_lamps`` are darker by 1 to 5%.
      Scenes where each of many small lamps lights a small part lose more: ``hall`` 6%, ``corridor`` 12%, with
      ``direct="vpl"`` 20% (blocks of 8 x 8 pixels up to 40%). The largest contributions to a pixel are traced (step
      ``largest``), hence the lost light belongs to hundreds of clusters with less than 3% of the pixel's light each.
      The loss decreases with larger ``sampling`` and with more points per slice.
    - Penumbrae are noisy, because uncertain predictors answer at random.
    - The visibility of a light is one number for every channel: light tinted by masks and thin glass becomes grey.

    **Departures from the paper.**

    - Visibility is separated instead of light (see :mod:`vpl.matrix.recovery`), once for every channel, and every
      gather point is shaded exactly.
    - Slices are halved at medians of the number of points (:mod:`vpl.points.slice_rows`).
    - Clusters are split in rounds, and share samples with their neighbours along the light tree
      (:mod:`vpl.matrix.reduced_columns`). Clusters without a lit sample may be split.
    - ``alpha`` is a tenth of the paper's; slices then have 200 columns here rather than the paper's 700.
    - Entries are traced where 65% of the surrounding entries are wrong instead of 20%, because errors are denser here.
      In addition, entries are traced that may be more than 3% of the light of their pixel.
    - Traced rows are selected by golden sections instead of at random (:mod:`vpl.matrix.visibility_samples`).
    - Nearest rows are found among every sample of a column, and the line of the linear predictor lies in the slice's
      plane (:mod:`vpl.matrix.visibility_prediction`).
    - If the separation of a slice fails, every entry of the affected columns is traced, and the slice is counted.
    - Lambertian and non-Lambertian points have separate slices.

    .. tabs::
        .. code-tab:: xml

            <integrator type="matrixrecovery">
                <integer name="max_depth" value="8"/>
                <float name="alpha" value="0.002"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "matrixrecovery", "max_depth": 8, "alpha": 0.002}
    """

    knobs = (
        Integer(
            "slice_rows", 1024,
            "Largest number of rows of a slice: pixels whose gather points have common clusters of lights.",
            minimum=1, maximum=65536,
        ),
        Integer(
            "initial_columns", 200,
            "Largest initial number of clusters of lights per slice, chosen by upper bounds.",
            minimum=1,
        ),
        Integer(
            "max_columns", 2000,
            "Largest final number of clusters per slice, at least one per kind of light.",
            minimum=1,
        ),
        Number(
            "alpha", 0.002,
            "A cluster is split if it may contribute more than this fraction of the slice's total. A smaller value "
            "reduces the error and increases the time.",
            minimum=0,
        ),
        Number(
            "sampling", 0.01,
            "Number of traced rows per column and round, among rows with a positive unoccluded contribution, as a "
            "fraction of the mean number of rows per slice.",
            minimum=1e-6,
        ),
        Number(
            "prediction_error", 0.1,
            "A column is sampled until predictors are wrong for less than this fraction of its new samples.",
            minimum=0,
        ),
        Integer("rounds", 20, "Largest number of sampling rounds of a column after the first.", minimum=1),
        Words(
            "steps", ",".join(STEPS),
            "Steps of the method, out of {allowed}. The first three are predictors of visibility: by the nearest "
            "traced rows, by a line between light and shadow, by the same row in nearby columns. Each column uses its "
            "best predictor; without predictors, every untraced entry counts as visible. ``separation``: detect "
            "prediction errors by separating the matrix into a part of low rank and sparse errors. ``correction``: "
            "trace entries where these errors are dense. ``largest``: trace entries that may be more than 3% of the "
            "light of their pixel.",
            words=STEPS,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Slices of one batch, their recovered matrices, and the radiance of their points."""
        if job.transport.traits.null:
            mi.Log(mi.LogLevel.Warn, "Light through coloured glass or masks becomes grey in this integrator.")
        work = self.start(job)
        clusters = work.entries.rows.clusters
        for block, found in self.recovered(job, work):
            work.light(block, found.visibility)
        if failed := work.counts["failed_slices"]:
            whole = work.counts["slices"]
            mi.Log(mi.LogLevel.Warn, f"The separation of {failed} of {whole} slices failed; their entries were traced.")
        radiance, used = clusters.in_batch_order([work.radiance, work.columns])
        spent = (work.entries.rays, work.bounds)
        rays, bounds = (dr.opaque(mi.Float, count / clusters.count, clusters.count) for count in spent)
        return ShadeResult(radiance, rays, bounds, used, work.clock.seconds, counts=work.counts)

    def start(self, job: ShadeJob) -> Work:
        """Build the slices of a batch."""
        clock = Clock(Stage.SLICES)
        pixel = download(job.ray).astype(np.int64) // job.grid.samples
        clusters = PointClusters(job.batch, partial(build_row_slices, pixel, self.slice_rows))
        rows = MatrixRows(clusters, pixel, job.seed)
        clock.stop()
        return Work(MatrixEntries(job.transport, rows), clock)

    def recovered(self, job: ShadeJob, work: Work):
        """Yield the recovered matrices of the slices: (block, recovery), block by block."""
        rows = work.entries.rows
        work.begin(Stage.INITIAL_CUT)
        columns, work.bounds = initial_columns(work.entries, job.mean, min(self.initial_columns, self.max_columns))
        for number, begin in enumerate(range(0, rows.slices, _SLICES)):
            if job.stopped():
                break
            work.begin(Stage.COLUMNS)
            slices = (begin, min(begin + _SLICES, rows.slices))
            part = columns.select(np.arange(*np.searchsorted(columns.piece, slices)))
            seed = derived_seed(job.seed, number)
            count = min(math.ceil(self.sampling * rows.count / rows.slices), rows.most)
            part, first = split_columns(work.entries, part, self.alpha, self.max_columns, count, seed)
            if part.count:
                samples = VisibilitySamples(work.entries, part, min(count * (self.rounds + 1), rows.most), seed)
                samples.resume(first)
                yield from self._blocks(job, work, samples, count, slices, seed)
        work.stop()

    def _blocks(
        self, job: ShadeJob, work: Work, samples: VisibilitySamples, count: int, slices: tuple[int, int], seed: int
    ):
        """Predict the columns of some slices, and recover their matrices in blocks of bounded memory."""
        work.begin(Stage.PREDICTION)
        entries, columns = work.entries, samples.columns
        named = tuple(kind for name, kind in PREDICTORS.items() if name in self.steps)
        kinds, rounds = (named, self.rounds) if named else (tuple(PREDICTORS.values()), 0)
        predictors, best = predict_columns(samples, kinds, count, self.prediction_error, rounds, seed)
        for name, kind in PREDICTORS.items():
            work.add(f"{name}_columns", int((best == kind).sum()) if named else 0)
        for begin, end in _chunks(entries, columns, slices):
            low, high = np.searchsorted(columns.piece, (begin, end))
            if job.stopped():
                return
            if low < high:
                block = MatrixBlock(entries, columns.select(np.arange(low, high)), begin, end)
                seed_of_block = derived_seed(seed, 1, begin)
                found = recover(block, predictors, best, int(low), self.steps, seed_of_block, work.begin)
                work.add("failed_slices", found.failed)
                work.add("entries", int(block.counts.prod(1).sum()))
                work.begin(Stage.EVALUATE)
                yield block, found


class Work:
    """Radiance of the points in slice order, filled block by block, with statistics.

    ``bounds``: number of computed upper bounds; ``counts``: slices, rows and entries, shadow rays by stage, columns by
    predictor, failed slices.
    """

    def __init__(self, entries: MatrixEntries, clock: Clock):
        self.entries, self.clock, self.bounds, rows = entries, clock, 0, entries.rows
        self.stage: Stage | None = None
        tree, count = rows.clusters.tree, rows.clusters.count
        self._begin = np.append(tree.first[tree.leaves].astype(np.int64), count)
        self.radiance, self.columns = dr.zeros(mi.UnpolarizedSpectrum, count), dr.zeros(mi.UInt32, count)
        dr.eval(self.radiance, self.columns)
        self.counts = {"slices": rows.slices, "rows": rows.count, "entries": 0, "failed_slices": 0}
        self.counts |= {f"{stage}_rays": 0 for stage in (Stage.COLUMNS, Stage.PREDICTION, Stage.CORRECTION)}

    def add(self, name: str, number: int) -> None:
        """Add a number to a count."""
        self.counts[name] = self.counts.get(name, 0) + number

    def begin(self, stage: Stage) -> None:
        """Begin a stage and end the previous one."""
        self.stop()
        self.stage = stage
        self.clock.begin(stage)

    def stop(self) -> None:
        """End the stage: record its time and shadow rays."""
        self.clock.stop()
        if self.stage is not None:
            before = sum(number for name, number in self.counts.items() if name.endswith("_rays"))
            self.add(f"{self.stage}_rays", self.entries.rays - before)
            self.stage = None

    def light(self, block: MatrixBlock, visibility) -> None:
        """Store the radiance of the points of a block's slices."""
        first, last = int(self._begin[block.begin]), int(self._begin[block.begin + block.slices])
        radiance, columns = block.light_points(visibility, first, last)
        point = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
        dr.scatter(self.radiance, radiance, point)
        dr.scatter(self.columns, columns, point)
        dr.eval(self.radiance, self.columns)


def _chunks(entries: MatrixEntries, columns, slices: tuple[int, int]):
    """Ranges of slices whose padded matrices have at most ENTRIES entries in total (or a single slice)."""
    begin, end = slices
    width = np.bincount(columns.piece - begin, minlength=end - begin)
    height = np.diff(entries.rows.first[begin : end + 1])
    first = 0
    for last in range(1, end - begin + 1):
        following = slice(first, last + 1)
        if last == end - begin or width[following].max() * height[following].max() * (last + 1 - first) > ENTRIES:
            yield begin + first, begin + last
            first = last


mi.register_integrator("matrixrecovery", MatrixRecoveryIntegrator)
