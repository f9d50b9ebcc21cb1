"""Curves of error against cost, and numbers read from the curves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from comparison import curves
from comparison.curves import Curve, Point
from tests.support.properties import examples

SEEDS = (0, 1, 2)


def point(label, name, cost, error, noise=0.0, scatter=0.0, seed=0):
    """A point at a cost and an error, with lognormal scatter over the seeds."""
    factors = np.exp(scatter * np.random.default_rng(seed).normal(size=(2, len(SEEDS))))
    costs, errors = (dict(zip(SEEDS, mean * of, strict=True)) for mean, of in zip((cost, error), factors, strict=True))
    return Point(label, name, costs, errors, dict.fromkeys(SEEDS, noise))


def power_law(label, factor=1.0, scatter=0.0, first_seed=0):
    """Error = factor / cost, for costs of 1, 4 and 16."""
    points = [
        point(label, f"{index}", 4**index, factor / 4**index, scatter=scatter, seed=first_seed + index)
        for index in range(3)
    ]
    return Curve(label, points)


def test_quantiles_of_student():
    for freedom in (1, 2, 3, 10, 11, 15, 30, 1000):
        assert curves.quantile(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-9)


def test_spread():
    assert curves.spread([2.0]) == {"mean": 2.0, "low": None, "high": None}
    assert curves.spread([0.0, 0.0]) == {"mean": 0.0, "low": None, "high": None}
    found = curves.spread([0.99, 1.0, 1.01])
    assert (found["low"], found["high"]) == pytest.approx(stats.t.interval(0.95, 2, 1, 0.01 / np.sqrt(3)), rel=1e-3)


def test_intervals_hold_the_mean_as_often_as_they_say():
    random, held = np.random.default_rng(0), 0
    for _ in range(2000):
        found = curves.spread(random.normal(1, 0.05, 3))
        held += found["low"] < 1 < found["high"]
    assert held / 2000 == pytest.approx(0.95, abs=0.015)


def test_front_keeps_what_nothing_beats():
    costs, errors = curves.front([(4, 0.1), (1, 1.0), (2, 2.0), (8, 0.1), (3, 0.5), (3, 0.4)])
    assert (costs.tolist(), errors.tolist()) == ([1, 3, 4], [1.0, 0.4, 0.1])
    assert curves.front([])[0].size == 0


@given(st.lists(st.tuples(st.floats(0.1, 10), st.floats(0.1, 10)), max_size=20))
@settings(max_examples=examples(100), deadline=None)
def test_fronts_rise_and_fall(pairs):
    costs, errors = curves.front(pairs)
    assert np.all(np.diff(costs) > 0) and np.all(np.diff(errors) < 0)
    kept = set(zip(costs, errors, strict=True))
    for cost, error in pairs:
        beaten = any(c <= cost and e <= error and (c, e) != (cost, error) for c, e in pairs)
        assert ((cost, error) in kept) != beaten


def test_power_laws_are_read_off_exactly():
    curve = power_law("a")
    assert curve.cost_at(0.5) == (pytest.approx(2), None)
    assert curve.error_at(8) == (pytest.approx(1 / 8), None)
    assert curve.cost_at(1.0) == (pytest.approx(1), None) and curve.cost_at(1 / 16) == (pytest.approx(16), None)


def test_nothing_is_read_off_beyond_the_ends():
    curve = power_law("a")
    assert curve.cost_at(0.06) == (None, None)  # not reached
    assert curve.cost_at(1.1) == (None, 1.0)  # costs less than the cheapest point
    assert curve.error_at(0.9) == (None, None)
    assert curve.error_at(17) == (None, 1 / 16)
    assert Curve("b", []).cost_at(1) == (None, None) and Curve("b", []).error_at(1) == (None, None)


def test_places_are_between_two_settings():
    """Half way in logarithmic axes; beyond the ends it is the setting there, or nothing."""
    curve = power_law("a")
    assert curve.interpolation_weights(2, 0) == pytest.approx({"0": 0.5, "1": 0.5})
    assert curve.interpolation_weights(4**-1.75, 1) == pytest.approx({"1": 0.25, "2": 0.75})
    assert curve.interpolation_weights(4, 0) == {"1": 1.0} and curve.interpolation_weights(1 / 16, 1) == {"2": 1.0}
    assert curve.interpolation_weights(17, 0) == {"2": 1.0} and curve.interpolation_weights(2, 1) == {"0": 1.0}
    assert (
        curve.interpolation_weights(0.9, 0)
        == curve.interpolation_weights(0.06, 1)
        == Curve("b", []).interpolation_weights(1, 0)
        == {}
    )
    beaten = Curve("c", [point("c", "1", 1, 0.5), point("c", "2", 2, 0.6), point("c", "3", 4, 0.125)])
    assert beaten.interpolation_weights(2, 0) == pytest.approx({"1": 0.5, "3": 0.5})
    hidden = Curve("d", [point("d", "1", 1, 1.0), point("d", "2", 4, 0.25, noise=0.3), point("d", "3", 8, 0.5)])
    assert (
        hidden.interpolation_weights(0.5, 1) == hidden.interpolation_weights(20, 0) == {"2": 1.0}
        and hidden.interpolation_weights(0.29, 1) == {}
    )
    alike = Curve("e", [point("e", "1", 16, 0.1, noise=0.3), point("e", "2", 2, 0.2, noise=0.3)])
    assert alike.interpolation_weights(4, 0) == {"2": 1.0}


def test_what_the_noise_hides_is_in_no_curve():
    curve = Curve("a", [point("a", "1", 1, 1.0), point("a", "2", 4, 0.25, noise=0.3)])
    assert curve.front()[0].tolist() == [1.0]
    assert curves.pareto(curve.points) == {("a", "1")}


def test_what_the_noise_hides_is_a_bound():
    """The true error is at most the noise: a larger error is reached, a smaller error may or may not be."""
    curve = Curve("a", [point("a", "1", 1, 1.0), point("a", "2", 4, 0.25, noise=0.3), point("a", "3", 8, 0.5)])
    assert curve.cost_at(0.7)[0] == pytest.approx(8 ** (np.log(0.7) / np.log(0.5)))
    assert curve.cost_at(0.5) == (None, 4)  # not the 8 of the curve
    assert curve.cost_at(0.3) == (None, 4) and curve.cost_at(0.29) == (None, None)
    assert curve.error_at(2)[0] == pytest.approx(2 ** (np.log(0.5) / np.log(8)))
    assert curve.error_at(4) == curve.error_at(20) == (None, 0.3)
    assert curves.pareto(curve.points) == {("a", "1")}
    hidden = Curve("b", [point("b", "1", 2, 0.0, noise=0.1)])
    assert hidden.cost_at(0.2) == (None, 2) and hidden.error_at(1) == (None, None)
    found = curves.equal_errors([power_law("c"), hidden], [0.125])[0]["costs"]["b"]
    assert found["speed_up"] is None and found["speed_up_at_least"] == pytest.approx(4)


def test_speed_up_at_equal_error():
    slow, fast = power_law("slow", 1.0), power_law("fast", 0.2)
    entries = curves.equal_errors([slow, fast])
    assert [entry["error"] for entry in entries] == [0.1, 0.2]
    for entry in entries:
        assert entry["costs"]["fast"]["speed_up"] == pytest.approx(5)
        assert entry["costs"]["slow"]["speed_up"] == pytest.approx(1)
        assert entry["costs"]["fast"]["value"] == pytest.approx(0.2 / entry["error"])
    beyond = curves.equal_errors([slow, fast], [0.05])[0]["costs"]
    assert beyond["slow"]["value"] is None and beyond["slow"]["at_most"] is None
    assert beyond["fast"]["value"] == pytest.approx(4) and beyond["fast"]["speed_up"] is None
    cheap = curves.equal_errors([slow, fast], [0.4])[0]["costs"]["fast"]
    assert (cheap["value"], cheap["at_most"], cheap["speed_up"]) == (None, 1, None)
    assert cheap["speed_up_at_least"] == pytest.approx(2.5)


def test_error_at_equal_cost():
    entry = curves.equal_costs([power_law("a", 1.0), power_law("b", 0.2)], [2.0])[0]
    assert entry["errors"]["b"]["value"] == pytest.approx(0.1)
    assert entry["errors"]["b"]["speed_up"] == pytest.approx(5)


def test_intervals_of_what_is_read_off():
    exact = curves.equal_errors([power_law("a"), power_law("b", 0.5)], [0.2])[0]["costs"]["b"]
    assert exact["low"] == pytest.approx(exact["value"]) == pytest.approx(exact["high"])
    held, total = 0, 300
    for trial in range(total):
        pair = [
            power_law("a", scatter=0.05, first_seed=1000 * trial),
            power_law("b", 0.5, scatter=0.05, first_seed=1000 * trial + 10),
        ]
        found = curves.equal_errors(pair, [0.2])[0]["costs"]["b"]
        assert found["speed_up_low"] < found["speed_up"] < found["speed_up_high"]
        held += found["speed_up_low"] < 2 < found["speed_up_high"]
    assert held / total == pytest.approx(0.95, abs=0.04)


def test_a_seed_that_does_not_reach_leaves_no_interval():
    noisy = Point("a", "2", dict.fromkeys(SEEDS, 4.0), {0: 0.01, 1: 0.3, 2: 0.3}, dict.fromkeys(SEEDS, 0.0))
    curve = Curve("a", [point("a", "1", 1, 1.0), noisy])
    found = curves.equal_errors([curve, power_law("b")], [0.25])[0]["costs"]["a"]
    assert found["value"] is not None and found["low"] is None


def test_targets_are_round_and_shared():
    assert curves._targets([np.array([0.03, 0.3]), np.array([0.015, 0.12])]) == [0.05, 0.1]
    assert curves._targets([np.array([0.3, 0.45]), np.array([0.33, 0.6])]) == [0.385]
    assert curves._targets([np.array([0.001, 1.0])]) == [0.001, 0.01, 0.1, 1.0]
    assert curves._targets([np.array([]), np.array([])]) == []
    assert curves._targets([np.array([0.1, 3.0]), np.array([0.01, 0.04])]) == [0.04, 0.1]  # nothing shared


def test_pareto_front_is_of_all_labels():
    points = [*power_law("a").points, point("b", "0", 2, 0.2), point("b", "1", 20, 0.2)]
    assert curves.pareto(points) == {("a", "0"), ("b", "0"), ("a", "2")}
