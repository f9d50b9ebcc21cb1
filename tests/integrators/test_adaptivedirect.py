"""Adaptive direct light through Mitsuba's interface: against ``direct`` and ``path``, and the promises of the
manual."""

import math
from functools import cache

import mitsuba as mi
import numpy as np
import pytest

from benchmarks.printed_passes import PrintedEstimates, PrintedPasses, as_printed
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box, sensor, wall
from tests.support.statistics import assert_same_mean
from vpl.direct import adaptive
from vpl.direct.passes import SiteEstimates

PLUGINS = ("adaptivedirect", "unoccludeddirect")
AOVS = ("noise", "passes", "shadow_rays", "visible")


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def lamp(transform, half_size, radiance):
    return {
        "type": "rectangle", "to_world": transform.scale(half_size),
        "emitter": {"type": "area", "radiance": rgb(*radiance)},
    }  # fmt: skip


def mixed_emitters():
    """All kinds of emitters; ``near`` almost touches the left wall."""
    transform = mi.ScalarTransform4f()
    sky = np.random.default_rng(0).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 3
    return {
        "near": lamp(transform.translate([-1.1, 0.2, 0.1]).rotate([0, 1, 0], -90), 0.25, (2, 1, 1)),
        "lamp": lamp(transform.translate([0.5, 0.9, 0.2]).rotate([1, 0, 0], 90), 0.2, (3, 4, 5)),
        "bulb": {"type": "point", "position": [0.9, 0.3, 0.8], "intensity": rgb(0.5, 0.4, 0.3)},
        "spot": {
            "type": "spot", "to_world": mi.ScalarTransform4f().look_at([0, 1, 0.8], [0.3, -1, 0], [0, 0, 1]),
            "cutoff_angle": 40.0, "intensity": rgb(1, 1.5, 2),
        },
        "sun": {"type": "directional", "direction": [0.3, -1, -0.4], "irradiance": rgb(0.4, 0.4, 0.3)},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky), "scale": 0.5},
    }  # fmt: skip


def mixed_scene(emitters):
    """Diffuse and glossy surfaces and an occluder, with all kinds of films (sensors 1 and up)."""
    films = {
        "cropped": {"width": 40, "height": 30, "crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 21,
                    "crop_height": 11, "rfilter": {"type": "box"}},
        "border": {"width": 19, "height": 13, "rfilter": {"type": "gaussian"}, "sample_border": True},
        "alpha": {"width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgba"},
    }  # fmt: skip
    cameras = {name: sensor(film={"type": "hdrfilm", **film}) for name, film in films.items()}
    return {
        "type": "scene", "sensor": sensor(32, 4), **cameras,
        "floor": wall([0, -1, 0], [1, 0, 0], -90, 1.5),
        "back": wall([0, 0, -1], [0, 1, 0], 0, 1.5, bsdf={"type": "roughconductor", "alpha": 0.2}),
        "left": wall([-1.2, 0, 0], [0, 1, 0], 90, 1.2, (0.6, 0.2, 0.1)),
        "ball": {"type": "sphere", "radius": 0.4, "center": [0.2, -0.5, 0], "bsdf": {"type": "diffuse"}},
        **emitters,
    }  # fmt: skip


@pytest.fixture(scope="module")
def mixed(variant):
    return mi.load_dict(mixed_scene(mixed_emitters()))


@pytest.fixture(scope="module")
def reference(mixed):
    """Function from a seed to the image of ``mixed`` by Mitsuba."""
    return cache(lambda seed: render(mixed, "direct", 512, 1000 + seed, emitter_samples=1, bsdf_samples=1))


@pytest.fixture(scope="module")
def expected(reference):
    """Mean of images of ``mixed`` by Mitsuba."""
    return np.mean([reference(seed) for seed in range(8)], axis=0)


