"""compare.py and its parts: scene files, passes, workers, the command."""

import ast
import html
import json
import re
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

import compare
from comparison import counters, images, machine, rendering, single_pass, worker
from comparison.scene_comparison import SceneComparison
from comparison.scene_files import SceneFile
from integrators import PLUGINS
from tests.support.paths import CORNELL, ROOT
from tests.support.scenes import cornell

HALL, HALL_REFERENCE = (str(ROOT / "scenes" / name) for name in ("hall.xml", "hall_reference.exr"))


# --- Scene files ---


def test_replacing_an_integrator_keeps_what_it_shows():
    file = cornell(max_depth="4")
    file.set_integrator("path", {"rr_depth": 3, "hide_emitters": True})
    file.set_integrator("direct", {"emitter_samples": 2})
    assert file.integrator == ("direct", {"hide_emitters": True, "emitter_samples": 2})  # it has no max_depth
    file = cornell(max_depth="4")
    file.set_integrator("volpath", {"rr_depth": 9})
    assert file.integrator == ("volpath", {"max_depth": 4, "rr_depth": 9})
    assert "max_depth = 4" in str(file.load().integrator())


def test_what_a_replaced_integrator_does_not_know_is_dropped_and_of_the_same_one_refused():
    file = cornell()
    file.set_integrator("lightcuts", {"error": 0.02, "vpl_count": 100})
    file.set_integrator("vpl", {"clamping": 0.0}, keep=None)
    assert file.integrator == ("vpl", {"max_depth": 6, "vpl_count": 100, "clamping": 0.0})
    with pytest.raises(ValueError, match='vpl: unknown property "vpl_cuont"; did you mean "vpl_count"'):
        file.set_integrator("vpl", {"vpl_cuont": 3}, keep=None)


def test_a_misspelt_parameter_in_a_scene_is_refused_when_its_integrator_is_kept(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="lightcuts"><float name="eror" value="1"/></integrator>'
        '<sensor type="perspective"/><emitter type="constant"/></scene>'
    )
    with pytest.raises(ValueError, match='unknown property "eror"; did you mean "error"'):
        SceneFile(path).set_integrator("lightcuts", {"max_cut": 10}, keep=None)


def test_unknown_parameters_are_refused_even_if_looked_at():
    file = cornell()
    file.set_integrator("path", {"bogus": 1})
    assert file.integrator[1]["bogus"] == 1
    file.fingerprint()
    with pytest.raises(RuntimeError, match="bogus"):
        file.load()


