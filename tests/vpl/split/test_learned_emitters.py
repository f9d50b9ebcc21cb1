"""Learning of `manylights`, robust to odd emitters, sensors of one ray, and bad values."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS, SENSORS, film
from tests.support.many_emitters import interactions
from tests.support.marks import stress
from tests.support.properties import unit_vectors
from tests.support.rendering import render, render_with_statistics
from tests.support.scenes import area_light, closed_box, image, rgb, sensor
from vpl.core.arrays import download, upload, upload_vectors
from vpl.cuts import traversal
from vpl.lights.light_set import LightSet
from vpl.split.camera_rays import trace_camera_rays
from vpl.split.emitters import cell_choice
from vpl.split.emitters.cell_choice import CellChoice
from vpl.split.emitters.irradiance import Irradiance
from vpl.split.emitters.learned import LearnedEmitters
from vpl.split.gather_vertices import LitVertices
from vpl.split.local_c import LocalC
from vpl.split.spatial_cells import SpatialCells
from vpl.split.view import ViewLights


def bulbs(**second):
    """Two point emitters inside of the closed box; `second`: more properties of the second."""
    return {
        "bulb": {"type": "point", "position": [0.3, 0.4, 0.6], "intensity": rgb(1.0)},
        "other": {"type": "point", "position": [-0.5, 0.4, 0.2], "intensity": rgb(0.3), **second},
    }


def learned(scene, known=lambda normal: normal[:, 0] < 2, seed=0):
    """Return the emitter sampler learned from vertices all over the closed box, and the vertices; ``known`` selects the
    vertices to learn from by their normals, by default all."""
    rng, count = np.random.default_rng(seed), 4000
    normal = unit_vectors(rng, count)
    position = rng.uniform(-0.9, 0.9, (count, 3)).astype(np.float32)
    emitters = LearnedEmitters(scene)
    seen = known(normal)
    emitters.learn(position[seen], normal[seen], 1 << 18, seed)
    return emitters, position, normal


def test_an_image_does_not_depend_on_the_order_of_the_emitters():
    """Mitsuba loads a scene's shapes in another order each time."""
    lamps = {"red": area_light(radiance=(4, 1, 1)), "blue": area_light(0.5, (1, 1, 9)), "sky": {"type": "constant"}}
    lamps |= bulbs()
    images = []
    for names in (list(lamps), list(reversed(lamps))):
        box = closed_box({name: lamps[name] for name in names})
        del box["left"]
        images.append(render(mi.load_dict(box), "manylights", 16, max_depth=4))
    assert np.abs(images[0] - images[1]).max() < 1e-5 * images[0].mean()


