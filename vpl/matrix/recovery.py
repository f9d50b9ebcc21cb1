"""Recovering the visibility of reduced matrices from the few entries that were traced [MSR 5, 6].

First every entry that was not traced is predicted, column by column; then the matrix is separated into a part of low
rank and sparse errors; and where errors lie dense, entries are traced after all.  So are, at last, those that may be
much of the light of their row.

Departure from the paper: what is separated is visibility, V, rather than light, E V.  E needs no recovering, and makes
the rank higher: separated light errs more than predictions (benchmarks/matrixrecovery.py).  And what is recovered is
D − Z, not XY, so that entries in which no error was found stay what they are.  And the paper knows no last step: a
small lamp lights what is next to it, where few of the rows of its column are, so that prediction, which goes by the
number of rows, loses most of its light.
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

# What may be done [MSR 7.1]: the predictors to choose from, and what follows prediction
STEPS = (*PREDICTORS, "separation", "correction", "largest")
# Share of errors around an entry from which on it is traced; 0.2 in the paper, but errors lie denser here
DENSITY = 0.65
LIMITS = SeparationLimits()
# Share of the light of a row from which on an entry is traced; the least share of its unoccluded light that a row is
# taken to have
LARGE_SHARE, _LEAST_LIGHT = 0.03, 0.1
# The Gaussian of the density of errors: 7 × 7 entries [MSR 6.2]
_TAPS, _SIGMA = 7, 1.5
# An error counts from this fraction of the whole entry on
_LEAST_ERROR = 0.01


@dataclass
class Recovered:
    """One block: arrays as :class:`vpl.matrix.matrix_block.MatrixBlock` lays them out, Float but for ``traced`` (Bool).

    ``unoccluded``: E; ``predicted``: V̄; ``traced``: entries whose V a ray found before; ``visibility``: V, recovered.
    Where columns were separated: ``part``, the block that these make, and in its layout ``error``, Z in units
    of whole entries, and ``density`` of errors (None without correction); ``separation``.
    """

    unoccluded: object
    predicted: object
    traced: object
    visibility: object
    part: MatrixBlock | None = None
    separation: Separation | None = None
    error: object = None
    density: object = None

    @property
    def failed(self) -> int:
        """Number of slices that could not be separated, so that what was in question there is traced."""
        return int(self.separation.failed.sum()) if self.separation else 0


def recover(
    block: MatrixBlock, predictors: Predictors, best: np.ndarray, first: int, steps: tuple[str, ...], seed: int,
    begin: Callable[[Stage], None] = tell,
) -> Recovered:  # fmt: skip
    """Recover a block: see :class:`Recovered`.

    ``best``: the predictor of every column that has samples; those of the block are these from number ``first`` on.
    ``steps``: those of STEPS that are taken; without a predictor what was not traced is taken to arrive, and correction
    needs separation.  ``begin``: called with every stage as it begins.
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
    """Trace the entries at some places, UInt32."""
    if len(wanted):
        block.trace(found.visibility, wanted, dr.opaque(mi.UInt32, seed))


def _largest(found: Recovered, block: MatrixBlock):
    """Places of entries that were predicted, and may be a large share of the light of their row: UInt32."""
    _, width, height = block.shape
    light, whole = _light_of_rows(found.unoccluded, found.visibility, block.shape)
    enough = LARGE_SHARE * dr.maximum(light, _LEAST_LIGHT * whole)
    lane, rows = dr.arange(mi.UInt32, block.size), dr.opaque(mi.UInt32, height)
    row = lane // dr.opaque(mi.UInt32, width * height) * rows + lane % rows
    return dr.compress(~found.traced & (found.unoccluded > dr.gather(mi.Float, enough, row)))


@dr.syntax
def _light_of_rows(unoccluded, visibility, shape: tuple[int, int, int]):
    """Sums of E V and of E over the columns, Float, evaluated: the rows of one slice after another."""
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
    """Columns, of ``count``, that have samples that differ: the others have nothing that could be told apart."""
    sums = (download(values)[first : first + count] for values in (predictors.in_light, predictors.in_shadow))
    return np.flatnonzero(np.minimum(*sums) > _LEAST_ERROR)


def _separate(found: Recovered, block: MatrixBlock, mixed: np.ndarray, correction: bool, seed: int):
    """Find and take off errors in some columns: the places to trace, UInt32, which are all of slices that failed and,
    with ``correction``, those where errors lie dense."""
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
    """For every entry of a block of some of the columns, its place in the whole block, and whether there is one."""
    source, present = dr.zeros(mi.UInt32, part.size), dr.zeros(mi.Bool, part.size)
    dr.eval(source, present)
    column, inside, _, active, place = part.lanes(np.arange(part.columns.count))
    slot = dr.gather(mi.UInt32, upload(mi.UInt32, block.slot[columns]), column)
    dr.scatter(source, slot * dr.opaque(mi.UInt32, block.shape[2]) + inside, place, active)
    dr.scatter(present, mi.Bool(True), place, active)
    dr.eval(source, present)
    return source, present


def _predicted(block: MatrixBlock, predictors: Predictors, best: np.ndarray, first: int, prediction: bool, seed: int):
    """(V̄ of all entries, which of them were traced)."""
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
    """Entries of the separated matrix where all arrives: of V, 1; 0 where there is no entry."""
    return dr.select(present, mi.Float(1), 0)


def _of_slices(block: MatrixBlock, chosen: np.ndarray):
    """Mask of the entries of some slices."""
    entries = dr.opaque(mi.UInt32, block.shape[1] * block.shape[2])
    return dr.gather(mi.UInt32, upload(mi.UInt32, chosen), dr.arange(mi.UInt32, block.size) // entries) == 1


def _blurred(block: MatrixBlock, values):
    """A Gaussian over rows and columns of every matrix; nothing lies beyond their borders."""
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
