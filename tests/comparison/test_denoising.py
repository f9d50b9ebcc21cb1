"""Denoising: auxiliary features, the error, and files."""

import json
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

import compare
import manylights
from benchmarks.denoised import _warm_denoiser
from comparison import images, worker
from comparison import render as rendering_module
from comparison.denoising import Denoiser
from tests.support.comparisons import results_of
from tests.support.marks import stress
from tests.support.paths import CORNELL, ROOT
from tests.support.processes import PATIENCE
from tests.support.rendering import render
from tests.support.scenes import cornell
from vpl.split.cost_model import CostModel


def squared_error(image, exact):
    return np.mean(np.square(image - exact) / (np.square(exact) + 0.01 * exact.mean() ** 2))


@pytest.fixture(scope="module")
def exact(variant):
    return render(cornell(64).load(), "path", 1024, 99, max_depth=6)


@pytest.mark.parametrize("integrator", ["path", "manylights", *stress("lightcuts")])
def test_denoised_image_is_closer_to_the_reference(exact, integrator):
    scene = cornell(64).load()
    image, took = manylights.render(scene, mi.load_dict({"type": integrator, "max_depth": 6}), spp=16, denoise=True)
    raw, denoised = (squared_error(one.numpy(), exact) for one in (took.raw, image))
    # The less noise an image has, the less of it a denoiser removes
    assert denoised < {"path": 0.3, "manylights": 0.4, "lightcuts": 1}[integrator] * raw
    assert abs(image.numpy().mean() / exact.mean() - 1) < 0.02
    assert 0 < took.denoise_seconds < took.seconds


@pytest.mark.parametrize("integrator", ["path", "manylights"])
def test_the_raw_image_has_the_mean_and_the_noise_of_one_without_denoising(exact, integrator):
    scene, plugin = cornell(64).load(), mi.load_dict({"type": integrator, "max_depth": 6})
    raw, plain = (
        [render_image(seed) for seed in range(4)]
        for render_image in (
            lambda seed: manylights.render(scene, plugin, spp=16, seed=seed, denoise=True)[1].raw.numpy(),
            lambda seed: manylights.render(scene, plugin, spp=16, seed=seed)[0].numpy(),
        )
    )
    assert np.mean(raw) == pytest.approx(np.mean(plain), rel=0.02)
    assert squared_error(np.array(raw), exact) == pytest.approx(squared_error(np.array(plain), exact), rel=0.25)


@pytest.mark.parametrize("denoise", [True, False])
def test_a_plugin_by_name_is_balanced_for_the_denoiser_and_an_object_keeps_its_property(denoise, monkeypatch):
    plugin, told, scene = mi.load_dict({"type": "manylights", "max_depth": 3}), [], cornell(16).load()
    without = CostModel.without_denoiser
    monkeypatch.setattr(CostModel, "without_denoiser", lambda model: told.append(model) or without(model))
    manylights.render(scene, plugin, spp=1, denoise=denoise)
    assert len(told) == 1 and not plugin.denoised
    manylights.render(scene, "manylights", spp=1, denoise=denoise)
    assert len(told) == (1 if denoise else 2)


def test_a_quality_chooses_the_network():
    scene, plugin = cornell(32).load(), mi.load_dict({"type": "path", "max_depth": 3})
    high, fast, usual = (
        manylights.render(scene, plugin, spp=64, denoise=one)[0].numpy() for one in ("high", "fast", True)
    )
    np.testing.assert_array_equal(high, usual)
    assert 0 < np.abs(high - fast).mean() < 0.3 * high.mean()
    with pytest.raises(ValueError, match="denoise must be True, False or one of high, balanced, fast, got 'best'"):
        manylights.render(scene, plugin, spp=2, denoise="best")


def test_time_includes_denoising(monkeypatch):
    """What the filter will take is reserved."""
    told, original = [], rendering_module.sizes_of

    def sizes(progressive, spp, time, *more):
        told.append(time)
        return original(progressive, spp, time, *more)

    monkeypatch.setattr(rendering_module, "sizes_of", sizes)
    manylights.render(cornell().load(), time=1, denoise=True)
    assert 0 < told[0] < 1