# ---------------------- Densities ----------------------


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("emitter", ["rectangle", "envmap", *stress("constant", "sunsky")])
def test_what_is_drawn_has_the_density_with_which_it_is_met(emitter, learns):
    """A ray along the drawn direction finds the same radiance and the same density, wherever it arrives; where
    something was learned, in packets of known and unknown cells."""
    box = closed_box(EMITTERS[emitter]() | bulbs())
    del box["left"], box["ceiling"]
    scene = mi.load_dict(box)
    emitters, position, normal = learned(scene, lambda normal: normal[:, 2] > -0.3)
    if not learns:
        emitters.forget()
    si = interactions(position, normal)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(position))
    cell = emitters.cell(si.p, si.n)
    assert np.any(np.array(cell) == 0) and np.any(np.array(cell) > 0) == learns
    sample = emitters.sample(si, cell, sampler.next_1d(), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
    weight = sample.arriving(scene, emitters, mi.UInt32(0), mi.Bool(True))[0]
    ray = si.spawn_ray(sample.direction)
    found = scene.ray_intersect(ray)
    met = emitters.met(si.p, cell, ray, found, mi.Bool(True), mi.Bool(True))
    lit = np.array((dr.max(weight) > 0) & ~sample.is_point)
    assert lit.sum() > 100
    # Directions at the very edge of a cell may be found in the next one
    close = np.isclose(np.array(met.density), np.array(sample.density), rtol=1e-2)[lit]
    assert close.mean() > 0.99
    same = np.isclose(np.array(met.radiance), np.array(weight * sample.density), rtol=2e-2)[:, lit].all(0)
    assert same.mean() > 0.98


def test_well_spread_numbers_draw_directions_that_are_spread_over_the_sky():
    box = closed_box(EMITTERS["envmap"]())
    del box["ceiling"]
    emitters, position, normal = learned(mi.load_dict(box))
    count, rng = 4096, np.random.default_rng(0)
    si = interactions(np.repeat(position[:1], count, 0), np.repeat(normal[:1], count, 0))
    cell = emitters.cell(si.p, si.n)
    assert np.array(cell)[0] > 0

    def irregularity(chosen):
        """Mean squared difference of the numbers of samples in parts of the sky for two sets of numbers."""
        counts = []
        for numbers in chosen:
            rest = (upload(mi.Float, rng.random(count)) for _ in range(3))
            member, place = next(rest), mi.Point2f(*rest)
            unit = download(
                emitters.sample(si, cell, upload(mi.Float, numbers), member, place, mi.Bool(True)).direction
            )
            around = np.arctan2(unit[:, 1], unit[:, 0]) / (2 * np.pi) + 0.5
            parts = np.minimum((unit[:, 2] + 1) * 8, 15).astype(int) * 16 + np.minimum(around * 16, 15).astype(int)
            counts.append(np.bincount(parts, minlength=256))
        return np.mean(np.square(counts[0] - counts[1]))

    spread = irregularity([(np.arange(count) + rng.random()) / count for _ in range(2)])
    assert spread < 0.5 * irregularity([rng.random(count) for _ in range(2)])


@pytest.mark.parametrize("step", [2.0**-23, 2.0**-24])
def test_rare_sources_draw_all_of_their_cells(step):
    """A number that draws a source of little probability has few bits left for the cell."""
    box = closed_box(EMITTERS["constant"]())
    del box["ceiling"]
    emitters, position, normal = learned(mi.load_dict(box))
    regions, first = emitters._regions.count, emitters._count
    share = np.zeros(first + regions)
    share[first], share[first + 1] = 2.0**-23, 1 - 2.0**-23
    emitters.choice._use(np.stack([share, share]))
    count = 4096
    si = interactions(np.repeat(position[:1], count, 0), np.repeat(normal[:1], count, 0))
    # All numbers that draw the first region
    number = upload(mi.Float, np.resize(np.arange(0, emitters.choice.pmf[1, first], step), count))
    member, *place = (upload(mi.Float, np.random.default_rng(k).random(count)) for k in range(3))
    sample = emitters.sample(si, mi.UInt32(1), number, member, mi.Point2f(*place), mi.Bool(True))
    unit = download(sample.direction)
    region, _ = emitters._regions.find(sample.direction, mi.Bool(True))
    assert (download(region) == 0).mean() > 0.99
    index = mi.UInt32(np.zeros(count, np.uint32))
    expected = emitters._regions.sample(index, member, mi.Point2f(*place), mi.Bool(True))[0]
    np.testing.assert_allclose(unit.std(0), download(expected).std(0), rtol=0.1)


@pytest.mark.parametrize("emitter", ["constant", "envmap", "sunsky", "rectangle"])
def test_rows_of_probabilities_are_positive_for_every_emitter_and_sum_to_one(emitter):
    """An environment is drawn by itself, too, beside its regions."""
    emitters, _, _ = learned(mi.load_dict(closed_box(EMITTERS[emitter]() | bulbs())))
    rows = emitters.choice.pmf
    np.testing.assert_allclose(rows.sum(1), 1, atol=1e-5)
    assert (rows >= 0).all() and (rows[:, : emitters._count] > 0).all()


@pytest.mark.parametrize("learns", [False, True])
def test_no_direction_at_the_edge_of_a_small_sun_weighs_far_too_much(learns):
    """The default sun of Mitsuba is half a degree wide: near its edge, densities differ from the densities of
    sampling."""
    emitters, position, normal = learned(mi.load_dict({"type": "scene", **EMITTERS["sunsky"]()}))
    if not learns:
        emitters.forget()
    si = interactions(position, normal)
    cell = emitters.cell(si.p, si.n)
    rng, heaviest, total = np.random.default_rng(0), 0.0, 0.0
    for _ in range(20):
        chosen, member, *place = (upload(mi.Float, rng.random(len(position))) for _ in range(4))
        sample = emitters.sample(si, cell, chosen, member, mi.Point2f(*place), mi.Bool(True))
        weight = np.array(sample.weight)[0]
        heaviest, total = max(heaviest, weight.max()), total + weight.mean() / 20
    assert heaviest < 20 * total


def test_all_vertices_at_one_place_are_a_cell_that_is_found_again():
    position, normal = np.full((20, 3), 0.3, np.float32), np.tile(np.float32([[0, 0, 1]]), (20, 1))
    cells, number = SpatialCells.around(position, normal, 100)
    found = cells.at(upload_vectors(mi.Point3f, position), upload_vectors(mi.Normal3f, normal))
    assert (np.array(found) == number).all()


def test_a_place_that_is_no_number_leads_to_no_entry_beyond_the_table():
    rng = np.random.default_rng(0)
    position, normal = rng.random((500, 3)).astype(np.float32), unit_vectors(rng, 500)
    cells, number = SpatialCells.around(position, normal, 10_000)
    bad = np.array([[np.nan, 0.5, 0.5], [0.5, np.inf, 0.5], [-np.inf, np.nan, 1e30]], np.float32)
    found = cells.at(upload_vectors(mi.Point3f, bad), upload_vectors(mi.Normal3f, normal[:3]))
    assert np.array(found).max() <= number.max()


def test_neighbours_are_the_cells_that_face_the_same_way_in_the_cubes_around():
    rng = np.random.default_rng(0)
    position = (rng.random((3000, 3)) * [1, 0.6, 0.3]).astype(np.float32)
    normal = unit_vectors(rng, 3000)
    cells, number = SpatialCells.around(position, normal, 200)
    found = cells.neighbours()
    assert found.shape == (number.max(), 26)
    size, low = np.array(cells.size).item(), np.array(cells.low).ravel()
    place = np.zeros((number.max(), 4), int)
    way = np.abs(normal).argmax(1) * 2 + (normal[np.arange(3000), np.abs(normal).argmax(1)] > 0)
    # Outliers belong to the cubes at the ends
    cube = np.clip((position - low) // size, 0, np.array(cells.resolution).ravel() - 1)
    place[number - 1] = np.concatenate([cube, way[:, None]], 1)
    apart = np.abs(place[:, None, :3] - place[None, :, :3]).max(2)
    expected = (apart == 1) & (place[:, None, 3] == place[None, :, 3])
    assert expected.any(1).mean() > 0.9
    for cell, near in enumerate(expected):
        assert set(found[cell]) - {0} == set(np.flatnonzero(near) + 1)


def found_where(seen):
    """Irradiance of 1 where a light is ``seen``, (n,), and of 1 everywhere without occlusion."""
    count = len(seen)
    arriving = upload_vectors(mi.Color3f, np.repeat(seen[:, None], 3, 1))
    return Irradiance(arriving, upload(mi.Float, np.ones(count)), mi.UInt32(1), mi.UInt32(0))


def test_what_neighbours_have_seen_is_drawn_more_often_than_what_nobody_has():
    rng = np.random.default_rng(1)
    position = rng.random((20_000, 3)).astype(np.float32)
    choice = CellChoice(np.full(3, 1 / 3), 0.2, np.zeros(0, int))

    def look(places, source, seed):
        """The first source is seen everywhere, the second from one side, the third from nowhere."""
        x, number = download(places.position.x), download(source)
        seen = (number == 0) | ((number == 1) & (x < 0.45))
        return found_where(seen)

    assert choice.learn(position, np.tile(np.float32([[0, 0, 1]]), (len(position), 1)), 6000, 0, look)
    low, size = np.array(choice._cells.low)[0].item(), np.array(choice._cells.size).item()
    where = np.arange(low + size / 2, 0.98, size)
    middle = np.array(choice.cell(mi.Point3f(upload(mi.Float, where), 0.5, 0.5), mi.Normal3f(0, 0, 1)))
    second, third = choice.pmf[middle, 1], choice.pmf[middle, 2]
    sees, neighbour = where < 0.45 - size / 2, np.flatnonzero(where > 0.45 + size / 2)[0]
    assert (second[sees] > 0.3).all()
    # What somebody sees, though nobody near, is drawn a little more often than what nobody sees
    assert second[neighbour] > 1.5 * second[-1] and second[-1] > third[-1] > 0


def test_rays_that_are_traced_a_few_at_a_time_teach_the_same(monkeypatch):
    rng = np.random.default_rng(2)
    position, seeds, found = rng.random((20_000, 3)).astype(np.float32), [], []

    def look(places, source, seed):
        seeds.append(seed)
        seen = download(source) == 0
        return found_where(seen)

    for most in (1 << 20, 100):
        monkeypatch.setattr(cell_choice, "_RAYS_AT_A_TIME", most)
        choice = CellChoice(np.full(3, 1 / 3), 0.2, np.zeros(0, int))
        assert choice.learn(position, np.tile(np.float32([[0, 0, 1]]), (len(position), 1)), 6000, 0, look)
        found.append(choice.pmf)
    np.testing.assert_array_equal(*found)
    # Each part has random numbers of its own
    assert len(seeds) > 10 and len(set(seeds[1:])) == len(seeds) - 1


# ---------------------- Changes between renders ----------------------


def test_changes_of_emitters_are_seen():
    """After a change to a brighter and flipped environment, the image equals the image of a new scene."""
    box = closed_box(EMITTERS["envmap"]() | bulbs(), 8)
    del box["left"]
    scene, images = mi.load_dict(box), []
    render(scene, "manylights", 64, max_depth=3)
    parameters = mi.traverse(scene)
    parameters["sky.data"] = 3 * mi.TensorXf(np.array(parameters["sky.data"])[::-1].copy())
    parameters["other.position"] = mi.Point3f(0.5, -0.3, -0.2)
    parameters.update()
    images = [[render(scene, name, 256, seed, max_depth=3).mean() for seed in range(4)]
              for name in ("manylights", "path")]  # fmt: skip
    np.testing.assert_allclose(*np.mean(images, 1), rtol=0.03)


# ---------------------- Emitters that `path` never samples ----------------------


@pytest.mark.stress
def test_a_point_emitter_that_is_never_sampled_is_black_as_in_path():
    scene = mi.load_dict(closed_box(bulbs(sampling_weight=0.0), 8))
    found, expected = (render(scene, name, 256, max_depth=3).mean() for name in ("manylights", "path"))
    np.testing.assert_allclose(found, expected, rtol=0.05)


# ---------------------- Sensors and values ----------------------


def test_all_samples_of_a_sensor_of_one_ray_are_used():
    """All rays of a radiancemeter are equal, so their directions are an array of one entry."""
    camera = SENSORS["radiancemeter"](film(1, 1))
    camera["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 0.9], [0.1, 0.2, -1], [0, 1, 0])
    scene = mi.load_dict(closed_box(bulbs(), 16) | {"sensor": camera})
    found = [render(scene, "manylights", 4096, seed, max_depth=2).mean() for seed in range(4)]
    assert np.std(found) < 0.1 * np.mean(found)


def test_the_weights_of_gather_vertices_are_finite():
    """An infinite weight among the sums over all vertices would erase the rest."""
    texels = np.full((8, 8, 3), 0.9)
    texels[0, 3] = np.inf
    mirror = {"type": "conductor", "specular_reflectance": image(texels) | {"filter_type": "nearest"}}
    box = closed_box(bulbs(), 16)
    box["back"]["bsdf"] = mirror
    scene = mi.load_dict(box)
    plugin, seen = mi.load_dict({"type": "manylights", "max_depth": 4}), []
    original = plugin._view

    def look(*arguments):
        view = original(*arguments)
        lane = dr.arange(mi.UInt32, view.count)
        lights = ViewLights(LightSet([], 0, plugin.max_depth, 0, 0, {}), c=LocalC.constant(0.1))
        gathered = trace_camera_rays(view, lane, view.settings(lights), 9).gathered
        seen.extend(np.isfinite(np.array(x.weight)).all() for x in (gathered.first, gathered.later))
        return view

    plugin._view = look
    plugin.virtual_lights = False
    render(scene, plugin, 16)
    assert seen == [True, True]


def test_later_vertices_are_lit_where_no_first_one_is(monkeypatch, lights_cost_nothing):
    """In an image of one pixel, the few lit samples may meet nothing."""
    plugin, scene = mi.load_dict({"type": "manylights", "max_depth": 5}), mi.load_dict(closed_box(bulbs(), 8))
    lit = LitVertices.of

    def without_first(first, *more):
        first.weight *= 0
        return lit(first, *more)

    monkeypatch.setattr(LitVertices, "of", without_first)
    render(scene, plugin, 16)
    assert plugin.statistics["light_paths"] > 0 and plugin.statistics.get("later", 0) > 0


def test_a_sky_without_surfaces():
    scene = mi.load_dict({"type": "scene", "sensor": sensor(8), **EMITTERS["envmap"]()})
    found, statistics = render_with_statistics("manylights", scene, 16)
    assert statistics["dropped"] == 0
    np.testing.assert_allclose(found, render(scene, "path", 16), rtol=0.2, atol=0.02)


def test_no_kernel_is_compiled_anew_for_another_seed(lights_cost_nothing, monkeypatch):
    """What depends on the pilot must not be a constant in them: c of the split, numbers of vertices and of lights."""
    # Cuts always have a second round, whose kernels would otherwise be compiled at the first large cut
    monkeypatch.setattr(traversal, "_FIRST", 1)
    box = closed_box(bulbs(), 16)
    # Some rays leave the box, and second vertices leave a remainder, so later vertices gather light too
    del box["left"]
    box["back"]["bsdf"] = {"type": "roughplastic"}
    scene = mi.load_dict(box)
    for seed in range(3):
        render(scene, "manylights", 16, seed, max_depth=4)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        render(scene, "manylights", 16, 3, max_depth=4)
        kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    # A kernel found on the disk was not in memory
    compiled = [kernel for kernel in kernels if not kernel["cache_hit"] or kernel["cache_disk"]]
    assert [(kernel["size"], kernel["operation_count"]) for kernel in compiled] == []


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("texel", [np.nan, *stress(0.0, np.inf)])
def test_an_environment_of_no_density_spoils_no_path(texel, many):
    """Mitsuba's own density of an image that is black, or has a texel that is no number, is none in any direction."""
    pixels = np.zeros((4, 8, 3), np.float32)
    pixels[1, 2] = texel
    dim = {
        f"dim{i}": {"type": "point", "position": [0.02 * i - 0.7, 0.5, 0.4], "intensity": rgb(0.01)} for i in range(70)
    }
    lit = closed_box(bulbs() | (dim if many else {}), 12)
    del lit["left"]
    images = []
    for sky in ({}, {"sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)}}):
        image, statistics = render_with_statistics("manylights", mi.load_dict(lit | sky), 256, max_depth=3)
        images.append(image.mean())
        assert statistics["dropped"] == 0
    assert images[1] == pytest.approx(images[0], rel=0.02)
