"""Passes of ``manylights`` whose pixels have different numbers of samples; channels with every second sample."""

import itertools
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from comparison.fine_film import fine_film, merged
from comparison.single_pass import SharedStart, render_pass
from tests.support.marks import stress
from tests.support.rendering import plugin_with_model
from tests.support.scenes import area_light, closed_box, image, sensor, wall
from tests.support.statistics import assert_same_mean
from vpl.split.pixel_rays import Continued, PixelRays

# Neither square nor symmetric, and as many pixels as a square of SIDE
WIDTH, HEIGHT, SIDE, SPP = 16, 4, 8, 16
# From a quarter of the mean number to four times, as many as the mean
DENSITY = np.random.default_rng(0).permutation(np.repeat([0.25, 0.5, 1, 2, 4], [24, 16, 10, 8, 6]))
DENSITY = DENSITY.reshape(HEIGHT, WIDTH)
FILM = {"width": WIDTH, "height": HEIGHT}
CROP = {"width": 30, "height": 20, "crop_offset_x": 14, "crop_offset_y": 9, "crop_width": WIDTH, "crop_height": HEIGHT}
LENS = {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 1.0}
RGBA = {"pixel_format": "rgba"}

# Virtual lights wherever they carry anything, and none
LIGHTS = {"with lights": True, "without lights": False}
with_and_without_lights = pytest.mark.parametrize("lights", LIGHTS.values(), ids=LIGHTS)


@pytest.fixture(autouse=True)
def lights_cost_nothing():
    """Let virtual lights pay in small images, with cuts that leave the noise to paths with one emitter sample."""
    with plugin_with_model(pays_below=1e30, fewest_light_paths=1000, coarsest_error=0.1, most_emitter_samples=1):
        yield


def room(film=FILM, **camera):
    """A closed box with walls of different colours and a lamp."""
    description = closed_box({"lamp": area_light()})
    description["sensor"] |= camera
    description["sensor"]["film"] |= film
    return mi.load_dict(description)


def pictures(film=FILM, camera=None):
    """A turned, shining picture in front of nothing, with texels that are about as large as pixels."""
    texels = np.random.default_rng(1).uniform(0.1, 2, (7, 23, 3))
    description = {"type": "scene", "sensor": sensor(fov=38), "picture": wall([0, 0, 0], [0, 0, 1], 20)}
    shines = {"type": "area", "radiance": image(texels) | {"filter_type": "nearest"}}
    description["picture"]["emitter"] = shines
    description["sensor"]["film"] |= film
    description["sensor"] |= camera or {}
    return mi.load_dict(description)


def plugin(lights=True, **more):
    return mi.load_dict({"type": "manylights", "denoised": True, "max_depth": 4, "virtual_lights": lights} | more)


def render(scene, *arguments, parts=1, **more):
    """A first pass of a render, see :func:`fine_image`, in the resolution of the image."""
    filter = scene.sensors()[0].film().rfilter()
    return merged(fine_image(scene, *arguments, parts=parts, **more), parts, filter)


