"""The tables of the papers: values from made-up runs, and the places of display."""

import json

import jsonschema
import pytest

from comparison import metrics, paper_tables, report
from comparison.published import TABLES
from comparison.quantities import QUANTITIES
from tests.support.comparisons import SCHEMA, results_of

ALL = dict.fromkeys(metrics.NAMES, 0.0)


def run(integrator, setting="", error=0.1, **given):
    """The result of a run with the same value for all errors."""
    noise = dict.fromkeys(metrics.NAMES, given.pop("noise", 0.0))
    return {
        "label": integrator, "integrator": integrator, "setting": setting, "parameters": {}, "seed": 0, "budget": None,
        "seconds": 1.0,
        "spp": 1, "passes": 1, "rays_per_sample": None, "bounds_per_sample": None, "cut_size_per_sample": None,
        "peak_memory_bytes": 1e9, "statistics": {}, "errors": dict.fromkeys(metrics.NAMES, error) | {"noise": noise},
    } | given  # fmt: skip


def stages(**seconds):
    return {"statistics": {"seconds": seconds}}


def table(renders, paper, name):
    """The table of a name; all are checked against the schema."""
    found = {(one["paper"], one["table"]): one for one in paper_tables.make(renders)}
    for one in found.values():
        jsonschema.validate(one, {"$ref": "#/$defs/paper_table", "$defs": SCHEMA["$defs"]})
    return found[paper, name]


def values(entry, label, name):
    return [row["values"][name] for row in entry["rows"] if row["label"] == label]


def names(renders):
    return [f"{one['paper']} {one['table']}" for one in paper_tables.make(renders)]


# --- Which tables there are ---


@pytest.mark.parametrize(
    ("integrators", "expected"),
    [
        (["path", "vpl"], []),
        (["lightcuts", "lightslice"], []),
        (["illuminationcut"], []),
        (["lightcuts", "illuminationcut"], ["IC Table 1", "IC Table 5"]),
        (["unoccludeddirect"], []),
        (["adaptivedirect"], ["IAS Tables 4 and 6"]),
        (["unoccludeddirect", "adaptivedirect"], ["IAS Tables 2 and 3, same rule", "IAS Tables 4 and 6"]),
        (["mdlightcuts", "lightslice"], []),
        (["matrixrecovery"], ["MSR Table 1, equal quality"]),
    ],
)
def test_tables_need_their_integrators(integrators, expected):
    assert names([run(integrator) for integrator in integrators]) == expected


def test_runs_that_failed_fill_no_table():
    failed = {"label": "lightcuts", "integrator": "lightcuts", "setting": "", "error": "no memory", "parameters": {}}
    assert names([failed, run("illuminationcut")]) == []


def test_samples_and_parameters_choose_the_table():
    pair = ("lightcuts", "illuminationcut")
    assert names([run(one, spp=4) for one in pair]) == ["IC Table 5", "IC Table 6"]
    strict = [run(one, parameters={"error": 0.001}) for one in pair]
    assert names(strict) == ["IC Table 1", "IC Table 3", "IC Table 5"]
    assert names([run("lightcuts", parameters={"max_cut": 500})]) == ["IC Table 4"]


def test_visibility_tells_both_methods_of_illuminationcut():
    sampled = run("illuminationcut", label="sampled", parameters={"visibility": "adaptive"})
    traced = run("illuminationcut", parameters={"visibility": "all"})
    found = table([run("lightcuts"), sampled, traced], "IC", "Table 1")
    assert [row["method"] for row in found["rows"]] == ["LC(1%)", "IC-S(1%)", "IC(1.5%)"]
    assert [one["method"] for one in found["published"]] == ["LC(1%)", "IC(1.5%)", "IC-S(1%)"]


# --- Runs without interpolation ---