@pytest.fixture(scope="module")
def bulb_over_floor(variant):
    """One point light, one plane, no noise."""
    return mi.load_dict(
        {
            "type": "scene", "sensor": sensor(16, 1), "floor": wall([0, -1, 0], [1, 0, 0], -90, 2.0),
            "bulb": {"type": "point", "position": [0.3, 0.2, 0.1], "intensity": rgb(1, 2, 3)},
        }
    )  # fmt: skip


def repeat(scene, integrator, count, spp, first_seed=0, **more):
    """Independent renders, (count, height, width, channels)."""
    plugin = mi.load_dict({"type": integrator, **more})
    return np.stack([render(scene, plugin, spp, first_seed + k) for k in range(count)])


def same_camera_rays(scene, integrator, count):
    """Independent estimates along rays through the middle of every pixel: (radiance, noise), both (count, pixels)."""
    y, x = np.mgrid[:32, :32].reshape(2, -1)
    places = mi.Point2f((x + 0.5) / 32, (y + 0.5) / 32)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, places, mi.Point2f(0.5))
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    levels, predicted = [], []
    for seed in range(count):
        sampler.seed(seed, x.size)
        radiance, _, (noise,) = integrator.sample(scene, sampler, mi.Ray3f(ray))
        levels.append(np.array(radiance).mean(0, dtype=np.float64))
        predicted.append(np.array(noise, dtype=np.float64))
    return np.array(levels), np.array(predicted)


def view(scene, integrator, sensor, spp=4, seed=0):
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed), dtype=np.float64)


def assert_mean_of_reference(scene, reference, spp=4, seeds=12, finds=0.02, plugin="adaptivedirect", **more):
    """``reference``: function from a seed to an image."""
    assert_same_mean(lambda seed: (render(scene, plugin, spp, seed, error=0.2, **more), reference(seed)), seeds, finds)


# ---- Properties

BOTH_BAD = [
    ("error", 0.0), ("error", -0.1), ("error", "x"), ("error", math.nan), ("error", True), ("dark_floor", -1.0),
    ("dark_floor", math.inf), ("max_samples", 0), ("max_samples", 1.5), ("bsdf_share", -0.1), ("bsdf_share", "no"),
    ("time", -1.0), ("time", math.nan), ("aovs", "noise,colour"),
    ("aovs", "noise,noise"), ("max_depth", -2), ("rr_depth", 0), ("samples_per_pass", 0),
]  # fmt: skip
ADAPTIVE_BAD = [
    ("lights", "some"), ("lights", 3), ("lights", "unoccluded"), ("cluster_angle", -0.1), ("cluster_angle", "x"),
    ("max_passes", 0), ("max_passes", 2.0),
]  # fmt: skip
BAD = [(plugin, *bad) for plugin in PLUGINS for bad in BOTH_BAD] + [
    *(("adaptivedirect", *bad) for bad in ADAPTIVE_BAD),
    *(("unoccludeddirect", "samples_per_ray", value) for value in (1, 0, 2.5, "many")),
]
ALLOWED = {
    "lights": '"auto", "clusters", "all"', "error": "a number of at least 0.0001", "samples_per_ray": "at least 2",
    "max_samples": "an integer from 1 to 100000", "aovs": ", ".join(f'"{name}"' for name in AOVS),
}  # fmt: skip


@pytest.mark.parametrize(("plugin", "name", "value"), BAD, ids=[f"{p}-{name}={value}" for p, name, value in BAD])
def test_bad_properties_are_named_with_their_value(plugin, name, value):
    with pytest.raises((ValueError, RuntimeError)) as error:
        mi.load_dict({"type": plugin, name: value})
    message = str(error.value)
    assert f'{plugin}: property "{name}" must be' in message and f"got {value!r}" in message
    assert ALLOWED.get(name, "at least") in message


