"""Benchmarks that compare methods at equal error: what they tell of errors that a method does not reach."""

import importlib
from types import SimpleNamespace

import pytest

from tests.support.paths import ROOT

# Mean absolute error of a method by its quality parameter
ERRORS = {
    "lightcuts": lambda error: error,
    "mdlightcuts": lambda error: 0.02 * (error / 0.01) ** 0.6,
    "lightslice": lambda columns: max(0.05, 2 / columns),
}


@pytest.fixture
def module(restore_variant):
    """Import a benchmark, which sets a variant."""
    return lambda name: importlib.import_module(f"benchmarks.{name}")


def made_up(baselines):
    """A problem whose methods have ``ERRORS``, and take a second."""

    class Problem(baselines.Problem):
        shared, pixels = 1.0, 16

        def __init__(self, *_):
            pass

        def plugin(self, kind, **more):
            quality = more.get(baselines.QUALITY[kind].name, 0.01) if kind in baselines.QUALITY else 0.01
            return SimpleNamespace(absolute=ERRORS.get(kind, lambda _: 0.01)(quality))

        def shade(self, plugin):
            stages = {"prediction": 0.5, "separation": 0.25}
            return baselines.Found(1.0, 0.1, plugin.absolute, 8.0, 4.0, stages, {"entries": 64})

    return Problem


def test_an_error_that_is_not_reached_is_told(module, monkeypatch, capsys):
    baselines = module("baselines")
    monkeypatch.setattr(baselines, "Problem", made_up(baselines))
    (rows,) = baselines.equal_errors(["room"], 8, 1, 10, ("mdlightcuts", "lightslice"))
    said, row = capsys.readouterr().out, rows["room"]
    assert {method: row[method]["not_reached"] for method in ERRORS} == {
        "lightcuts": False, "mdlightcuts": False, "lightslice": True,
    }  # fmt: skip
    assert row["mdlightcuts"]["absolute"] == pytest.approx(0.01, rel=0.03)
    (line,) = (line for line in said.splitlines() if "| lightslice," in line)
    assert line.endswith("| 1.0 at most: error not reached") and said.count("not reached") == 1
    assert "speedups of mdlightcuts: 1.00" in said and "speedups of lightslice: at most 1.00" in said


def test_so_it_is_for_methods_beside_matrix_recovery(module):
    recovery = module("matrixrecovery")
    problem = made_up(module("baselines"))()
    found = {label: problem.shade(one) for label, one in recovery._equal_plugins(problem, ("error",)).items()}
    row = recovery._equal_error_row(found, problem)
    assert row["lightslice"]["not_reached"] is True and row["mdlightcuts"]["not_reached"] is False


def test_tables_mark_such_ratios_as_bounds(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    tables = importlib.import_module("tables")
    text, known = tables.table_text("slices"), tables.result("baselines_slices_kitchen")["rows"]["kitchen"]
    assert known["lightslice"]["not_reached"]
    (line,) = (line for line in text.splitlines() if line.startswith("| kitchen"))
    assert line.endswith("| ≤ **0.17** |")
