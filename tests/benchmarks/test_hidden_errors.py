"""Errors that the noise of a reference hides, in the benchmark of direct light."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

ERROR, NOISE = 0.01, 0.002


@pytest.fixture
def adaptivedirect(restore_variant):
    """The benchmark, which sets a variant when it is imported."""
    return importlib.import_module("benchmarks.adaptivedirect")


@pytest.fixture
def raced(adaptivedirect, monkeypatch):
    """Let renders take two seconds, and be as far from the reference as the plugins tell."""

    class Problem(adaptivedirect.Problem):
        def __init__(self, *_):
            self.scene, self.pixels = None, 4
            self.reference = SimpleNamespace(image=np.ones((2, 2, 3)))

        def errors(self, image):
            return {"relmse_trimmed": image.mean(), "noise": {"relmse_trimmed": NOISE}}

    def race(errors):
        """``errors``: of each plugin."""

        def plugin(name, **_):
            return SimpleNamespace(name=name, statistics={"shadow_rays": 8})

        def render(scene, integrator, **_):
            return np.full((2, 2, 3), errors.get(integrator.name, ERROR))

        monkeypatch.setattr(adaptivedirect, "Problem", Problem)
        monkeypatch.setattr(adaptivedirect, "plugin", plugin)
        monkeypatch.setattr(adaptivedirect.mi, "render", render)
        monkeypatch.setattr(adaptivedirect.scenes, "timed", lambda function: (function(), 2.0))
        return SimpleNamespace(error=0.03, width=8, spp=4, against=adaptivedirect.AGAINST)

    return race


@pytest.mark.parametrize("hidden", ["adaptivedirect", "unoccludeddirect"])
def test_times_at_an_error_that_the_noise_hides_are_unknown(adaptivedirect, raced, hidden, capsys):
    (rows,) = adaptivedirect.table(["room"], raced({hidden: 0.0}))
    row, said = rows["room"], capsys.readouterr().out
    assert {label for label, one in row.items() if one.get("hidden")} == (
        {"adaptive", "all"} if hidden == "adaptivedirect" else {"unoccluded"}
    )
    known = {label for label, one in row.items() if "speedup" in one} - {"same rule"}
    assert known == (set() if hidden == "adaptivedirect" else {"adaptive", "all", "direct", "path"})
    assert row["same rule"] == {"speedup": 1, "fewer_rays": 1}
    assert f"2.00, 2, < {NOISE:.5f}" in said and "1.0 | 1.0 | - |" in said


def test_errors_above_the_noise_have_times(adaptivedirect, raced):
    (rows,) = adaptivedirect.table(["room"], raced({"path": 0.03}))
    assert rows["room"]["path"] == pytest.approx(
        {"seconds": 2, "relmse": 0.03, "rays": 2, "hidden": False, "speedup": 3}
    )


def test_the_method_as_printed_is_not_compared_by_hidden_errors(adaptivedirect, raced, capsys):
    (rows,) = adaptivedirect.departures(["room"], raced({"adaptivedirect": 0.0}))
    assert "speedup" not in rows["room"] and rows["room"]["ours"]["hidden"]
    assert capsys.readouterr().out.rstrip().endswith("| -")
