"""Every plugin with every material, emitter, sensor and film that Mitsuba has: finite, not negative, and right.

The reference is ``prb``: with masks, Mitsuba's ``path`` (3.9.1) is darker than that and ``direct`` at small depths.
"""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import (
    EMITTERS,
    FILMS,
    MATERIALS,
    ONE_PIXEL,
    PLUGINS,
    SENSORS,
    all_materials,
    film,
    one_of,
    plugin,
    stage,
)
from tests.support.marks import stress
from tests.support.rendering import render, render_with_statistics
from tests.support.scenes import rgb, wall
from tests.support.statistics import assert_same_mean

# A few materials that nothing else tests by every plugin, and emitters that compile quickly, for the short run
QUICK_SENSORS = ("thinlens",)
QUICK_FILMS = ("rgba float16", "crop")
QUICK_EMITTERS = ("point", "rectangle", "sphere", "envmap", "spot", "directional")


def image_of(scene, name, spp=4, seed=0, **more):
    """A render that is checked to be finite and not negative, but for what ``manylights`` takes off by chance."""
    found = render(scene, mi.load_dict(plugin(name, **more)), spp, seed)
    assert np.isfinite(found).all()
    assert found.min() >= (-0.1 * found.max() if name == "manylights" else 0)
    return found


def assert_close_mean(ours, expected, tolerance=0.03, dark=False):
    """Means of images within a share of each other and five standard errors, over seeds."""
    ours, expected = (np.stack(images).mean((1, 2, 3)) for images in (ours, expected))
    assert (expected.mean() > 0) != dark
    error = np.sqrt(ours.var(ddof=1) / len(ours) + expected.var(ddof=1) / len(expected))
    assert abs(ours.mean() - expected.mean()) <= tolerance * expected.mean() + 5 * error


def assert_mean_of_reference(scene, name, spp, reference, tiles, finds=0.01, **more):
    """``reference``: function from a seed to an image."""

    def pair(seed):
        return image_of(scene, name, spp, seed, max_depth=2, **more), reference(seed)

    assert_same_mean(pair, 6, finds, tiles)


def reference(scene, spp=512, seeds=4, **more):
    return [render(scene, "prb", spp, 100 + seed, max_depth=2, **more) for seed in range(seeds)]


@pytest.mark.parametrize(("number", "material"), list(enumerate(list(MATERIALS)[::4])))
def test_some_materials_with_some_plugin(number, material):
    names, emitters = list(PLUGINS), list(QUICK_EMITTERS)
    emitter = EMITTERS[emitters[number % len(emitters)]]()
    scene = mi.load_dict(stage(emitter, one_of(MATERIALS[material]()), 16))
    assert image_of(scene, names[number % len(names)], max_depth=3).max() > 0


@pytest.mark.stress
@pytest.mark.parametrize("emitter", EMITTERS)
def test_every_plugin_with_all_materials_under_every_emitter(emitter):
    scene = mi.load_dict(stage(EMITTERS[emitter](), all_materials(), 24))
    expected = reference(scene, hide_emitters=True)
    for name in PLUGINS:
        found = [image_of(scene, name, 16, seed, max_depth=2, hide_emitters=True) for seed in range(4)]
        assert_close_mean(found, expected, dark=emitter == "directionalarea")
        if "direct" not in name:
            image_of(scene, name, max_depth=5)


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize(("number", "material"), list(enumerate(MATERIALS)))
def test_every_plugin_with_every_material_alone(name, number, material):
    emitters = list(QUICK_EMITTERS)
    emitter = EMITTERS[emitters[(number + list(PLUGINS).index(name)) % len(emitters)]]()
    scene = mi.load_dict(stage(emitter, one_of(MATERIALS[material]()), 16))
    found = [image_of(scene, name, 64, seed, max_depth=2, hide_emitters=True) for seed in range(4)]
    assert_close_mean(found, reference(scene, hide_emitters=True))
    if "direct" not in name:
        image_of(scene, name, max_depth=6)


@pytest.mark.stress
@pytest.mark.parametrize("direct", ["vpl", "adaptive", "none"])
@pytest.mark.parametrize("emitter", EMITTERS)
def test_every_way_of_direct_light_under_every_emitter(direct, emitter):
    """Direct light as virtual lights, and by adaptive sampling, with all materials in view."""
    scene = mi.load_dict(stage(EMITTERS[emitter](), all_materials(), 16))
    if direct == "vpl" and emitter in ("texturedspot", "projector"):
        with pytest.raises(RuntimeError) as error:
            image_of(scene, "lightcuts", direct=direct)
        assert 'cannot become virtual lights: use direct="nee"' in str(error.value.__cause__)
        return
    image_of(scene, "lightcuts", max_depth=4, direct=direct, direct_count=300)


