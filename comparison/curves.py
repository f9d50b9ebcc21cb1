"""Curves of error against time or shadow rays, and what is read off them. NumPy only.

A point is a setting, its coordinates are means over seeds. An integrator's curve joins those of its points that no
other of its points beats in both (its own front), by straight lines in logarithmic axes. Errors that the reference's
noise hides are no part of it, but bounds: they are at most that noise. Nothing is read off beyond a curve's ends.

Confidence intervals are at 95%: of means by Student's t on a logarithmic scale, of what is read off by the jackknife
over seeds. Ratios of two integrators leave the same seed out of both, as they may share lights.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

# Quantiles of Student's t at 97.5%, for 1 to 10 degrees of freedom; beyond them by an expansion good to 1e-4.
_QUANTILES = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281)
_NORMAL = 1.959964
TARGETS = 4  # at most so many errors, and times, at which integrators are compared


def quantile(freedom):
    """The quantile of Student's t at 97.5% for `freedom` degrees of freedom, at least 1."""
    if freedom <= len(_QUANTILES):
        return _QUANTILES[freedom - 1]
    z = _NORMAL
    terms = (z, (z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384)
    return sum(term / freedom**power for power, term in enumerate(terms))


def spread(values):
    """Return the mean of positive values over seeds and its interval: a dict with "mean", "low" and "high", the latter
    two None for a single value, or where the mean is zero."""
    values = np.asarray(values, np.float64)
    mean = float(values.mean())
    if len(values) < 2 or mean <= 0:
        return {"mean": mean, "low": None, "high": None}
    factor = float(np.exp(quantile(len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)) / mean))
    return {"mean": mean, "low": mean / factor, "high": mean * factor}


@dataclass
class Point:
    """A setting: for each of its seeds, the cost (seconds or rays), the error, and the noise below which an error means
    nothing. `cost` and the others are dicts from seed to number."""

    label: str
    name: str
    cost: dict
    error: dict
    noise: dict

    def mean(self, without=None):
        """Return the means of cost and error, with a seed left out; None if there is no other seed, or if the error
        cannot be told from the reference's noise."""
        cost, error, noise = self._means(without)
        return (cost, error) if error > noise and cost > 0 else None

    def bound(self, without=None):
        """Return the means of cost and noise where that hides the error, which is at most as large; None elsewhere."""
        cost, error, noise = self._means(without)
        return (cost, noise) if error <= noise and cost > 0 else None

    def _means(self, without):
        seeds = [seed for seed in self.cost if seed != without]
        if not seeds:
            return np.nan, np.nan, np.nan
        return tuple(float(np.mean([of[seed] for seed in seeds])) for of in (self.cost, self.error, self.noise))


class Curve:
    """The curve of one integrator; `points` are its `Point`s."""

    def __init__(self, label, points):
        self.label, self.points = label, points

    def front(self, without=None):
        """Return cost and error, arrays of the points of the curve in order of rising cost and falling error."""
        return front([mean for point in self.points if (mean := point.mean(without)) is not None])

    def bounds(self, without=None):
        """Return cost and noise, a list of pairs, of the points whose errors the noise hides."""
        return [bound for point in self.points if (bound := point.bound(without)) is not None]

    def cost_at(self, error, without=None):
        """Return the cost of an error as (cost, at most): the second where a cheaper point is better than that, be it
        the cheapest or one that the noise hides, (None, None) where the curve does not get there."""
        costs, errors = self.front(without)
        hidden = [cost for cost, noise in self.bounds(without) if noise <= error]
        return _read_off(error, errors[::-1], costs[::-1], hidden)

    def error_at(self, cost, without=None):
        """Return the error at a cost as (error, at most): the second where a point that costs less, be it the most
        expensive or one that the noise hides, is better, (None, None) where even the cheapest costs more."""
        hidden = [noise for at, noise in self.bounds(without) if at <= cost]
        return _read_off(cost, *self.front(without), hidden)

    def between(self, value, axis):
        """Return the settings that what is read off at a cost (axis 0) or an error (axis 1) comes from: a dict from
        names to shares in logarithmic axes, which add up to 1. They are two settings of the front, or one; where only a
        bound is known it is the setting that has it, and where the curve does not get there, none."""
        read, at_most = self.error_at(value) if axis == 0 else self.cost_at(value)
        if at_most is not None:
            pairs = {point.name: point.mean() or point.bound() for point in self.points}
            # Bounds may be alike, as the reference's noise is: of them, one that is not beyond the place
            reached = {name: pair for name, pair in pairs.items() if pair and pair[axis] <= value}
            return {next(name for name, pair in reached.items() if pair[1 - axis] == at_most): 1.0}
        if read is None:
            return {}
        front = set(zip(*map(np.ndarray.tolist, self.front()), strict=True))
        along = {mean[axis]: point.name for point in self.points if (mean := point.mean()) in front}
        at = sorted(along)
        above = int(np.searchsorted(at, value))
        if at[above] == value:
            return {along[value]: 1.0}
        share = float(np.log(value / at[above - 1]) / np.log(at[above] / at[above - 1]))
        return {along[at[above - 1]]: 1 - share, along[at[above]]: share}

    @property
    def seeds(self):
        return sorted({seed for point in self.points for seed in point.cost})