def test_plain_runs_are_means_with_ratios_to_the_first():
    lightcuts = [
        run("lightcuts", seed=seed, seconds=seconds, rays_per_sample=90.0, **stages(trace=1.0, tree=1.0, cut=3.0))
        for seed, seconds in enumerate((7.0, 9.0))
    ]
    faster = run("illuminationcut", seconds=4.0, bounds_per_sample=20.0, **stages(trace=1.0, tree=1.0))
    found = table([*lightcuts, faster], "IC", "Table 1")
    assert found["equal"] is None
    assert values(found, "lightcuts", "light_seconds") == [2.0] and values(found, "lightcuts", "speed_up") == [1.0]
    assert values(found, "lightcuts", "render_seconds") == [6.0] and values(found, "lightcuts", "rays") == [90.0]
    assert values(found, "illuminationcut", "render_seconds") == [2.0]
    assert values(found, "illuminationcut", "speed_up") == [3.0]
    assert values(found, "illuminationcut", "rays") == [None]
    (shown, _) = paper_tables.shown({"paper_tables": paper_tables.make([*lightcuts, faster])})
    assert "Single settings, means" in shown["reading"] and "ratios are not at equal error" in shown["reading"]
    assert shown["rows"][1] == ["illuminationcut", "2", "2", "n/a", "20", "n/a", "0.1", "10.00%", "3"]


def test_given_seconds_have_no_ratios_and_labels_stay_together():
    pair = [run("lightcuts", budget=20.0), run("illuminationcut", budget=20.0)]
    assert values(table(pair, "IC", "Table 1"), "illuminationcut", "speed_up") == [None]
    mixed = [run(one, setting) for setting in ("a", "b") for one in ("lightcuts", "illuminationcut")]
    found = table(mixed, "IC", "Table 5")["rows"]
    assert [(row["label"], *row["settings"]) for row in found] == [
        ("lightcuts", "a"), ("lightcuts", "b"), ("illuminationcut", "a"), ("illuminationcut", "b"),
    ]  # fmt: skip


def test_published_figures_are_ranges_and_ratios_scene_by_scene():
    found = table([run("lightcuts"), run("illuminationcut")], "IC", "Table 1")
    first, other = (one["figures"] for one in found["published"])
    assert first["render_seconds"] == {"low": 116.71, "high": 749.41}
    assert (other["bounds"], "rmse" in other) == ({"low": 69, "high": 236}, False)
    assert other["speed_up"] == {"low": pytest.approx(116.71 / 36.94), "high": pytest.approx(183.07 / 43.04)}
    (shown, _) = paper_tables.shown({"paper_tables": [found, found]})
    assert shown["classes"] == ["", "", "published", "published"]
    assert shown["rows"][-1][0] == "[IC] IC(1.5%)" and shown["rows"][-1][-1] == "3.16–4.25"


def test_stages_and_rates_of_matrix_recovery():
    counters = {"shadow_rays": 30, "entries": 600, "slices": 8, "seconds": {
        "trace": 1.0, "slices": 0.5, "initial_cut": 0.5, "columns": 1.0, "prediction": 2.0, "shading": 0.25,
        "separation": 3.0, "correction": 0.75, "evaluate": 1.0,
    }}  # fmt: skip
    ours = run("matrixrecovery", seconds=10.0, passes=2, statistics=counters, rays_per_sample=5.0, spp=4)
    other = run("lightslice", seconds=19.0, **stages(tree=1.0, slices=1.0, rows=2.0, columns=3.0, shared_columns=4.0))
    found = table([ours, other], "MSR", "Table 1, equal quality")
    assert values(found, "matrixrecovery", "sampling_rate") == [0.05]
    assert values(found, "matrixrecovery", "rays") == [20.0] and values(found, "matrixrecovery", "slices") == [4.0]
    seconds = [f"{stage}_seconds" for stage in ("choosing", "separation", "render")]
    assert [values(found, "matrixrecovery", name)[0] for name in seconds] == [4.0, 4.0, 9.0]
    assert [values(found, "lightslice", name)[0] for name in seconds] == [10.0, None, 18.0]
    assert values(found, "lightslice", "times_as_long") == [2.0]
    # Clustering and gathering of the paper together, over the time of its own method
    (_, published) = found["published"]
    assert published["figures"]["times_as_long"] == {"low": pytest.approx(440 / 125), "high": pytest.approx(429 / 45)}


