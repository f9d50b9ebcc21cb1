"""Result files of benchmarks: contents, the option `--json`, and refused quantities and numbers."""

import argparse
import json
import subprocess
import sys

import pytest

from benchmarks import results


@pytest.fixture
def run_as(monkeypatch):
    """Set the command line of this process."""

    def set_command(*arguments):
        monkeypatch.setattr(sys, "argv", [str(results.ROOT / "benchmarks" / "lightcuts.py"), *arguments])

    return set_command


def test_a_file_holds_its_origin_and_its_rows(run_as, tmp_path, monkeypatch):
    run_as("--parts", "cold", "--json", "a.json", "--scenes", "kitchen")
    monkeypatch.setattr(results, "commit", lambda: "0123456")
    rows = {"kitchen": {"path": {"seconds": 1 / 3, "hidden": True}, "lights": 4}}
    results.write_results(tmp_path / "a.json", "cold", {"width": 256}, rows)
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["command"] == "./run -- python benchmarks/lightcuts.py --parts cold --scenes kitchen"
    assert found["commit"] == "0123456" and found["part"] == "cold" and found["settings"] == {"width": 256}
    assert found["machine"]["cores"] >= 1
    assert found["rows"] == {"kitchen": {"path": {"seconds": 0.333333, "hidden": True}, "lights": 4}}
    assert set(found["units"]) == {"seconds", "hidden", "lights"}
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_the_commit_tells_of_changes(monkeypatch):
    answers = {"rev-parse": "0123456\n", "status": " M README.md\n"}

    def git(command, **_):
        return argparse.Namespace(stdout=answers[command[1]])

    monkeypatch.setattr(results.subprocess, "run", git)
    assert results.commit() == "0123456+changes"
    answers["status"] = ""
    assert results.commit() == "0123456"


@pytest.mark.parametrize(
    "row, message",
    [({"second": 1.0}, "unknown quantity 'second'"), ({"path": {"seconds": float("nan")}}, "seconds is nan")],
)
def test_unknown_quantities_and_numbers_that_are_not_finite_are_refused(row, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        results.write_results(tmp_path / "a.json", "cold", {}, {"kitchen": row})
    assert not list(tmp_path.iterdir())


def parsed(*arguments):
    parser = argparse.ArgumentParser()
    results.add_options(parser, ["cold", "path", "table"])
    return results.parse(parser, [*map(str, arguments)])


def test_a_file_takes_one_part_and_is_checked_before_the_work(tmp_path, monkeypatch, capsys):
    file = tmp_path / "a.json"
    assert parsed("--json", file, "--parts", "cold").json == file
    assert parsed().parts == ["cold", "path", "table"]
    for arguments, message in (
        (("--json", file, "--parts", "cold", "path"), "--parts names 2"),
        (("--json", tmp_path / "missing" / "a.json", "--parts", "cold"), "no folder"),
        (("--parts", "warm"), "invalid choice: 'warm'"),
    ):
        with pytest.raises(SystemExit):
            parsed(*arguments)
        assert message in capsys.readouterr().err
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit):
        parsed("--json", file, "--parts", "cold")
    assert "--json needs the commit" in capsys.readouterr().err


def test_parts_write_their_rows(tmp_path):
    options = parsed("--json", tmp_path / "a.json", "--parts", "cold")

    def cold():
        yield {"hall": {"seconds": 2.0}}
        written = json.loads((tmp_path / "a.json.partial").read_text())
        assert written["part"] == "cold" and written["rows"] == {"hall": {"seconds": 2.0}}
        yield {"hall": {"seconds": 2.0}, "kitchen": {"seconds": 3.0}}

    results.run_parts(options, {"cold": cold}, {"width": 9})
    assert list(json.loads((tmp_path / "a.json").read_text())["rows"]) == ["hall", "kitchen"]
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_rows_of_an_interrupted_run_become_no_result(tmp_path):
    (tmp_path / "a.json.partial").write_text("{}")
    results.run_parts(parsed("--json", tmp_path / "a.json", "--parts", "cold"), {"cold": lambda: iter(())}, {})
    assert not list(tmp_path.iterdir())


def test_a_variance_needs_two_passes():
    """The benchmark tells before it renders."""
    file = results.ROOT / "benchmarks" / "manylights.py"
    command = [sys.executable, file, "--parts", "denoised", "timed", "--passes", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2
    assert "--passes is 1: allowed are 2 and above for timed" in ended.stderr
