"""Curves of error against time or shadow rays, and values interpolated on them.

A point is a setting; its coordinates are means over seeds. The curve of an integrator is its Pareto front, connected by
straight lines in logarithmic axes. An error below the reference's noise is not part of a curve; the noise is an upper
bound of it. Curves are not extrapolated.

Confidence intervals are at 95%: Student's t on a logarithmic scale for means, the jackknife over seeds for interpolated
values. Ratios of two integrators leave out the same seed of both, because both may use the same lights.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

TARGETS = 4  # maximum number of errors, and of times, in a comparison of integrators


def quantile(freedom):
    """Return the 97.5% quantile of Student's t for `freedom` (at least 1) degrees of freedom."""
    from scipy.special import stdtrit  # here, because --help works without optional packages

    return float(stdtrit(freedom, 0.975))


def spread(values):
    """Return the mean of positive values over seeds with its confidence interval: "mean", "low" and "high"; the latter
    two are None for a single value or a mean of zero."""
    values = np.asarray(values, np.float64)
    mean = float(values.mean())
    if len(values) < 2 or mean <= 0:
        return {"mean": mean, "low": None, "high": None}
    factor = float(np.exp(quantile(len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)) / mean))
    return {"mean": mean, "low": mean / factor, "high": mean * factor}


@dataclass
class Point:
    """Setting with its cost (seconds or rays), its error, and the noise below which the error is indistinguishable from
    zero; each a dict from seed to number."""

    label: str
    name: str
    cost: dict
    error: dict
    noise: dict

    def mean(self, without=None):
        """Return the means of cost and error, leaving out a seed; None without a further seed, or if the reference's
        noise hides the error."""
        cost, error, noise = self._means(without)
        return (cost, error) if error > noise and cost > 0 else None

    def bound(self, without=None):
        """Return the means of cost and noise if the noise hides the error and so bounds it from above, else None."""
        cost, error, noise = self._means(without)
        return (cost, noise) if error <= noise and cost > 0 else None

    def _means(self, without):
        seeds = [seed for seed in self.cost if seed != without]
        if not seeds:
            return np.nan, np.nan, np.nan
        return tuple(float(np.mean([values[seed] for seed in seeds])) for values in (self.cost, self.error, self.noise))


class Curve:
    """Curve of an integrator from its `Point`s."""

    def __init__(self, label, points):
        self.label, self.points = label, points

    def front(self, without=None):
        """Return the arrays of costs (rising) and errors (falling) of the Pareto front."""
        return front([mean for point in self.points if (mean := point.mean(without)) is not None])

    def bounds(self, without=None):
        """Return (cost, noise) of the points with hidden errors."""
        return [bound for point in self.points if (bound := point.bound(without)) is not None]

    def cost_at(self, error, without=None):
        """Return (cost, None) of an error; (None, upper bound) if a cheaper point already has a smaller error, measured
        or hidden by noise; (None, None) if no point reaches the error."""
        costs, errors = self.front(without)
        hidden = [cost for cost, noise in self.bounds(without) if noise <= error]
        return _interpolate(error, errors[::-1], costs[::-1], hidden)

    def error_at(self, cost, without=None):
        """Return (error, None) at a cost; (None, upper bound) if a point of lower cost already has a smaller error,
        measured or hidden by noise; (None, None) if every point costs more."""
        hidden = [noise for at, noise in self.bounds(without) if at <= cost]
        return _interpolate(cost, *self.front(without), hidden)

    def interpolation_weights(self, value, axis):
        """Return setting name -> weight for the interpolation at a cost (axis 0) or an error (axis 1).

        The weights, with sum 1, belong to one or two settings of the front. If only a bound is known, its setting has
        the weight 1. The dict is empty if the curve does not reach the value.
        """
        read, at_most = self.error_at(value) if axis == 0 else self.cost_at(value)
        if at_most is not None:
            pairs = {point.name: point.mean() or point.bound() for point in self.points}
            # Several bounds may equal the reference's noise; take one that reaches the value
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
    """Return the Pareto front of (cost, error) pairs, two arrays in order of rising cost."""
    kept = []
    for cost, error in sorted(pairs):
        if not kept or error < kept[-1][1]:
            kept.append((cost, error))
    return tuple(np.array(kept, np.float64).reshape(-1, 2).T)


def _interpolate(x, xs, ys, bounds):
    """Interpolate a falling curve (xs, ys), xs rising, at x. Return (value, None), or (None, upper bound) beyond the
    end of the curve or if one of `bounds` is lower, or (None, None)."""
    value, at_most = None, min(bounds, default=np.inf)
    if xs.size and x > xs[-1]:
        at_most = min(at_most, float(ys[-1]))
    elif xs.size and x >= xs[0]:
        value = float(np.exp(np.interp(np.log(x), np.log(xs), np.log(ys))))
    if value is not None and value <= at_most:
        return value, None
    return None, at_most if np.isfinite(at_most) else None


def interval(value, seeds):
    """Return the 95% jackknife interval (low, high) of a positive number; (None, None) for a single seed, or if the
    number is unknown without one of the seeds. `value` maps the omitted seed (None: no seed) to the number or None."""
    without = [value(seed) for seed in seeds]
    if len(seeds) < 2 or any(number is None for number in without):
        return None, None
    logs, count = np.log(without), len(seeds)
    error = np.sqrt((count - 1) / count * np.square(logs - logs.mean()).sum())
    factor = float(np.exp(quantile(count - 1) * error))
    return value(None) / factor, value(None) * factor


def equal_errors(curves, targets=None):
    """Return the costs of the curves at equal errors: a list of {"error", "costs": label -> reading}.

    A reading has "value", "at_most", "low", "high", "speed_up", "speed_up_low", "speed_up_high" and
    "speed_up_at_least". "speed_up" is the cost of the first curve over the cost of the label, "speed_up_at_least" the
    former over "at_most". Unknown entries are None; if value and at_most are None, the error is not reached.
    """
    targets = _targets([curve.front()[1] for curve in curves]) if targets is None else targets
    return [
        {"error": target, "costs": {curve.label: _read(curves[0], curve, Curve.cost_at, target) for curve in curves}}
        for target in targets
    ]


def equal_costs(curves, targets=None):
    """Return the errors of the curves at equal costs: a list of {"cost", "errors"} with readings as in `equal_errors`,
    where the speed-up is a ratio of errors."""
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
    """Choose the values for comparisons of curves with these ranges.

    Chooses at most `TARGETS` round numbers (1, 2 or 5 times a power of ten) contained in as many ranges as possible.
    Without a round number, chooses the middle of the common range; without a common range, the two closest ends, so
    that one is a bound.
    """
    ranges = [(float(values.min()), float(values.max())) for values in ranges if values.size]
    if not ranges:
        return []
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    candidates = [float(f"{step}e{int(decade)}") for decade in decades for step in (1, 2, 5)]
    # The number of ranges that contain a value changes only at their ends; test a value between each pair of ends
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
    """Return the set of (label, name) on the Pareto front of all curves, including bounds of hidden errors."""
    means = {(point.label, point.name): mean for point in points if (mean := point.mean()) is not None}
    bounds = [bound for point in points if (bound := point.bound()) is not None]
    kept = set(zip(*map(np.ndarray.tolist, front([*means.values(), *bounds])), strict=True))
    return {key for key, mean in means.items() if mean in kept}