def test_counts_of_adaptive_sampling_are_a_point():
    counters = {"gather_points": 10, "passes": 27, "clusters": 50}
    found = table([run("adaptivedirect", statistics=counters)], "IAS", "Tables 4 and 6")
    assert values(found, "adaptivedirect", "passes") == [2.7] and values(found, "adaptivedirect", "clusters") == [5.0]


def test_errors_that_the_noise_hides_are_marked():
    pair = [run("unoccludeddirect", error=0.02, noise=0.05), run("adaptivedirect", error=0.2, noise=0.05)]
    found = table(pair, "IAS", "Tables 2 and 3, same rule")
    assert [row["at_most"] for row in found["rows"]] == [["relmse_trimmed"], []]
    shown = paper_tables.shown({"paper_tables": [found]})[0]
    assert [row[3] for row in shown["rows"][:2]] == ["< 0.05", "0.2"]


def test_ratios_are_between_runs_of_one_setting():
    """Equal-time ratios appear beside the equal-error ratios, which need curves."""
    reference = curve("unoccludeddirect", [("error=0.1", 8.0, 0.2), ("error=0.05", 30.0, 0.1)], rays_per_sample=4)
    adaptive = curve("adaptivedirect", [("error=0.1", 4.0, 0.2), ("error=0.05", 10.0, 0.1)], rays_per_sample=2)
    found = table([*reference, *adaptive], "IAS", "Tables 2 and 3, same rule")
    assert values(found, "adaptivedirect", "speed_up") == [2.0, 3.0]
    assert values(found, "adaptivedirect", "fewer_rays") == [4.0, 6.0]
    assert values(table([*reference, *adaptive], "IAS", "Table 2"), "adaptivedirect", "speed_up") == [2.0, 3.0]
    adaptive[0]["setting"] = "error=0.07"
    found = table([*reference, *adaptive], "IAS", "Tables 2 and 3, same rule")
    assert values(found, "adaptivedirect", "speed_up") == [None, 3.0]


# --- At equal errors and rays ---


def curve(integrator, settings, **counted):
    """Runs of a sweep: settings are (name, seconds, error), counted are a number of each for every second."""
    return [
        run(integrator, name, error, seconds=seconds, **{key: rate * seconds for key, rate in counted.items()})
        for name, seconds, error in settings
    ]


FIRST = curve("lightcuts", [("error=4", 4.0, 0.4), ("error=1", 20.0, 0.1)], rays_per_sample=10, bounds_per_sample=100)
OTHER = [("error=8", 1.0, 0.8), ("error=2", 4.0, 0.2), ("error=0.5", 16.0, 0.05)]


def test_equal_errors_are_read_off_between_settings():
    other = curve("illuminationcut", OTHER, rays_per_sample=8, bounds_per_sample=3)
    found = table([*FIRST, *other], "IC", "Table 1")
    assert (found["equal"], found["metric"]) == ("error", "rmse")
    assert [row["label"] for row in found["rows"]] == ["lightcuts", "illuminationcut"] * 2
    assert values(found, "illuminationcut", "rmse") == pytest.approx([0.4, 0.1])
    assert values(found, "illuminationcut", "render_seconds") == pytest.approx([2.0, 8.0])
    assert values(found, "illuminationcut", "bounds") == pytest.approx([6.0, 24.0])
    assert values(found, "illuminationcut", "speed_up") == pytest.approx([2.0, 2.5])
    assert found["rows"][1]["settings"] == pytest.approx({"error=2": 0.5, "error=8": 0.5})
    (shown, _) = paper_tables.shown({"paper_tables": [found, found]})
    assert "At equal RMSE" in shown["reading"]
    assert shown["classes"] == ["begins", "", "begins", "", "published", "published"]
    assert {row[0] for row in shown["rows"][:2]} == {"lightcuts error=4", "illuminationcut error=2 to error=8"}


