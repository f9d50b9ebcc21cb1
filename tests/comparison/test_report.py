"""Files that a sweep writes, and strips of pictures."""

import html
import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import compare
from comparison import analysis, images, metrics, plots, references, strip, tables
from tests.support.comparisons import results_of
from tests.support.paths import CORNELL

# --- results.json ---


def test_sweep_has_points_with_intervals(swept):
    results = results_of(swept)
    (scene,) = results["scenes"]
    assert (results["seeds"], results["complete"], len(scene["renders"])) == ([0, 1], True, 10)
    points = {(point["label"], point["setting"]): point for point in scene["points"] if point["cost"] == "seconds"}
    assert list(points) == [
        ("path", "spp=1"), ("lightcuts", "error=0.4"), ("vpl", "vpl_count=2000"), ("path", "spp=8"),
        ("lightcuts", "error=0.1"),
    ]  # fmt: skip
    assert points["path", "spp=8"]["error"]["mean"] < 0.3 * points["path", "spp=1"]["error"]["mean"]
    for point in points.values():
        assert point["seeds"] == [0, 1] and point["error"]["low"] < point["error"]["mean"] < point["error"]["high"]
    assert {point["label"] for point in scene["points"] if point["cost"] == "rays"} == {"lightcuts", "vpl"}
    assert any(point["pareto"] for point in scene["points"])
    lightcuts, every = (points[key] for key in (("lightcuts", "error=0.1"), ("vpl", "vpl_count=2000")))
    assert lightcuts["error"]["mean"] == pytest.approx(every["error"]["mean"], rel=0.3)


def test_runs_share_lights_and_say_how_they_were_made(swept):
    renders = results_of(swept)["scenes"][0]["renders"]
    assert [render["seed"] for render in renders] == [0] * 5 + [1] * 5
    lights = {
        (render["seed"], json.dumps(render["statistics"]["lights"])) for render in renders if render["label"] != "path"
    }
    assert len(lights) == 2  # a set of lights a seed
    # An empty kernel cache is found once by each label.
    assert [render["label"] for render in renders if render["cold_seconds"] is not None] == ["path", "lightcuts", "vpl"]
    assert all(render["load_average"] >= 0 and 0 <= render["errors"]["flip"] <= 1 for render in renders)
    for render in renders:
        assert images.read_exr_metadata(render["output"])["run"] == render["run"]
    assert len({render["run"] for render in renders}) == 10


def test_automatic_reference_is_good_enough(swept):
    (scene,) = results_of(swept)["scenes"]
    shares = [
        np.sqrt(render["errors"]["noise"]["relmse_trimmed"] / render["errors"]["relmse_trimmed"])
        for render in scene["renders"]
    ]
    assert scene["reference_share"] == pytest.approx(max(shares)) and max(shares) <= 0.9
    assert scene["reference"]["spp"] >= 64


def test_automatic_reference_is_continued_up_to_its_limit(tmp_path, swept, capsys):
    few = [CORNELL, "-i", "path", "--width", "24", "--max-depth", "3", "--spp", "128", "-o", str(tmp_path)]
    status = compare.main([*few, "-r", "path:auto:0.01", "--reference-limit", "100", "--cache", str(tmp_path)])
    assert status == 0
    scene = results_of(tmp_path)["scenes"][0]
    assert scene["reference"]["spp"] == 100 and scene["reference_share"] > 0.01
    assert "stopped at --reference-limit" in capsys.readouterr().out


def test_a_reference_that_hides_an_error_is_reported(tmp_path, capsys, monkeypatch):
    """Errors of zero, of which the noise has an infinite share, are written all the same."""
    compared = metrics.compare
    monkeypatch.setattr(metrics, "compare", lambda *given: compared(*given) | {"relmse_trimmed": 0.0})
    few = [CORNELL, "-i", "path", "--width", "16", "--spp", "1", "-o", str(tmp_path), "--cache", str(tmp_path)]
    assert compare.main([*few, "-r", "path:auto", "--reference-limit", "64"]) == 0
    assert results_of(tmp_path)["scenes"][0]["reference_share"] is None
    assert "with noise larger than an error" in capsys.readouterr().out


