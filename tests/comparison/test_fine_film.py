"""Films of twice the resolution, and the images of the usual resolution from them."""

from threading import Thread

import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison import fine_film as module
from comparison.fine_film import fine_film, merged, usual_parts
from tests.support.scenes import closed_box, cornell

FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")
FORMATS = ("rgb", "rgba", "luminance", "luminance_alpha", "xyz", "xyza")


def camera(film=None, **more):
    description = closed_box({}, 8)["sensor"]
    description["film"] |= film or {}
    return mi.load_dict(description | more)


def filter_of(name):
    return camera({"rfilter": {"type": name}}).film().rfilter()


@pytest.mark.parametrize("pixel_format", FORMATS)
def test_a_fine_film_has_the_pixels_of_the_film(pixel_format):
    crop = {"crop_offset_x": 7, "crop_offset_y": 3, "crop_width": 11, "crop_height": 5}
    one = camera({"width": 30, "height": 20, "pixel_format": pixel_format, "rfilter": {"type": "gaussian"}} | crop)
    film = one.film()
    with fine_film(one, 2):
        fine = one.film()
        sizes = [[int(x) for x in pair] for pair in (fine.size(), fine.crop_size(), fine.crop_offset())]
        assert sizes == [[60, 40], [22, 10], [14, 6]]
        assert fine.rfilter().is_box_filter()
        for each in (film, fine):
            each.prepare([])
        assert fine.bitmap().pixel_format() == film.bitmap().pixel_format()
    assert one.film() is film
    with fine_film(one, 1):
        assert one.film() is film


def test_the_film_returns_after_an_error():
    one = camera()
    film = one.film()
    with pytest.raises(KeyError), fine_film(one, 2):
        raise KeyError
    assert one.film() is film


@pytest.mark.parametrize("name", FILTERS)
def test_constant_images_stay_constant_up_to_the_border(name):
    image = np.broadcast_to(np.float32([1, 2, 0.5]), (24, 10, 3))
    found = merged(image, 2, filter_of(name))
    assert found.shape == (12, 5, 3) and found.dtype == np.float32
    np.testing.assert_allclose(found, np.broadcast_to(np.float32([1, 2, 0.5]), (12, 5, 3)), rtol=1e-6)


def test_a_box_filter_takes_the_mean_of_the_parts():
    image = np.random.default_rng(0).random((6, 8, 2))
    np.testing.assert_allclose(merged(image, 2, filter_of("box")), image.reshape(3, 2, 4, 2, 2).mean((1, 3)))
    assert merged(image, 1, filter_of("gaussian")) is image


@pytest.mark.parametrize("name", FILTERS[1:])
def test_other_filters_keep_position_and_width(name):
    """Moments of the response to a fine pixel, in the middle of an image."""
    filter = filter_of(name)
    place = np.linspace(-filter.radius(), filter.radius(), 20001)[1:-1]
    values = np.array(filter.eval(mi.Float(place)))
    exact = (values * place**2).sum() / values.sum()
    # The response of every pixel to a fine column; its transpose is the filter of a pixel
    columns = np.eye(48)[:, :, None]
    weights = merged(np.repeat(columns, 2, axis=0).reshape(96, 48, 1), 2, filter)[24, :, 0]
    response = np.array(
        [merged(np.tile(column[None, :, None], (2, 1, 1)), 2, filter)[0, 12, 0] for column in np.eye(48)]
    )
    centre = (np.arange(48) + 0.5) / 2 - 12.5
    assert weights.shape == (24,) and response.sum() == pytest.approx(1, abs=1e-6)
    assert (response * centre).sum() == pytest.approx(0, abs=1e-6)
    # A fine pixel is half a pixel wide. Without negative weights, filters are slightly wider
    wider = {"tent": 0.03, "gaussian": 0.01}.get(name, 2e-3)
    assert (response * centre**2).sum() + 0.25 / 12 == pytest.approx(exact, abs=wider)