def test_ends_of_curves_are_named():
    better = curve("illuminationcut", [("error=2", 4.0, 0.2), ("error=0.5", 16.0, 0.15)])
    found = table([*FIRST, *better], "IC", "Table 1")
    ours = [row for row in found["rows"] if row["label"] == "illuminationcut"]
    assert [(row["beyond"], row["settings"]) for row in ours] == [(True, {"error=2": 1.0}), (False, {})]
    assert values(found, "illuminationcut", "speed_up") == [1.0, None]
    (shown, _) = paper_tables.shown({"paper_tables": [found, found]})
    assert shown["rows"][1][0] == "illuminationcut error=2, less already"
    assert shown["rows"][3][:3] == ["illuminationcut", "not reached", ""]


def test_equal_rays_are_read_off_curves_alone():
    ours = curve("matrixrecovery", [("alpha=2", 10.0, 0.4), ("alpha=1", 40.0, 0.2)], rays_per_sample=1)
    other = curve("mdlightcuts", [("error=8", 1.0, 0.9), ("error=2", 4.0, 0.1)], rays_per_sample=5)
    found = table([*ours, *other], "MSR", "Table 1, equal rays")
    assert found["equal"] == "rays" and values(found, "mdlightcuts", "rays") == pytest.approx([10.0, 20.0])
    assert values(found, "mdlightcuts", "relative_l1") == pytest.approx([0.3, 0.1])
    assert [row["beyond"] for row in found["rows"]] == [False, False, False, True]
    assert "MSR Table 1, equal rays" not in names([*ours[:1], *other[:1]])


# --- Declarations and display ---


def test_declared_tables_have_columns_that_exist():
    assert len({(one.paper, one.name) for one in TABLES}) == len(TABLES)
    for one in TABLES:
        assert set(one.quantities) <= QUANTITIES.keys() and not set(one.ratios) & QUANTITIES.keys()
        assert one.equal is None or one.methods[0].integrator in one.needed
        assert one.equal is None or {"error": one.metric, "rays": "rays"}[one.equal] in one.quantities
        for method in one.methods:
            assert method.figures.keys() <= set(one.quantities), (one.name, method.name)
            assert len({len(figures) for figures in method.figures.values()}) == 1


def test_page_without_the_integrators_has_no_tables(swept):
    assert results_of(swept)["scenes"][0]["paper_tables"] == []
    assert "Tables of the papers" not in (swept / "report.html").read_text()


def test_page_and_text_show_the_tables_of_a_sweep(swept, tmp_path):
    """The runs of a real sweep, those of one integrator under the name of another."""
    results = json.loads((swept / "results.json").read_text())
    (scene,) = results["scenes"]
    for render in scene["renders"]:
        render["integrator"] = {"path": "path", "lightcuts": "lightcuts", "vpl": "illuminationcut"}[
            render["integrator"]
        ]
    scene["paper_tables"] = paper_tables.make(scene["renders"])
    report.write(tmp_path, results, [None])
    page = (tmp_path / "report.html").read_text()
    (first, _) = results_of(tmp_path)["scenes"][0]["paper_tables"]
    assert first["table"] == "Table 1" and first["equal"] == "error"
    assert all(row["values"]["rays"] > 0 for row in first["rows"] if row["settings"])
    for wanted in ("Tables of the papers", "[IC] Table 1", "[IC] Table 5", "3.16–4.25"):
        assert wanted in page
    assert page.count('class="published"') == 4 and "[MSR]" not in page and "[IAS]" not in page
    assert "[IC] Table 1: " in report.text(scene) and "[IC] IC(1.5%)" in report.text(scene)
