"""Prediction of the visibility of rows from traced rows, column by column [MSR section 5].

A column has three predictors: by the nearest rows, by a linear boundary between light and shadow, and by Bayes' rule
from nearby columns and the same row.  A column is sampled until a predictor has a small enough error on new samples
[MSR algorithm 2].

Departures from the paper:

- Nearest rows are found by exhaustive search in the tens of samples of a column, not along shifted Hilbert curves.
- The linear boundary lies in the tangent plane of the slice, and its slope counts half: equation 10 would be certain of
  light if 3 of 4 samples are lit.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, upload
from ..core.sampling import HASH_ROUNDS, derived_seed
from .visibility_samples import NO_ROW, VisibilitySamples

NEAREST, LINEAR, BAYES = range(3)
PREDICTORS = {"nearest": NEAREST, "linear": LINEAR, "bayes": BAYES}
# Columns to either side along the light tree for the Bayes predictor: five in total [MSR section 5.1]
_BESIDE = 2
# Imaginary prior samples of each class of visibility
_PRIOR = 0.1
# Ridge of the least squares per sample, for samples that do not span the plane
_RIDGE = 1e-3


class Predictors:
    """Predictors of some columns, learned from the present samples.

    ``kinds``: available predictors; ``in_light``, ``in_shadow``: Float, sums of V and 1 − V over the samples of each
    column.
    """

    def __init__(self, samples: VisibilitySamples, kinds: tuple[int, ...] = (NEAREST, LINEAR, BAYES)):
        self.samples, self.kinds = samples, kinds
        columns = samples.columns
        segment = columns.segment
        number = np.arange(columns.count)
        first, last = np.searchsorted(segment, segment), np.searchsorted(segment, segment, side="right")
        self._first = upload(mi.UInt32, np.maximum(number - _BESIDE, first))
        self._last = upload(mi.UInt32, np.minimum(number + _BESIDE + 1, last))
        self._piece = upload(mi.UInt32, columns.piece)
        self._line = [dr.zeros(mi.Float, columns.count) for _ in range(3)]
        self.in_light, self.in_shadow = (dr.zeros(mi.Float, columns.count) for _ in range(2))
        dr.eval(self._line, self.in_light, self.in_shadow)
        self.learn(number)

    def learn(self, index: np.ndarray) -> None:
        """Update the predictors of some columns from the present samples."""
        column = upload(mi.UInt32, index)
        line, lit, number = self._fit(column)
        for target, value in zip(self._line, line, strict=True):
            dr.scatter(target, value, column)
        dr.scatter(self.in_light, lit, column)
        dr.scatter(self.in_shadow, mi.Float(number) - lit, column)
        dr.eval(self._line, self.in_light, self.in_shadow)

    def predict(self, kind: int, column, row, draw):
        """Predict V of some rows of some columns, Float: 0 or 1, or the traced value of a nearest row.

        ``row``: within the slice; ``draw``: uniform number that turns a probability into V.
        """
        if kind == NEAREST:
            return self._of_nearest(column, row, draw)
        lit = self._by_line(column, row) if kind == LINEAR else self._by_bayes(column, row)
        return dr.select(draw < lit, mi.Float(1), 0)

    def _place(self, column, row):
        first, _ = self.samples.entries.rows.range(dr.gather(mi.UInt32, self._piece, column))
        return self.samples.entries.rows.place(first + row)

    @dr.syntax
    def _of_nearest(self, column, row, draw):
        """V of one of the three nearest samples, drawn uniformly [MSR section 5.1]; 1 without samples."""
        begin = column * dr.opaque(mi.UInt32, self.samples.most)
        count, k = dr.gather(mi.UInt32, self.samples.number, column), mi.UInt32(0)
        x, y = self._place(column, row)
        # Squared distances and V of the nearest samples so far
        distance1, distance2, distance3 = (dr.full(mi.Float, np.inf, dr.width(column)) for _ in range(3))
        value1, value2, value3 = (dr.full(mi.Float, 1, dr.width(column)) for _ in range(3))
        while dr.hint(k < count, exclude=[self, begin, x, y]):
            value = dr.gather(mi.Float, self.samples.value, begin + k)
            u, v = (dr.gather(mi.Float, side, begin + k) for side in (self.samples.x, self.samples.y))
            distance = dr.square(u - x) + dr.square(v - y)
            first, second, third = distance < distance1, distance < distance2, distance < distance3
            value3 = dr.select(second, value2, dr.select(third, value, value3))
            distance3 = dr.select(second, distance2, dr.select(third, distance, distance3))
            value2 = dr.select(first, value1, dr.select(second, value, value2))
            distance2 = dr.select(first, distance1, dr.select(second, distance, distance2))
            value1, distance1 = dr.select(first, value, value1), dr.minimum(distance1, distance)
            k += 1
        rank = draw * mi.Float(dr.minimum(count, 3))
        return dr.select(rank < 1, value1, dr.select(rank < 2, value2, value3))

    @dr.syntax
    def _fit(self, column):
        """(Three coefficients of the linear boundary, sum of V, number of samples) of columns [MSR equation 9]."""
        begin = column * dr.opaque(mi.UInt32, self.samples.most)
        count, k = dr.gather(mi.UInt32, self.samples.number, column), mi.UInt32(0)
        matrix, right = (dr.zeros(kind, dr.width(column)) for kind in (mi.Matrix3f, mi.Vector3f))
        lit = dr.zeros(mi.Float, dr.width(column))
        while dr.hint(k < count, exclude=[self, begin, column]):
            value = dr.gather(mi.Float, self.samples.value, begin + k)
            u, v = (dr.gather(mi.Float, side, begin + k) for side in (self.samples.x, self.samples.y))
            point = mi.Vector3f(u - 0.5, v - 0.5, 1)
            matrix += mi.Matrix3f(point.x * point, point.y * point, point)
            right += point * (2 * value - 1)
            lit += value
            k += 1
        ridge = _RIDGE * mi.Float(dr.maximum(count, 1))
        line = dr.rcp(matrix + dr.identity(mi.Matrix3f) * ridge) @ right
        return list(line), lit, count

    def _by_line(self, column, row):
        """Probability of light by the linear boundary [MSR equation 10].

        The function is fitted to −1 and 1 and counts half: the prediction is certain if the samples agree.
        """
        x, y = self._place(column, row)
        a, b, c = (dr.gather(mi.Float, values, column) for values in self._line)
        return dr.clip(0.5 + 0.5 * (a * (x - 0.5) + b * (y - 0.5) + c), 0, 1)

    @dr.syntax
    def _by_bayes(self, column, row):
        """Probability of light by Bayes' rule [MSR section 5.1], from samples of nearby columns and of the same row."""
        j, end = dr.gather(mi.UInt32, self._first, column), dr.gather(mi.UInt32, self._last, column)
        width = dr.width(column)
        light, shadow, row_light, row_shadow = (dr.full(mi.Float, _PRIOR, width) for _ in range(4))
        while dr.hint(j < end, exclude=[self, row]):
            light += dr.gather(mi.Float, self.in_light, j)
            shadow += dr.gather(mi.Float, self.in_shadow, j)
            seen, lit = self.samples.at(j, row)
            row_light += mi.Float(lit)
            row_shadow += mi.Float(seen - lit)
            j += 1
        _, rows = self.samples.entries.rows.range(dr.gather(mi.UInt32, self._piece, column))
        prior = _PRIOR * mi.Float(rows)
        # P(v) P(i | v), up to a common factor
        odds_light, odds_shadow = light * row_light / (light + prior), shadow * row_shadow / (shadow + prior)
        return odds_light / (odds_light + odds_shadow)