@pytest.mark.parametrize("name", ["box", "gaussian"])
def test_the_image_of_a_fine_film_is_that_of_mitsuba(name):
    film = {"width": 24, "height": 16, "rfilter": {"type": name}, "pixel_format": "rgba"}
    description = closed_box({"lamp": {"type": "constant"}}, 8)
    description["sensor"]["film"] |= film
    scene = mi.load_dict(description)
    path, one = mi.load_dict({"type": "path", "max_depth": 2}), scene.sensors()[0]
    expected = np.array(mi.render(scene, integrator=path, spp=4096, seed=1))
    with fine_film(one, 2):
        fine = np.array(mi.render(scene, sensor=one, integrator=path, spp=1024, seed=2))
    found = merged(fine, 2, one.film().rfilter())
    assert np.sqrt(np.mean(np.square(found - expected))) < 0.02 * expected.mean()


def plugin(name, **more):
    return mi.load_dict({"type": name} | more)


@pytest.mark.parametrize(("spp", "parts"), [(4, 2), (None, 2), (1000, 2), (3, 1), (1, 1)])
def test_pixels_of_a_fine_film_have_a_sample_at_least(spp, parts):
    assert usual_parts(camera(), plugin("path"), spp) == parts


def test_films_that_keep_their_resolution(monkeypatch):
    path = plugin("path")
    assert usual_parts(camera({"rfilter": {"type": "gaussian"}}), path, 16) == 2
    assert usual_parts(camera({"sample_border": True}), path, 16) == 1
    batch = {"type": "batch", "film": {"type": "hdrfilm"}, "one": closed_box({}, 8)["sensor"]}
    assert usual_parts(mi.load_dict(batch), path, 16) == 1
    monkeypatch.setattr(module, "LARGEST", 4 * 64 - 1)
    assert usual_parts(camera(), path, 16) == 1 and usual_parts(camera({"width": 7}), path, 16) == 2


def test_integrators_that_gain_by_a_fine_film():
    wrapped = {"type": "aov", "aovs": "d:depth", "inner": {"type": "path"}}
    gain = [plugin("path"), plugin("direct"), mi.load_dict(wrapped), plugin("manylights")]
    assert {usual_parts(camera(), one, 16) for one in gain} == {2}
    others = [plugin("ptracer"), plugin("lightcuts"), plugin("mdlightcuts"), plugin("adaptivedirect")]
    assert {usual_parts(camera(), one, 16) for one in [*others, plugin("manylights", samples_per_pass=8)]} == {1}


@pytest.mark.parametrize("integrator", ["ptracer", "adaptivedirect"])
def test_other_integrators_are_denoised_in_the_usual_resolution(integrator):
    image, took = manylights.render(cornell(32).load(), plugin(integrator), spp=64, denoise=True)
    assert image.shape == (32, 32, 3) and took.denoiser["denoise_resolution"] == 1
    expected = manylights.render(cornell(32).load(), plugin(integrator), spp=64)[0].numpy()
    np.testing.assert_allclose(took.raw.numpy(), expected, rtol=1e-4, atol=1e-4 * expected.max())


def test_a_sensor_in_use_keeps_its_film():
    one = camera()
    film, refused = one.film(), []

    def other():
        with pytest.raises(RuntimeError, match="another thread") as error, fine_film(one, 2):
            pass
        refused.append(error)

    with fine_film(one, 2):
        thread = Thread(target=other)
        thread.start()
        thread.join()
    assert refused and one.film() is film


def test_no_pixel_beside_a_bright_one_is_negative():
    image = np.zeros((24, 24, 1))
    image[12, 12] = 1e6
    for name in ("box", "tent", "gaussian"):
        assert merged(image, 2, filter_of(name)).min() == 0


@pytest.mark.parametrize("integrator", ["path", "manylights"])
@pytest.mark.parametrize(("spp", "rounded"), [(3, 3), (4, 4), (6, 8), (50, 52)])
def test_samples_are_rounded_up_to_those_of_equal_parts(integrator, spp, rounded):
    image, took = manylights.render(cornell(16).load(), integrator, spp=spp, denoise=True, layers=["albedo", "depth"])
    assert took.spp == rounded and image.shape == took.raw.shape == (16, 16, 7)
    assert took.denoiser["denoise_resolution"] == (1 if spp < 4 else 2)
    assert np.isfinite(image.numpy()).all()
