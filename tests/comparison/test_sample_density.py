"""Samples of pixels in images that will be denoised."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import fine_film, rendering, single_pass
from comparison.checkpoint import Checkpoint
from comparison.images import with_colour
from comparison.pass_sizes import PROBE
from comparison.sample_density import LEAST_SAMPLES, SampleDensity
from comparison.timed_sizes import PASS_SECONDS, TimedSizes
from tests.comparison.test_pass_sizes import render as made_up_passes
from tests.support.scenes import area_light, closed_box, cornell
from tests.support.statistics import assert_same_mean

SIZE = 48


def learned(difference, left=1.0):
    """The density learned from two halves of a grey image that differ by `difference`, of which the denoiser leaves the
    fraction `left`."""
    density = SampleDensity(lambda image, names, quality: 1 + (image - 1) * np.float32(left))
    image = np.ones((SIZE, SIZE, 3), np.float32)
    half = image + np.float32(difference)[..., None] / 2
    density.learn(image, half, ["R", "G", "B"])
    return density


def corner(level):
    """Differences of 0.1, and in a quarter of the image of `level`."""
    difference = np.full((SIZE, SIZE), 0.1)
    difference[: SIZE // 2, : SIZE // 2] = level
    return difference


def same(first, second):
    """Whether two densities have about as many samples in the corner: rounding chooses among equal pixels."""
    corners = [density.relative[: SIZE // 2, : SIZE // 2].mean() for density in (first, second)]
    return corners[0] == pytest.approx(corners[1], rel=0.05)


def test_pixels_where_halves_differ_have_more_samples():
    density = learned(corner(0.4))
    assert density.relative.mean() == 1
    inside, outside = density.relative[4:20, 4:20], density.relative[30:, 30:]
    # In proportion to the difference, 1 to 4, up to the rounding to powers of two
    assert inside.min() >= 2 and outside.max() <= 1 and inside.mean() == pytest.approx(4 * outside.mean(), rel=0.45)
    assert density.seconds > 0


def test_equal_differences_give_equal_numbers():
    density = learned(np.full((SIZE, SIZE), 0.1))
    assert (density.relative == 1).all()


def test_noise_counts_with_and_without_the_denoiser():
    """Four times the noise, of which the denoiser leaves a sixteenth, is a quarter of it then: numbers are equal."""
    left = np.where(corner(0.4) == 0.4, 1 / 16, 1)[..., None]
    assert (learned(corner(0.4), left).relative == 1).all()
    assert same(learned(corner(0.4), 0.1), learned(corner(0.4)))


def test_noise_that_the_denoiser_removes_determines_nothing():
    assert learned(corner(0.4), 0.0).relative is None


def test_pixels_that_are_not_finite_have_samples():
    density, image = SampleDensity(lambda image, names, quality: np.nan_to_num(image)), np.ones((SIZE, SIZE, 3))
    half = image + corner(0.4)[..., None] / 2
    half[20, 20] = image[20, 20] = np.nan
    density.learn(image, half, ["R", "G", "B"])
    inside, outside = density.relative[:24, :24], density.relative[24:, 24:]
    assert inside.mean() > 3 * outside.mean() and inside.min() > 0 and density.relative.mean() == 1


def test_the_sign_of_a_difference_does_not_matter():
    assert same(learned(corner(0.4)), learned(-corner(0.4)))


def test_a_firefly_does_not_take_all_samples():
    difference = corner(0.1)
    difference[10, 10] = 1e4
    assert learned(difference).relative.max() == 1


def test_equal_halves_determine_nothing():
    assert learned(np.zeros((SIZE, SIZE))).relative is None


def test_films_of_one_channel_have_the_luminance_of_the_halves():
    density = SampleDensity(lambda image, names, quality: image)
    half = np.zeros((SIZE, SIZE, 3), np.float32)
    half[..., 1] = 1 + corner(0.4) / 2  # green alone
    density.learn(np.full((SIZE, SIZE, 1), 0.71516, np.float32), half, ["Y"])
    assert same(density, learned(corner(0.4)))


def test_films_of_xyz_have_the_samples_of_others():
    """Halves are in RGB."""
    image = np.broadcast_to(np.float32([1, 0.2, 0.1]), (SIZE, SIZE, 3))
    half, found = image * np.float32(1 + corner(0.4) / 2)[..., None], []
    for names in ("RGB", "XYZ"):
        found.append(SampleDensity(lambda image, names, quality: image))
        found[-1].learn(with_colour(image, names, image), half, names)
    assert same(*found) and not same(found[0], learned(corner(0.1)))


def passes_of(monkeypatch, scene, integrator, **limits):
    """(Whether a pass had numbers of its own, whether it made halves) of each pass of a render."""
    seen, before = [], rendering.render_pass

    def spied(*arguments, density, half, **more):
        seen.append((density is not None, half))
        return before(*arguments, density=density, half=half, **more)

    monkeypatch.setattr(rendering, "render_pass", spied)
    manylights.render(scene, integrator, **limits)
    return seen


EQUAL, HALVES, OWN = (False, False), (False, True), (True, False)


def test_passes_of_images_for_denoising_have_numbers_of_their_own(monkeypatch):
    found = passes_of(monkeypatch, cornell().load(), "manylights", spp=60, denoise=True)
    assert found[:2] == [EQUAL, HALVES] and set(found[2:]) == {OWN}


@pytest.mark.parametrize("spp", [61, 62, 64, 72])
def test_only_a_remainder_below_sixteen_samples_has_equal_numbers(monkeypatch, spp):
    found = passes_of(monkeypatch, cornell().load(), "manylights", spp=spp, denoise=True)
    assert found[:2] == [EQUAL, HALVES] and set(found[2:-1]) == {OWN} and found[-1] == EQUAL


@pytest.mark.parametrize(
    ("integrator", "limits"),
    [
        ("manylights", {"spp": 64}),
        ("path", {"spp": 64, "denoise": True}),
        ("manylights", {"spp": 64, "denoise": True, "error": 1e-6}),
        ("manylights", {"spp": 64, "denoise": True, "pass_spp": 16}),
        # No pass would follow
        ("manylights", {"spp": 16, "denoise": True}),
    ],
)
def test_other_passes_have_equal_numbers(monkeypatch, integrator, limits):
    assert set(passes_of(monkeypatch, cornell().load(), integrator, **limits)) == {EQUAL}


def test_films_with_another_filter_have_equal_numbers_in_their_own_resolution(monkeypatch):
    scene = closed_box({"lamp": area_light()}, 16)
    scene["sensor"]["film"]["rfilter"] = {"type": "gaussian"}
    assert OWN in passes_of(monkeypatch, mi.load_dict(scene), "manylights", spp=64, denoise=True)
    monkeypatch.setattr(fine_film, "LARGEST", 1000)
    assert set(passes_of(monkeypatch, mi.load_dict(scene), "manylights", spp=64, denoise=True)) == {EQUAL}


def test_images_with_few_samples_in_a_pass_have_equal_numbers(monkeypatch):
    scene, plugin = cornell().load(), mi.load_dict({"type": "manylights", "denoised": True})
    progressive = rendering.Progressive(scene, 0, integrator=plugin, denoise=print)
    assert progressive.differs
    monkeypatch.setattr(single_pass, "MAXIMUM_PASS_SAMPLES", 7 * progressive.pixels // single_pass.MORE_IN_PARTS)
    assert not progressive.differs


@pytest.mark.parametrize(("parts", "before", "after"), [(1, 1, [1, 2, 3, 4, 8, 12, 16]), (2, 4, [4, 8, 12, 16, 32])])
def test_any_size_is_accepted_before_numbers_are_determined(parts, before, after):
    plugin = mi.load_dict({"type": "manylights", "denoised": True})
    progressive = rendering.Progressive(cornell().load(), 0, integrator=plugin, denoise=print, parts=parts)
    sizes = range(1, 10 * before)
    assert [spp for spp in sizes if progressive.accepts(spp)] == list(sizes[before - 1 :: before])
    progressive.density.relative = np.ones((16, 16))
    assert [spp for spp in range(1, after[-1] + 3) if progressive.accepts(spp)] == after


def test_the_error_of_different_numbers_is_unknown():
    scene = cornell().load()
    assert manylights.render(scene, "manylights", spp=64, denoise=True)[1].error is None
    assert manylights.render(scene, "manylights", spp=64, pass_spp=16, denoise=True)[1].error > 0


def test_an_interrupted_render_goes_on_with_its_numbers(tmp_path):
    # With half the width, some seeds give all pixels the same number
    scene, limits = cornell(32).load(), {"spp": 256, "denoise": True, "seed": 3}
    checkpoints = [Checkpoint(tmp_path / "image.checkpoint.npz", {"seed": 3}) for _ in range(2)]

    def stop(took, image):
        """End after the second pass, which determines the numbers."""
        return took.passes < 2

    seen = []
    before = rendering.Progressive.render

    def spied(progressive, *arguments, **more):
        seen.append(progressive.density.relative)
        return before(progressive, *arguments, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering.Progressive, "render", spied)
        manylights.render(scene, "manylights", checkpoint=checkpoints[0], progress=stop, **limits)
        manylights.render(scene, "manylights", checkpoint=checkpoints[1], **limits)
    assert seen[0] is None and seen[1] is None and seen[2] is not None and (seen[2] != 1).any()


def spied_passes(monkeypatch):
    """A list that receives (samples per pixel, `Continued`) of each later pass."""
    seen, before = [], rendering.render_pass

    def spied(*arguments, continued, **more):
        seen.append((arguments[3], continued))
        return before(*arguments, continued=continued, **more)

    monkeypatch.setattr(rendering, "render_pass", spied)
    return seen


@pytest.mark.parametrize("interrupted", [False, True])
def test_passes_with_numbers_of_their_own_share_lattices(tmp_path, monkeypatch, interrupted):
    """Each goes on after those before; the first two and a small last one have lattices of their own."""
    scene, limits = cornell().load(), {"spp": 135, "denoise": True}
    seen = spied_passes(monkeypatch)
    monkeypatch.setattr(single_pass, "MAXIMUM_PASS_SAMPLES", 16 * 16 * 32 // single_pass.MORE_IN_PARTS)
    for most in (4, 100) if interrupted else (100,):
        checkpoint = Checkpoint(tmp_path / "image.checkpoint.npz", {})
        progress = lambda took, _, most=most: took.passes < most  # noqa: E731
        manylights.render(scene, "manylights", checkpoint=checkpoint, progress=progress, **limits)
    shared = [(spp, continued.earlier) for spp, continued in seen if continued]
    assert [one for _, one in seen[:2]] == [None, None] and seen[-1][1] is None and len(shared) > 2
    assert shared == [(spp, sum(size for size, _ in shared[:index])) for index, (spp, _) in enumerate(shared)]
    assert len({continued.seed for _, continued in seen if continued}) == 1


@pytest.mark.parametrize("limits", [{}, {"error": 1e-4}, {"denoise": True}])
def test_passes_of_raw_images_share_lattices_unless_they_end_by_error(monkeypatch, limits):
    seen = spied_passes(monkeypatch)
    for spp, shared in ((12, [None, 0, 4]), (8, [None, None])):
        seen.clear()
        _, took = manylights.render(cornell().load(), "manylights", spp=spp, pass_spp=4, **limits)
        assert took.error > 0
        found = [continued and continued.earlier for _, continued in seen]
        assert found == ([None] * len(shared) if limits else shared)


def test_passes_that_share_lattices_have_the_mean_and_less_noise():
    """Direct light of a large lamp, which a lattice samples well."""
    scene = mi.load_dict(closed_box({"lamp": area_light()}, 16))
    plugin = mi.load_dict({"type": "manylights", "max_depth": 2})

    @cache
    def image(shares, seed):
        progressive = rendering.Progressive(scene, seed, integrator=plugin)
        progressive.shares_lattices = shares
        for spp in (2, 10, 10, 10, 10):
            progressive.render(spp)
        return progressive.image[..., :3]

    shared, alone = (np.array([image(shares, seed) for seed in range(8)]) for shares in (True, False))
    assert shared.var(0, ddof=1).mean() < 0.85 * alone.var(0, ddof=1).mean()
    assert_same_mean(lambda seed: (image(True, seed), image(False, seed)), 8)


def test_a_seed_gives_the_same_image():
    scene = cornell().load()
    first, second = (
        manylights.render(scene, "manylights", spp=64, seed=5, denoise=True)[1].raw.numpy() for _ in range(2)
    )
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5)


def test_the_raw_image_has_the_mean_of_path(variant):
    scene = closed_box({"lamp": area_light()}, 16)
    scene, depth = mi.load_dict(scene), {"max_depth": 4}
    plugin, path = (
        mi.load_dict({"type": "manylights", "denoised": True, **depth}),
        mi.load_dict({"type": "path"} | depth),
    )

    def pair(seed):
        image = manylights.render(scene, plugin, spp=64, seed=1000 * seed, denoise=True)[1].raw
        return image.numpy(), mi.render(scene, integrator=path, spp=64, seed=seed + 7).numpy()

    assert_same_mean(pair, 12, 0.02)


# --- Sizes of passes ---


@pytest.mark.parametrize("time", [10.0, 60.0])
def test_a_pass_that_determines_numbers_is_short(time):
    passes, _ = made_up_passes(256 * 128, 0.05, 0.04, 0.3, time=time, in_parts=True, probes=True)
    probe, rest = passes[1], passes[2:]
    assert probe.seconds <= PROBE * 10 + 0.5 and probe.spp >= LEAST_SAMPLES
    assert sum(one.spp for one in rest) > 0.6 * sum(one.spp for one in passes)
    assert sum(one.seconds for one in passes) <= time + PASS_SECONDS / 4


@pytest.mark.parametrize("multiple", [4, 8])
@pytest.mark.parametrize("spp", [16, 64, 256])
def test_a_pass_that_determines_numbers_has_a_quarter_of_the_samples_that_are_left(spp, multiple):
    limits = {"spp": spp, "in_parts": True, "probes": True, "multiple": multiple}
    passes, ended_by = made_up_passes(256 * 128, 0.05, 0.004, 0.3, **limits)
    assert ended_by == "spp" and sum(one.spp for one in passes) == spp
    expected = int(PROBE * (spp - 4)) // multiple * multiple
    assert passes[1].spp == (expected if expected >= LEAST_SAMPLES else spp - 4)


@pytest.mark.parametrize("limits", [{"spp": 59}, {"time": 2.4}])
def test_short_renders_have_no_pass_that_determines_numbers(limits):
    """Of fewer than 60 samples, of which a sample takes 0.04 seconds."""
    found = [
        made_up_passes(256 * 128, 0.05, 0.04, 0.0, in_parts=True, probes=probes, **limits)[0]
        for probes in (True, False)
    ]
    sizes, expected = ([one.spp for one in passes] for passes in found)
    assert sizes == expected and 50 < sum(sizes) < 60


@pytest.mark.parametrize("limits", [{"spp": 60}, {"time": 3.2}])
def test_renders_of_sixty_samples_have_a_pass_that_determines_numbers(limits):
    passes, _ = made_up_passes(256 * 128, 0.05, 0.04, 0.0, in_parts=True, probes=True, **limits)
    rest = sum(one.spp for one in passes[1:])
    assert LEAST_SAMPLES <= passes[1].spp <= PROBE * rest


def test_a_slow_first_pass_does_not_end_a_render():
    passes, ended_by = made_up_passes(256 * 128, 0.05, 0.04, 6.0, 0.3, time=60.0, in_parts=True, probes=True)
    assert ended_by == "time" and passes[0].seconds > 6
    assert sum(one.seconds for one in passes) > 55


def test_large_images_in_short_renders_have_passes_as_without_a_probe():
    """Where a probe would have too few samples, in an image of a third of a million pixels."""
    found = [
        made_up_passes(768 * 432, 0.05, 0.3, 1.0, 0.3, time=6.0, in_parts=True, probes=probes)[0]
        for probes in (True, False)
    ]
    sizes, expected = ([one.spp for one in passes] for passes in found)
    assert sizes == expected and max(sizes) > 4


def test_given_sizes_of_passes_are_kept():
    passes, _ = made_up_passes(256 * 128, 0.05, 0.004, 0.3, spp=256, fixed=64, in_parts=True, probes=True)
    assert [one.spp for one in passes] == [64] * 4


def test_passes_that_cost_more_than_expected_end_by_the_limit():
    sizes, passes, elapsed = TimedSizes(256 * 128, 10, in_parts=True, probes=True), [], 0.0
    while not isinstance(spp := sizes.next(passes, elapsed), str):
        # Virtual lights from 24 samples on, whose cost is 1.2 times the predicted one
        seconds = 0.05 + 0.04 * spp * (1.8 if spp >= 24 else 1)
        stages = {"traced": seconds - 0.05} | ({"cuts": 0.0} if spp >= 24 else {})
        costs = [(1, (1.0, 0.0, 0.0)), (4, (1.0 if spp >= 24 else 1.5, 0.0, 0.0))]
        statistics = {"seconds": stages, "costs": costs}
        passes.append(single_pass.Pass(0, spp, seconds, statistics))
        elapsed += seconds
    assert 9 < elapsed < 10.5
