"""compare.py and what it is made of: scene files, passes, images, references, workers, reports."""

import html
import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import compare
from comparison import images, references, rendering, worker
from comparison.scene_files import SceneFile

ROOT = Path(__file__).resolve().parent.parent
CORNELL = ROOT / "scenes" / "cornell.xml"
HALL, HALL_REFERENCE = (str(ROOT / "scenes" / name) for name in ("hall.xml", "hall_reference.exr"))


def cornell(width=16, **defines):
    file = SceneFile(CORNELL, defines)
    file.set_width(width)
    return file


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


# --- Passes ---


def test_pass_seeds_differ_and_begin_with_the_seed():
    seeds = [rendering.pass_seed(seed, index) for seed in (0, 1, 2) for index in range(100)]
    assert seeds[::100] == [0, 1, 2]
    assert len(set(seeds)) == 300
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_pass_sizes():
    assert rendering.pass_sizes(5, 10**9) == [1] * 5
    assert rendering.pass_sizes(100, 2**16) == [32, 32, 32, 4]
    assert rendering.pass_sizes(3, 16) == [3]
    assert rendering.pass_sizes(5, 16, pass_spp=2) == [2, 2, 1]


def test_progressive_is_the_weighted_mean_of_its_passes():
    scene = cornell().load()
    progressive = rendering.Progressive(scene, seed=5)
    for spp in (1, 3):
        progressive.render(spp)
    refused = progressive.render(8, accept=lambda: False)
    assert refused is None
    one, three = (mi.render(scene, seed=rendering.pass_seed(5, i), spp=spp).numpy() for i, spp in ((0, 1), (1, 3)))
    np.testing.assert_allclose(progressive.image, (one + 3.0 * three) / 4, rtol=1e-5)
    assert (progressive.spp, len(progressive.passes), progressive.channels) == (4, 2, ["R", "G", "B"])
    assert progressive.seconds > 0


def test_statistics_add_up():
    statistics = [
        {"shadow_rays": 3, "seconds": {"trace": 1.0}, "lights": {"omni": 7}},
        {"shadow_rays": 4, "seconds": {"trace": 0.5, "cut": 1.0}, "lights": {"omni": 8}},
    ]
    total = rendering.total_statistics([rendering.Pass(0, 1, 1.0, one) for one in statistics])
    assert total == {"shadow_rays": 7, "seconds": {"trace": 1.5, "cut": 1.0}, "lights": {"omni": 8}}
    assert statistics[0]["seconds"] == {"trace": 1.0}


# --- Images ---


@pytest.mark.parametrize("half", [False, True])
def test_exr_files_keep_channels_and_metadata(tmp_path, half):
    image = np.random.default_rng(0).random((5, 7, 4))
    metadata = {"spp": 4, "seconds": 1.5, "name": "path", "seed": 2**32 - 1, "parameters": {"a": 1}, "flag": True}
    images.write_exr(tmp_path / "a.exr", image, ["R", "G", "B", "dd.T"], metadata, half)
    read, channels, found = images.read_exr(tmp_path / "a.exr")
    assert channels == ["B", "G", "R", "dd.T"]
    np.testing.assert_allclose(images.colour(read, channels), image[..., :3], rtol=1e-3 if half else 1e-6)
    np.testing.assert_allclose(read[..., 3], image[..., 3], rtol=1e-3 if half else 1e-6)
    assert {key: found[key] for key in metadata} == metadata | {
        "seed": "4294967295", "parameters": '{"a": 1}', "flag": "true",
    }  # fmt: skip
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


def test_failed_write_leaves_the_old_file(tmp_path):
    (tmp_path / "a.png").write_text("old")
    with pytest.raises(RuntimeError), images.replacing(tmp_path / "a.png") as temporary:
        temporary.write_text("new, but")
        raise RuntimeError("disk full")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a.png", "old")]


def test_tone_mapping():
    rgb = np.zeros((20, 20, 3))
    rgb[:2], rgb[2:4], rgb[4:] = 4.0, np.inf, 2.0
    exposure = images.automatic_exposure(rgb)
    assert exposure == pytest.approx(0.2)
    mapped = images.tone_map(rgb, exposure)
    assert mapped.dtype == np.uint8
    assert mapped[0, 0, 0] == round(255 * (1.055 * 0.8 ** (1 / 2.4) - 0.055))
    assert images.automatic_exposure(np.zeros((4, 4, 3))) == 1


