"""Russian roulette by expected contribution: when it pays, learned values, and an image equal to `path`."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.properties import unit_vectors
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.rooms import lamp_behind_the_camera
from tests.support.scenes import closed_box, sensor, wall
from tests.support.statistics import assert_same_mean
from vpl.core.arrays import upload_vectors
from vpl.split.cost_model import CostModel
from vpl.split.roulette import OutgoingRadiance, best_multiple

MODEL = CostModel()
# Russian roulette is used whatever it gains, with the smallest probabilities
ROULETTE_EVERYWHERE = {"roulette_gain": 1e30, "first_edges": 0.0}


def test_paths_end_where_they_bring_little_and_cost_much():
    brought, edges = np.full(10_000, 0.01), np.full(10_000, 5)
    multiple = best_multiple(brought, brought, edges, 10_000, 1.0, MODEL)
    assert multiple * 0.01 < 0.2
    # Rare paths carry all of the noise, and cannot be told in advance
    rare = np.where(np.arange(10_000) % 100 == 0, 10.0, 0.0)
    multiple = best_multiple(np.ones(10_000), rare, edges, 10_000, 1.0, MODEL)
    assert multiple >= 1


def test_where_roulette_does_not_pay_only_paths_that_bring_next_to_nothing_end():
    """A tenth of the paths bring hardly any light, and have few edges."""
    bright = np.arange(10_000) % 10 > 0
    brought, edges = np.where(bright, 1.0, 0.02), np.where(bright, 5, 1)
    multiple = best_multiple(brought, brought, edges, 10_000, 1.0, MODEL)
    survival = np.clip(multiple * brought, MODEL.least_survival, 1)
    saved = 1 - (MODEL.first_edges + np.mean(edges * survival)) / (MODEL.first_edges + edges.mean())
    assert 0 < saved < 1 - MODEL.roulette_gain
    rise = np.mean(brought**2 * (1 / survival - 1))
    assert 0 <= rise <= MODEL.roulette_rise
    # Paths end at all, and those that bring much go on
    assert (survival[~bright] < 1).all() and (survival[bright] == 1).all()


def test_no_path_ends_in_a_black_image():
    dark = np.zeros(100)
    assert best_multiple(dark, dark, np.ones(100, int), 100, 0.0, MODEL) == np.inf


def test_a_single_path_does_not_decide():
    brought, edges = np.full(10_000, 0.01), np.full(10_000, 5)
    brought[7] = 1e3
    assert best_multiple(np.full(10_000, 0.01), brought, edges, 10_000, 1.0, MODEL) < np.inf


def test_those_that_bring_more_are_followed():
    """Half of the paths carry all radiance: the rest may end."""
    bright = np.arange(10_000) % 2 == 0
    expected = np.where(bright, 1.0, 0.01)
    multiple = best_multiple(expected, expected, np.full(10_000, 8), 10_000, 1.0, MODEL)
    assert 0.5 <= multiple and multiple * 0.01 < 0.5


def test_what_a_vertex_sent_back_does_not_tell_of_itself():
    rng, count = np.random.default_rng(0), 500
    # Ten to a place
    position = np.repeat(rng.random((count // 10, 3)).astype(np.float32), 10, 0)
    normal = np.repeat(unit_vectors(rng, count // 10), 10, 0)
    radiance = np.zeros(count)
    radiance[7] = 100.0
    outgoing, expected = OutgoingRadiance.learned(position, normal, radiance, MODEL)
    assert expected[7] < 0.5 * expected[8] and expected[8] == expected.max()
    # The table on the device includes all vertices
    cell = outgoing.cells.at(
        *(upload_vectors(kind, x[7:8]) for kind, x in ((mi.Point3f, position), (mi.Normal3f, normal)))
    )
    assert np.array(outgoing.radiance)[np.array(cell)[0]] == pytest.approx(np.max(np.array(outgoing.radiance)))


@pytest.mark.parametrize("lights", [True, False])
def test_the_image_is_that_of_path(lights):
    """Most paths end at their second vertices here, because the edges before them count as free."""
    scene = mi.load_dict(closed_box(lamp_behind_the_camera(), size=16))

    def pair(seed):
        found, statistics = render_with_statistics("manylights", scene, 256, seed, virtual_lights=lights)
        assert ("lights" in statistics) == lights and float(statistics["roulette"]) > 0
        return found, render(scene, "path", 256, seed)

    with plugin_with_model(pays_below=1e30, fewest_light_paths=4000, **ROULETTE_EVERYWHERE):
        assert_same_mean(pair, 8, 0.025)


def test_alpha_is_that_of_path_where_a_pixel_sees_masks_behind_masks():
    mask = {"type": "mask", "opacity": 0.3, "nested": {"type": "twosided", "nested": {"type": "diffuse"}}}
    veils = {f"veil{k}": wall([0, 0, -0.3 * k], [0, 1, 0], 0, 8, bsdf=mask) for k in range(6)}
    description = {"type": "scene", "sensor": sensor(16), "lamp": {"type": "point", "position": [0, 0, 3]}, **veils}
    description["sensor"]["film"]["pixel_format"] = "rgba"
    scene = mi.load_dict(description)
    given = {"max_depth": 10, "rr_depth": 20}
    with plugin_with_model(**ROULETTE_EVERYWHERE):
        found, statistics = render_with_statistics("manylights", scene, 64, **given)
    assert float(statistics["roulette"]) > 0
    assert found[..., 3].mean() == pytest.approx(render(scene, "path", 64, 1, **given)[..., 3].mean(), rel=0.02)
