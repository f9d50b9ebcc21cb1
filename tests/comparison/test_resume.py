"""Comparisons that are interrupted, killed, and go on."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import compare
from comparison import images, runs, worker
from tests.support.comparisons import SCHEMA
from tests.support.marks import stress
from tests.support.paths import CORNELL, ROOT
from tests.support.processes import PATIENCE, wait_until


def command(out):
    return [
        CORNELL, "-i", "path", "--width", "16", "--sweep", "path:time=0.2,0.4", "--seeds", "3", "--reference",
        "path:16", "--cache", str(out / "cache"), "-o", str(out),
    ]  # fmt: skip


def finished(out):
    return set((out / "runs").glob("*.json"))


def start(out, *more):
    """Start a comparison, and return its process when it has finished two runs."""
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "compare.py"), *command(out), *more], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    wait_until(lambda: len(finished(out)) >= 2, process)
    return process


def workers_of(out):
    """The processes that render into a folder."""
    found = []
    for status in Path("/proc").glob("[0-9]*/environ"):
        try:
            if (
                str(out).encode() in status.read_bytes()
                and b"comparison.worker" in (status.parent / "cmdline").read_bytes()
            ):
                found.append(int(status.parent.name))
        except OSError:
            pass  # it has just ended, or is somebody else's
    return found


@pytest.mark.parametrize("signal_number", [signal.SIGINT, *stress(signal.SIGTERM)])
def test_interruption_leaves_a_report_of_what_is_finished(tmp_path, signal_number):
    process = start(tmp_path)
    process.send_signal(signal_number)
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert errors == f"\ncompare: interrupted; finished runs are in {tmp_path}; --resume continues\n"
    results = json.loads((tmp_path / "results.json").read_text())
    jsonschema.validate(results, SCHEMA, jsonschema.Draft202012Validator)
    renders = results["scenes"][0]["renders"]
    assert not results["complete"] and len(renders) == len(finished(tmp_path)) >= 2
    assert all("errors" in render for render in renders)
    assert "interrupted" in (tmp_path / "report.html").read_text()
    assert "path time=0.2" in output
    assert not list(tmp_path.glob(".*.exr")) and not (tmp_path / "runs" / "kernels").exists()


@pytest.mark.stress
def test_killed_comparison_goes_on_where_it_stopped(tmp_path, monkeypatch):
    process = start(tmp_path)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait_until(lambda: not workers_of(tmp_path))  # they end with it
    (tmp_path / ".cornell.path.123.exr").write_text("as if killed while writing")
    before = {file: file.read_text() for file in finished(tmp_path)}

    made, run = [], worker.run
    monkeypatch.setattr(worker, "run", lambda job, tick: made.append(job) or run(job, tick))
    assert compare.main([*command(tmp_path), "--resume"]) == 0
    assert len(made) == 6 - len(before) and not (tmp_path / ".cornell.path.123.exr").exists()
    assert len(finished(tmp_path)) == 6 and all(file.read_text() == text for file, text in before.items())
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["complete"] and len(results["scenes"][0]["renders"]) == 6

    made.clear()
    assert compare.main([*command(tmp_path), "--resume", "--max-depth", "2", "--seeds", "1"]) == 0
    assert len(made) == 2  # other parameters, other runs
    assert compare.main([*command(tmp_path), "--resume", "--seeds", "1"]) == 0
    assert len(made) == 4  # the previous run overwrote these images


@pytest.mark.stress
def test_two_comparisons_do_not_share_a_folder(tmp_path, capsys):
    process = start(tmp_path)
    try:
        assert compare.main(command(tmp_path)) == 2
        assert "another comparison is writing to" in capsys.readouterr().err
    finally:
        process.kill()
        process.communicate()


# Writes beyond a file size limit fail as on a full disk
LIMITED = """
import resource, runpy, sys
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
sys.argv.pop(0)
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize(
    ("limit", "printed", "unwritten"),
    [(100, r"^path: FAILED: .*cornell\.path\.", "results.json"), *stress((12_000, r"^path +1 ", "report.html"))],
)
def test_a_full_disk_is_reported_with_the_name_of_the_file_and_the_comparison_goes_on(
    tmp_path, limit, printed, unwritten
):
    """No file could be written, or all except for the report."""
    reference, out = tmp_path / "reference.exr", tmp_path / "out"
    images.write_exr(reference, np.ones((16, 16, 3)), ["R", "G", "B"])
    arguments = [CORNELL, "-i", "path", "--spp", "1", "--reference", str(reference), "-o", str(out)]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(limit), str(ROOT / "compare.py"), *arguments],
        capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert re.search(printed, done.stdout, re.MULTILINE)
    assert done.stderr.splitlines()[-1] == f"compare: [Errno 27] File too large: '{out / unwritten}'"
    assert not list(out.glob(".*.*"))
    assert compare.main([*arguments, "--resume"]) == 0
    results = json.loads((out / "results.json").read_text())
    assert results["complete"] and "errors" in results["scenes"][0]["renders"][0]
    assert (out / "report.html").is_file() and not list(out.glob(".*.*"))


HOSTILE = {
    "not finite": {"spp": float("nan"), "seconds": float("inf")},
    "markup": {"spp": "many", "integrator": "<script>alert(1)</script>", "scene": "\x01</script>", "file": "elsewhere"},
    "large": {"spp": -5, "seconds": 1e300, "command": "x" * 100_000},
}


@pytest.mark.parametrize("metadata", ["markup", *stress("not finite", "large")])
def test_hostile_metadata_of_a_reference_does_not_spoil_the_report(tmp_path, metadata):
    reference, out = tmp_path / "reference.exr", tmp_path / "out"
    images.write_exr(reference, np.ones((16, 16, 3)), ["R", "G", "B"], HOSTILE[metadata])
    assert compare.main([CORNELL, "-i", "path", "--spp", "1", "--reference", str(reference), "-o", str(out)]) == 0

    def refused(constant):
        raise AssertionError(constant)

    results = json.loads((out / "results.json").read_text(), parse_constant=refused)
    jsonschema.validate(results, SCHEMA, jsonschema.Draft202012Validator)
    assert "<script>alert" not in (out / "report.html").read_text()


def test_a_run_that_cannot_be_kept_is_a_failure(tmp_path, monkeypatch):
    def save(self, result):
        raise OSError(28, "No space left on device", "run.json")

    monkeypatch.setattr(runs.Runs, "save", save)
    arguments = [CORNELL, "-i", "path", "--width", "16", "--spp", "1", "--reference", "vpl"]
    assert compare.main([*arguments, "-o", str(tmp_path)]) == 1
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["scenes"][0]["renders"][0]["error"] == "[Errno 28] No space left on device: 'run.json'"