def test_only_colour_is_denoised_and_bad_pixels_stay_alone():
    scene = cornell(32).load()
    image = np.random.default_rng(0).random((32, 32, 5)).astype(np.float32)
    image[3, 4, 1] = np.nan
    channels = ["R", "G", "B", "A", "cut_size"]
    found = Denoiser(scene).denoise(image, channels)
    assert np.isfinite(found).all() and found.shape == image.shape
    np.testing.assert_array_equal(found[..., 3:], image[..., 3:])
    assert found[..., :3].std() < image[..., [0, 2]].std()


def test_the_colour_of_xyz_is_denoised():
    scene, image = cornell(32).load(), np.random.default_rng(0).random((32, 32, 3)).astype(np.float32)
    rgb, xyz = ["R", "G", "B"], ["X", "Y", "Z"]
    in_xyz = images.with_colour(image, xyz, image)
    denoiser = Denoiser(scene)
    found = images.colour(denoiser.denoise(in_xyz, xyz), xyz)
    np.testing.assert_allclose(found, denoiser.denoise(image, rgb), atol=1e-3)


def test_an_interrupted_image_is_denoised_however_long_that_takes(tmp_path):
    script = f"""
import signal, sys, threading, time
from types import SimpleNamespace
import mitsuba as mi
import manylights
from comparison import interruption
from comparison.denoising import Denoiser
interruption.PATIENCE = 0.5
render, denoise, calls, denoising = mi.render, Denoiser.denoise_passes, [], threading.Event()
class Event(threading.Event):  # the patience begins with the denoising, however slow the machine renders
    def wait(self, timeout):
        return denoising.wait() and super().wait(timeout)
interruption.threading = SimpleNamespace(**vars(threading) | {{"Event": Event}})
def interrupted(*arguments, **keywords):
    calls.append(1)
    if len(calls) == 4:
        signal.raise_signal(signal.SIGINT)
    return render(*arguments, **keywords)
def slow(*arguments):
    denoising.set()
    time.sleep(1.5)
    return denoise(*arguments)
mi.render, Denoiser.denoise_passes = interrupted, slow
size = ["-D", "resx=24", "-D", "resy=24", "--pass-spp", "4", "--spp", "400"]
sys.exit(manylights.main([{CORNELL!r}, *size, "-o", {str(tmp_path / "a.exr")!r}, "--denoise"]))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 130 and "interrupted; wrote" in done.stderr, done.stderr
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.denoised.exr", "a.exr"]


def command(*arguments):
    try:
        return manylights.main([CORNELL, "-D", "resx=24", "-D", "resy=24", "--spp", "4", *map(str, arguments)])
    except SystemExit as error:
        return error.code


def test_denoised_exr_is_beside_the_raw_one(tmp_path):
    assert command("-o", tmp_path / "a.exr", "--denoise") == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.denoised.exr", "a.exr"]
    raw, _, _ = images.read_exr(tmp_path / "a.exr")
    denoised, _, metadata = images.read_exr(tmp_path / "a.denoised.exr")
    assert command("-o", tmp_path / "b.exr") == 0
    assert raw.shape == images.read_exr(tmp_path / "b.exr")[0].shape
    assert raw.shape == denoised.shape and np.abs(raw - denoised).max() > 0.01
    assert metadata["denoise_resolution"] == 2
    assert 0 < metadata["denoise_seconds"] < metadata["render_seconds"]
    assert "denoised" not in images.read_exr(tmp_path / "b.exr")[2]["parameters"]


@pytest.mark.parametrize(("given", "expected"), [([], True), (["-p", "denoised=false"], False)])
def test_the_command_sets_the_property_unless_it_is_given(tmp_path, given, expected, monkeypatch):
    told, without = [], CostModel.without_denoiser
    monkeypatch.setattr(CostModel, "without_denoiser", lambda model: told.append(model) or without(model))
    assert command("-o", tmp_path / "a.exr", "--denoise", "-i", "manylights", *given) == 0
    assert len(told) == (0 if expected else 1)
    assert json.loads(images.read_exr(tmp_path / "a.exr")[2]["parameters"])["denoised"] is expected


def test_the_comparison_sets_the_property_unless_it_is_given():
    options = compare.parse([CORNELL, "-i", "path,manylights,raw=manylights", "-p", "raw.denoised=false", "--denoise"])
    chosen = {label: given for label, (_, given) in compare.chosen_integrators(options).items()}
    assert chosen == {"path": {}, "manylights": {"denoised": True}, "raw": {"denoised": False}}


def test_the_command_passes_the_quality_on(tmp_path, capsys):
    for quality in ("high", "fast"):
        assert command("-o", tmp_path / f"{quality}.exr", "--denoise", "--denoise-quality", quality) == 0
    high, fast = (images.read_exr(tmp_path / f"{quality}.denoised.exr")[0] for quality in ("high", "fast"))
    assert np.abs(high - fast).max() > 0
    assert command("--denoise", "--denoise-quality", "best") == 2
    assert "invalid choice: 'best'" in capsys.readouterr().err
    assert command("--denoise-quality", "fast") == 2
    assert "--denoise-quality needs --denoise" in capsys.readouterr().err
    assert images.read_exr(tmp_path / "fast.denoised.exr")[2]["denoise_quality"] == "fast"


def test_png_shows_the_denoised_image(tmp_path):
    assert command("-o", tmp_path / "a.png", "--denoise", "--exposure", "0") == 0
    assert command("-o", tmp_path / "a.exr", "--denoise") == 0
    denoised, channels, described = images.read_exr(tmp_path / "a.denoised.exr")
    expected = images.tone_map(images.colour(denoised, channels), 1.0)
    assert np.abs(images.read_png(tmp_path / "a.png").astype(int) - expected).max() <= 1
    texts = mi.Bitmap(str(tmp_path / "a.png")).metadata()
    assert {"spp", "seed", "denoise_quality", "mitsuba"} <= set(texts) & set(described)
    # Mitsuba writes texts in quotes
    assert texts["integrator"].strip('"') == described["integrator"] == "manylights"


def test_without_the_package_the_message_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert command("-o", tmp_path / "a.exr", "--denoise") == 1
    assert "needs the package 'mitsuba_oidn'; pip install 'manylights[denoise]'" in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError, match="manylights\\[denoise\\]"):
        manylights.render(cornell().load(), denoise=True)
    assert command("-o", tmp_path / "a.exr") == 0  # nothing else needs it


@pytest.mark.parametrize(("spp", "samples"), [(1, 16), (13, 16), (20, 32), (40, 80), (1000, 128), (None, 128)])
def test_albedo_and_normal_have_twice_the_samples_of_the_image_within_limits(spp, samples):
    assert Denoiser(cornell(16).load(), spp=spp).feature_spp == samples


@pytest.mark.parametrize(("time_limit", "samples"), [(1e-3, 16), (1e6, 144)])
def test_albedo_and_normal_take_a_small_part_of_a_time_limit(time_limit, samples):
    assert Denoiser(cornell(16).load(), time_limit=time_limit).feature_spp == samples


@pytest.mark.parametrize(("size", "parts"), [(1, 1), (40, 1), (300, 1), (1, 2), (40, 2), (150, 2)])
def test_the_time_of_the_denoiser_is_expected_from_a_tile(size, parts, monkeypatch):
    """A made-up denoiser needs 10 microseconds for a pixel after the first call, which takes longer."""
    scene, widths = cornell(size).load(), []

    def seconds_of(self, inputs, quality):
        widths.append(inputs["color"].shape[0])
        assert {plane.shape for plane in inputs.values()} == {(widths[-1], widths[-1], 3)}
        return 1e-5 * widths[-1] ** 2 + (1.0 if len(widths) == 1 else 0.0)

    monkeypatch.setattr(Denoiser, "_seconds_of", seconds_of)
    assert Denoiser(scene, parts=parts).expected_seconds == pytest.approx(1e-5 * (parts * size) ** 2)
    assert widths == [min(parts * size, 64)] * 3


def test_tiles_become_larger_where_the_denoiser_is_fast(monkeypatch):
    scene, widths = cornell(300).load(), []
    monkeypatch.setattr(
        Denoiser, "_seconds_of", lambda self, inputs, quality: widths.append(len(inputs["color"])) or 1e-9
    )
    assert Denoiser(scene, parts=1).expected_seconds == 1e-9
    assert widths == [64, 64, 128, 256, 300, 300]


@pytest.mark.parametrize(("seconds", "last"), ((0.01, 128), (0.06, 64)))
def test_tiles_become_larger_where_an_image_takes_long(seconds, last, monkeypatch):
    """A tile takes a hundredth of the time of the image, unless that is longer than a twentieth of a second."""
    scene, widths = cornell(350).load(), []
    monkeypatch.setattr(
        Denoiser, "_seconds_of", lambda self, inputs, quality: widths.append(len(inputs["color"])) or seconds
    )
    assert Denoiser(scene, parts=2).expected_seconds == pytest.approx(seconds * 700**2 / last**2)
    assert widths == [64, 64, last] + [128] * (last == 128)


def made_up_networks(monkeypatch, share):
    """Networks of which the best one takes a `share` of 1000 seconds for the 40 × 40 pixels of an image."""
    times = {"high": 1.0, "balanced": 0.45, "fast": 0.24}

    def seconds_of(self, inputs, quality):
        return times[quality] * share * 1000 * self.parts**2 * inputs["color"][..., 0].size / (40 * self.parts) ** 2

    monkeypatch.setattr(Denoiser, "_seconds_of", seconds_of)
    return {name: time * share * 1000 for name, time in times.items()}


@pytest.mark.parametrize(
    ("share", "chosen"),
    [(0.1, "high"), (0.3, "high"), (0.5, "balanced"), (0.95, "fast"), (2.0, "fast"), (50.0, "fast")],
)
def test_the_network_suits_the_time(share, chosen, monkeypatch):
    times = made_up_networks(monkeypatch, share)
    found = Denoiser(cornell(40).load(), time_limit=1000, parts=1)
    assert found.quality == chosen and found.expected_seconds == pytest.approx(times[chosen])
    assert Denoiser(cornell(40).load(), time_limit=1000, quality="high", parts=1).quality == "high"
    assert Denoiser(cornell(40).load(), parts=1).quality == "high"


@pytest.mark.parametrize(
    ("share", "parts", "chosen"),
    [
        (0.01, 2, "high"),
        (0.05, 2, "high"),
        (0.1, 2, "balanced"),
        (0.2, 2, "fast"),
        (0.3, 2, "fast"),
        (0.37, 1, "balanced"),
    ],
)
def test_the_resolution_suits_the_time(share, parts, chosen, monkeypatch):
    made_up_networks(monkeypatch, share)
    found = Denoiser(cornell(40).load(), time_limit=1000, parts=2)
    assert (found.parts, found.quality) == (parts, chosen)
    assert found.description["denoise_resolution"] == parts
    # A network that is asked for is the one that has to be quick
    asked = Denoiser(cornell(40).load(), time_limit=1000, quality="high", parts=2)
    assert asked.parts == (2 if share <= 0.05 else 1) and asked.quality == "high"


@pytest.mark.parametrize(("spp", "chosen"), [(4, "fast"), (16, "balanced"), (64, "high"), (None, "high")])
def test_the_network_at_twice_the_resolution_suits_the_samples(spp, chosen):
    assert Denoiser(cornell(16).load(), spp=spp, parts=2).quality == chosen
    assert Denoiser(cornell(16).load(), spp=spp, quality="high", parts=2).quality == "high"


@pytest.mark.parametrize(
    ("spp", "parts", "copies"), [(4, 2, 1), (64, 2, 1), (256, 2, 2), (1024, 2, 4), (16, 1, 1), (64, 1, 2), (None, 2, 1)]
)
def test_copies_suit_the_samples(spp, parts, copies):
    found = Denoiser(cornell(16).load(), spp=spp, parts=parts)
    assert found.copies == found.description["denoise_copies"] == copies
    assert Denoiser(cornell(16).load(), spp=spp, quality="fast", parts=parts).copies == 1


@pytest.mark.parametrize(
    ("share", "copies", "seconds"), [(0.2, 1, 200), (0.1, 1, 100), (0.03, 2, 60), (0.005, 4, 22.34375)]
)
def test_copies_suit_the_time(share, copies, seconds, monkeypatch):
    """The last one includes two halves by the fastest network."""
    made_up_networks(monkeypatch, share)
    found = Denoiser(cornell(40).load(), time_limit=1000, parts=1)
    assert (found.quality, found.copies) == ("high", copies)
    assert found.expected_seconds == pytest.approx(seconds)


def test_copies_are_mirrored_back_and_averaged(monkeypatch):
    """A made-up denoiser moves the image to the right and upwards: its errors are mirrored."""
    monkeypatch.setattr(
        Denoiser,
        "_filtered",
        lambda self, inputs, network: np.roll(inputs["color"] * inputs["albedo"], (-1, 2), (0, 1)),
    )
    found, rng = Denoiser(cornell(32).load(), spp=16, parts=1), np.random.default_rng(2)
    image = rng.random((32, 32, 3)).astype(np.float32)
    given = image * found.merged_features["albedo"]
    moves = [(-1, 2), (1, -2), (-1, -2), (1, 2)]
    for copies in (1, 2, 4):
        found.copies = copies
        expected = np.mean([np.roll(given, move, (0, 1)) for move in moves[:copies]], axis=0)
        np.testing.assert_allclose(found.denoise(image, ["R", "G", "B"]), expected, rtol=1e-5)
        # A network that is asked for has one copy
        alone = found.denoise(image, ["R", "G", "B"], "fast")
        np.testing.assert_allclose(alone, np.roll(given, moves[0], (0, 1)), rtol=1e-5)


def slower_from_the_second_on(monkeypatch):
    """Let denoisers after the first one measure that networks take a thousand times as long."""
    denoisers, seconds_of = [], Denoiser._seconds_of

    def measured(self, inputs, quality):
        if self not in denoisers:
            denoisers.append(self)
        return seconds_of(self, inputs, quality) * (1 if self is denoisers[0] else 1000)

    monkeypatch.setattr(Denoiser, "_seconds_of", measured)


def test_a_denoiser_may_decide_as_another_one(monkeypatch):
    slower_from_the_second_on(monkeypatch)
    scene = cornell(64).load()
    first = Denoiser(scene, time_limit=1.0, parts=2)
    like, alone = Denoiser(scene, time_limit=1.0, like=first), Denoiser(scene, time_limit=1.0, parts=2)
    decisions = [(one.parts, one.quality, one.copies, one.restores) for one in (first, like, alone)]
    assert first.parts == 2 and decisions[0] == decisions[1] != decisions[2]
    assert like.features["albedo"].shape == (128, 128, 3)


def test_a_denoiser_that_decides_as_another_one_measures_what_that_one_measured(monkeypatch):
    """Also where the first one falls from two parts to one."""
    made_up_networks(monkeypatch, 0.37)
    measured, expected_by_tiles = [], Denoiser._expected_by_tiles
    monkeypatch.setattr(
        Denoiser,
        "_expected_by_tiles",
        lambda self, quality: measured.append((self, self.parts, quality)) or expected_by_tiles(self, quality),
    )
    scene = cornell(40).load()
    first = Denoiser(scene, time_limit=1000, parts=2)
    like = Denoiser(scene, time_limit=1000, like=first)
    own, other = ([more for found, *more in measured if found is one] for one in (first, like))
    assert first.parts == like.parts == 1 and own[0][0] == 2 and own == other


def test_a_run_is_denoised_as_its_first_denoiser_decided(tmp_path, monkeypatch):
    """The second one, whose time is told, makes the image."""
    slower_from_the_second_on(monkeypatch)
    files = [str(tmp_path / name) for name in ("a.exr", "a.denoised.exr")]
    job = worker.Job("p", "path", CORNELL, files[0], width=64, budget=1.0, denoised_output=files[1])
    worker.render(job)
    found = images.read_exr_metadata(files[1])
    assert found["denoise_resolution"] == 2 and found["denoise_quality"] == "high"


def test_the_benchmark_denoises_as_its_first_denoiser_decided(monkeypatch):
    slower_from_the_second_on(monkeypatch)
    assert _warm_denoiser(cornell(64).load(), 1.0, 2).parts == 2


def test_the_smallest_image_in_the_shortest_time():
    image, took = manylights.render(cornell(1).load(), "manylights", time=0.01, denoise=True)
    assert image.shape == (1, 1, 3) and np.isfinite(image.numpy()).all() and took.spp > 0


def test_mono_variant(tmp_path):
    script = f"""