@pytest.mark.parametrize(
    ("plugin", "name", "value"),
    [
        ("adaptivedirect", "samples_per_ray", 10), ("unoccludeddirect", "lights", "all"),
        ("unoccludeddirect", "max_passes", 10), ("adaptivedirect", "vpl_count", 10),
    ],
)  # fmt: skip
def test_properties_of_other_plugins_are_refused(plugin, name, value):
    with pytest.raises(RuntimeError, match=name):
        mi.load_dict({"type": plugin, name: value})


def test_properties_reach_the_sampler_under_their_own_names():
    given = {
        "error": 0.25, "dark_floor": 0.5, "lights": "clusters", "cluster_angle": 0.125, "max_passes": 7,
        "max_samples": 1234, "bsdf_share": 0.75, "time": 9.0,
    }  # fmt: skip
    plugin = mi.load_dict({"type": "adaptivedirect", **given})
    options, text = vars(plugin.options()), str(plugin)
    assert {name: options[name] for name in given} == given
    assert all(f"{name} = {value}" in text for name, value in given.items())


# ---- Expectation

METHODS = {
    "clusters": ("adaptivedirect", {"lights": "clusters"}),
    "all": ("adaptivedirect", {"lights": "all"}),
    "unoccluded": ("unoccludeddirect", {"samples_per_ray": 30}),
}


@pytest.mark.parametrize("method", ["clusters", *stress("unoccluded", "all")])
def test_expectation_equals_direct(mixed, reference, method):
    plugin, more = METHODS[method]
    # A cut at every point takes seconds
    spp, seeds, finds = (1, 8, 0.04) if method == "unoccluded" else (4, 12, 0.02)
    assert_mean_of_reference(mixed, reference, spp, seeds, finds, plugin, **more)


@pytest.mark.stress
def test_bsdf_samples_do_not_change_the_expectation_but_the_noise(mixed, reference):
    for share in (0.0, 1.0):
        assert_mean_of_reference(mixed, reference, 2, finds=0.03, lights="clusters", bsdf_share=share)
    without, many = (
        render(mixed, "adaptivedirect", 1, lights="clusters", error=0.2, bsdf_share=share) for share in (0.0, 1.0)
    )
    assert not np.allclose(without, many, rtol=1e-3)


@pytest.mark.stress
def test_smaller_error_gives_less_noise_for_more_rays(mixed):
    found = []
    for error in (0.2, 0.02):
        plugin = mi.load_dict({"type": "adaptivedirect", "lights": "clusters", "error": error, "aovs": "noise"})
        levels, _ = same_camera_rays(mixed, plugin, 4)
        found.append((levels.std(0, ddof=1).mean(), plugin.statistics["shadow_rays"]))
    (coarse, few), (fine, many) = found
    assert fine < 0.7 * coarse and many > 3 * few