def test_false_colours_get_brighter_with_the_error():
    errors = np.array([[0.0, 0.01, 0.05, 0.2, 0.7, 1.0, 50.0, np.nan]])
    brightness = images.false_colours(errors).astype(int).sum(axis=-1)[0]
    assert np.all(np.diff(brightness) >= 0)
    assert brightness[0] == brightness[1] < brightness[2] < brightness[3] < brightness[4] < brightness[5]


def test_false_colours_of_other_channels_span_their_scale():
    colours = images.false_colours(np.array([[0.0, -1.0, 30.0, 300.0, 3000.0, np.inf, np.nan]]), (30, 3000))[0]
    assert np.all(colours[:3] == images.FALSE_COLOURS[0]) and np.all(colours[4:] == images.FALSE_COLOURS[-1])
    np.testing.assert_allclose(colours[3], images.FALSE_COLOURS[2:4].mean(axis=0), atol=1)  # the middle of the scale


def test_scale_of_several_images_holds_all_and_ignores_grazed_pixels():
    few, many = np.linspace(101.0, 201, 1000).reshape(20, 50), np.full((20, 50), 4000.0)
    few[0, :5], few[1, :10], many[0, 0] = 1e-3, 0, np.inf
    assert images.logarithmic_ends([few, many]) == (100, 4000)
    assert images.logarithmic_ends([many, np.zeros((2, 2))]) == (2000, 4000)
    assert images.logarithmic_ends([np.zeros((2, 2))]) == (1, 2)


def test_colour_of_luminance_and_of_nothing():
    assert images.colour(np.ones((2, 2, 1)), ["Y"]).shape == (2, 2, 3)
    with pytest.raises(ValueError, match="no colour channels among depth"):
        images.colour(np.ones((2, 2, 1)), ["depth"])


# --- References ---


