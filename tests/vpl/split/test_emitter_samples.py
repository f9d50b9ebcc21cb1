"""Numbers of emitter samples at first scattering vertices: their choice, and an image equal to `path`."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from tests.integrators.test_null_surfaces import sheets
from tests.support.many_emitters import bulbs, panels
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.scenes import area_light, closed_box, rgb
from tests.support.statistics import assert_same_mean
from vpl.split.cost_model import CostModel
from vpl.split.emitter_samples import EmitterSamples

MODEL = CostModel().without_denoiser()
# Samples are free, so that there are as many as possible where they differ
FREE = {"emitter_sample_cost": 0.0}
WIDTH = 16


def pilot(count=4096, brightness=1.0):
    """Pairs of paths in an image of an even brightness, of which the left half has the even pairs."""
    rng = np.random.default_rng(0)
    pixel = np.repeat(rng.permutation(count // 2) % WIDTH**2, 2)
    return SimpleNamespace(model=MODEL, brightness=np.full(count, brightness), pixel=pixel, size=(WIDTH, WIDTH**2))


def effect(difference, fraction=1.0, **constants):
    """The effect of samples in the image of :func:`pilot`, with random signs of the differences."""
    paths = pilot()
    paths.model = replace(MODEL, **constants)
    sign = np.random.default_rng(1).choice([-1, 1], len(paths.pixel))
    return EmitterSamples.of(paths, difference(paths.pixel) * sign, fraction)


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
    assert products.min() * (1 - 1e-9) <= chosen.left * chosen.cost < 1.02 * products.min()


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
    assert (found.numbers(chosen.multiple) == 1).all() and (chosen.left, chosen.cost) == (0.6, 1.0)


def test_few_samples_of_a_pixel_are_hardly_stratified():
    found = effect(lambda pixel: 0.5 + 0 * pixel, 0.05)
    assert found.retained(1) == 1 and found.retained(4) == pytest.approx(0.05**0.5)
    assert found.retained(16) == found.retained(256) == 0.05
    assert found.best(0.6, 1.0, 1).multiple > 0


def test_more_noise_than_there_is_cannot_be_removed():
    """The pilot measures both apart, so one may exceed the other."""
    chosen = effect(lambda pixel: 5.0 + 0 * pixel).best(0.6, 1.0, 64)
    assert 0.6 / MODEL.most_emitter_samples <= chosen.left * (1 + 1e-9) and chosen.left < 0.6


def test_images_that_are_denoised_take_fewer_samples():
    multiples = [
        effect(lambda pixel: 0.5 + 0 * pixel, samples_power=power).best(0.6, 1.0, 64).multiple for power in (1.0, 0.45)
    ]
    assert multiples[1] < multiples[0]


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


@pytest.mark.parametrize("lights", [False, True])
@pytest.mark.parametrize("name", ["gloss", "points", "masks", "emitters"])
def test_more_samples_keep_the_mean(name, lights, request):
    constants = {"fixed_cost": 0.0, "fewest_light_paths": 2000} if lights else {}
    scene, depth = mi.load_dict(rooms()[name]), 4

    def pair(seed):
        with plugin_with_model(pays_below=1e30 if lights else 0.0, **FREE, **constants):
            found, statistics = render_with_statistics("manylights", scene, 64, seed, max_depth=depth)
        assert ("lights" in statistics) == lights
        # Virtual lights carry nearly all direct light of many emitters
        assert statistics["emitter_samples"] > 1.5 or (lights and name == "emitters")
        return found, render(scene, "prb", 512, seed, max_depth=depth)

    assert_same_mean(pair, 10, 0.06)


def test_more_samples_remove_noise_as_predicted():
    """Shadows of small lamps: the variance between seeds falls like the prediction."""
    lamps = {f"lamp{number}": bulb for number, bulb in enumerate(_small_lamps())}
    ball = {"type": "sphere", "center": [0, 0, 0], "radius": 0.3, "bsdf": {"type": "diffuse", "reflectance": rgb(0.0)}}
    scene, images, left = mi.load_dict(closed_box(lamps, 16, ball=ball)), {}, {}
    for cost in (1e9, 0.0):
        with plugin_with_model(emitter_sample_cost=cost):
            rendered = [
                render_with_statistics("manylights", scene, 64, seed, max_depth=2, hide_emitters=True)
                for seed in range(12)
            ]
        images[cost] = np.var([image for image, _ in rendered], axis=0, ddof=1)
        left[cost] = np.mean([1 / statistics["precision"] for _, statistics in rendered])
    measured = np.mean(images[0.0]) / np.mean(images[1e9])
    assert 0.02 < measured < 0.5
    assert left[0.0] / left[1e9] == pytest.approx(measured, rel=0.5)


def _small_lamps():
    glow = {"type": "area", "radiance": rgb(90)}
    places = itertools.product((-0.7, 0, 0.7), repeat=2)
    return [{"type": "sphere", "center": [x, 0.85, z], "radius": 0.03, "emitter": glow} for x, z in places]
