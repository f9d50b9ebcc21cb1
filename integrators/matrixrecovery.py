"""Matrix sampling and recovery: slices whose visibility is mostly predicted, not traced."""

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

# Slices that are sampled together: bounds the memory of their samples
_SLICES = 128


@manual_page
class MatrixRecoveryIntegrator(ManyLightIntegrator):
    r"""
    .. _integrator-matrixrecovery:

    Matrix sampling and recovery (:monosp:`matrixrecovery`)
    -------------------------------------------------------

    .. pluginparameters::

     {knobs}

    Huo et al. 2015, "A matrix sampling-and-recovery approach for many-lights rendering" [MSR]. What the clusters of
    lights of a slice send to its pixels is a matrix, most entries of which differ from those beside them only by smooth
    factors that need no shadow ray. So visibility is traced for a few percent of the entries and predicted for the
    others; what a predictor got wrong is found as that which does not fit a matrix of low rank, and traced as well.
    It takes about a tenth of the shadow rays that tracing all entries would. Predicting an entry costs as much as a few
    rays in scenes of moderate size, though: unless a ray takes microseconds, :ref:`lightslice <integrator-lightslice>`
    and :ref:`mdlightcuts <integrator-mdlightcuts>` are faster at the same error.

    {what is estimated}

    There is no bound on the error. One light stands for each cluster in a whole slice, which ``alpha`` holds small and
    averages out over seeds; slices show as blotches where ``alpha`` is large. What is predicted wrongly does not
    average out, and most of it is light that is taken to be blocked: where it arrives, near a lamp, are fewer of the
    traced rows than where it does not. Beside all the same virtual lights, images of 64 pixels' width are brighter by
    0.8% in the Cornell box, darker by 1 to 5% in the scenes ``arcade``, ``banquet`` and ``kitchen_lamps``, and where
    many small lamps each light a little of the scene by more: ``hall`` by 6%, ``corridor`` by 12%, with
    ``direct="vpl"`` by 20% (blocks of 8 x 8 pixels by up to 40%). What a pixel has most of its light from is traced
    (step ``largest``), so what is lost is light of hundreds of clusters, each of them less than 3% of it. It is less
    the larger ``sampling`` is and the more points slices have. Penumbrae are noisy, since predictors answer at random
    where they are not sure. The visibility of a light is one number for all channels: what masks and thin glass tint
    arrives grey.

    **Departures from the paper.** Visibility is separated, not light (see :mod:`vpl.matrix.recovery`), once for all
    channels, and every gather point is shaded exactly. Slices are halved at medians by the number of points
    (:mod:`vpl.points.slice_rows`). Clusters are split in rounds, and lend their samples to those beside them along the
    light tree (:mod:`vpl.matrix.reduced_columns`); ``alpha`` is a tenth of the paper's, with which slices have 200
    columns here rather than its 700; entries are traced where 65% of those around them are wrong instead of 20%, for
    errors lie denser here, and at last, which the paper does not do, where they may be more than 3% of the light of
    their pixel. Clusters of whose samples none is lit may be split all the same. Rows that are traced follow
    each other by golden sections instead of being drawn at random (:mod:`vpl.matrix.visibility_samples`). Nearest rows
    are found by looking at all samples of a column, and the line of the linear predictor lies in the slice's plane
    (:mod:`vpl.matrix.visibility_prediction`). Where the separation of a slice fails, all entries of the columns in
    question are traced, and the slice is counted. Lambertian points and all others are in slices of their own.

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
            "Most rows of a slice: pixels whose gather points are lit by the same clusters.",
            minimum=1, maximum=65536,
        ),
        Integer(
            "initial_columns", 200,
            "Clusters of lights that a slice begins with, at most, chosen by upper bounds.",
            minimum=1,
        ),
        Integer(
            "max_columns", 2000,
            "Most clusters that a slice ends with, but one for each kind of light at least.",
            minimum=1,
        ),
        Number(
            "alpha", 0.002,
            "Clusters are split that may send more than this fraction of what all of them may send. The error falls "
            "and the time grows as it falls.",
            minimum=0,
        ),
        Number(
            "sampling", 0.01,
            "How many rows are traced for each column in every round, of those where light would arrive: this fraction "
            "of the rows that slices have on average.",
            minimum=1e-6,
        ),
        Number(
            "prediction_error", 0.1,
            "A column is sampled until its visibility is predicted with fewer errors than this fraction of the new "
            "samples.",
            minimum=0,
        ),
        Integer("rounds", 20, "How often a column is sampled at most after the first time.", minimum=1),
        Words(
            "steps", ",".join(STEPS),
            "What is done, out of {allowed}. The first three predict visibility: by the nearest rows that were traced, "
            "by a line between light and shadow, by the same row in nearby columns, each column by the best of those "
            "named; where none is, all that was not traced is taken to arrive. ``separation``: errors of the "
            "prediction are found by separating the matrix into a part of low rank and sparse errors. ``correction``: "
            "entries are traced where these lie dense. ``largest``: entries are traced that may be more than 3% of the "
            "light of their pixel.",
            words=STEPS,
        ),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Slices, their columns, what is traced of their matrices, and what these send to the points of one batch."""
        if job.transport.traits.null:
            mi.Log(mi.LogLevel.Warn, "Light that passes through coloured glass or masks loses its colour there.")
        work = self.start(job)
        clusters = work.entries.rows.clusters
        for block, found in self.recovered(job, work):
            work.light(block, found.visibility)
        if failed := work.counts["failed_slices"]:
            whole = work.counts["slices"]
            mi.Log(mi.LogLevel.Warn, f"{failed} of {whole} slices could not be separated and were traced instead.")
        radiance, used = clusters.in_batch_order([work.radiance, work.columns])
        spent = (work.entries.rays, work.bounds)
        rays, bounds = (dr.opaque(mi.Float, count / clusters.count, clusters.count) for count in spent)
        return ShadeResult(radiance, rays, bounds, used, work.clock.seconds, counts=work.counts)

    def start(self, job: ShadeJob) -> Work:
        """The slices of a batch."""
        clock = Clock(Stage.SLICES)
        pixel = download(job.ray).astype(np.int64) // job.grid.samples
        clusters = PointClusters(job.batch, partial(build_row_slices, pixel, self.slice_rows))
        rows = MatrixRows(clusters, pixel, job.seed)
        clock.stop()
        return Work(MatrixEntries(job.transport, rows), clock)

    def recovered(self, job: ShadeJob, work: Work):
        """Yield the matrices of all slices, recovered: (block, what was found), block by block."""
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
        """Predict the columns of some slices, and recover their matrices as many at a time as memory allows."""
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
    """Light of all points along the slices, filled block by block, and what it took.

    ``bounds``: upper bounds that were computed; ``counts``: slices, rows and entries; shadow rays by stage;
    columns by predictor; slices that failed.
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
        """Count something."""
        self.counts[name] = self.counts.get(name, 0) + number

    def begin(self, stage: Stage) -> None:
        """A stage begins, and the one before ends."""
        self.stop()
        self.stage = stage
        self.clock.begin(stage)

    def stop(self) -> None:
        """The stage ends: its time, and its shadow rays."""
        self.clock.stop()
        if self.stage is not None:
            before = sum(number for name, number in self.counts.items() if name.endswith("_rays"))
            self.add(f"{self.stage}_rays", self.entries.rays - before)
            self.stage = None

    def light(self, block: MatrixBlock, visibility) -> None:
        """Add what the columns of a block send to the points of its slices."""
        first, last = int(self._begin[block.begin]), int(self._begin[block.begin + block.slices])
        radiance, columns = block.light_points(visibility, first, last)
        point = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
        dr.scatter(self.radiance, radiance, point)
        dr.scatter(self.columns, columns, point)
        dr.eval(self.radiance, self.columns)


def _chunks(entries: MatrixEntries, columns, slices: tuple[int, int]):
    """Ranges of slices whose matrices, padded to one size, hold at most ENTRIES entries (or a single slice)."""
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
