"""Settings of --sweep, order of runs, time left, and cached runs."""

import argparse

import numpy as np
import pytest

from comparison import command_line, images, runs, sweeps, worker
from comparison.command_line import UsageError
from comparison.progress import Progress

TWO = {"path": ("path", {}), "cuts": ("lightcuts", {"max_cut": 500})}


def settings(*texts, integrators=TWO, spp=None, time=None, **more):
    return sweeps.settings(integrators, [sweeps.sweep(text) for text in texts], spp, time, **more)


def test_sweeps_are_parsed():
    assert sweeps.sweep("a:error=0.04, 0.02") == ("a", "error", (0.04, 0.02))
    assert sweeps.sweep("a-b:spp=4,16") == ("a-b", "spp", (4, 16))
    assert sweeps.sweep("a:time=0.5") == ("a", "time", (0.5,))
    assert sweeps.sweep("a:visibility=all,adaptive") == ("a", "visibility", ("all", "adaptive"))
    assert sweeps.sweep("all") == ("all", None, ())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not of the form"),
        ("a:", "not of the form"),
        ("a:error=", "not of the form"),
        ("a:error=1,,2", "not of the form"),
        (":error=1", "not of the form"),
        ("a:=1", "not of the form"),
        ("scenes/cornell.xml", "write --sweep all"),
        ("a:error=0.1,0.10", "a value twice"),
        ("a:spp=1.5", "'1.5' is not a positive whole number"),
        ("a:time=0", "'0' is not a positive number"),
    ],
)
def test_bad_sweeps_are_refused(text, message):
    with pytest.raises(argparse.ArgumentTypeError, match=message):
        sweeps.sweep(text)


def test_settings_without_a_sweep():
    found = settings(time=20.0)
    assert [(one.title, one.spp, one.time, one.swept) for of in found.values() for one in of] == [
        ("path", None, 20.0, {}), ("cuts", None, 20.0, {}),
    ]  # fmt: skip


def test_settings_of_a_sweep():
    found = settings("path:spp=4,16", "cuts:error=0.04,0.02")
    assert [(one.title, one.spp, one.time, one.parameters) for of in found.values() for one in of] == [
        ("path spp=4", 4, None, {}),
        ("path spp=16", 16, None, {}),
        ("cuts error=0.04", sweeps.DEFAULT_SPP, None, {"max_cut": 500, "error": 0.04}),
        ("cuts error=0.02", sweeps.DEFAULT_SPP, None, {"max_cut": 500, "error": 0.02}),
    ]
    assert found["cuts"][0].file_name == "cuts.error=0.04"


def test_several_parameters_make_a_grid():
    found = settings("cuts:error=0.04,0.02", "cuts:spp=1,4", "path:time=1,2")
    assert [one.name for one in found["cuts"]] == [
        "error=0.04,spp=1", "error=0.04,spp=4", "error=0.02,spp=1", "error=0.02,spp=4",
    ]  # fmt: skip
    assert [(one.spp, one.time) for one in found["path"]] == [(None, 1.0), (None, 2.0)]


def test_labels_without_a_sweep_have_their_default():
    found = settings("path:spp=4")
    assert [one.name for one in found["cuts"]] == ["error=0.08", "error=0.04", "error=0.02", "error=0.01"]
    assert {one.spp for one in found["cuts"]} == {sweeps.DEFAULT_SPP}  # as in sweeps that were given
    assert [one.name for one in settings("all")["path"]] == ["spp=4", "spp=16", "spp=64", "spp=256"]


def test_default_sweeps_are_over_samples_too():
    assert [one.name for one in settings("all")["cuts"]] == [
        f"error={error},spp={spp}" for error in ("0.04", "0.01") for spp in (1, 4, 16)
    ]
    assert [one.name for one in settings("all", spp=2)["cuts"]][:2] == ["error=0.08", "error=0.04"]
    assert [one.name for one in settings("cuts", samples=False)["cuts"]][:2] == ["error=0.08", "error=0.04"]


def test_default_sweeps_are_of_parameters_that_exist():
    assert {*sweeps.DEFAULTS, "manylights"} == set(command_line.own_integrators())
    assert sweeps.default_grid("manylights", True) == sweeps.default_grid("path", True)
    for name, (key, values) in sweeps.DEFAULTS.items():
        for value in values:
            command_line.check_parameters(name, name, {key: value})


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["nosuch:spp=1"], "no such label; there are path, cuts"),
        (["path:spp=1", "path:spp=2"], "given twice"),
        (["path:spp=1", "path:time=2"], "over spp or time, not both"),
        (["cuts:max_cut=1,2"], "--param cuts.max_cut fixes"),
        (["cuts:direct=a b,a_b"], "files of the same name"),
    ],
)
def test_settings_that_do_not_fit_are_refused(texts, message):
    with pytest.raises(UsageError, match=message):
        settings(*texts)


