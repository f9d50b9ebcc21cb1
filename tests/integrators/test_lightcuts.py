"""Cuts against the sum of all lights, and against a walk in plain Python."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import stress
from tests.support.pairs import prepared
from tests.support.rendering import render
from tests.support.rooms import COATED, GLOSSY, many_kinds
from tests.support.scenes import area_light, closed_box, sensor, wall
from vpl.core.arrays import download, upload
from vpl.cuts import light_cuts, traversal
from vpl.cuts.light_cuts import CutChunk, collect_cuts, cuts_at, evaluate_cuts, limited_cuts
from vpl.lights.light_set import LightGroup, LightSet, light_tree
from vpl.lights.virtual_lights import VirtualLights
from vpl.points.surfaces import LambertianSurface, ScatteringSurface
from vpl.transport.contribution import contribution
from vpl.transport.evaluation import sum_all_lights


def test_error_zero_is_the_sum_of_all_lights():
    scene = mi.load_dict(many_kinds())
    settings = {"vpl_count": 400, "max_depth": 5}
    cut = render(scene, "lightcuts", 1, error=0.0, max_cut=0, **settings)
    assert np.allclose(cut, render(scene, "vpl", 1, **settings), rtol=1e-3, atol=1e-4 * cut.mean())


@pytest.mark.parametrize("direct", ["nee", "vpl"])
def test_one_percent_is_within_two_percent_of_all_lights(direct):
    scene = mi.load_dict(many_kinds())
    settings = {"vpl_count": 5000, "max_depth": 5, "direct": direct, "direct_count": 256}
    expected = render(scene, "vpl", 1, **settings)
    errors = [
        np.abs(render(scene, "lightcuts", 1, error=error, **settings) - expected).sum() / expected.sum()
        for error in (0.01, 0.1)
    ]
    assert errors[0] < 0.02 and errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("batch", [0, 1])
def test_cuts_hold_every_light_that_can_arrive_once_and_keep_their_bounds(batch):
    """The device's walk against leaves counted on the host: each light below one node of the cut, or below none."""
    plugin, jobs = prepared(mi.load_dict(many_kinds()))
    job = jobs[batch]
    threshold = dr.full(mi.Float, plugin.error * job.mean, job.batch.count)
    sizes = cuts_at(job.lights, job.batch, threshold)
    for chunk in collect_cuts(job.lights, job.batch, threshold, sizes):
        tree, first = chunk.group.tree, int(chunk.offset[7])
        nodes = download(chunk.nodes)[first : first + int(chunk.length[7])]
        escape = download(tree.gather(dr.arange(mi.UInt32, tree.count)).escape)
        assert np.all(np.diff(nodes.astype(np.int64)) > 0), "preorder"
        assert np.all(escape[nodes[:-1]] <= nodes[1:]), "no node lies below another one of the cut"
        covered = np.zeros(tree.count, bool)
        for node in nodes:
            covered[node : escape[node]] = True
        leaves = np.flatnonzero(escape == np.arange(tree.count) + 1)
        part = chunk.batch.select(mi.UInt32(7))
        for leaf in leaves[~covered[leaves]][:50]:
            light = chunk.group.lights.gather(tree.representative(mi.UInt32(int(leaf))))
            value = contribution(chunk.group.kind, part.surfaces, light, job.lights.smallest_distance)
            assert download(value).max() == 0, "a light that was skipped contributes nothing"


def test_what_a_cut_came_out_shorter_than_counted_is_part_of_none():
    """Counted rows of nodes without values are 0, like the rows of the first cut; every third is missing."""
    rows, offset, length = ([0, 0, 0, 1, 0, 2, 2, 0], [0, 3, 5, 7], [2, 1, 2, 0])
    columns = (upload(mi.UInt32, np.array(x)) for x in (offset, length, rows))
    chunk = CutChunk(None, 0, None, None, *columns, nodes=None, visits=None)
    assert download(chunk.written).tolist() == [True, True, False, True, False, True, True, False]


def test_largest_cut_is_respected():
    _plugin, jobs = prepared(mi.load_dict(many_kinds()))
    for job in jobs:
        threshold = dr.full(mi.Float, 1e-4 * job.mean, job.batch.count)
        free = cuts_at(job.lights, job.batch, threshold).total()
        assert free.max() > 60
        raised, sizes = limited_cuts(job.lights, job.batch, threshold, 60)
        assert sizes.total().max() <= 60
        assert np.array_equal(sizes.total(), cuts_at(job.lights, job.batch, raised).total())
        untouched = free <= 60
        assert np.array_equal(sizes.total()[untouched], free[untouched])