def predict_columns(
    samples: VisibilitySamples, kinds: tuple[int, ...], count: int, error: float, rounds: int, seed: int
):
    """Sample columns until a predictor's error on ``count`` new samples is below ``error``, or for ``rounds`` rounds.

    Returns (predictors, kind of the best predictor of every column, (c,)).
    """
    predictors, columns = Predictors(samples, kinds), samples.columns.count
    best, errors = np.zeros(columns, np.int64), np.zeros((columns, len(kinds)))
    active = np.arange(columns)
    for number in range(rounds):
        if not len(active):
            break
        wrong, tested = _validate(predictors, active, count, derived_seed(seed, 2, number))
        errors[active] += wrong
        # Earlier rounds break ties
        best[active] = (wrong + 1e-3 * errors[active]).argmin(1)
        predictors.learn(active)
        # Without an error a column is done, even for ``error`` 0 or without samples
        active = active[wrong.min(1) >= np.maximum(error * tested, 1e-9)]
    return predictors, np.asarray(kinds)[best]


def _validate(predictors: Predictors, index: np.ndarray, count: int, seed: int):
    """Predict new samples, then trace them: (error of each predictor, (c, k), number of samples, (c,))."""
    samples = predictors.samples
    rows = samples.draw(index, count)
    lane = dr.arange(mi.UInt32, len(index) * count)
    column = dr.gather(mi.UInt32, upload(mi.UInt32, index), lane // dr.opaque(mi.UInt32, count))
    drawn = rows != NO_ROW
    inside, draw = dr.select(drawn, rows, 0), mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed), HASH_ROUNDS)
    predicted = [predictors.predict(kind, column, inside, draw) for kind in predictors.kinds]
    dr.eval(predicted)
    value = samples.trace(index, rows, count)
    known = value >= 0
    wrong = [dr.select(known, dr.abs(one - value), 0) for one in predicted]
    tested = dr.select(known, mi.Float(1), 0)
    dr.eval(wrong, tested)
    wrong, tested = (download(x).reshape(-1, count).sum(1) for x in wrong), download(tested).reshape(-1, count).sum(1)
    return np.stack(list(wrong), axis=1), tested
