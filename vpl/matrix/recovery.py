"""Recovery of the visibility of reduced matrices from few traced entries [MSR sections 5, 6].

1. Prediction: the remaining entries are predicted, column by column.
2. Separation of the matrix into a low-rank part and sparse errors.
3. Correction: entries in regions of dense errors are traced.
4. Largest entries: predicted entries that may be a large fraction of the light of a row are traced.

Departures from the paper:

- Visibility V is separated, not light E V.  E is known and raises the rank: separated light has larger errors than
  predictions (benchmarks/matrixrecovery.py).
- The result is D − Z, not XY: entries without an error stay unchanged.
- Step 4 is new.  A small lamp lights few rows of its column, nearby.  Prediction minimises the number of wrong rows,
  and so loses most of the lamp's light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..core.sampling import HASH_ROUNDS, derived_seed
from ..core.stages import Stage, tell
from .matrix_block import MatrixBlock
from .separation import Separation, SeparationLimits, separate
from .visibility_prediction import PREDICTORS, Predictors

# Optional steps [MSR section 7.1]: available predictors, then the steps after prediction
STEPS = (*PREDICTORS, "separation", "correction", "largest")
# Density of errors above which an entry is traced; 0.2 in the paper, but errors of visibility are denser
DENSITY = 0.65
LIMITS = SeparationLimits()
# Fraction of the light of a row above which a predicted entry is traced
LARGE_SHARE = 0.03
# Least light assumed for a row, relative to its unoccluded light
_LEAST_LIGHT = 0.1
# Gaussian kernel of the density of errors: 7 × 7 entries, standard deviation in entries [MSR section 6.2]
_TAPS, _SIGMA = 7, 1.5
# Least error that counts, relative to the unoccluded entry
_LEAST_ERROR = 0.01


@dataclass
class Recovered:
    """Entries of a block, in the layout of :class:`vpl.matrix.matrix_block.MatrixBlock`.

    ``unoccluded``: E; ``predicted``: V̄; ``traced``: whether V was traced before prediction; ``visibility``: recovered
    V.  With separation: ``part``, the block of the separated columns; in its layout ``error``, Z relative to the
    unoccluded entry, and, with correction, ``density`` of errors.
    """

    unoccluded: mi.Float
    predicted: mi.Float
    traced: mi.Bool
    visibility: mi.Float
    part: MatrixBlock | None = None
    separation: Separation | None = None
    error: mi.Float | None = None
    density: mi.Float | None = None

    @property
    def failed(self) -> int:
        """Number of slices without a valid separation, in which the entries in question are traced."""
        return int(self.separation.failed.sum()) if self.separation else 0


def recover(
    block: MatrixBlock, predictors: Predictors, best: np.ndarray, first: int, steps: tuple[str, ...], seed: int,
    begin: Callable[[Stage], None] = tell,
) -> Recovered:  # fmt: skip
    """Recover the visibility of a block.

    ``best``: predictor of every sampled column; the columns of the block start at number ``first``.
    ``steps``: subset of STEPS; without a predictor every entry that was not traced is assumed visible; correction
    requires separation.  ``begin``: called with every stage before it.
    """
    begin(Stage.PREDICTION)
    prediction = any(step in PREDICTORS for step in steps)
    predicted, traced = _predicted(block, predictors, best, first, prediction, seed)
    begin(Stage.SHADING)
    found = Recovered(block.unoccluded(), predicted, traced, mi.Float(predicted))
    mixed = _mixed_columns(predictors, first, block.columns.count) if "separation" in steps else []
    if len(mixed):
        begin(Stage.SEPARATION)
        wanted = _separate(found, block, mixed, "correction" in steps, seed)
        begin(Stage.CORRECTION)
        _trace(found, block, wanted, seed)
    if "largest" in steps:
        begin(Stage.CORRECTION)
        _trace(found, block, _largest(found, block), derived_seed(seed, 1))
    return found


def _trace(found: Recovered, block: MatrixBlock, wanted, seed: int) -> None:
    """Trace the entries with the indices ``wanted``, UInt32."""
    if len(wanted):
        block.trace(found.visibility, wanted, dr.opaque(mi.UInt32, seed))


def _largest(found: Recovered, block: MatrixBlock):
    """Indices, UInt32, of predicted entries that may be a large fraction of the light of their row."""
    _, width, height = block.shape
    light, whole = _light_of_rows(found.unoccluded, found.visibility, block.shape)
    enough = LARGE_SHARE * dr.maximum(light, _LEAST_LIGHT * whole)
    lane, rows = dr.arange(mi.UInt32, block.size), dr.opaque(mi.UInt32, height)
    row = lane // dr.opaque(mi.UInt32, width * height) * rows + lane % rows
    return dr.compress(~found.traced & (found.unoccluded > dr.gather(mi.Float, enough, row)))


@dr.syntax
def _light_of_rows(unoccluded, visibility, shape: tuple[int, int, int]):
    """Sums of E V and of E over the columns, for the rows of slice after slice: Float, evaluated."""
    slices, width, height = shape
    lane, rows = dr.arange(mi.UInt32, slices * height), dr.opaque(mi.UInt32, height)
    place = lane // rows * dr.opaque(mi.UInt32, width * height) + lane % rows
    j, columns = mi.UInt32(0), dr.opaque(mi.UInt32, width)
    light, whole = (dr.zeros(mi.Float, slices * height) for _ in range(2))
    while dr.hint(j < columns, exclude=[unoccluded, visibility, rows, columns]):
        entry = dr.gather(mi.Float, unoccluded, place)
        whole += entry
        light += entry * dr.gather(mi.Float, visibility, place)
        place += rows
        j += 1
    dr.eval(light, whole)
    return light, whole


def _mixed_columns(predictors: Predictors, first: int, count: int) -> np.ndarray:
    """Columns, out of ``count``, with samples both in light and in shadow; no other column needs separation."""
    sums = (download(values)[first : first + count] for values in (predictors.in_light, predictors.in_shadow))
    return np.flatnonzero(np.minimum(*sums) > _LEAST_ERROR)


def _separate(found: Recovered, block: MatrixBlock, mixed: np.ndarray, correction: bool, seed: int):
    """Separate the columns ``mixed``, subtract errors, and return the indices of entries to trace, UInt32.

    These are the entries of slices without a valid separation and, with ``correction``, of regions of dense errors.
    """
    part = MatrixBlock(block.entries, block.columns.select(mixed), block.begin, block.begin + block.slices)
    source, present = _places(block, part, mixed)
    predicted = dr.gather(mi.Float, found.predicted, source, present)
    free = present & ~dr.gather(mi.Bool, found.traced, source, present)
    unoccluded = dr.gather(mi.Float, found.unoccluded, source, present)
    weight = whole_entries(unoccluded, present)
    whole = predicted * weight
    dr.eval(whole, weight, free, predicted, unoccluded)
    found.part, found.separation = part, separate(whole, free, weight, part.shape, LIMITS, seed)
    error = dr.select(free & (weight > 0), found.separation.error / weight, 0)
    error = dr.select(dr.isfinite(error), dr.clip(error, -1, 1), 0)
    found.error = error
    wrong = dr.select(dr.abs(error) > _LEAST_ERROR, mi.Float(1), 0)
    dr.eval(found.error, wrong)
    wanted = failed = _of_slices(part, found.separation.failed)
    dr.scatter(found.visibility, dr.clip(predicted - error, 0, 1), source, present & ~failed)
    dr.eval(found.visibility)
    if correction:
        found.density = _blurred(part, wrong)
        wanted |= found.density > DENSITY
    return dr.gather(mi.UInt32, source, dr.compress(wanted & free & (unoccluded > 0)))


def _places(block: MatrixBlock, part: MatrixBlock, columns: np.ndarray):
    """For every entry of ``part``, with some columns of a block: (index in the block, whether the entry exists)."""
    source, present = dr.zeros(mi.UInt32, part.size), dr.zeros(mi.Bool, part.size)
    dr.eval(source, present)
    column, inside, _, active, place = part.lanes(np.arange(part.columns.count))
    slot = dr.gather(mi.UInt32, upload(mi.UInt32, block.slot[columns]), column)
    dr.scatter(source, slot * dr.opaque(mi.UInt32, block.shape[2]) + inside, place, active)
    dr.scatter(present, mi.Bool(True), place, active)
    dr.eval(source, present)
    return source, present


def _predicted(block: MatrixBlock, predictors: Predictors, best: np.ndarray, first: int, prediction: bool, seed: int):
    """(V̄ of every entry, whether the entry was traced)."""
    samples, height = predictors.samples, dr.opaque(mi.UInt32, block.shape[2])
    values, traced = dr.zeros(mi.Float, block.size), dr.zeros(mi.Bool, block.size)
    dr.eval(values, traced)
    for kind in predictors.kinds if prediction else ():
        index = np.flatnonzero(best[first : first + block.columns.count] == kind)
        if len(index):
            column, inside, _, active, place = block.lanes(index)
            draw = mi.sample_tea_float32(place, dr.opaque(mi.UInt32, seed), HASH_ROUNDS)
            row = dr.select(active, inside, 0)
            value = predictors.predict(kind, column + dr.opaque(mi.UInt32, first), row, draw)
            dr.scatter(values, value, place, active)
            dr.eval(values)
    if not prediction:
        _, _, _, active, place = block.lanes(np.arange(block.columns.count))
        dr.scatter(values, mi.Float(1), place, active)
        dr.eval(values)
    lane = dr.arange(mi.UInt32, block.columns.count * samples.most)
    column, number = lane // dr.opaque(mi.UInt32, samples.most), lane % dr.opaque(mi.UInt32, samples.most)
    known = number < dr.gather(mi.UInt32, samples.number, column + dr.opaque(mi.UInt32, first))
    source = lane + dr.opaque(mi.UInt32, first * samples.most)
    place = dr.gather(mi.UInt32, upload(mi.UInt32, block.slot), column) * height
    place += dr.gather(mi.UInt32, samples.row, source, known)
    dr.scatter(values, dr.gather(mi.Float, samples.value, source, known), place, known)
    dr.scatter(traced, mi.Bool(True), place, known)
    dr.eval(values, traced)
    return values, traced


def whole_entries(unoccluded, present):
    """Value of fully visible entries in the separated matrix: 1 for V; 0 for padding."""
    return dr.select(present, mi.Float(1), 0)


def _of_slices(block: MatrixBlock, chosen: np.ndarray):
    """Mask of the entries of some slices."""
    entries = dr.opaque(mi.UInt32, block.shape[1] * block.shape[2])
    return dr.gather(mi.UInt32, upload(mi.UInt32, chosen), dr.arange(mi.UInt32, block.size) // entries) == 1


def _blurred(block: MatrixBlock, values):
    """Blur every matrix by a Gaussian over rows and columns, with zeros beyond the borders."""
    offsets = np.arange(_TAPS) - _TAPS // 2
    taps = np.exp(-0.5 * (offsets / _SIGMA) ** 2)
    taps /= taps.sum()
    _, width, height = block.shape
    lane = dr.arange(mi.UInt32, block.size)
    for stride, length in ((1, height), (height, width)):
        step = dr.opaque(mi.UInt32, stride)
        at = mi.Int32((lane // step) % dr.opaque(mi.UInt32, length))
        total = dr.zeros(mi.Float, block.size)
        for offset, tap in zip(offsets.tolist(), taps.tolist(), strict=True):
            inside = (at + offset >= 0) & (at + offset < dr.opaque(mi.Int32, length))
            source = mi.UInt32(mi.Int32(lane) + offset * mi.Int32(step))
            total += tap * dr.gather(mi.Float, values, source, inside)
        dr.eval(total)
        values = total
    return values