def test_references_that_are_no_use_lose_nothing_else(tmp_path, capsys):
    """A black and a non-finite reference: the report covers the runs and the remaining scenes. A depth that another
    program wrote as text counts as a depth."""
    for name, value in (("black", 0.0), ("bright", np.inf), ("cornell", 1.0)):
        (tmp_path / f"{name}.xml").write_text(Path(CORNELL).read_text())
        image, error, described = np.full((16, 16, 3), value), np.full((16, 16, 3), 0.1), {"max_depth": "6"}
        references.write(tmp_path / f"{name}.exr", image, error, described)
    scenes = [str(tmp_path / f"{name}.xml") for name in ("black", "bright", "cornell")]
    out = tmp_path / "out"
    assert compare.main([*scenes, "-i", "path", "--spp", "1", "-r", str(tmp_path), "-o", str(out)]) == 1
    black, bright, cornell = results_of(out)["scenes"]
    assert black["error"] == "the reference is black" and black["renders"][0]["seconds"] > 0
    assert "has 256 pixels that are not finite" in bright["error"] and bright["renders"] == []
    assert "error" not in cornell and cornell["renders"][0]["errors"]["relmse"] > 0
    assert "the reference is black" in (out / "report.html").read_text()


def test_tables_have_a_row_a_setting(swept):
    (scene,) = results_of(swept)["scenes"]
    rows = tables.rows(scene)
    assert all(len(row) == len(tables.COLUMNS) for row in rows)
    assert [row[0] for row in rows] == [
        "path spp=1", "path spp=8", "lightcuts error=0.4", "lightcuts error=0.1", "vpl vpl_count=2000",
    ]  # fmt: skip
    cold = tables.COLUMNS.index("cold [s]")
    assert [bool(row[cold]) for row in rows] == [True, False, True, False, True]
    low, high = map(float, rows[0][tables.COLUMNS.index("95%")].split(" to "))
    assert low < float(rows[0][tables.COLUMNS.index("trimmed")]) < high


def test_table_and_curves_agree_on_what_the_noise_hides():
    """Of errors on both sides of the noise, the mean counts; relative L1 has to be more than the noise."""

    def row_and_points(metric, noise, *errors):
        renders = [
            {"label": "a", "setting": "", "seed": seed, "seconds": 1.0, "cold_seconds": None, "spp": 1,
             "rays_per_sample": None, "bounds_per_sample": None, "peak_memory_bytes": 1, "load_average": 0.0,
             "errors": dict.fromkeys(metrics.NAMES, error) | {
                 "noise": dict.fromkeys(metrics.NAMES, noise), "flip": 0.1, "bias": 0.0, "bad_pixels": 0,
                 "below_noise": []}}
            for seed, error in enumerate(errors)
        ]  # fmt: skip
        (row,) = tables.rows({"renders": renders} | analysis.analyse(renders, ["a"], metric))
        ((_, (point,)), _) = analysis.points_by_cost(renders, metric)
        assert (row[tables.COLUMNS.index("95%")] == "") == (point.mean() is None)
        return row, point

    row, point = row_and_points("relmse", 1.0, 0.5, 1.4)
    assert row[tables.COLUMNS.index("relMSE")] == "< 1" and point.mean() is None
    row, point = row_and_points("relmse", 1.0, 0.8, 1.3)
    assert row[tables.COLUMNS.index("relMSE")] == "1.05" and point.mean() == (1, pytest.approx(1.05))
    assert row[tables.COLUMNS.index("rel. L1")] == "< 141.42%"
    assert row_and_points("relative_l1", 1.0, 0.8, 1.3)[1].mean() is None
    row, point = row_and_points("relative_l1", 1.0, 1.5, 1.6)
    assert row[tables.COLUMNS.index("rel. L1")] == "155.00%" and point.mean() is not None