def fine_image(scene, integrator, density=None, seed=0, spp=SPP, half=False, parts=1, continued=None):
    """A first pass of a render in the resolution of its film: an array (height, width, channels)."""
    camera = scene.sensors()[0]
    one = integrator.pass_of(SharedStart(), True, density, half, parts, continued)
    with one as is_missing, fine_film(camera, parts):
        assert not is_missing
        found = mi.render(scene, sensor=camera, integrator=integrator, spp=spp // parts**2, seed=seed)
        return np.array(found, np.float64)


def by_pixel(planes):
    """The pixels in a square, of which tests of means can take every pixel as a tile."""
    return planes.reshape(SIDE, SIDE, -1)


def assert_same_mean_of_pixels(pair, seeds=10, finds=0.03):
    """Of pairs of images (HEIGHT, WIDTH, channels)."""
    assert_same_mean(lambda seed: tuple(map(by_pixel, pair(seed))), seeds, finds, tiles=SIDE)


def test_the_density_of_these_tests_has_these_numbers():
    assert DENSITY.mean() == 1
    assert (PixelRays.by_density(DENSITY, SPP).numbers.reshape(DENSITY.shape) == SPP * DENSITY).all()


# ---------------------- Images ----------------------


@pytest.mark.parametrize("film", [FILM, CROP], ids=["film", "crop"])
@pytest.mark.parametrize("camera", [{}, LENS], ids=["pinhole", "lens"])
def test_a_pixel_is_that_of_an_image_with_as_many_equal_samples(film, camera):
    """Where nothing but camera samples is random."""
    scene, integrator = pictures(film | RGBA, camera), plugin(max_depth=1)
    found = render(scene, integrator, DENSITY, 3)
    for times in np.unique(DENSITY):
        pixels = DENSITY == times
        equal = render(scene, integrator, None, 3, int(times * SPP))
        np.testing.assert_allclose(found[pixels][:, :3], equal[pixels][:, :3], atol=1e-5)
        # Alpha is rounded to a multiple of 1 / SPP
        assert np.abs(found - equal)[pixels][:, 3].max() < 1 / SPP
    assert np.abs(found - render(scene, integrator, None, 3)).max() > 0.01
    assert np.std(found[..., 3]) > 0.1


@with_and_without_lights
def test_a_constant_density_gives_the_image_of_equal_numbers(lights):
    scene, integrator = room(), plugin(lights)
    found, expected = (render(scene, integrator, density, 5) for density in (np.full((HEIGHT, WIDTH), 7.0), None))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(found - render(scene, integrator, DENSITY, 5)).max() > 1e-3


@pytest.mark.parametrize(("lights", "parts"), [(True, 1), (False, 2), *stress((True, 2), (False, 1))])
def test_the_mean_of_every_pixel_is_that_of_equal_numbers(lights, parts):
    scene, integrator = room(), plugin(lights)

    def pair(seed):
        found = render(scene, integrator, DENSITY, seed, parts=parts)
        assert (integrator.statistics.get("light_paths", 0) > 0) == lights
        return found, render(scene, integrator, None, 1000 + seed)

    assert_same_mean_of_pixels(pair)


DIVISIONS = list(itertools.product((1, 2), (None, 2 * SPP * WIDTH)))
# What the quick run tests: lights, with several cells in a pixel, and a divided image apart
QUICK_SHARED = [(True, 2, None), (False, 1, 2 * SPP * WIDTH)]
ALL_SHARED = [(lights, *division) for lights in (True, False) for division in DIVISIONS]


@pytest.mark.parametrize(
    ("lights", "parts", "rays_of_part"),
    [*QUICK_SHARED, *stress(*(one for one in ALL_SHARED if one not in QUICK_SHARED))],
)
def test_passes_that_share_lattices_have_the_mean_of_equal_numbers(monkeypatch, lights, parts, rays_of_part):
    """And in their mean less noise than passes with lattices of their own, wherever the image is divided."""
    scene, integrator = room(), plugin(lights)
    if rays_of_part:
        monkeypatch.setattr("vpl.split.estimator._WAVEFRONT", (rays_of_part, rays_of_part))

    def mean_of_passes(seed, shares):
        sizes, images, done = (SPP, SPP, 2 * SPP), [], 0
        for number, size in enumerate(sizes):
            continued = Continued(done, seed) if shares else None
            image = render(scene, integrator, DENSITY, 10 * seed + number, size, parts=parts, continued=continued)
            images.append(size * image)
            done += size
        return sum(images) / done

    found = {shares: [] for shares in (True, False)}

    def pair(seed):
        for shares, images in found.items():
            images.append(mean_of_passes(seed, shares))
        return found[True][-1], render(scene, integrator, None, 1000 + seed)

    assert_same_mean_of_pixels(pair)
    shared, own = (np.var(images, axis=0, ddof=1).mean() for images in found.values())
    assert shared < own


def test_images_of_several_parts_have_the_mean_of_equal_numbers(monkeypatch):
    scene, integrator = room(), plugin()

    def pair(seed):
        expected = render(scene, integrator, None, 1000 + seed)
        with monkeypatch.context() as patched:
            # Of about a quarter of the rays
            patched.setattr("vpl.split.estimator._WAVEFRONT", (SPP * WIDTH, SPP * WIDTH))
            return render(scene, integrator, DENSITY, seed), expected

    assert_same_mean_of_pixels(pair)


@with_and_without_lights
def test_a_later_pass_is_the_same_wherever_the_first_pass_was_rendered(lights):
    """The start belongs to the first pass, whose pixels have equal numbers."""
    scene, first, shared = room(), (4, 7), SharedStart()
    render_pass(scene, 0, plugin(lights), *first, first, shared)
    here, elsewhere = (
        render_pass(scene, 0, plugin(lights), SPP, 8, first, start, DENSITY).planes for start in (shared, None)
    )
    np.testing.assert_allclose(here, elsewhere, rtol=1e-4, atol=1e-5)


def test_a_monochrome_image_has_the_mean_of_equal_numbers(restore_variant):
    mi.set_variant("llvm_ad_mono")
    scene, integrator = room(), plugin(lights=False)
    assert_same_mean_of_pixels(lambda seed: tuple(render(scene, integrator, x, seed) for x in (DENSITY, None)))
    assert {"every second.Y"} == {name for name in halves(scene, integrator) if name.startswith("every second")}


# ---------------------- Variance ----------------------


@with_and_without_lights
def test_the_variance_of_pixels_falls_with_their_samples(lights):
    scene, integrator = room(), plugin(lights)
    own, equal = (
        np.var([render(scene, integrator, density, seed) for seed in range(16)], axis=0, ddof=1).mean(2)
        for density in (DENSITY, None)
    )
    typical = [np.exp(np.log(own / equal)[DENSITY == times].mean()) for times in np.unique(DENSITY)]
    assert (np.diff(typical) < 0).all()
    # About inversely to the samples
    assert typical[0] > 2.5 and typical[-1] < 0.5


# ---------------------- Alpha ----------------------


@pytest.mark.parametrize("spp", [4, *stress(SPP)])
def test_alpha_has_the_mean_of_equal_numbers(spp):
    """In pixels with any number of samples; of a mask that covers the film by a third, with nothing behind."""
    mask = {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse"}}
    description = {"type": "scene", "sensor": sensor(16), "lamp": {"type": "point", "position": [0, 0, 3]}}
    description["mask"] = wall([0, 0, 0], [0, 1, 0], 0, 8, bsdf=mask)
    description["sensor"]["film"] |= FILM | RGBA
    scene, integrator, seeds = mi.load_dict(description), plugin(lights=False), 50
    alpha = np.array([render(scene, integrator, DENSITY, seed, spp)[..., 3] for seed in range(seeds)])
    assert alpha.min() >= 0 and alpha.max() <= 1
    for times in np.unique(DENSITY):
        found = alpha[:, DENSITY == times].mean(1)
        assert abs(found.mean() - 0.3) <= 4.5 * found.std(ddof=1) / seeds**0.5 + 1e-4, f"{times} times the samples"


# ---------------------- Layers and halves ----------------------


def test_layers_sum_to_the_image_and_have_the_means_of_equal_numbers():
    scene, integrator = room(), plugin(layers="emission,direct,indirect")

    def pair(seed):
        found, expected = (render(scene, integrator, density, seed) for density in (DENSITY, None))
        np.testing.assert_allclose(found[..., 3:6] + found[..., 6:9] + found[..., 9:], found[..., :3], atol=1e-4)
        return found[..., 3:], expected[..., 3:]

    assert_same_mean_of_pixels(pair)


def halves(scene, integrator, seed=0):
    """(Channels by name, of the film) of a pass with every second sample."""
    render(scene, integrator, None, seed, half=True)
    bitmap = scene.sensors()[0].film().bitmap()
    planes = np.array(bitmap, np.float64).reshape(HEIGHT, WIDTH, -1)
    return {entry.name: planes[..., number] for number, entry in enumerate(bitmap.struct_())}


def colour(channels, prefix=""):
    return np.stack([channels[prefix + name] for name in "RGB"], -1)


@with_and_without_lights
@pytest.mark.parametrize("rgba", [False, True])
def test_halves_are_additional_channels(rgba, lights):
    scene, integrator = room(FILM | (RGBA if rgba else {})), plugin(lights, layers="direct")
    expected = render(scene, integrator, None, 2)
    found = halves(scene, integrator, 2)
    layers = [f"direct.{channel}" for channel in "RGB"]
    assert list(found) == [*("RGBA" if rgba else "RGB"), *layers, "every second.R", "every second.G", "every second.B"]
    # The others are those of a render without halves
    for name, plane in zip(list(found)[:-3], np.moveaxis(expected, 2, 0), strict=True):
        np.testing.assert_allclose(found[name], plane, rtol=1e-4, atol=1e-5)
    assert "every second.R" not in integrator.aov_names()


@with_and_without_lights
def test_halves_have_the_mean_of_the_image(lights):
    scene, integrator = room(), plugin(lights)

    def pair(seed):
        found = halves(scene, integrator, seed)
        return colour(found, "every second."), colour(found)

    assert_same_mean_of_pixels(pair)


def test_halves_are_of_every_second_sample():
    """What they leave of the image is the mean of as many other samples."""
    scene, integrator = pictures(), plugin(max_depth=1)
    found = [halves(scene, integrator, seed) for seed in range(64)]
    half, whole = (np.array([colour(x, prefix) for x in found]) for prefix in ("every second.", ""))
    rest = 2 * whole - half
    # The radiance of a lamp is positive
    assert half.min() >= 0 and rest.min() >= -1e-6
    variances = [x.var(0) for x in (half, rest, whole)]
    noisy = np.min(variances, axis=0) > 1e-4
    assert noisy.mean() > 0.5
    of_half, of_rest, of_whole = (x[noisy] for x in variances)
    # Both have as much noise, and more than the image
    assert np.median(of_half / of_rest) == pytest.approx(1, abs=0.25)
    assert np.median(of_half / of_whole) > 1.5


@pytest.mark.parametrize("film", [{}, {"rfilter": {"type": "gaussian"}}], ids=["box", "gaussian"])
@with_and_without_lights
def test_the_mean_of_every_pixel_of_a_fine_film_is_that_of_a_usual_one(lights, film):
    # Only the back wall, which is smooth: at corners, the steps of a filter change a pixel by 1.5%
    scene, integrator = room(FILM | film, fov=45), plugin(lights)

    def pair(seed):
        found = render(scene, integrator, None, seed, parts=2)
        assert (integrator.statistics.get("light_paths", 0) > 0) == lights
        return found, render(scene, integrator, None, 1000 + seed)

    assert_same_mean_of_pixels(pair)


def test_a_fine_film_shows_the_parts_of_pixels():
    """A picture whose texels are smaller than pixels, where nothing but camera samples is random."""
    scene, integrator = pictures(), plugin(max_depth=1)
    camera = scene.sensors()[0]
    with fine_film(camera, 2):
        expected = np.array(mi.render(scene, sensor=camera, integrator=integrator, spp=4096, seed=1))
    found = fine_image(scene, integrator, None, 2, 4096, parts=2)
    assert found.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())
    merged_image = render(scene, integrator, None, 2, 4096, parts=2)
    np.testing.assert_allclose(merged_image, found.reshape(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3)), rtol=1e-5)