def front(pairs):
    """Return, of (cost, error) pairs, those that no other beats in both, as two arrays in order of rising cost."""
    kept = []
    for cost, error in sorted(pairs):
        if not kept or error < kept[-1][1]:
            kept.append((cost, error))
    return tuple(np.array(kept, np.float64).reshape(-1, 2).T)


def _read_off(x, xs, ys, bounds):
    """Return the value at x of a falling curve through (xs, ys), xs rising, and None; or None and what it is at most,
    beyond the end of the curve, or because one of `bounds` is lower; or None twice."""
    value, at_most = None, min(bounds, default=np.inf)
    if xs.size and x > xs[-1]:
        at_most = min(at_most, float(ys[-1]))
    elif xs.size and x >= xs[0]:
        value = float(np.exp(np.interp(np.log(x), np.log(xs), np.log(ys))))
    if value is not None and value <= at_most:
        return value, None
    return None, at_most if np.isfinite(at_most) else None


def interval(value, seeds):
    """Return the 95% interval of a positive number by the jackknife, (low, high), or (None, None) where it cannot be
    told: a single seed, or a number that is not there without one of them. `value` maps the seed that is left out, or
    None, to the number or None."""
    without = [value(seed) for seed in seeds]
    if len(seeds) < 2 or any(number is None for number in without):
        return None, None
    logs, count = np.log(without), len(seeds)
    error = np.sqrt((count - 1) / count * np.square(logs - logs.mean()).sum())
    factor = float(np.exp(quantile(count - 1) * error))
    return value(None) / factor, value(None) * factor


def equal_errors(curves, targets=None):
    """Return what each curve costs at the same errors: a list of {"error", "costs"}, the latter from label to {"value",
    "at_most", "low", "high", "speed_up", "speed_up_low", "speed_up_high", "speed_up_at_least"}; a speed-up is the cost
    of the first curve over that of the label's, the last one over `at_most`. What is not known is None; "not reached"
    is where both value and at_most are."""
    targets = _targets([curve.front()[1] for curve in curves]) if targets is None else targets
    return [
        {"error": target, "costs": {curve.label: _read(curves[0], curve, Curve.cost_at, target) for curve in curves}}
        for target in targets
    ]


def equal_costs(curves, targets=None):
    """Return the error of each curve at the same costs: a list of {"cost", "errors"}, the latter as in `equal_errors`,
    with the ratio of errors in place of the speed-up."""
    targets = _targets([curve.front()[0] for curve in curves]) if targets is None else targets
    return [
        {"cost": target, "errors": {curve.label: _read(curves[0], curve, Curve.error_at, target) for curve in curves}}
        for target in targets
    ]


def _read(base, curve, read, target):
    def ratio(without):
        over, under = read(base, target, without)[0], read(curve, target, without)[0]
        return over / under if over and under else None

    over, (value, at_most) = read(base, target)[0], read(curve, target)
    low, high = interval(lambda without: read(curve, target, without)[0], curve.seeds) if value else (None, None)
    speed_up = ratio(None)
    both = sorted({*base.seeds, *curve.seeds})
    speed_low, speed_high = interval(ratio, both) if speed_up and curve is not base else (None, None)
    return {
        "value": value, "at_most": at_most, "low": low, "high": high,
        "speed_up": speed_up, "speed_up_low": speed_low, "speed_up_high": speed_high,
        "speed_up_at_least": over / at_most if over and at_most else None,
    }  # fmt: skip


def _targets(ranges):
    """Choose the numbers at which to compare: round ones (1, 2 or 5 times a power of ten) that as many as possible of
    the ranges hold, `TARGETS` of them at most; the middle of what the ranges share where no round one is. Where they
    share nothing, the ends that are closest to each other, so that one of them is a bound."""
    ranges = [(float(values.min()), float(values.max())) for values in ranges if values.size]
    if not ranges:
        return []
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    candidates = [float(f"{step}e{int(decade)}") for decade in decades for step in (1, 2, 5)]
    # Corners of the ranges join: somewhere between two of them is the most that can be had.
    corners = sorted({corner for pair in ranges for corner in pair})
    candidates += [float(f"{np.sqrt(a * b):.3g}") for a, b in pairwise(corners)]
    holders = [sum(low <= number <= high for low, high in ranges) for number in candidates]
    most = max(holders, default=0)
    if most < min(2, len(ranges)):
        return sorted({min(high for _, high in ranges), max(low for low, _ in ranges)})
    best = [number for number, count in zip(candidates, holders, strict=True) if count == most]
    is_round = [number for number in best if f"{number:e}"[0] in "125" and float(f"{number:.0e}") == number]
    best = sorted(is_round or best[:1])
    chosen = np.unique(np.linspace(0, len(best) - 1, min(TARGETS, len(best))).round().astype(int))
    return [best[index] for index in chosen]


def pareto(points):
    """Return the set of (label, name) of those points of all curves that no point of any curve beats in both, be it one
    that the noise hides."""
    means = {(point.label, point.name): mean for point in points if (mean := point.mean()) is not None}
    bounds = [bound for point in points if (bound := point.bound()) is not None]
    kept = set(zip(*map(np.ndarray.tolist, front([*means.values(), *bounds])), strict=True))
    return {key for key, mean in means.items() if mean in kept}