def test_numbers_have_no_exponents():
    assert [tables.number(value) for value in (0.00012345, 0.5, 99.94, 999.4, 999.6, 16384.0)] == [
        "0.000123", "0.5", "99.9", "999", "1000", "16384",
    ]  # fmt: skip


def test_failures_say_how_often():
    renders = [{"label": "a", "setting": "", "seed": seed, "error": "no memory"} for seed in (0, 1)]
    assert tables.rows({"renders": renders[:1]}) == [("a", "no memory")]
    assert tables.rows({"renders": renders}) == [("a", "no memory (2 of 2 seeds)")]


def reading(**given):
    names = ("value", "at_most", "low", "high", "speed_up", "speed_up_low", "speed_up_high", "speed_up_at_least")
    return dict.fromkeys(names) | given


def test_readings_say_what_is_not_known():
    costs = {
        "a": reading(value=2.0, speed_up=1.0),
        "b": reading(value=0.5, speed_up=4.0, speed_up_low=3.0, speed_up_high=5.333),
        "c": reading(at_most=0.4, speed_up_at_least=5.0),
        "d": reading(at_most=4000.0, speed_up_at_least=0.0005),
        "e": reading(),
    }
    head, row = tables.equal_errors({"equal_errors": {"seconds": [{"error": 0.1, "costs": costs}]}}, "seconds")
    assert head == ["error", "a", "b", "c", "d", "e"]
    assert row == ["0.1", "2", "0.5 (4×, 3 to 5.33)", "≤ 0.4 (≥ 5×)", "≤ 4000", "not reached"]
    assert tables.equal_costs({}, "seconds") == []


def of_budget(label, *seconds, budget=10.0, denoised=False):
    """Runs of an integrator with some seeds."""
    return [
        {
            "label": label,
            "setting": "",
            "seed": seed,
            "load_average": 0.0,
            "budget": budget,
            "seconds": one,
            "denoised": denoised,
        }
        for seed, one in enumerate(seconds)
    ]


def test_times_that_are_not_equal_are_named():
    failed = [
        {"label": "c", "setting": "", "load_average": 0.0, "budget": 10.0, "error": "no memory", "denoised": False}
    ]
    renders = of_budget("a", 9.0, 11.0) + of_budget("b", 10.9) + failed
    assert tables.warnings({"renders": renders}, cores=2) == []
    renders += of_budget("long", 14.0) + of_budget("other", 20.0, budget=20.0)
    (warning,) = tables.warnings({"renders": renders}, cores=2)
    assert warning == "Not at equal time: of 10 s, a took 10 s and long 14 s."
    given_samples = of_budget("a", 1.0, budget=None) + of_budget("b", 9.0, budget=None)
    assert tables.warnings({"renders": given_samples}, cores=2) == []
    # The denoiser works after the budget
    denoised = [run for label in "ab" for run in of_budget(f"{label}, denoised", 13.0, denoised=True)]
    assert tables.warnings({"renders": of_budget("a", 9.0, 11.0) + denoised}, cores=2) == []


def test_errors_that_the_noise_hides_are_named():
    points = [
        {"label": label, "setting": "spp=4", "cost": cost, "below_noise": label != "b"}
        for cost in analysis.COSTS for label in "abc"
    ]  # fmt: skip
    (warning,) = tables.warnings({"renders": [], "points": points}, cores=2)
    assert "hides the error of a spp=4, c spp=4; use" in warning


def test_a_busy_machine_is_named():
    scene = {"renders": of_budget("a", 1.0) + of_budget("b", 1.0)}
    scene["renders"][1]["load_average"] = 3.5
    assert tables.warnings(scene, cores=4) == []
    assert "load 3.5 on 2 cores" in tables.warnings(scene, cores=2)[0]