class UniformPasses(PrintedPasses):
    """Learnt from samples alone as printed, but weighted without bias."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.estimates = SiteEstimates(*arguments)
        self.estimates.most_samples = PrintedEstimates.most_samples


@pytest.mark.stress
def test_probabilities_learnt_from_samples_alone_leave_the_expectation(mixed, reference, monkeypatch):
    monkeypatch.setattr(adaptive, "SitePasses", UniformPasses)
    assert_mean_of_reference(mixed, reference, lights="clusters")


def test_the_method_as_printed_is_another_estimate_of_the_same(mixed, expected):
    usual = repeat(mixed, "adaptivedirect", 2, 4, lights="clusters", error=0.05)
    with as_printed():
        printed = repeat(mixed, "adaptivedirect", 2, 4, lights="clusters", error=0.05)
    assert not np.allclose(usual, printed, rtol=1e-3)
    assert abs(printed.mean() / expected.mean() - 1) < 0.1


@pytest.mark.parametrize("plugin", PLUGINS)
def test_emitters_seen_by_the_camera_equal_path(mixed, plugin):
    # Camera rays are the same with the same seed, and nothing else is random
    ours, path = (render(mixed, name, 4, 3, max_depth=1) for name in (plugin, "path"))
    assert path.max() > 2 and np.allclose(ours, path, rtol=1e-5, atol=1e-6)
    assert render(mixed, plugin, 4, 3, max_depth=0).max() == 0


@pytest.mark.stress
def test_hidden_emitters_equal_path(mixed, expected):
    hidden = cache(lambda seed: render(mixed, "path", 512, 1000 + seed, max_depth=2, hide_emitters=True))
    assert_mean_of_reference(mixed, hidden, hide_emitters=True)
    assert hidden(0).mean() < 0.95 * expected.mean()


@pytest.mark.parametrize(("hide", "max_depth"), [(False, 2), (True, 2), (False, 0)])
def test_alpha_equals_path(mixed, hide, max_depth):
    ours, path = (
        view(mixed, mi.load_dict({"type": name, "max_depth": max_depth, "hide_emitters": hide}), 3)
        for name in ("adaptivedirect", "path")
    )
    assert ours.shape == (16, 16, 4) and np.array_equal(ours[..., 3], path[..., 3])
    assert (path[..., 3].min() < 1) == (hide or max_depth == 0)


# ---- Scenes at the limits


@pytest.mark.parametrize("plugin", PLUGINS)
@pytest.mark.parametrize("more", [{}, {"max_depth": -1}], ids=["direct", "any depth"])
def test_one_light_is_exact(bulb_over_floor, plugin, more):
    image, path = (
        render(bulb_over_floor, name, 1, 2, **kw) for name, kw in ((plugin, more), ("path", {"max_depth": 2}))
    )
    assert 0 < np.count_nonzero(path.mean(2)) < path[..., 0].size
    assert np.allclose(image, path, rtol=1e-3, atol=1e-7)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("plugin", PLUGINS)
def test_light_that_is_not_finite_counts_for_nothing(bulb_over_floor, plugin):
    bad = {"type": "point", "position": [0, 0.3, 0], "intensity": rgb(math.nan, 1, 1)}
    broken = mi.load_dict(
        {
            "type": "scene", "sensor": sensor(16, 1), "floor": wall([0, -1, 0], [1, 0, 0], -90, 2.0), "bad": bad,
            "bulb": {"type": "point", "position": [0.3, 0.2, 0.1], "intensity": rgb(1, 2, 3)},
        }
    )  # fmt: skip
    integrator = mi.load_dict({"type": plugin})
    assert np.allclose(render(broken, integrator, 1, 2), render(bulb_over_floor, "path", 1, 2), rtol=1e-3, atol=1e-7)
    render(broken, integrator, 1)
    assert integrator.statistics["dropped"] == 1


FLOOR = {"floor": lambda: wall([0, -1, 0], [1, 0, 0], -90, 2.0)}
BLACK = {
    "no emitters": lambda: {"floor": FLOOR["floor"]()},
    "nothing at all": lambda: {},
    "camera sees nothing": lambda: {"ball": {"type": "sphere", "center": [0, 0, 90]}, "bulb": {"type": "point"}},
    "zero power": lambda: {
        "floor": FLOOR["floor"](), "bulb": {"type": "point", "intensity": 0.0},
        "lamp": area_light(radiance=[0, 0, 0]), "sky": {"type": "constant", "radiance": 0.0},
    },
    "light in a closed box": lambda: {
        "floor": FLOOR["floor"](), "case": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.2)},
        "bulb": {"type": "point"}, "lamp": area_light(0.1),
    },
}  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("plugin", PLUGINS)
@pytest.mark.parametrize("name", BLACK)
def test_scenes_without_light_are_black(plugin, name):
    scene = mi.load_dict({"type": "scene", "sensor": sensor(16, 2), **BLACK[name]()})
    image = render(scene, mi.load_dict({"type": plugin, "aovs": "noise,shadow_rays"}), 2)
    assert image.shape == (16, 16, 5) and np.isfinite(image).all() and image[..., :4].max() == 0


@pytest.mark.parametrize("plugin", PLUGINS)
def test_environment_without_geometry_is_shown(plugin):
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor(16, 2), "sky": {"type": "constant", "radiance": rgb(1, 2, 3)}}
    )
    assert np.allclose(render(scene, plugin, 2), [1, 2, 3], rtol=1e-5)


# ---- Randomness


@pytest.mark.parametrize("plugin", ["adaptivedirect", *stress("unoccludeddirect")])
def test_same_seed_same_image_and_other_seed_other_image(mixed, plugin):
    first, again, other = (render(mixed, plugin, 2, seed, error=0.1) for seed in (3, 3, 4))
    assert np.allclose(first, again, rtol=1e-5, atol=0)
    assert not np.allclose(first, other, rtol=1e-2)


@pytest.mark.stress
def test_order_of_emitters_does_not_matter(reference):
    scene = mi.load_dict(mixed_scene(dict(reversed(mixed_emitters().items()))))
    assert_mean_of_reference(scene, reference, lights="clusters")


# ---- What is known besides the image


@pytest.mark.stress
def test_aovs_have_their_names_and_ranges(mixed):
    for plugin, more in METHODS.values():
        integrator = mi.load_dict({"type": plugin, "aovs": ",".join(AOVS), "error": 0.1, **more})
        assert tuple(integrator.aov_names()) == AOVS
        image = render(mixed, integrator, 4)
        assert np.isfinite(image).all() and image.min() >= 0
        noise, passes, rays, visible = np.moveaxis(image[..., 3:], 2, 0)
        lit = passes > 0
        assert 0.05 < lit.mean() < 1
        assert 0 < np.median(noise[lit]) < 0.3 and noise.max() < 2
        assert rays.sum() * 4 == pytest.approx(integrator.statistics["shadow_rays"], rel=1e-5)
        assert 0 < integrator.statistics["shadow_rays"] and rays[~lit].max() == 0
        # BSDF samples that found light count as emitter samples
        assert visible.max() <= 1 and visible.mean() > 0.05
        assert passes.sum() * 4 == pytest.approx(integrator.statistics["passes"], rel=1e-5)
        if plugin == "adaptivedirect" and more["lights"] == "clusters":
            assert passes.max() <= 15


def test_aovs_come_in_the_order_that_is_asked_for(mixed):
    some, rest = (render(mixed, "adaptivedirect", 4, 1, aovs=names) for names in ("visible,noise", ",".join(AOVS)))
    assert np.allclose(some[..., 3:], rest[..., [6, 3]], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("method", ["clusters", *stress("unoccluded")])
def test_noise_is_calibrated(mixed, method):
    plugin, more = METHODS[method]
    integrator = mi.load_dict({"type": plugin, "aovs": "noise", "error": 0.1, **more})
    levels, predicted = same_camera_rays(mixed, integrator, 20 if method == "clusters" else 8)
    mean, spread = levels.mean(0), levels.std(0, ddof=1)
    counted = predicted.mean(0) > 0
    assert counted.mean() > 0.3
    # Pixels that are held to the floor have any relative noise
    counted &= mean > 0.2 * mean[counted].mean()
    actual = np.sqrt(np.mean(np.square(spread[counted] / mean[counted])))
    assert 1 / 2.5 < actual / predicted.mean(0)[counted].mean() < 2.5
    assert actual < 0.2


@pytest.mark.parametrize(("plugin", "more"), [METHODS["clusters"], *stress(METHODS["unoccluded"])], ids=PLUGINS)
def test_max_samples_holds_and_matters(mixed, plugin, more):
    most = 200

    def rays(limit):
        integrator = mi.load_dict(
            {"type": plugin, "error": 1e-3, "bsdf_share": 0.0, "aovs": "shadow_rays",
             "max_samples": limit, **more}
        )  # fmt: skip
        return render(mixed, integrator, 1)[..., 3], integrator.statistics["sources"]

    limited, sources = rays(most)
    one_pass = max(50, 1.5 * sources) + 8
    assert 0 < limited.max() <= most + one_pass
    assert rays(5 * most)[0].max() > most + one_pass


def test_max_passes_holds(mixed):
    passes = render(mixed, "adaptivedirect", 1, lights="clusters", error=1e-3, max_passes=2, aovs="passes")[..., 3]
    assert passes.max() == 2


def test_clusters_are_counted_and_fall_with_their_angle(mixed):
    found = []
    for angle in (0.02, 10.0):
        plugin = mi.load_dict({"type": "adaptivedirect", "cluster_angle": angle, "error": 0.2})
        render(mixed, plugin, 1)
        found.append(plugin.statistics["clusters"] / plugin.statistics["gather_points"])
    assert plugin.statistics["sources"] >= found[0] > found[1] > 0


def test_time_is_a_limit(mixed):
    found = []
    for seconds in (1e-6, 100.0):
        plugin = mi.load_dict({"type": "adaptivedirect", "lights": "clusters", "error": 0.01, "time": seconds})
        image = render(mixed, plugin, 2)
        assert np.isfinite(image).all() and image.min() >= 0 and image.max() > 0
        found.append(plugin.statistics["shadow_rays"])
    assert found[0] < 0.2 * found[1]


# ---- Films and wrappers


@pytest.mark.parametrize("plugin", ["adaptivedirect", *stress("unoccludeddirect")])
@pytest.mark.parametrize(("number", "shape"), [(1, (11, 21, 3)), (2, (13, 19, 3))], ids=["crop", "border"])
def test_films(mixed, plugin, number, shape):
    ours, path = (view(mixed, mi.load_dict({"type": name, **more}), number, spp) for name, more, spp in (
        (plugin, {"error": 0.03}, 64), ("path", {"max_depth": 2}, 1024)
    ))  # fmt: skip
    assert ours.shape == path.shape == shape
    # Rows or columns that were mixed up would differ by far more
    assert np.mean(np.abs(ours - path)) < (0.08 if plugin == "adaptivedirect" else 0.12) * path.mean()


def test_passes_and_one_sample_a_pixel(mixed, expected):
    plugin = {"type": "adaptivedirect", "lights": "clusters", "error": 0.1}
    in_passes = render(mixed, mi.load_dict(plugin | {"samples_per_pass": 4}), 16)
    once = np.mean([render(mixed, mi.load_dict(plugin), 1, seed) for seed in range(16)], axis=0)
    for image in (in_passes, once):
        assert np.mean(np.abs(image - expected)) < 0.08 * expected.mean()


def test_moment_and_aov_can_wrap_it(mixed, expected):
    nested = {"type": "adaptivedirect", "error": 0.1, "aovs": "noise,passes"}
    moment = render(mixed, mi.load_dict({"type": "moment", "nested": nested}), 4)
    assert np.isfinite(moment).all() and moment.shape[2] > 5
    assert moment[..., :3].mean() == pytest.approx(expected.mean(), rel=0.05)
    depth = render(mixed, mi.load_dict({"type": "aov", "aovs": "dd:depth", "nested": nested}), 4)
    assert np.isfinite(depth).all() and depth.shape[2] == 8
    assert depth[..., :3].mean() == pytest.approx(expected.mean(), rel=0.05)


# ---- Mirrors, glass, media, variants


@pytest.mark.parametrize("plugin", PLUGINS)
def test_mirrors_show_direct_light_of_what_they_reflect(plugin):
    emitters = {
        "bulb": {"type": "point", "position": [0.3, 0.2, 0.1], "intensity": rgb(1, 2, 3)},
        "lamp": lamp(mi.ScalarTransform4f().translate([0.4, 0.3, 1.5]).rotate([0, 1, 0], 180), 0.3, (1, 2, 3)),
    }
    floor, mirror = (
        wall([0, -1, 0], [1, 0, 0], -90, 2.0),
        wall([0, 0, -1], [0, 1, 0], 0, 1.0, bsdf={"type": "conductor"}),
    )
    base = {"type": "scene", "sensor": sensor(16, 1), "floor": floor, "mirror": mirror}

    def compare(scene, ours, theirs):
        found, path = (render(scene, name, 1, 2, max_depth=depth) for name, depth in ((plugin, ours), ("path", theirs)))
        assert np.allclose(found, path, rtol=1e-3, atol=1e-6)
        return path

    scene = mi.load_dict(base | {"bulb": emitters["bulb"]})
    # A plane does not light itself; the fourth edge would bring light from the mirror to it
    near, far = compare(scene, 2, 2), compare(scene, 3, 3)
    compare(scene, -1, 3)
    assert far.sum() > 1.05 * near.sum() > 0
    # Two edges: emission in the mirror, and direct light of the floor, which is left out here
    scene = mi.load_dict({"type": "scene", "sensor": sensor(16, 1), "mirror": mirror, "lamp": emitters["lamp"]})
    assert compare(scene, 2, 2).max() > 0.5


@pytest.mark.stress
def test_emitter_in_glass_is_found_by_bsdf_samples(variant):
    # The emitter lies within the glass: its light reaches the floor by refraction alone, and light from the floor
    # returns to it by way of the glass only after the fourth edge
    def ball(radius, **more):
        return {"type": "sphere", "radius": radius, "center": [0, -0.3, 0], **more}

    scene = mi.load_dict(
        {
            "type": "scene", "sensor": sensor(16, 1), "floor": wall([0, -1, 0], [1, 0, 0], -90, 2.0),
            "glass": ball(0.5, bsdf={"type": "dielectric"}),
            "lamp": ball(0.3, emitter={"type": "area", "radiance": rgb(2, 3, 4)}),
        }
    )  # fmt: skip
    path = cache(lambda seed: render(scene, "path", 2048, 1000 + seed, max_depth=4))
    assert_mean_of_reference(scene, path, 8, finds=0.035, max_depth=4, bsdf_share=1.0, lights="clusters")
    # Only rays that see the emitter directly are left
    assert render(scene, "adaptivedirect", 4, max_depth=4, bsdf_share=0.0).mean() < 0.9 * path(0).mean()


@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_medium_is_refused_by_name(plugin):
    fog = {
        "type": "sphere", "radius": 0.3, "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "albedo": 0.5}
    }  # fmt: skip
    scene = mi.load_dict({"type": "scene", "sensor": sensor(16), "fog": fog, "bulb": {"type": "point"}})
    with pytest.raises(RuntimeError) as error:
        render(scene, plugin)
    assert "participating medium" in str(error.value) + str(error.value.__cause__)


@pytest.mark.stress
def test_virtual_lights_take_adaptive_direct_light(variant):
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    given = {"max_depth": 3, "vpl_count": 1000, "direct_error": 0.2}

    def pair(seed):
        return tuple(render(scene, "lightcuts", 8, seed, direct=direct, **given) for direct in ("adaptive", "nee"))

    assert not np.allclose(*pair(0), rtol=1e-2)
    assert_same_mean(pair, 12)


@pytest.mark.stress
@pytest.mark.usefixtures("restore_variant")
def test_mono_variant_renders_the_same_luminance():
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(mixed_scene(mixed_emitters()))
    path = np.mean([render(scene, "path", 256, seed, max_depth=2).mean() for seed in range(4)])
    for plugin, more in (METHODS["clusters"], METHODS["unoccluded"]):
        image = render(scene, plugin, 8, 0, error=0.05, **more)
        assert image.shape == (32, 32, 1)
        assert image.mean() == pytest.approx(path, rel=0.02)