@pytest.mark.parametrize("density", [None, DENSITY], ids=["equal numbers", "different numbers"])
def test_light_that_the_rays_of_a_pixel_share_leaves_the_pixel_as_it_is(density):
    scene, integrator, found = room(), plugin(), []
    for spread in (0.0, 1.0):
        integrator.cost_model = replace(integrator.cost_model, spread=spread)
        found.append(fine_image(scene, integrator, density, 3, 64, parts=2))
        assert integrator.statistics["light_paths"] > 0
    apart, shared = (image.reshape(HEIGHT, 2, WIDTH, 2, 3) for image in found)
    # Cells with the mean number of rays: a pixel is the mean of its cells
    np.testing.assert_allclose(shared.mean((1, 3)), apart.mean((1, 3)), rtol=1e-4)
    assert shared.std((1, 3)).mean() < 0.9 * apart.std((1, 3)).mean()


def test_with_layers_rays_share_no_light():
    scene, images = room(), []
    for spread in (0.0, 1.0):
        integrator = plugin(layers="direct,indirect")
        integrator.cost_model = replace(integrator.cost_model, spread=spread)
        images.append(fine_image(scene, integrator, None, 3, 64, parts=2))
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("spp", [4, 20, 64])
def test_a_fine_film_has_the_decisions_of_the_usual_one(spp):
    scene, integrator, plans = room(), plugin(), []
    for parts in (1, 2):
        render(scene, integrator, None, 3, spp, parts=parts)
        plans.append([integrator.statistics[key] for key in ("light_paths", "clusters", "gather_points")])
    assert plans[1] == pytest.approx(plans[0], rel=0.1)


