"""The verdict of a comparison: ratios to the first integrator, means, and sentences."""

import pytest

from comparison import analysis, verdict


def run(label, setting, seconds, error, seed=0, noise=0.0, bias=0.0, integrator=None, denoised=False):
    errors = {"relmse": error, "rmse": error**0.5, "bias": bias, "noise": {"relmse": noise, "rmse": noise**0.5}}
    return {
        "label": label, "setting": setting, "integrator": integrator or label, "seed": seed, "seconds": seconds,
        "spp": 1, "rays_per_sample": None, "errors": errors, "denoised": denoised,
    }  # fmt: skip


def scene(name, *renders, metric="relmse"):
    labels = list(dict.fromkeys(render["label"] for render in renders))
    return {"name": name, "renders": renders} | analysis.analyse(renders, labels, metric)


def images(name, ours, seconds=10.0, **more):
    """Path with an error of 0.1 in ten seconds, and ours."""
    return scene(name, run("path", "", 10.0, 0.1), run("ours", "", seconds, ours, **more))


def curves(name, speed_up, seeds=1):
    return scene(name, *(
        run(label, f"spp={spp}", (1 + 0.02 * seed) * spp / factor, 1 / spp, seed)
        for seed in range(seeds) for label, factor in (("path", 1.0), ("ours", speed_up)) for spp in (1, 4, 16)
    ))  # fmt: skip


def outcome(of, metric="relmse"):
    (row,) = verdict.summarise([of], metric)["scenes"].values()
    return row["ours"]


def test_single_images_have_the_time_that_path_would_take():
    found = outcome(images("box", 0.02, bias=-0.03))
    assert (found["bias"], found["measured"], found["seconds"]) == (-0.03, 0.02, 10.0)
    assert found["error"]["value"] == pytest.approx(0.2) and not found["error"]["extrapolated"]
    assert found["time"]["value"] == pytest.approx(0.2) and found["time"]["extrapolated"]
    of_roots = outcome(scene("box", *images("box", 0.025)["renders"], metric="rmse"), "rmse")
    assert of_roots["error"]["value"] == pytest.approx(0.5) and of_roots["time"]["value"] == pytest.approx(0.25)


def test_errors_are_compared_at_equal_time_only():
    found = outcome(images("box", 0.02, seconds=12.0))
    assert found["error"] is None and found["time"]["value"] == pytest.approx(0.24)


def test_errors_of_others_need_not_fall_with_their_samples():
    renders = [run("cuts", "", 10.0, 0.1, integrator="lightcuts"), run("ours", "", 10.0, 0.05)]
    found = outcome(scene("box", *renders))
    assert found["time"] is None and found["error"]["value"] == pytest.approx(0.5)
    (sentence,) = verdict.summarise([scene("box", *renders)], "relmse")["sentences"]
    assert sentence == "ours has half of the error of cuts at equal time in box."


def test_what_the_noise_hides_is_a_bound():
    found = outcome(images("box", 0.001, noise=0.01))
    assert found["hidden"] and found["error"]["bound"] == found["time"]["bound"] == "at_most"
    assert found["error"]["value"] == pytest.approx(0.1)
    hidden = scene("box", run("path", "", 10.0, 0.01, noise=0.02), run("ours", "", 10.0, 0.1))
    assert outcome(hidden)["error"]["bound"] == "at_least" and outcome(hidden)["error"]["value"] == pytest.approx(5)
    both = scene("box", run("path", "", 10.0, 0.01, noise=0.02), run("ours", "", 10.0, 0.01, noise=0.02))
    assert outcome(both)["error"] is None
    assert verdict.summarise([both], "relmse")["sentences"] == [
        "These runs do not determine the performance of ours relative to path."
    ]


def test_curves_are_read_off():
    found = outcome(curves("box", 5, seeds=3))
    assert found["time"]["value"] == pytest.approx(0.2) and not found["time"]["extrapolated"]
    assert found["time"]["low"] <= 0.2 <= found["time"]["high"] and found["setting"] == "spp=16"
    assert found["error"]["value"] == pytest.approx(0.2, rel=0.02)


def test_curves_that_share_no_error_are_bounds():
    slow = scene("box", *(
        run(label, f"spp={spp}", seconds, error) for label, spp, seconds, error in (
            ("path", 1, 1.0, 0.4), ("path", 2, 2.0, 0.2), ("ours", 1, 50.0, 0.8), ("ours", 2, 100.0, 0.6),
        )
    ))  # fmt: skip
    found = outcome(slow)
    assert found["time"]["bound"] == "at_least" and found["time"]["value"] == pytest.approx(100)


def test_sentences_count_scenes_and_name_the_others():
    scenes = [curves(name, factor) for name, factor in (("a", 10), ("b", 10), ("c", 0.5), ("d", 1.02))]
    summary = verdict.summarise(scenes, "relmse")
    assert summary["sentences"] == [
        "ours needs less time than path for the same error in 2 of 4 scenes (geometric mean: 37% of the time). It "
        "needs more time in c (2×)."
    ]
    mean = summary["means"]["ours"]["time"]
    assert mean["value"] == pytest.approx((0.1 * 0.1 * 2 / 1.02) ** 0.25) and mean["scenes"] == 4
    only = verdict.summarise([curves("a", 5)], "relmse")["sentences"]
    assert only == ["ours needs a fifth of the time of path for the same error in a."]