def measured(sensor, **film_options):
    """The stage with a plastic ball under an area emitter, seen by some sensor of the catalogue."""
    description = stage(EMITTERS["rectangle"](), one_of(MATERIALS["roughplastic"]()), 16)
    size = (1, 1) if sensor in ONE_PIXEL else (16, 16)
    return mi.load_dict(description | {"sensor": SENSORS[sensor](film(*size, **film_options))})


@pytest.mark.parametrize("sensor", [*QUICK_SENSORS, *stress(*(name for name in SENSORS if name not in QUICK_SENSORS))])
def test_every_sensor(sensor):
    scene = measured(sensor)
    tiles, spp = (1, 4096) if sensor in ONE_PIXEL else (4, 256)
    reference = cache(lambda seed: render(scene, "prb", spp, seed, max_depth=2))
    # A pixel of adaptive samples ends at its error, however many camera rays it has
    more, finds = ({"max_samples": 10_000, "error": 0.005}, 0.02) if sensor in ONE_PIXEL else ({}, 0.01)
    assert_mean_of_reference(scene, "lightcuts", spp, reference, tiles)
    assert_mean_of_reference(scene, "adaptivedirect", spp, reference, tiles, finds, **more)


def test_all_samples_of_a_sensor_with_a_single_ray_are_lit():
    """The sensor ``radiancemeter`` gives one ray for all samples."""
    _, statistics = render_with_statistics("lightcuts", measured("radiancemeter"), 64, 0, max_depth=2)
    assert statistics["gather_points"] == 64


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_every_sensor_with_every_plugin(sensor, name):
    scene = measured(sensor)
    found = [image_of(scene, name, 256, seed, max_depth=2) for seed in range(4)]
    assert_close_mean(found, reference(scene, 1024))


@pytest.mark.parametrize("name", ["lightcuts", "adaptivedirect"])
def test_a_meter_on_a_surface(name):
    """The floor measures the irradiance of a small emitter."""
    description = stage(EMITTERS["sphere"](), {}, 16)
    meter = {"type": "irradiancemeter", "film": film(1, 1), "sampler": {"type": "independent"}}
    del description["sensor"]
    description["floor"] |= {"sensor": meter}
    scene = mi.load_dict(description)
    # With the same seed, the same rays of the meter meet the emitter
    reference = cache(lambda seed: render(scene, "prb", 4096, seed, max_depth=2))
    assert_mean_of_reference(scene, name, 4096, reference, 1, 0.03)


@pytest.mark.parametrize("options", [*QUICK_FILMS, *stress(*(name for name in FILMS if name not in QUICK_FILMS))])
def test_every_film_shows_what_it_shows_of_path(options):
    scene = measured("perspective", **FILMS[options])
    expected = render(scene, "path", 64, max_depth=2)
    for name in ("lightcuts", "adaptivedirect"):
        found = image_of(scene, name, 64, max_depth=2)
        assert found.shape == expected.shape
        assert np.abs(found - expected).mean() < 0.06 * expected.mean()


@pytest.mark.stress
@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize("options", FILMS)
def test_every_film_with_every_plugin(options, name):
    scene = measured("perspective", **FILMS[options])
    assert image_of(scene, name, max_depth=3).shape == render(scene, "path", 1).shape


def never_sampled(*emitters, count=1):
    """The given number of each of some emitters of the catalogue, with sampling weight 0 for ``path``."""
    lamps = {name: EMITTERS[name]()["lamp"] | {"sampling_weight": 0.0} for name in emitters}
    return {f"{name}{k}": lamp for name, lamp in lamps.items() for k in range(count)}


@pytest.mark.parametrize(
    "emitters",
    [lambda: {"area": EMITTERS["directionalarea"]()["lamp"]} | never_sampled("directional", "projector"),
     lambda: never_sampled("point", "spot", count=40)],
    ids=["directionalarea, directional, projector", "points and spots"],
)  # fmt: skip
def test_emitters_that_path_never_finds_light_nothing(emitters):
    """A directional area emitter emits in a direction that no surface samples; the remaining emitters have a sampling
    weight of 0, beside a hidden lamp."""
    hidden = {"hidden": {"type": "point", "position": [0, -5, 0], "intensity": rgb(1.0)}}
    scene = mi.load_dict(stage(emitters() | hidden, {"panel": wall([0, 0, 0], [0, 1, 0], 0, 0.5)}, 16))
    for name in ("path", "manylights", "lightcuts", "adaptivedirect"):
        assert render(scene, name, 16, max_depth=4).max() == 0


@pytest.mark.usefixtures("restore_variant")
@pytest.mark.parametrize("variant", ["llvm_ad_mono_polarized", "llvm_ad_spectral"])
def test_variants_of_other_films_are_refused(variant):
    """A film of spectral bands exists in these only."""
    mi.set_variant(variant)
    with pytest.raises(RuntimeError, match=f'does not support the variant "{variant}"'):
        mi.load_dict(plugin("lightcuts"))