@with_and_without_lights
def test_halves_of_a_fine_film_have_the_mean_of_the_image(lights):
    scene, integrator = room(), plugin(lights)

    def pair(seed):
        found = render(scene, integrator, None, seed, half=True, parts=2)
        return found[..., 3:], found[..., :3]

    assert_same_mean_of_pixels(pair)


def test_a_fine_film_counts_as_an_image_where_samples_are_not_stratified():
    scene, integrator = room(), plugin(stratified=False)
    assert_same_mean_of_pixels(
        lambda seed: (render(scene, integrator, None, seed, parts=2), render(scene, integrator, None, 1000 + seed))
    )


def test_a_fine_film_is_refused_where_mitsuba_divides_a_pass():
    with pytest.raises(RuntimeError) as raised:
        render(room(), plugin(samples_per_pass=4), None, 0, 64, parts=2)
    assert "parts must be 1 with samples_per_pass, got 2" in f"{raised.value} {raised.value.__cause__}"


# ---------------------- Where numbers may differ ----------------------


def described(film=None, camera=None):
    description = closed_box({"lamp": area_light()}, 8)["sensor"]
    description["film"] |= film or {}
    return mi.load_dict(description | (camera or {}))


def test_numbers_may_differ_with_the_default_sampler_and_a_box_filter():
    assert all(plugin().may_differ(described(), spp) for spp in (4, 8, 20, 1024))
    assert plugin(layers="direct").may_differ(described(RGBA, LENS), 16)


