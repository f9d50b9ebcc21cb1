"""Numbers of emitter samples at first scattering vertices: their choice, and an image equal to `path`."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import mitsuba as mi
import numpy as np
import pytest

from tests.integrators.test_light_groups import LENGTHS, assert_sums, layers_of
from tests.integrators.test_null_surfaces import sheets
from tests.support.many_emitters import bulbs, panels
from tests.support.marks import stress
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.scenes import area_light, closed_box, rgb, wall
from tests.support.statistics import assert_same_mean
from vpl.split import start
from vpl.split.cost_model import CostModel
from vpl.split.emitter_samples import EmitterSamples
from vpl.split.path_tracer import _numbers_of_sample
from vpl.split.pilot import Pilot, relative_variance

MODEL = CostModel().without_denoiser()
WIDTH = 16


def effect(difference, fraction=1.0, count=4096, noise=(0.0, 0.0), **constants):
    """The effect of samples with a ``difference`` by pixel, in pairs of paths all over an image of even brightness.

    ``noise``: standard deviation of paths with the weight of one of two samples, and with that of a single one.
    """
    pixel = np.repeat(np.random.default_rng(0).permutation(count // 2) % WIDTH**2, 2)
    paths = SimpleNamespace(
        model=replace(MODEL, **constants), brightness=np.ones(count), pixel=pixel, size=(WIDTH, WIDTH**2)
    )
    random = np.random.default_rng(1).standard_normal(count)
    of_several, alone = (1 + one * random for one in noise)
    return EmitterSamples.of(
        paths, SimpleNamespace(difference=difference(pixel), radiance=of_several, alone=alone), fraction
    )


def left_half(pixel):
    return pixel % WIDTH < WIDTH // 2


def test_the_numbers_are_the_best_of_all_multiples():
    """With the same difference in all pixels, the oracle tries every number."""
    found = effect(lambda pixel: 0.5 + 0 * pixel)
    # A little brightness is added to that of each pixel
    assert found.whole == pytest.approx(0.5 / (1 + MODEL.black))
    variance, cost = 0.6, 1.3
    numbers = np.arange(1, MODEL.most_emitter_samples + 1)
    products = (variance - found.whole * (1 - 1 / numbers)) * (cost + MODEL.emitter_sample_cost * (numbers - 1))
    chosen = found.best(variance, cost, 64)
    assert (found.numbers(chosen.multiple) > 1).all() and products.min() < 0.9 * products[0]
    # The candidates are powers of two at half steps
    assert products.min() * (1 - 1e-9) <= variance * chosen.remains * chosen.cost < 1.02 * products.min()


def test_samples_go_where_they_differ():
    found = effect(left_half)
    numbers = found.numbers(found.best(0.6, 1.0, 64).multiple).reshape(WIDTH, WIDTH)
    assert (numbers[:, WIDTH // 2 + 1 :] == 1).all() and (numbers[:, : WIDTH // 2 - 1] > 1).all()


@pytest.mark.parametrize("changed", ["no difference", "small", "dear", "stratified", "one"])
def test_one_sample_suffices(changed):
    """If two samples agree, make little of the noise, cost much, are stratified, or may not be more."""
    size = {"no difference": 0.0, "small": 0.05}.get(changed, 0.5)
    constants = {"dear": {"emitter_sample_cost": 5.0}, "one": {"most_emitter_samples": 1}}.get(changed, {})
    found = effect(lambda pixel: size + 0 * pixel, 0.05 if changed == "stratified" else 1.0, **constants)
    chosen = found.best(0.6, 1.0, 64)
    assert (found.numbers(chosen.multiple) == 1).all() and (chosen.remains, chosen.cost) == (1.0, 1.0)


@pytest.mark.parametrize(("noise", "more"), [((0.6, 0.6), True), ((0.6, 0.1), False), ((0.1, 0.6), True)])
def test_one_sample_suffices_if_its_own_weight_leaves_less_variance(noise, more):
    found = effect(lambda pixel: 0.5 + 0 * pixel, noise=noise)
    chosen = found.best(0.6, 1.0, 64)
    assert (found.numbers(chosen.multiple) > 1).all() == more
    if not more:
        assert chosen.remains == pytest.approx(1 - (0.36 - 0.01) / (1 + MODEL.black) / 0.6, rel=0.05)


def test_the_weight_of_a_single_sample_counts_where_a_pixel_takes_one():
    """Its gain lies in the half without differences, and so remains beside more samples in the other half."""
    noisy = ~left_half(np.repeat(np.random.default_rng(0).permutation(2048) % WIDTH**2, 2))
    plain, own = effect(left_half), effect(left_half, noise=(0.6 * noisy, 0.1 * noisy))
    assert own.best(0.6, 1.0, 64).multiple == plain.best(0.6, 1.0, 64).multiple > 0
    assert own.best(0.6, 1.0, 64).remains < plain.best(0.6, 1.0, 64).remains


@pytest.mark.parametrize("variance", [0.6, 1e-3])
def test_some_noise_remains_whatever_the_pilot_measured(variance):
    chosen = effect(lambda pixel: 0.1 + 0 * pixel, noise=(5.0, 0.0), samples_power=0.7).best(variance, 1.0, 64)
    assert 1 / MODEL.most_emitter_samples <= chosen.remains * (1 + 1e-9) and chosen.remains < 1


def test_few_samples_of_a_pixel_are_hardly_stratified():
    found = effect(lambda pixel: 0.5 + 0 * pixel, 0.05)
    assert found.retained(1) == 1 and found.retained(4) == pytest.approx(0.05**0.5)
    assert found.retained(16) == found.retained(256) == 0.05
    assert found.best(0.6, 1.0, 1).multiple > 0


def test_more_noise_than_there_is_cannot_be_removed():
    """The pilot measures both apart, so one may exceed the other."""
    chosen = effect(lambda pixel: 5.0 + 0 * pixel).best(0.6, 1.0, 64)
    assert 1 / MODEL.most_emitter_samples <= chosen.remains * (1 + 1e-9) and chosen.remains < 1


def test_images_that_are_denoised_take_fewer_samples():
    multiples = [
        effect(lambda pixel: 0.5 + 0 * pixel, samples_power=power).best(0.6, 1.0, 64).multiple for power in (1.0, 0.45)
    ]
    assert multiples[1] < multiples[0]


@pytest.mark.parametrize("number", [0, 1, 9, 15])
def test_numbers_of_a_sample_keep_their_last_bit_and_are_spread(number):
    """Both multiples of 2^-24 and of 2^-23 choose with exact probabilities, see `LearnedEmitters.sample`."""
    first = mi.Float(np.arange(2**12) * 2.0**-12 + 2.0**-24), mi.Point2f([0, 1 - 2.0**-24], [2.0**-24, 0.5])
    numbers = _numbers_of_sample((first[0], first[1], 0.25, 0.5), mi.UInt32(number))
    moved = [np.array(x, np.float64).ravel() * 2**24 for x in numbers[:2]]
    for values in moved:
        assert (values == values.round()).all() and (values >= 0).all() and (values < 2**24).all()
    # All of them by the same amount, with the last bit
    steps = np.round((moved[0] - np.array(first[0], np.float64) * 2**24) % 2**24)
    assert (steps == steps[0]).all() and (steps[0] == 0) == (number == 0)
    assert numbers[2:] == (0.25, 0.5)


# ---------------------- Images ----------------------


def rooms():
    """Rooms by name: with gloss and two lamps, with points alone, with masks, with many emitters."""
    rng = np.random.default_rng(2)
    gloss = {"type": "roughconductor", "alpha": 0.3}
    ball = {"type": "sphere", "center": [-0.3, -0.5, 0.2], "radius": 0.4, "bsdf": gloss}
    lamps = {"lamp": area_light(), "small": area_light(0.05, (60, 60, 90))}
    return {
        "gloss": closed_box(lamps, 12, ball=ball),
        "points": closed_box(bulbs(3, rng), 12),
        "masks": closed_box(lamps, 12, **sheets("torn", "glass")),
        "emitters": closed_box(panels(90, rng) | bulbs(10, rng), 12),
    }


@pytest.fixture
def four_samples(monkeypatch):
    """All pixels have four emitter samples, whatever the pilot says."""
    monkeypatch.setattr(EmitterSamples, "numbers", lambda self, multiple: np.full(len(self.expected), 4, np.uint32))


ROOMS_AND_LIGHTS = list(itertools.product(["gloss", "points", "masks", "emitters"], [False, True]))
# What the quick run tests
QUICK = [("gloss", False), ("masks", True)]


@pytest.mark.parametrize(("name", "lights"), [*QUICK, *stress(*(one for one in ROOMS_AND_LIGHTS if one not in QUICK))])
def test_more_samples_keep_the_mean(name, lights, four_samples):
    constants = {"fixed_cost": 0.0, "fewest_light_paths": 2000} if lights else {}
    scene, depth = mi.load_dict(rooms()[name]), 4

    def pair(seed):
        with plugin_with_model(pays_below=1e30 if lights else 0.0, **constants):
            found, statistics = render_with_statistics("manylights", scene, 64, seed, max_depth=depth)
        assert ("lights" in statistics) == lights and statistics["emitter_samples"] == "4"
        return found, render(scene, "prb", 512, seed, max_depth=depth)

    assert_same_mean(pair, 10, 0.06)


@pytest.mark.parametrize("kind", ["hidden emitters", "mask", *stress("plain")])
def test_bsdf_samples_have_the_weight_of_the_other_samples(kind, four_samples):
    """A glossy floor below a large lamp: both kinds of samples bring much of the light, by way of a mask as well."""
    lamp = area_light()
    lamp["to_world"] = mi.ScalarTransform4f().translate([0, 0.9, 0]).rotate([1, 0, 0], 90).scale(0.9)
    mask = {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse", "reflectance": rgb(0.0)}}
    sheet = {"sheet": wall([0, 0.6, 0], [1, 0, 0], -90, 1.0, bsdf=mask)} if kind == "mask" else {}
    box = closed_box({"lamp": lamp}, 12, **sheet)
    box["floor"]["bsdf"] = {"type": "roughconductor", "alpha": 0.15}
    scene = mi.load_dict(box)
    more = {"max_depth": 3 if kind == "mask" else 2, "hide_emitters": kind == "hidden emitters"}
    oracle = "prb" if kind == "mask" else "path"

    def pair(seed):
        return render(scene, "manylights", 64, seed, **more), render(scene, oracle, 256, seed, **more)

    # Of 10 seeds, the spread is too large, and 40 more would follow
    assert_same_mean(pair, 20, 0.008)


def test_layers_sum_to_the_image(four_samples):
    scene = mi.load_dict(rooms()["masks"])
    image, layers, statistics = layers_of(scene, 16, 3, layers=LENGTHS, light_groups="lamps=lamp", max_depth=4)
    assert statistics["emitter_samples"] == "4"
    assert_sums(image, layers)


@pytest.mark.parametrize(("denoised", "spp", "more"), [(True, 16, False), (True, 64, True), (False, 16, True)])
def test_denoised_images_of_few_samples_take_one(denoised, spp, more):
    scene = mi.load_dict(closed_box({f"lamp{n}": lamp for n, lamp in enumerate(_small_lamps())}, 16))
    _, statistics = render_with_statistics("manylights", scene, spp, max_depth=2, hide_emitters=True, denoised=denoised)
    assert (statistics["emitter_samples"] != "1") == more


def test_one_sample_is_the_least():
    with pytest.raises(ValueError, match="most_emitter_samples must be at least 1, got 0"):
        CostModel(most_emitter_samples=0)


# ---------------------- Predictions ----------------------


def shining_box():
    """A closed box with walls that shine evenly: BSDF samples are perfect, and emitter samples add noise."""
    box = closed_box({}, 32)
    for name in ("floor", "ceiling", "left", "right", "back", "front"):
        box[name]["emitter"] = {"type": "area", "radiance": rgb(0.5)}
    return mi.load_dict(box)


def test_paths_of_a_single_sample_are_as_noisy_as_predicted():
    """The pilot with two samples tells the noise of paths with one."""
    pilots = {}
    for most in (1, CostModel().most_emitter_samples):
        found, of = [], Pilot.of.__func__
        traced = classmethod(lambda cls, *arguments, kept=found, of=of: kept.append(of(cls, *arguments)) or kept[-1])
        with mock.patch.object(Pilot, "of", traced), plugin_with_model(most_emitter_samples=most):
            _, statistics = render_with_statistics("manylights", shining_box(), 256, max_depth=2)
        pilots[most] = found[-1]
        assert statistics["emitter_samples"] == "1"
    single, double = pilots.values()
    np.testing.assert_array_equal(single.alone, single.radiance)
    assert np.mean(double.alone) == pytest.approx(np.mean(single.radiance), rel=0.005)
    predicted, weighted_as_two = (
        relative_variance(x, double.brightness, MODEL) for x in (double.alone, double.radiance)
    )
    measured = relative_variance(single.radiance, single.brightness, MODEL)
    assert predicted == pytest.approx(measured, rel=0.05) and weighted_as_two > 1.5 * measured


def test_noise_of_shadows_is_stratified_less_than_smooth_light():
    """The view of a white wall below one lamp, and of a wall behind many small veils."""
    rng = np.random.default_rng(3)
    veils = {
        f"veil{number}": wall(list(rng.uniform(-0.8, 0.8, 3) * [1, 0.3, 1] + [0, 0.4, 0]), [1, 0, 0], 90, 0.05)
        for number in range(60)
    }
    smooth, torn = (fraction_in(closed_box({"lamp": area_light()} | more, 32)) for more in ({}, veils))
    assert smooth < 0.15 < 2 * smooth < torn <= 1


def fraction_in(box):
    """The fraction measured in a scene."""
    found, measure = [], start.retained_fraction
    with mock.patch.object(start, "retained_fraction", lambda view: found.append(measure(view)) or found[-1]):
        render(mi.load_dict(box), "manylights", 16, max_depth=2)
    return found[0]


def test_more_samples_remove_noise_as_predicted():
    """Shadows of small lamps: the variance between seeds falls within a factor of two of the prediction."""
    lamps = {f"lamp{number}": bulb for number, bulb in enumerate(_small_lamps())}
    ball = {"type": "sphere", "center": [0, 0, 0], "radius": 0.3, "bsdf": {"type": "diffuse", "reflectance": rgb(0.0)}}
    scene, images, predicted = mi.load_dict(closed_box(lamps, 16, ball=ball)), {}, {}
    for cost in (1e9, 0.0):
        with plugin_with_model(emitter_sample_cost=cost):
            rendered = [
                render_with_statistics("manylights", scene, 64, seed, max_depth=2, hide_emitters=True)
                for seed in range(12)
            ]
        images[cost] = np.var([image for image, _ in rendered], axis=0, ddof=1)
        predicted[cost] = np.mean([1 / statistics["precision"] for _, statistics in rendered])
    measured = np.mean(images[0.0]) / np.mean(images[1e9])
    assert 0.02 < measured < 0.5
    assert 0.5 < predicted[0.0] / predicted[1e9] / measured < 2


def _small_lamps():
    glow = {"type": "area", "radiance": rgb(90)}
    places = itertools.product((-0.7, 0, 0.7), repeat=2)
    return [{"type": "sphere", "center": [x, 0.85, z], "radius": 0.03, "emitter": glow} for x, z in places]