def test_integrator_can_be_added(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text('<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/></scene>')
    file = SceneFile(path)
    assert file.integrator == (None, {})
    assert file.name == tmp_path.name
    file.set_integrator("direct")
    assert "DirectIntegrator" in str(file.load().integrator())


def test_scene_without_sensor_is_refused(tmp_path):
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    with pytest.raises(ValueError, match="no sensor"):
        SceneFile(tmp_path / "scene.xml")


def test_width_keeps_the_aspect():
    file = SceneFile(CORNELL, {"resx": "640", "resy": "360"})
    file.set_width(64)
    assert file.size == (64, 36)


def test_fingerprint_follows_everything_that_matters(tmp_path):
    bitmap, scene = tmp_path / "light.pfm", tmp_path / "scene.xml"
    bitmap.write_bytes(b"1")
    scene.write_text(
        '<scene version="3.0.0"><default name="spp" value="4"/><default name="depth" value="4"/>'
        '<sensor type="perspective"><sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>'
        '</sensor><integrator type="path"><integer name="max_depth" value="$depth"/></integrator>'
        '<emitter type="envmap"><string name="filename" value="light.pfm"/></emitter></scene>'
    )
    before = SceneFile(scene).fingerprint()
    assert SceneFile(scene, {"spp": "9"}).fingerprint() == before
    file = SceneFile(scene)
    file.set_sampler("multijitter")
    assert file.fingerprint() != before
    assert SceneFile(scene, {"depth": "9"}).fingerprint() != before
    bitmap.write_bytes(b"2")
    assert SceneFile(scene).fingerprint() != before


def test_every_sensor_gets_the_sampler(tmp_path):
    scene = tmp_path / "scene.xml"
    own = '<sampler type="independent"><integer name="sample_count" value="9"/></sampler>'
    sensors = "".join(f'<sensor type="perspective">{sampler}</sensor>' for sampler in (own, ""))
    scene.write_text(f'<scene version="3.0.0">{sensors}<shape type="sphere"/></scene>')
    file = SceneFile(scene)
    file.set_sampler("multijitter")
    assert [sensor.sampler().class_name() for sensor in file.load().sensors()] == ["MultijitterSampler"] * 2
    assert SceneFile(scene, changes=file.changes).load().sensors()[0].sampler().sample_count() == 9
    with pytest.raises(ValueError, match="'path' is no sampler"):
        file.set_sampler("path")


def test_all_images_have_the_sampler_of_the_option(tmp_path, capsys):
    common = [CORNELL, "-i", "path", "-D", "resx=8", "-D", "resy=8", "--spp", "7", "-r", "path:16"]
    assert compare.main([*common, "--sampler", "multijitter", "-o", str(tmp_path)]) == 0
    (scene,) = json.loads((tmp_path / "results.json").read_text())["scenes"]
    # Mitsuba rounds the samples of this sampler
    assert scene["sampler"] == "multijitter" and scene["renders"][0]["spp"] == 8
    for name in ("gaussian", "nosuch"):
        assert compare.main([*common, "--sampler", name, "-o", str(tmp_path)]) == 2
        assert f"unknown sampler '{name}'; there are independent, " in capsys.readouterr().err


# --- Passes ---


def test_pass_seeds_differ_and_begin_with_the_seed():
    seeds = [single_pass.pass_seed(seed, index) for seed in (0, 1, 2) for index in range(100)]
    assert seeds[::100] == [0, 1, 2]
    assert len(set(seeds)) == 300
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_pass_sizes():
    assert single_pass.largest_pass(10**9) == single_pass.largest_pass(10**9, in_parts=True) == 1
    assert single_pass.largest_pass(2**16) == 32
    assert single_pass.largest_pass(2**16, in_parts=True) == 128
    assert single_pass.pass_sizes(100, 32) == [32, 32, 32, 4]
    assert single_pass.pass_sizes(3, 128) == [3]
    assert single_pass.pass_sizes(5, 2) == [2, 2, 1]


def test_progressive_is_the_weighted_mean_of_its_passes():
    scene = cornell().load()
    progressive = rendering.Progressive(scene, seed=5)
    for spp in (1, 3):
        progressive.render(spp)
    refused = progressive.render(8, accept=lambda: False)
    assert refused is None
    one, three = (mi.render(scene, seed=single_pass.pass_seed(5, i), spp=spp).numpy() for i, spp in ((0, 1), (1, 3)))
    np.testing.assert_allclose(progressive.image, (one + 3.0 * three) / 4, rtol=1e-5)
    assert (progressive.spp, len(progressive.passes), progressive.channels) == (4, 2, ["R", "G", "B"])
    assert progressive.seconds > 0


def test_passes_count_the_samples_that_were_taken():
    """Mitsuba rounds the number up for stratified samplers, and its log says so."""
    file = cornell(max_depth="2")
    file.set_sampler("ldsampler")
    file.set_integrator("vpl", {"vpl_count": 10, "direct": "vpl"})
    progressive = rendering.Progressive(file.load(), seed=0)
    one, nine = progressive.render(1), progressive.render(9)
    assert (one.spp, nine.spp, progressive.spp) == (4, 16, 20)
    rays = nine.statistics["shadow_rays"] / one.statistics["shadow_rays"]
    assert rays == pytest.approx(4, rel=0.05)  # as many more as samples


def test_statistics_add_up():
    statistics = [
        {"shadow_rays": 3, "seconds": {"trace": 1.0}, "lights": {"omni": 7}},
        {"shadow_rays": 4, "seconds": {"trace": 0.5, "cut": 1.0}, "lights": {"omni": 8}},
    ]
    total = counters.total_statistics([single_pass.Pass(0, 1, 1.0, one) for one in statistics])
    assert total == {"shadow_rays": 7, "seconds": {"trace": 1.5, "cut": 1.0}, "lights": {"omni": 8}}
    assert statistics[0]["seconds"] == {"trace": 1.0}


def test_what_describes_a_pass_is_that_of_the_largest():
    statistics = [
        {"plan": "too few samples", "share": 0.5},
        {"plan": "glossy", "share": 0.25, "lights": {"surface": 7}},
        {"plan": "too few samples"},
    ]
    passes = [single_pass.Pass(0, spp, 1.0, one) for spp, one in zip((1, 8, 2), statistics, strict=True)]
    assert counters.total_statistics(passes) == {"plan": "glossy", "share": 0.75, "lights": {"surface": 7}}


def test_statistics_are_read_once_as_passes_come():
    read = []

    class Read(dict):
        def items(self):
            read.append(1)
            return super().items()

    totals, passes, found = counters.TotalStatistics(), [], []
    for spp in (4, 8, 2, 8):
        passes.append(single_pass.Pass(0, spp, 1.0, Read(rays=spp, plan=f"{spp}, {len(passes)}")))
        found.append(totals.of(passes))
    assert len(read) == 4 and found[-1] == counters.total_statistics(passes) == {"rays": 22, "plan": "8, 3"}
    assert found[0] == {"rays": 4, "plan": "4, 0"}


# --- Workers ---


def test_worker_measures_within_a_time_budget(tmp_path):
    job = worker.Job("p", "path", CORNELL, str(tmp_path / "a.exr"), width=16, budget=0.5, max_depth=3)
    result = worker.run(job)
    assert "error" not in result
    assert result["parameters"] == {"max_depth": 3}
    assert 0.25 < result["seconds"]
    assert result["cold_seconds"] > 0 and result["warm_seconds"] > 0
    assert (result["passes"] - 1) * result["pass_spp"] < result["spp"] <= result["passes"] * result["pass_spp"]
    assert result["peak_memory_bytes"] > 1e7
    assert result["rays_per_sample"] is None
    image, _, metadata = images.read_exr(tmp_path / "a.exr")
    assert image.shape == (16, 16, 3) and metadata["integrator"] == "path"


def test_worker_that_dies_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(worker.sys, "executable", "/bin/false")
    result = worker.run(worker.Job("p", "path", CORNELL, str(tmp_path / "a.exr"), spp=1))
    assert result["error"] == "the renderer ended with status 1"


# --- The command ---


def test_comparison_reports_results_and_failures(tmp_path, capsys):
    broken = tmp_path / "broken.xml"
    broken.write_text("<scene version='3.0.0'>")
    out = tmp_path / "out"
    status = compare.main([
        CORNELL, str(broken), "-i", "path,direct,bad=stokes", "--spp", "4", "--width", "16",
        "--reference", "path:64", "--cache", str(tmp_path / "cache"), "-o", str(out), "--seed", "7",
    ])  # fmt: skip
    assert status == 1
    printed = capsys.readouterr().out
    assert "bad: FAILED" in printed and "broken: FAILED" in printed

    results = json.loads((out / "results.json").read_text())
    assert (
        results["seeds"] == [7]
        and results["complete"]
        and results["versions"]["mitsuba"]
        and results["machine"]["cores"]
    )
    scene, failed = results["scenes"]
    assert "error" in failed and scene["hash"] and scene["reference"]["spp"] == 64
    path, direct, bad = scene["renders"]
    assert "integrator" in bad["error"]
    assert path["spp"] == 4 and path["errors"]["relmse"] > 0
    assert direct["errors"]["bias"] < -0.1
    for name in ("cornell.path.exr", "cornell.path.png", "cornell.direct.error.png", "cornell.reference.png"):
        assert (out / name).is_file()
    page = (out / "report.html").read_text()
    assert re.findall('"title": "([^"]*)"', page) == ["reference", "path", "direct"]
    assert bad["error"] in html.unescape(page)


@pytest.mark.stress
def test_reference_by_vpl_shares_the_lights(tmp_path, capsys):
    status = compare.main([
        CORNELL, "-i", "path,all=vpl,cuts=lightcuts", "-p", "all.vpl_count=300", "-p", "cuts.vpl_count=300",
        "-p", "cuts.error=0.3", "--spp", "1", "--width", "16", "--max-depth", "3", "--reference", "vpl", "-o",
        str(tmp_path),
    ])  # fmt: skip
    assert status == 0, capsys.readouterr().out
    path, every, cuts = json.loads((tmp_path / "results.json").read_text())["scenes"][0]["renders"]
    assert "errors" not in path
    assert every["errors"]["relative_l1"] < 1e-4
    assert every["rays_per_sample"] > 0
    assert every["vpl_output"] == cuts["vpl_output"] and len(list(tmp_path.glob("*.vpl.*.exr"))) == 1
    assert 1e-3 < cuts["errors"]["relative_l1"] < 0.2


def test_comparison_is_of_path_and_manylights_unless_others_are_named(tmp_path, capsys):
    """The report states the choice; the samples suffice for virtual lights to pay."""
    status = compare.main([
        CORNELL, "--spp", "64", "--width", "96", "--reference", "path:128", "--cache", str(tmp_path / "cache"), "-o",
        str(tmp_path),
    ])  # fmt: skip
    assert status == 0, capsys.readouterr().out
    path, ours = json.loads((tmp_path / "results.json").read_text())["scenes"][0]["renders"]
    assert (path["label"], ours["label"]) == ("path", "manylights")
    assert (path["parameters"], ours["parameters"]) == ({"max_depth": 6}, {"max_depth": 6})
    found = ours["statistics"]
    assert "of the variance" in found["plan"]
    assert found["light_paths"] > 0 and found["shadow_rays"] > 0 and sum(found["lights"].values()) > 0
    assert ours["rays_per_sample"] > 0 and ours["errors"]["relmse"] < path["errors"]["relmse"]
    assert found["plan"] in html.unescape((tmp_path / "report.html").read_text())


def test_manylights_shares_no_lights_with_vpl(tmp_path, capsys):
    status = compare.main([
        CORNELL, "-i", "manylights,vpl", "-p", "vpl.vpl_count=100", "--spp", "1", "--width", "16", "--reference", "vpl",
        "-o", str(tmp_path),
    ])  # fmt: skip
    assert status == 0, capsys.readouterr().out
    ours, vpl = json.loads((tmp_path / "results.json").read_text())["scenes"][0]["renders"]
    assert "errors" not in ours and vpl["errors"]["relative_l1"] < 1e-4


def test_runs_depend_on_every_module_of_a_worker():
    """Modules that make no image: the command line, and what describes the machine."""
    found, seen = ["worker"], set()
    while found:
        name = found.pop()
        seen.add(name)
        for node in ast.walk(ast.parse((ROOT / "comparison" / f"{name}.py").read_text())):
            if isinstance(node, ast.ImportFrom) and node.level == 1:
                names = [node.module] if node.module else [alias.name for alias in node.names]
                found += {*names} - seen
    others = {"command_line", "interruption", "machine"}
    assert {f"comparison/{name}.py" for name in seen - others} <= set(machine.SOURCES)
    assert others <= seen and all(list(ROOT.glob(pattern)) for pattern in machine.SOURCES)


def test_only_integrators_with_virtual_lights_share_them_with_vpl(tmp_path):
    """Direct light is not judged by global illumination."""
    named = ",".join(("path", *PLUGINS))
    options = compare.parse([CORNELL, "-i", named, "--spp", "1", "--reference", "vpl", "-o", str(tmp_path)])
    store = SimpleNamespace(kernels=tmp_path, key=lambda *_: "run")
    comparison = SceneComparison(CORNELL, compare.chosen_settings(options), options, store, None)
    comparison.result["hash"] = "scene"
    sharing = {label for label, (one,) in comparison.settings.items() if comparison._job(one, 0).vpl_folder}
    assert sharing == {"vpl", "lightcuts", "mdlightcuts", "lightslice", "matrixrecovery", "illuminationcut"}


def test_demo_compares_path_and_manylights():
    options = compare.parse(["--demo"])
    assert (options.scenes, options.integrators) == ([HALL], "path,manylights")


def test_aovs_are_asked_for_and_shown_on_one_scale(tmp_path, capsys):
    status = compare.main([
        CORNELL, "-i", "path,few=vpl,many=vpl", "-p", "few.vpl_count=100", "-p", "many.vpl_count=900", "--spp",
        "1", "--width", "16", "--reference", "vpl", "-o", str(tmp_path), "-p", "many.aovs=cut_size,shadow_rays",
        "--aovs", "shadow_rays, upper_bounds",
    ])  # fmt: skip
    assert status == 0, capsys.readouterr().out
    scene = json.loads((tmp_path / "results.json").read_text())["scenes"][0]
    asked = [render["parameters"].get("aovs") for render in scene["renders"]]
    assert asked == [None, "shadow_rays,upper_bounds", "cut_size,shadow_rays,upper_bounds"]
    assert images.read_exr(scene["renders"][2]["vpl_output"])[1] == ["B", "G", "R"]
    assert list(scene["aovs"]) == ["shadow_rays", "upper_bounds"]
    rays, bounds = scene["aovs"].values()
    assert rays["files"] == {label: str(tmp_path / f"cornell.{label}.shadow_rays.png") for label in ("few", "many")}
    low, high = rays["scale"]
    assert 4 * low < high and bounds["scale"] == [1, 2]  # vpl computes no bounds
    pixels = {label: np.array(mi.Bitmap(file)).astype(int) for label, file in rays["files"].items()}
    assert pixels["many"].mean() > 2 * pixels["few"].mean() > 0
    assert np.all(np.array(mi.Bitmap(bounds["files"]["few"])) == images.FALSE_COLOURS[0])
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4  # channels
    assert f"<span>{low:g}</span><span>{high:g}</span>" in page


def test_aovs_that_not_all_know_are_asked_of_those_that_do(monkeypatch):
    monkeypatch.setattr(compare.command_line, "aov_refusal", lambda *asked: asked == ("vpl", "own"))
    options = compare.parse([CORNELL, "-i", "path,lightcuts,vpl", "--aovs", "cut_size,own"])
    asked = {label: parameters for label, (_, parameters) in compare.chosen_integrators(options).items()}
    assert asked == {"path": {}, "lightcuts": {"aovs": "cut_size,own"}, "vpl": {"aovs": "cut_size"}}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no scene given"),
        (["nosuch.xml"], "no scene file 'nosuch.xml'"),
        ([CORNELL, CORNELL], "would have output files of the same name, 'cornell'"),
        ([CORNELL, "-i", "nosuch"], "unknown integrator 'nosuch'; there are"),
        ([CORNELL, "-i", "path,path"], "'path' has no unique label"),
        ([CORNELL, "-p", "vpl.error=1"], "LABEL is path or manylights"),
        (
            [CORNELL, "-i", "path,lightcuts", "--aovs", "shadow_rays,bogus"],
            'a comma-separated list out of "shadow_rays", "upper_bounds"',
        ),
        ([CORNELL, "--aovs", "cut_size"], "supported only by vpl, lightcuts, "),
        ([CORNELL, "-i", ""], "'' has no unique label"),
        ([CORNELL, "-i", "path,reference=vpl"], "'reference=vpl' has no unique label"),
        ([CORNELL, HALL, "-r", HALL_REFERENCE], "is a single image; for several scenes give a folder"),
        (
            [CORNELL, "-i", "lightcuts", "-p", "lightcuts.bogus=1"],
            'lightcuts: unknown property "bogus"; there are "error", "dark_floor"',
        ),
        ([CORNELL, "-p", "manylights.bogus=1"], 'manylights: unknown property "bogus"; there are "virtual_lights"'),
        (
            [CORNELL, "-i", "lightcuts", "-p", "lightcuts.error=-1"],
            'property "error" must be a number of at least 0, got -1',
        ),
        ([CORNELL, "-r", "path:many"], "not of the form path:SPP"),
        ([CORNELL, "-r", "path:auto:2"], "'2' is not a fraction"),
        ([CORNELL, "--sweep", "lightcuts:error"], "not of the form LABEL:KEY=VALUE"),
        ([CORNELL, "--sweep", "vpl:error=1"], "no such label; there are path, manylights"),
        ([CORNELL, "--sweep", "path:spp=0"], "spp: '0' is not a positive whole number"),
        ([CORNELL, "--sweep", "path:bogus=1,2"], "path bogus=1: the integrator 'path' has no parameter 'bogus'"),
        ([CORNELL, "--sweep", "-o", "/dev/null/a"], "cannot write to the folder '/dev/null/a': Not a directory"),
        ([CORNELL, "--sweep", "--check", "nosuch.json"], "'nosuch.json' cannot be read"),
        ([CORNELL, "--check-share", "2"], "'2' is not a fraction from 0 to 1"),
        ([CORNELL, "--seed", "4294967295", "--seeds", "2"], "too large for 2 seeds"),
        ([CORNELL, "-r", "nosuch.exr"], "neither a file"),
        ([CORNELL, "-r", str(ROOT / "tests")], "/tests/cornell.exr' for the scene"),
        ([CORNELL, "--spp", "1", "--time", "1"], "not allowed with"),
        ([CORNELL, "-m", "bogus"], "unknown variant 'bogus'"),
    ],
)
def test_usage_errors(arguments, message, capsys):
    try:
        status = compare.main(arguments)
    except SystemExit as error:
        status = error.code
    assert status == 2
    assert message in capsys.readouterr().err


def test_cold_images_begin_with_empty_kernel_caches(tmp_path, capsys):
    status = compare.main([
        CORNELL, "-i", "path", "--cold", "--spp", "2", "--seeds", "2", "--width", "16", "-r", "path:64", "--cache",
        str(tmp_path / "cache"), "-o", str(tmp_path),
    ])  # fmt: skip
    assert status == 0, capsys.readouterr().out
    renders = json.loads((tmp_path / "results.json").read_text())["scenes"][0]["renders"]
    assert len(renders) == 2
    for render in renders:
        assert render["cold"] and render["cold_pass_kept"] and render["seconds"] == render["cold_seconds"]