REFUSED = {
    "a filter with weights": ({"rfilter": {"type": "gaussian"}}, {}, {}),
    "another filter with weights": ({"rfilter": {"type": "tent"}}, {}, {}),
    "samples beyond the border": ({"sample_border": True}, {}, {}),
    "another sampler": ({}, {"sampler": {"type": "stratified", "sample_count": 16}}, {}),
    "one more sampler": ({}, {"sampler": {"type": "multijitter", "sample_count": 16}}, {}),
    "an image that is not denoised": ({}, {}, {"denoised": False}),
    "samples that are not stratified": ({}, {}, {"stratified": False}),
    "a pass that Mitsuba divides": ({}, {}, {"samples_per_pass": 4}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_numbers_may_not_differ_with(case):
    film, camera, more = REFUSED[case]
    assert not plugin(**more).may_differ(described(film, camera), 16)


def test_numbers_may_differ_on_a_fine_film_for_any_filter():
    film = {"rfilter": {"type": "gaussian"}}
    assert all(plugin().may_differ(described(film), spp, 2) for spp in (16, 32, 80))
    assert not any(plugin().may_differ(described(film), spp, 2) for spp in (4, 8, 24))
    assert not plugin(samples_per_pass=4).may_differ(described(film), 32, 2)


@pytest.mark.parametrize("spp", [1, 2, 6, 15, 17])
def test_numbers_may_not_differ_without_a_quarter_of_the_samples(spp):
    assert not plugin().may_differ(described(), spp)


def test_numbers_may_not_differ_between_the_sensors_of_a_batch():
    camera = closed_box({}, 8)["sensor"]
    batch = {"type": "batch", "film": camera["film"], "sampler": camera["sampler"], "one": camera}
    assert not plugin().may_differ(mi.load_dict(batch), 16)


@pytest.mark.parametrize("density", [DENSITY[:2], DENSITY.T])
def test_a_density_of_another_shape_is_refused(density):
    with pytest.raises(RuntimeError) as raised:
        render(room(), plugin(), density)
    assert "density must have the shape of the image" in str(raised.value.__cause__ or raised.value)


def test_a_density_with_halves_is_refused():
    with pytest.raises(ValueError, match="half must be False"):
        render(room(), plugin(), DENSITY, half=True)
