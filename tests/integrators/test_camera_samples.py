"""Camera samples of ``manylights`` are stratified where the sensor's sampler is ``independent``, and only there."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.rendering import render
from tests.support.statistics import assert_same_mean

PIXELS, SAMPLES = 6, 16


def edge(sampler="independent", rfilter="box", **sensor):
    """A lamp whose slanted edge crosses the image."""
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": rfilter}}
    camera = {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
    }
    lamp = {
        "type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([0, 0, 1], 20),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }  # fmt: skip
    return mi.load_dict(
        {"type": "scene", "lamp": lamp, "sensor": camera | sensor | {"film": film, "sampler": {"type": sampler}}}
    )


def variance(scene, stratified=True, **more):
    more |= {"stratified": stratified, "max_depth": 1}
    images = np.array([render(scene, "manylights", SAMPLES, seed, **more) for seed in range(16)])
    return images.var(0, ddof=1).mean()


@pytest.mark.parametrize("passes", [1, 4])
def test_samples_of_a_pixel_are_one_in_each_stratum(passes):
    from integrators.camera_samples import LatticeSampler

    sampler = LatticeSampler()
    sampler.pixels = PIXELS
    sampler.set_sample_count(SAMPLES)
    sampler.seed(7, PIXELS * SAMPLES // passes)
    drawn = []
    for number in range(passes):
        if number:
            sampler.advance()
        once, points, lens = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
        rows = [np.array(x) for x in (once, points.x, points.y, lens.x, lens.y)]
        drawn.append(np.array(rows).reshape(5, PIXELS, -1))
    # A random shift and then a point in each stratum: all gaps are equal
    ordered = np.sort(np.concatenate(drawn, 2), 2)
    assert np.diff(ordered, axis=2) == pytest.approx(1 / SAMPLES, abs=1e-5)
    assert len({tuple(row) for row in ordered.reshape(5 * PIXELS, -1).round(6)}) == 5 * PIXELS


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_an_edge_has_a_fraction_of_the_variance(rfilter):
    scene = edge(rfilter=rfilter)
    assert variance(scene) < 0.4 * variance(scene, stratified=False)


LENS = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 1.0}


def test_a_lens_has_less_variance():
    scene = edge(**LENS)
    assert variance(scene) < 0.7 * variance(scene, stratified=False)


def test_passes_have_less_variance():
    scene = edge()
    assert variance(scene, samples_per_pass=4) < 0.4 * variance(scene, stratified=False)


def test_a_chosen_sampler_is_used():
    scene = edge("stratified")
    images = [render(scene, "manylights", SAMPLES, 3, max_depth=1, stratified=on) for on in (True, False)]
    assert (images[0] == images[1]).all()


@pytest.mark.parametrize(("camera", "more"), [({}, {}), ({}, {"samples_per_pass": 4}), (LENS, {})])
def test_the_mean_is_that_of_path(camera, more):
    scene = edge(rfilter="gaussian", **camera)

    def pair(seed):
        return render(scene, "manylights", SAMPLES, seed, max_depth=2, stratified=True, **more), render(
            scene, "path", 64, seed
        )

    assert_same_mean(pair, 8, finds=0.02)


def test_the_sensor_keeps_its_sampler_and_film():
    scene = edge()
    sensor = scene.sensors()[0]
    before = sensor.sampler().sample_count()
    image = mi.render(scene, integrator=mi.load_dict({"type": "manylights"}), spp=SAMPLES)
    assert sensor.sampler().class_name() == "IndependentSampler" and sensor.sampler().sample_count() == before
    assert dr.allclose(image, mi.TensorXf(sensor.film().bitmap()))


def test_kept_lights_serve_any_number_of_samples():
    room = mi.cornell_box() | {"integrator": {"type": "manylights", "keep_lights": True}}
    room["sensor"]["film"] |= {"width": 64, "height": 64}
    scene = mi.load_dict(room)
    for spp in (32, 64):
        mi.render(scene, spp=spp, seed=2)
    found = scene.integrator().statistics
    assert sum(found["lights"].values()) > 0 and found["light_paths"] == 0


def test_lent_sensors_are_lent_again():
    from integrators import camera_samples

    first, second = edge().sensors()[0], edge().sensors()[0]
    with camera_samples.stratified(first, 4) as one, camera_samples.stratified(second, 9) as other:
        assert one is not other and one.film() is first.film() and other.sampler().sample_count() == 9
    assert one.film() is not first.film()
    with camera_samples.stratified(second, 0) as again:
        assert again in (one, other)