def test_cuts_are_unbiased_for_coloured_lights():
    """Mean over many trees (representatives) of one light set against the sum over that set."""
    _plugin, jobs = prepared(mi.load_dict(closed_box({"lamp": area_light(radiance=[4.0, 0.5, 0.1])})), size=16)
    job = jobs[0]
    group = job.lights.groups[0]
    records = download(group.lights._records).reshape(-1, 16)
    depth = records[:, 3].copy().view(np.uint32)
    lights = VirtualLights.of("oriented", records[:, 0:3], records[:, 4:7], records[:, 8:11], depth)
    exact = download(sum_all_lights(job.transport, job.batch)[0]).mean(0)
    means = []
    for seed in range(48):
        trees = LightSet(
            [LightGroup("oriented", group.lights, light_tree(lights, seed))], job.lights.smallest_distance, 5, 0, 0, {}
        )
        threshold = dr.full(mi.Float, 0.1 * job.mean, job.batch.count)
        sizes = cuts_at(trees, job.batch, threshold)
        radiance, _, _ = evaluate_cuts(replace(job.transport, lights=trees), job.batch, threshold, sizes)
        means.append(download(radiance).mean(0))
    means = np.array(means)
    deviation = np.abs(means.mean(0) - exact) / (means.std(0, ddof=1) / np.sqrt(len(means)))
    assert np.all(deviation < 3.5), (means.mean(0), exact)
    assert np.all(means.std(0) < 0.1 * exact), "the test would not see a bias of a few percent"


def test_lambertian_points_are_found_and_shade_as_their_bsdf():
    scene = mi.load_dict(many_kinds())
    _, jobs = prepared(scene)
    assert len(jobs) == 2, "diffuse walls and glossy things lie in separate batches"
    plain = jobs[0].batch
    assert isinstance(plain.surfaces, LambertianSurface)
    assert isinstance(jobs[1].batch.surfaces, ScatteringSurface)
    # All glossy surfaces are in the second batch: the number that the camera sees
    total = sum(job.batch.count for job in jobs)
    assert 0.02 * total < jobs[1].batch.count < 0.6 * total


@pytest.mark.parametrize("bsdf", [GLOSSY, COATED, {"type": "principled", "roughness": 0.4, "metallic": 0.3}])
def test_proxies_are_majorants_of_the_materials_in_random_directions(bsdf):
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor(), "ball": {"type": "sphere", "bsdf": bsdf}, "sky": {"type": "constant"}}
    )
    _, jobs = prepared(scene)
    batch = jobs[-1].batch
    rng = np.random.default_rng(0)
    over = []
    for _ in range(40):
        direction = rng.normal(size=(batch.count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        to_light = mi.Vector3f(*(upload(mi.Float, direction[:, k]) for k in range(3)))
        value = download(batch.surfaces.reflected(to_light, mi.Bool(True)))
        proxy = batch.proxy
        cosine = dr.maximum(dr.dot(batch.normal, to_light), 0)
        lobe = dr.power(dr.maximum(dr.dot(proxy.axis, to_light), 0), proxy.exponent)
        bound = download(proxy.base * cosine + dr.select(cosine > 0, proxy.peak * lobe, 0))
        over.append((value > 1.2 * bound + 1e-3 * value.max()).mean())
    assert np.mean(over) < 0.01


def test_light_passes_masks_as_path_says():
    """A half-open screen dims virtual lights and does not block them."""
    screen = {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}
    scene = mi.load_dict(
        closed_box({"lamp": area_light()}, screen=wall([0, -0.6, 0], [1, 0, 0], -90, 0.9, bsdf=screen))
    )
    ours = np.mean([render(scene, "lightcuts", 16, k, max_depth=6, clamping=0.0, vpl_count=5000) for k in range(3)])
    # Crossing the screen costs ``path`` an edge: it needs a larger depth for the same light
    reference = render(scene, "path", 512, 9, max_depth=8).mean()
    assert abs(ours / reference - 1) < 0.06


@pytest.mark.stress
@pytest.mark.parametrize("bsdf", [GLOSSY, *stress({"type": "roughdielectric", "alpha": 0.3})])
def test_nothing_that_a_material_reflects_has_a_bound_of_zero(bsdf):
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor(), "ball": {"type": "sphere", "bsdf": bsdf}, "sky": {"type": "constant"}}
    )
    _, jobs = prepared(scene)
    batch, sampler = jobs[-1].batch, mi.load_dict({"type": "independent"})
    sampler.seed(1, batch.count)
    si, proxy = batch.surfaces.interaction, batch.proxy
    for _ in range(16):
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
        value = download(mi.Color3f(weight * sample.pdf))
        to_light = si.to_world(sample.wo)
        cosine = dr.select(proxy.no_cosine, 1, dr.maximum(dr.dot(batch.normal, to_light), 0))
        lobe = dr.power(dr.maximum(dr.dot(proxy.axis, to_light), 0), proxy.exponent)
        bound = download(proxy.base * cosine + dr.select(cosine > 0, proxy.peak * lobe, 0))
        assert np.all(bound[value > 0] > 0)
        assert np.mean(value.max(1) > 3 * bound.max(1)) < 0.1


def test_a_largest_cut_below_the_number_of_kinds_ends():
    image = render(mi.load_dict(many_kinds()), "lightcuts", 1, vpl_count=300, max_cut=1)
    assert np.isfinite(image).all() and image.max() > 0