def test_runs_take_turns():
    found = settings("path:spp=1,2,3", "cuts:error=0.2,0.1")
    order = [f"{setting.title} {seed}" for setting, seed in sweeps.order(found, [5, 6])]
    assert order == [
        "path spp=1 5", "cuts error=0.2 5", "path spp=2 5", "cuts error=0.1 5", "path spp=3 5",
        "cuts error=0.2 6", "path spp=1 6", "cuts error=0.1 6", "path spp=2 6", "path spp=3 6",
    ]  # fmt: skip


def test_time_left_is_that_of_the_same_settings(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("comparison.progress.time.monotonic", lambda: now[0])
    found = settings("path:spp=1,2", "cuts:error=0.2")
    progress = Progress(["a.xml"], sweeps.order(found, [0, 1]))
    assert progress.seconds_left() is None
    for setting, seconds in ((found["path"][0], 1.0), (found["cuts"][0], 10.0), (found["path"][1], 3.0)):
        progress.begin("a.xml", setting)
        now[0] += seconds
        progress.end(kept=False)
    assert progress.seconds_left() == 1 + 10 + 3
    progress.begin("a.xml", found["cuts"][0])
    now[0] += 4
    assert progress.seconds_left() == 1 + 3 + 6
    progress.end(kept=True)
    progress.skip("a.xml")
    assert progress.seconds_left() == 0
    progress.close()


def test_time_left_is_found_by_sums_and_only_where_somebody_watches(monkeypatch):
    """The progress is updated twice a second beside a measured run."""
    found = settings("path:spp=1,2", "cuts:error=0.2")
    progress = Progress(["a.xml"], sweeps.order(found, range(1000)))
    for seed in range(500):
        for setting in (*found["path"], *found["cuts"]):
            progress.begin("a.xml", setting)
            progress.end(kept=seed % 2 > 0)
    asked, expected = [], progress._expected
    monkeypatch.setattr(progress, "_expected", lambda run: asked.append(run) or expected(run))
    progress.seconds_left()
    assert len(asked) == 3 and len(progress._took) == 6
    asked.clear()
    progress.tick()
    assert progress._bar.disable and not asked
    progress.close()


# --- Runs that are kept ---


def job(tmp_path, **more):
    return worker.Job("a", "path", "s.xml", str(tmp_path / "a.exr"), **more)


def test_runs_are_recognised_by_what_they_depend_on(tmp_path):
    store = runs.Runs(tmp_path, {"versions": {"mitsuba": "1"}})
    key = store.key(job(tmp_path), "hash")
    assert store.key(worker.Job("b", "path", "t.xml", "b.exr", kernel_cache="k"), "hash") == key
    others = {
        store.key(job(tmp_path, **{name: value}), "hash")
        for name, value in (("seed", 1), ("spp", 4), ("budget", 4), ("parameters", {"max_depth": 3}), ("width", 8),
                            ("defines", {"a": "b"}), ("variant", "llvm_ad_mono"), ("threads", 1), ("pass_spp", 1))
    }  # fmt: skip
    others |= {
        store.key(job(tmp_path), "other"),
        runs.Runs(tmp_path, {"versions": {"mitsuba": "2"}}).key(job(tmp_path), "hash"),
    }
    others.add(store.key(job(tmp_path, vpl_folder="f"), "hash"))
    assert len(others) == 12 and key not in others


def test_only_runs_whose_image_is_there_are_found(tmp_path):
    store, one = runs.Runs(tmp_path, {}), job(tmp_path, run="k")
    assert store.find(one) is None
    store.save({"run": "k", "label": "old", "vpl_output": None})
    assert store.find(one) is None  # no image
    _write_image(tmp_path / "a.exr", "other")
    assert store.find(one) is None  # that of another run
    _write_image(tmp_path / "a.exr", "k")
    assert store.find(one)["label"] == "a"
    (tmp_path / "runs" / "k.json").write_text('{"run": "k"')
    assert store.find(one) is None


def _write_image(path, run):
    images.write_exr(path, np.ones((2, 2, 3)), ["R", "G", "B"], {"run": run})


def test_a_folder_has_one_comparison_at_a_time(tmp_path):
    with (
        runs.locked(tmp_path / "lock"),
        pytest.raises(UsageError, match="busy"),
        runs.locked(tmp_path / "lock", "busy"),
    ):
        pass
    with runs.locked(tmp_path / "lock", "busy"):
        pass