def test_scenes_without_an_answer_are_counted():
    failed = {"name": "broken", "renders": [], "error": "no such file"}
    (sentence,) = verdict.summarise([images("a", 0.02), images("b", 0.02), failed], "relmse")["sentences"]
    assert sentence == (
        "ours needs less time than path for the same error in 2 of 3 scenes (geometric mean over 2 scenes: about a "
        "fifth of the time)."
    )


def test_the_best_comes_first():
    (box,) = [scene("box", *(run(label, "", 10.0, error) for label, error in (("path", 1), ("a", 0.5), ("b", 0.1))))]
    assert [text.split()[0] for text in verdict.summarise([box], "relmse")["sentences"]] == ["b", "a"]


def test_nothing_is_said_without_runs():
    nothing = {"base": None, "bases": {}, "scenes": {}, "means": {}, "sentences": []}
    assert verdict.summarise([], "relmse") == nothing


def with_denoised(*renders):
    """Raw images, and their denoised images with a tenth of the error, in a second more."""
    return scene("box", *renders, *(
        run(f"{one['label']}, denoised", one["setting"], one["seconds"] + 1, one["errors"]["relmse"] * factor,
            integrator=one["integrator"], denoised=True)
        for one, factor in zip(renders, (0.1, 0.5), strict=True)
    ))  # fmt: skip


def test_denoised_images_are_compared_with_denoised_images_and_come_first():
    found = verdict.summarise([with_denoised(run("path", "", 10.0, 0.1), run("ours", "", 10.0, 0.01))], "relmse")
    assert found["sentences"] == [
        "Denoised, ours has half of the error of path at equal time in box.",
        "ours needs about a tenth of the time of path for the same error in box.",
    ]
    assert found["base"] == "path" and next(iter(found["scenes"]["box"])) == "path, denoised"
    assert found["bases"] == {
        "path, denoised": "path, denoised", "ours, denoised": "path, denoised", "path": "path", "ours": "path"
    }  # fmt: skip
    # The denoised error does not fall with the number of samples at a known rate
    assert found["scenes"]["box"]["ours, denoised"]["time"] is None
    assert set(found["means"]) == {"ours", "ours, denoised"}


def test_the_first_integrator_stays_the_base_of_denoised_images_where_it_failed():
    """A failed run has no denoised image."""
    failed = with_denoised(run("path", "", 10.0, 0.1), run("ours", "", 10.0, 0.01)) | {"name": "first"}
    failed["renders"] = [one for one in failed["renders"] if one["label"] != "path, denoised"]
    good = with_denoised(run("path", "", 10.0, 0.1), run("ours", "", 10.0, 0.01))
    found = verdict.summarise([failed, good], "relmse")
    assert found["bases"]["ours, denoised"] == found["bases"]["path, denoised"] == "path, denoised"
    assert found["scenes"]["first"]["ours, denoised"]["error"] is None
    assert found["scenes"]["box"]["ours, denoised"]["error"]["value"] == pytest.approx(0.5)


def test_curves_of_denoised_images_are_relative_to_the_denoised_curve():
    runs = [
        run(f"{label}{end}", f"spp={spp}", spp / factor, scale / spp, denoised=bool(end))
        for end, scale, speed_up in (("", 1.0, 10), (", denoised", 0.1, 4))
        for label, factor in (("path", 1.0), ("ours", speed_up)) for spp in (1, 4, 16)
    ]  # fmt: skip
    row = verdict.summarise([scene("box", *runs)], "relmse")["scenes"]["box"]
    assert row["ours, denoised"]["time"]["value"] == pytest.approx(0.25, rel=0.02)
    assert row["ours"]["time"]["value"] == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize(
    ("value", "bound", "text"),
    [
        (0.2, None, "a fifth of"), (0.5, "at_most", "at most half of"), (0.04, None, "1/25 of"), (0.7, None, "70% of"),
        (1.0, None, "about"), (1.4, None, "1.4 times"), (12.3, "at_least", "at least 12 times"),
    ],
)  # fmt: skip
def test_sizes_in_words(value, bound, text):
    ratio = {"value": value, "bound": bound, "low": None, "high": None, "extrapolated": False}
    assert verdict.in_words(ratio) == text


@pytest.mark.parametrize(
    ("value", "low", "high", "bound", "found"),
    [
        (0.9, None, None, None, "better"), (0.97, None, None, None, "alike"), (1.2, None, None, None, "worse"),
        (0.5, 0.2, 1.1, None, "alike"), (0.5, 0.4, 0.6, None, "better"), (0.5, None, None, "at_least", None),
        (2.0, None, None, "at_most", None), (0.5, None, None, "at_most", "better"),
    ],
)  # fmt: skip
def test_differences_have_to_exceed_their_intervals(value, low, high, bound, found):
    ratio = {"value": value, "low": low, "high": high, "bound": bound, "extrapolated": False}
    assert verdict.verdict_of(ratio) == found