def test_errors_at_one_setting_each_are_bars():
    renders = [
        run | {"rays_per_sample": None, "errors": {"relmse": error, "noise": {"relmse": noise}}}
        for run, error, noise in (
            (of_budget("a", 3.0)[0], 0.1, 0.0), (of_budget("b", 4.0)[0], 0.02, 0.05), (of_budget("c", 5.0)[0], 0.0, 0.0)
        )
    ]  # fmt: skip
    ((_, of), _) = analysis.points_by_cost(renders, "relmse")
    svg = plots.error_bars(of, ["a", "b", "c"], "relmse")
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    assert {"a", "b", "c", "0.1, 3 s", "&lt; 0.05, 4 s"} <= set(texts)
    assert "currentColor" in svg and "#010203" not in svg


def test_page_begins_with_the_verdict(swept):
    """The sentence, warnings, and a table of scenes and integrators."""
    results, page = results_of(swept), (swept / "report.html").read_text()
    page = html.unescape(page)
    (first, *_) = results["summary"]["sentences"]
    places = [page.index(text) for text in (f'<p class="headline">{first}', '<table class="summary">', "<h2>cornell")]
    assert places == sorted(places)
    for scene in results["scenes"]:
        for warning in tables.scene_warnings(scene):
            assert page.index(warning) < places[1]
    assert results["summary"]["base"] == "path" and list(results["summary"]["scenes"]["cornell"]) == [
        "path", "lightcuts", "vpl",
    ]  # fmt: skip
    assert "error ratio" in page and "are relative to path;" in page


def test_unequal_samplers_are_named():
    def warnings(sampler="independent", **parameters):
        renders = [{"integrator": name, "parameters": parameters} for name in ("path", "manylights")]
        return tables._unequal_samplers({"sampler": sampler, "renders": renders})

    assert len(warnings()) == len(warnings(stratified=True)) == 1
    assert warnings("multijitter") == warnings(stratified=False) == []


# --- Strips ---


def test_strip_of_pictures(swept, tmp_path, capsys):
    output = tmp_path / "strip.png"
    assert strip.main([str(swept), "--output", str(output)]) == 0
    assert "made by: compare.py" in capsys.readouterr().out
    pixels = images.read_png(output)
    assert pixels.shape == (24 + 45, 11 * 28 - 4, 3)  # five settings, the reference, five errors
    expected = images.read_png(swept / "cornell.path.spp=1.png")
    np.testing.assert_array_equal(pixels[:24, :24], expected)
    assert pixels[24:].min() < 128  # captions
    assert "compare.py" in mi.Bitmap(str(output)).metadata()["command"]


def test_a_row_for_every_scene_that_is_named(swept, tmp_path):
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    assert strip.main([str(swept), "--output", str(one)]) == 0
    assert strip.main([str(swept), "--scene", "cornell", "cornell", "--output", str(two)]) == 0
    row, rows = images.read_png(one), images.read_png(two)
    np.testing.assert_array_equal(rows, np.concatenate([row, row]))
    np.testing.assert_array_equal(strip.below([row, row[:, :50]])[len(row) :, 50:], 255)


def test_strips_without_a_common_reference(swept):
    results = results_of(swept)
    (scene,) = results["scenes"]
    shown = [file for file, _ in strip.panels(results, None)]
    assert len(shown) == 11 and all((swept / f"{file}.png").is_file() for file in shown)
    del scene["reference"]
    assert [file for file, _ in strip.panels(results, None)] == [file for file in shown if file != "cornell.reference"]
    errors = scene["renders"][0]["errors"]
    errors["relmse_trimmed"], errors["noise"]["relmse_trimmed"] = 0.1, 0.2
    assert "error of path spp=1\ntrimmed relMSE < 0.2" in [caption for _, caption in strip.panels(results, None)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--scene", "nosuch"], "there are cornell"), (["--output", "/no/folder.png"], "no folder")],
)
def test_strip_refuses(swept, tmp_path, capsys, arguments, message):
    given = arguments if "--output" in arguments else [*arguments, "--output", str(tmp_path / "a.png")]
    assert strip.main([str(swept), *given]) == 2
    assert message in capsys.readouterr().err


def test_strip_needs_a_comparison(tmp_path, capsys):
    assert strip.main([str(tmp_path), "--output", str(tmp_path / "a.png")]) == 2
    assert "no results.json in" in capsys.readouterr().err