def test_batches_are_mean_and_standard_error(tmp_path):
    samples = np.random.default_rng(0).random((9, 4, 4, 3))
    batches = references.Batches()
    for image in samples[:5]:
        batches = batches.with_batch(image, 3)
    batches.write(tmp_path / "a.exr", {"integrator": "path"})
    batches = references.Batches.read(tmp_path / "a.exr")
    for image in samples[5:]:
        batches = batches.with_batch(image, 3)
    assert (batches.spp, batches.count) == (27, 9)
    np.testing.assert_allclose(batches.mean, samples.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(batches.standard_error, samples.std(axis=0, ddof=1) / 3, rtol=1e-5)


def test_batches_of_different_sizes_count_by_their_samples():
    random, sizes = np.random.default_rng(0), (1, 3, 2, 16, 8, 1, 4)
    samples = random.normal(5, 1, (sum(sizes), 40, 50, 3))
    batches, first = references.Batches(), 0
    for size in sizes:
        batches = batches.with_batch(samples[first : first + size].mean(axis=0), size)
        first += size
    np.testing.assert_allclose(batches.mean, samples.mean(axis=0), rtol=1e-12)
    # On average the variance of the mean is that of a sample over their number, whatever the batches.
    assert np.square(batches.standard_error).mean() == pytest.approx(1 / sum(sizes), rel=0.03)


def test_path_traced_references_are_kept_and_continued(tmp_path):
    first = references.path_traced(cornell(), 32, tmp_path)
    (file,) = tmp_path.glob("*.exr")
    left = [tmp_path / f".{name}.123.exr" for name in (file.stem, "other")]
    for one in left:
        one.write_text("as if killed while writing")
    again = references.path_traced(cornell(), 16, tmp_path)
    np.testing.assert_array_equal(first.image, again.image)
    more = references.path_traced(cornell(), 128, tmp_path)
    assert (first.description["spp"], more.description["spp"], first.size) == (32, 128, (16, 16))
    assert np.median(more.standard_error / first.standard_error) == pytest.approx(0.5, rel=0.3)
    at_once = references.path_traced(cornell(), 128, tmp_path / "other")
    assert np.abs(more.image - at_once.image).sum() < 0.2 * at_once.image.sum()
    assert set(tmp_path.glob("*.exr")) == {file, left[1]}  # of others, who may be writing it


def test_interrupted_reference_keeps_what_it_has(tmp_path, monkeypatch):
    render, passes = rendering.Progressive.render, []

    def interrupted(self, *arguments):
        if len(passes) == 5:
            raise KeyboardInterrupt
        passes.append(render(self, *arguments))

    monkeypatch.setattr(references.Progressive, "render", interrupted)
    with pytest.raises(KeyboardInterrupt):
        references.path_traced(cornell(), 64, tmp_path)
    monkeypatch.undo()
    (file,) = tmp_path.glob("*.exr")
    assert references.read(file).description["batches"] == 5
    assert references.path_traced(cornell(), 64, tmp_path).description["spp"] == 64


def test_kept_reference_that_cannot_be_read_is_named(tmp_path):
    references.path_traced(cornell(), 4, tmp_path)
    (file,) = tmp_path.glob("*.exr")
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(ValueError, match=f"the kept reference '{file}' cannot be read"):
        references.path_traced(cornell(), 4, tmp_path)


def test_shipped_reference_fits_the_shipped_hall():
    path = ROOT / "scenes" / "hall_reference.exr"
    reference = references.read(path)
    assert path.stat().st_size < 300_000
    assert reference.description["command"].startswith("python -m comparison.references scenes/hall.xml")
    file = SceneFile(ROOT / "scenes" / "hall.xml")
    assert reference.description["max_depth"] == file.integrator[1]["max_depth"]
    file.set_width(reference.size[0])
    assert file.size == reference.size
    image = mi.render(file.load(), spp=64).numpy()
    assert image.mean() == pytest.approx(reference.image.mean(), rel=0.03)


# --- Workers ---


def test_worker_measures_within_a_time_budget(tmp_path):
    job = worker.Job("p", "path", str(CORNELL), str(tmp_path / "a.exr"), width=16, budget=0.5, max_depth=3)
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


class Recorded(rendering.Progressive):
    """A render that takes as long as it is told, by default a second a sample, and remembers what it was asked for."""

    def __init__(self, pixels, *seconds):
        self._pixels, self._seconds, self.asked = pixels, list(seconds), []
        self.restart()

    pixels = property(lambda self: self._pixels)

    def render(self, spp, seed=None):
        self.asked.append((spp, seed is not None))
        self.passes.append(rendering.Pass(seed or 0, spp, self._seconds.pop(0) if self._seconds else float(spp)))
        return self.passes[-1]


def test_kernels_of_every_size_of_pass_are_compiled_before_the_clock_runs():
    job = worker.Job("p", "path", "s.xml", "a.exr", spp=19)
    progressive = Recorded(rendering.MAXIMUM_PASS_SAMPLES // 9, 2.0)
    assert worker._measure(progressive, job) == (2.0, False)
    assert progressive.asked == [(9, True), (1, True), (9, False), (9, False), (1, False)]
    assert sum(one.spp for one in progressive.passes) == 19
    progressive = Recorded(rendering.MAXIMUM_PASS_SAMPLES // 9, worker.LONG_PASS + 1)
    assert worker._measure(progressive, job) == (worker.LONG_PASS + 1, True)  # too long to be rendered twice
    assert progressive.asked == [(9, True), (9, False), (1, False)]


@pytest.mark.parametrize(
    ("budget", "pass_spp", "passes"),
    [
        (35, 10, [10, 10, 10, 5]),
        (30, 10, [10, 10, 10]),
        (33, 10, [10, 10, 10, 4]),  # 4 are nearer to 3 than none
        (31, 10, [10, 10, 10]),
        (4.9, 2, [2, 2]),
        (5.6, 2, [2, 2, 2]),
        (3.4, 1, [1, 1, 1]),
        (12, 10, [10]),
    ],
)
def test_the_last_pass_fills_the_budget(budget, pass_spp, passes):
    progressive = Recorded(100)
    worker._measure(progressive, worker.Job("p", "path", "s.xml", "a.exr", budget=budget, pass_spp=pass_spp))
    assert [one.spp for one in progressive.passes] == passes
    assert abs(progressive.seconds - budget) <= min(pass_spp, worker.WARM_SPP) / 2


def test_worker_that_dies_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(worker.sys, "executable", "/bin/false")
    result = worker.run(worker.Job("p", "path", str(CORNELL), str(tmp_path / "a.exr"), spp=1))
    assert result["error"] == "the renderer ended with status 1"


# --- The command ---


def test_comparison_reports_results_and_failures(tmp_path, capsys):
    broken = tmp_path / "broken.xml"
    broken.write_text("<scene version='3.0.0'>")
    out = tmp_path / "out"
    status = compare.main([
        str(CORNELL), str(broken), "-i", "path,direct,bad=stokes", "--spp", "4", "--width", "16",
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


def test_reference_by_vpl_shares_the_lights(tmp_path, capsys):
    status = compare.main([
        str(CORNELL), "-i", "path,all=vpl,cuts=lightcuts", "-p", "all.vpl_count=300", "-p", "cuts.vpl_count=300",
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


def test_aovs_are_asked_for_and_shown_on_one_scale(tmp_path, capsys):
    status = compare.main([
        str(CORNELL), "-i", "path,few=vpl,many=vpl", "-p", "few.vpl_count=100", "-p", "many.vpl_count=900", "--spp",
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
    options = compare.parse([str(CORNELL), "-i", "path,lightcuts,vpl", "--aovs", "cut_size,own"])
    asked = {label: parameters for label, (_, parameters) in compare.chosen_integrators(options).items()}
    assert asked == {"path": {}, "lightcuts": {"aovs": "cut_size,own"}, "vpl": {"aovs": "cut_size"}}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no scene given"),
        (["nosuch.xml"], "no scene file 'nosuch.xml'"),
        ([str(CORNELL), str(CORNELL)], "would have files of the same name, 'cornell'"),
        ([str(CORNELL), "-i", "nosuch"], "unknown integrator 'nosuch'; there are"),
        ([str(CORNELL), "-i", "path,path"], "'path' is no name of its own"),
        ([str(CORNELL), "-p", "vpl.error=1"], "LABEL is path or lightcuts"),
        ([str(CORNELL), "--aovs", "shadow_rays,bogus"], 'a comma-separated list out of "shadow_rays", "upper_bounds"'),
        ([str(CORNELL), "-i", "path", "--aovs", "cut_size"], "have AOVs"),
        ([str(CORNELL), "-i", ""], "'' is no name of its own"),
        ([str(CORNELL), "-i", "path,reference=vpl"], "'reference=vpl' is no name of its own"),
        ([str(CORNELL), HALL, "-r", HALL_REFERENCE], "is of one scene; for several give a folder"),
        ([str(CORNELL), "-p", "lightcuts.bogus=1"], "lightcuts: the integrator 'lightcuts' has no parameter 'bogus'"),
        ([str(CORNELL), "-p", "lightcuts.error=-1"], 'property "error" must be a number of at least 0, got -1'),
        ([str(CORNELL), "-r", "path:many"], "not of the form path:SPP"),
        ([str(CORNELL), "-r", "path:auto:2"], "'2' is not a fraction"),
        ([str(CORNELL), "--sweep", "lightcuts:error"], "not of the form LABEL:KEY=VALUE"),
        ([str(CORNELL), "--sweep", "vpl:error=1"], "no such label; there are path, lightcuts"),
        ([str(CORNELL), "--sweep", "path:spp=0"], "spp: '0' is not a positive whole number"),
        ([str(CORNELL), "--sweep", "path:bogus=1,2"], "path bogus=1: the integrator 'path' has no parameter 'bogus'"),
        ([str(CORNELL), "--sweep", "-o", "/dev/null/a"], "cannot write to the folder '/dev/null/a': Not a directory"),
        ([str(CORNELL), "--sweep", "--check", "nosuch.json"], "'nosuch.json' cannot be read"),
        ([str(CORNELL), "--check-share", "2"], "'2' is not a fraction from 0 to 1"),
        ([str(CORNELL), "--seed", "4294967295", "--seeds", "2"], "too large for 2 seeds"),
        ([str(CORNELL), "-r", "nosuch.exr"], "neither a file"),
        ([str(CORNELL), "-r", str(ROOT / "tests")], "/tests/cornell.exr' for the scene"),
        ([str(CORNELL), "--spp", "1", "--time", "1"], "not allowed with"),
        ([str(CORNELL), "-m", "bogus"], "unknown variant 'bogus'"),
    ],
)
def test_usage_errors(arguments, message, capsys):
    try:
        status = compare.main(arguments)
    except SystemExit as error:
        status = error.code
    assert status == 2
    assert message in capsys.readouterr().err