def test_thresholds_do_not_bias_the_image():
    """Estimates and cuts use different representatives: the mean over trees is the sum over the lights."""
    scene = mi.load_dict(closed_box({"lamp": area_light()}))
    ratios = []
    for seed in range(24):
        plugin, jobs = prepared(scene, seed, 16, vpl_count=300, error=0.3, dark_floor=0.0)
        job = jobs[0]
        exact = download(sum_all_lights(job.transport, job.batch)[0]).sum()
        ratios.append(download(plugin.shade(job).radiance).sum() / exact)
    assert abs(np.mean(ratios) - 1) < 3.5 * np.std(ratios, ddof=1) / np.sqrt(len(ratios)) + 1e-3


@pytest.mark.parametrize("direct", ["nee", "vpl"])
def test_an_environment_behind_masks_and_coloured_panes_is_seen_as_path_sees_it(direct):
    tint = {"type": "rgb", "value": [1.0, 0.3, 0.1]}
    scene = {
        "type": "scene", "sensor": sensor(16), "sky": {"type": "constant"},
        "floor": wall([0, 0, -1], [0, 1, 0], 0, 4.0),
        "pane": wall([0, 0, -0.8], [0, 1, 0], 0, 9.0, bsdf={
            "type": "thindielectric", "specular_transmittance": tint, "specular_reflectance": 0.0,
        }),
    }  # fmt: skip
    scene = mi.load_dict(scene)
    ours = render(scene, "lightcuts", 64, max_depth=4, direct=direct, direct_count=256).mean((0, 1))
    assert np.allclose(ours, render(scene, "path", 256, 5, max_depth=4).mean((0, 1)), rtol=0.06)


def test_alpha_is_that_of_path_with_and_without_an_environment():
    for sky in ({}, {"sky": {"type": "constant"}}):
        camera = sensor(16)
        camera["film"]["pixel_format"] = "rgba"
        scene = mi.load_dict({"type": "scene", "sensor": camera, "ball": {"type": "sphere"}, **sky})
        alphas = [render(scene, name, 16)[..., 3] for name in ("lightcuts", "path")]
        assert np.allclose(*alphas, atol=0.3) and np.allclose(alphas[0].mean(), alphas[1].mean(), atol=0.02)


@pytest.mark.parametrize("name", ["adaptivedirect", *stress("lightcuts")])
def test_alpha_is_that_of_path_behind_masks_and_thin_glass(name):
    camera = sensor(16, spp=64)
    camera["film"]["pixel_format"] = "rgba"

    def sheet(height, **bsdf):
        return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([height, 0, -height]), "bsdf": bsdf}

    grey = {"type": "rgb", "value": 0.5}
    sheets = {
        "front": sheet(0, type="mask", opacity=0.3, nested={"type": "diffuse"}),
        "back": sheet(0.5, type="mask", opacity=0.5, nested={"type": "plastic"}),
        "pane": sheet(1, type="thindielectric", specular_transmittance=grey),
        "wall": sheet(1.2, type="diffuse"),
        "lamp": sheet(-0.5, type="diffuse") | {"emitter": {"type": "area"}},
    }
    scene = mi.load_dict({"type": "scene", "sensor": camera, **sheets})
    for more in ({"max_depth": 1}, {"max_depth": 2}, {"max_depth": 8}, {"rr_depth": 1}, {"hide_emitters": True}):
        options = {"max_depth": 8} | more
        ours, path = (render(scene, one, 64, **options)[..., 3] for one in (name, "path"))
        assert np.allclose(ours, path, atol=0.4) and np.allclose(ours.mean(), path.mean(), atol=0.015), more


@pytest.mark.parametrize(("first", "store"), [(1, 1 << 24), (2, 300), (16, 0)])
@pytest.mark.parametrize("most", [0, 5])
def test_cuts_do_not_depend_on_rounds_and_memory(monkeypatch, first, store, most):
    """Against cuts of a single round, which are stored as a whole."""
    _plugin, jobs = prepared(mi.load_dict(many_kinds()))

    def cuts_of(job):
        threshold = dr.full(mi.Float, 1e-3 * job.mean, job.batch.count)
        threshold, sizes = limited_cuts(job.lights, job.batch, threshold, most)
        chunks = list(collect_cuts(job.lights, job.batch, threshold, sizes))
        assert all(download(chunk.written).all() for chunk in chunks)
        return download(sizes.visits), [(download(chunk.rows), download(chunk.nodes)) for chunk in chunks]

    monkeypatch.setattr(traversal, "_FIRST", 1 << 12)
    expected = [cuts_of(job) for job in jobs]
    monkeypatch.setattr(traversal, "_FIRST", first)
    monkeypatch.setattr(light_cuts, "LARGEST_STORE", store)
    for job, (visits, chunks) in zip(jobs, expected, strict=True):
        assert max(np.bincount(rows).max() for rows, _ in chunks) > first or most
        found_visits, found = cuts_of(job)
        np.testing.assert_array_equal(found_visits, visits)
        for one, other in zip(found, chunks, strict=True):
            np.testing.assert_array_equal(one, other)
