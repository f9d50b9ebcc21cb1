"""compare.py --check: speed-ups that fell since an earlier comparison."""

import json
import shutil

import pytest

import compare
from comparison import analysis, baseline, report
from comparison.command_line import UsageError
from tests.support.comparisons import SWEEP, results_of


def fake_results(speed_up):
    """Results of two integrators with errors inverse to time; the second is faster by the given factor."""
    renders = [
        {
            "label": label, "setting": f"spp={spp}", "seed": 0, "seconds": spp / factor, "rays_per_sample": None,
            "spp": spp, "errors": {"relmse": 1 / spp, "noise": {"relmse": 0}},
        }
        for label, factor in (("path", 1.0), ("fast", speed_up)) for spp in (1, 4, 16)
    ]  # fmt: skip
    scene = {"name": "box", "renders": renders}
    scene |= analysis.analyse(renders, ["path", "fast"], "relmse")
    return {"format": report.FORMAT, "metrics": {"compared": "relmse"}, "scenes": [scene]}


def test_single_points_are_not_compared_as_curves():
    results = fake_results(5)
    one, two = ([("path", f"spp={spp}"), ("fast", f"spp={spp}")] for spp in (4, 16))
    (scene,) = without(results, *one, *two)["scenes"]
    found = analysis.analyse(scene["renders"], ["path", "fast"], "relmse")
    assert len(found["points"]) == 2 and found["equal_errors"] == found["equal_costs"] == {}
    (scene,) = without(fake_results(5), *one, two[0])["scenes"]
    assert analysis.analyse(scene["renders"], ["path", "fast"], "relmse")["equal_errors"]["seconds"]


def test_check_finds_speed_ups_that_fell():
    before = fake_results(5)
    assert baseline.check(fake_results(4.2), before, 0.2) == []
    lines = baseline.check(fake_results(3.5), before, 0.2)
    assert len(lines) == 4 and lines[0].startswith(
        "box: fast over path, seconds at error 0.1: 5× before, 3.5× now, 30%"
    )
    assert baseline.check(fake_results(3.5), before, 0.5) == []


def without(results, *unwanted):
    """The same results without the runs of some (label, setting)."""
    for scene in results["scenes"]:
        scene["renders"] = [one for one in scene["renders"] if (one["label"], one["setting"]) not in unwanted]
    return results


def test_check_finds_errors_that_are_no_longer_reached():
    slow = [("fast", "spp=4"), ("fast", "spp=16")]
    lines = baseline.check(without(fake_results(5), *slow), fake_results(5), 0.2)
    assert len(lines) == 3 and all(line.endswith(": 5× before, not reached now") for line in lines)
    lines = baseline.check(without(fake_results(5), *slow, ("fast", "spp=1")), fake_results(5), 0.2)
    assert len(lines) == 4 and all(line.endswith("no such curves now") for line in lines)
    lines = baseline.check(without(fake_results(5), ("path", "spp=4"), ("path", "spp=16")), fake_results(5), 0.2)
    assert len(lines) == 3 and all(line.endswith("not reached now by the first") for line in lines)


def test_check_lets_pass_what_is_better_than_it_can_tell():
    """Where even the cheapest setting is better than the error, a bound has to do."""
    cheap = [("fast", "spp=1"), ("fast", "spp=4")]
    assert len(baseline.check(without(fake_results(5), *cheap), fake_results(5), 0.2)) == 4
    assert baseline.check(without(fake_results(100), *cheap), fake_results(5), 0.2) == []
    lines = baseline.check(without(fake_results(5), ("path", "spp=1"), ("path", "spp=4")), fake_results(5), 0.2)
    assert lines and all(line.endswith("only bounds are known now") for line in lines)


def test_check_refuses_what_cannot_be_compared(tmp_path):
    file = tmp_path / "a.json"
    file.write_text(json.dumps(fake_results(5)))
    assert baseline.read(file, "relmse", ["box", "other"])["scenes"][0]["name"] == "box"
    with pytest.raises(UsageError, match="none of these scenes"):
        baseline.read(file, "relmse", ["other"])
    with pytest.raises(UsageError, match="are relmse, not rmse"):
        baseline.read(file, "rmse", ["box"])
    for content in ("{}", "[]", '{"format": 1}'):
        file.write_text(content)
        with pytest.raises(UsageError, match=r"is no results\.json of format 2"):
            baseline.read(file, "relmse", ["box"])
    file.write_text(json.dumps(fake_results(5) | {"scenes": []}))
    with pytest.raises(UsageError, match="no speed-ups"):
        baseline.read(file, "relmse", ["box"])


def test_check_sets_the_exit_status(swept, tmp_path, capsys, monkeypatch):
    """With everything finished, nothing is rendered again."""
    monkeypatch.setattr("comparison.worker.run", lambda *_: pytest.fail("rendered again"))
    results = results_of(swept)
    entry = {"value": 1, "at_most": None, "low": None, "high": None, "speed_up": 1e9}
    results["scenes"][0]["equal_errors"]["rays"] = [{"error": 0.05, "costs": {"lightcuts": entry, "vpl": entry}}]
    (tmp_path / "baseline.json").write_text(json.dumps(results))
    out = tmp_path / "sweep"  # a copy: other processes read the original
    shutil.copytree(swept, out)
    again = [*SWEEP, "-o", str(out), "--cache", str(out / "cache"), "--resume", "--check"]
    assert compare.main([*again, str(tmp_path / "baseline.json")]) == 3
    assert "vpl over lightcuts, rays at error 0.05: 1e+09× before" in capsys.readouterr().err