import manylights
size = ["-D", "resx=24", "-D", "resy=24"]
assert manylights.main([{CORNELL!r}, *size, "-o", "a.exr", "-m", "llvm_ad_mono", "--spp", "4", "--denoise"]) == 0
"""
    environment = {"cwd": tmp_path, "capture_output": True, "text": True}
    root = manylights.__file__.rpartition("/")[0]
    done = subprocess.run([sys.executable, "-c", f"import sys; sys.path.insert(0, {root!r}){script}"], **environment)
    assert done.returncode == 0, done.stderr
    assert images.read_exr(tmp_path / "a.denoised.exr")[1] == ["Y"]


@pytest.mark.stress
def test_comparison_shows_raw_and_denoised(tmp_path, capsys):
    arguments = [
        CORNELL, "-i", "path,direct", "--spp", "8", "--seeds", "2", "--width", "64", "--reference", "path:512", "-o",
        str(tmp_path / "out"), "--cache", str(tmp_path / "cache"), "--denoise",
    ]  # fmt: skip
    assert compare.main(arguments) == 0
    first = results_of(tmp_path / "out")["scenes"][0]
    labels = [render["label"] for render in first["renders"]]
    assert labels == ["path", "path, denoised", "direct", "direct, denoised"] + [
        "direct", "direct, denoised", "path", "path, denoised"
    ]  # fmt: skip
    for raw, denoised in zip(first["renders"][::2], first["renders"][1::2], strict=True):
        assert denoised["denoised"] and not raw["denoised"]
        assert denoised["seconds"] == raw["seconds"] + raw["denoise_seconds"] > raw["seconds"]
        for one in (raw, denoised):
            assert images.read_exr_metadata(one["output"])["run"] == raw["run"]
    path, denoised = first["renders"][:2]
    assert denoised["errors"]["relmse_trimmed"] < 0.7 * path["errors"]["relmse_trimmed"]
    assert {point["label"] for point in first["points"]} >= {"path", "path, denoised"}
    assert (tmp_path / "out" / "cornell.path.denoised.png").is_file()
    page = (tmp_path / "out" / "report.html").read_text()
    titles = re.findall('"title": "([^"]*)"', page)
    assert titles == ["reference", "path", "path, denoised", "direct", "direct, denoised"]
    assert "\npath, denoised  " in capsys.readouterr().out

    assert compare.main([*arguments, "--resume"]) == 0
    again = results_of(tmp_path / "out")["scenes"][0]
    assert [render["seconds"] for render in again["renders"]] == [render["seconds"] for render in first["renders"]]
