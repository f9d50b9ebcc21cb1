"""The parts of the split: minorants, numbers, cells, clusters, bounds; each against its definition."""

import itertools
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.catalogue import EMITTERS, MATERIALS, one_of, stage
from tests.support.properties import points, seeds, unit_vectors
from vpl.core.arrays import download, upload, upload_vectors
from vpl.core.materials import Materials
from vpl.core.shapes import SceneShapes
from vpl.direct.emitter_sampling import power_heuristic
from vpl.lights.light_set import ScatteredGroup
from vpl.lights.virtual_lights import DeviceLights, VirtualLights
from vpl.points.surfaces import CutLambertianSurface
from vpl.split.gather_vertices import GatherVertices, LitVertices, drawn_later
from vpl.split.lattice import EXTENSIBLE, Lattice, lattice_multiplier
from vpl.split.pixel_clusters import PixelClusters, Receivers
from vpl.split.pixel_rays import PixelRays
from vpl.split.spatial_cells import FACINGS, facing
from vpl.split.view import View
from vpl.transport.bounds import contribution_bound
from vpl.transport.carried_share import carried_geometry_term, carried_share
from vpl.transport.contribution import contribution
from vpl.transport.minorant import Minorants, agrees, side_of

# ---------------------- Minorants ----------------------


@pytest.mark.parametrize("material", MATERIALS)
def test_a_minorant_is_the_same_from_everywhere_on_its_side(material):
    """For the same points, seen from random directions on the same side."""
    scene = mi.load_dict(stage(EMITTERS["point"](), one_of(MATERIALS[material]()), 8))
    minorants = Minorants(Materials.of(SceneShapes.of(scene)))
    rng, camera, found = np.random.default_rng(0), mi.Point3f(0, 0, 4), []
    target = points(rng.normal(size=(500, 3)) * 0.3 + [-0.6, -0.4, 0.3])
    first = scene.ray_intersect(mi.Ray3f(camera, dr.normalize(target - camera)))
    outward = first.n * side_of(first) * dr.sign(dr.dot(first.n, first.sh_frame.n))
    for _ in range(3):
        away = mi.Vector3f(points(unit_vectors(rng, 500)))
        away = dr.normalize(away + outward * 1.05)
        si = scene.ray_intersect(mi.Ray3f(first.p + away * 1e-2, -away))
        same = first.is_valid() & si.is_valid() & (dr.norm(si.p - first.p) < 1e-4) & (si.shape == first.shape)
        side = side_of(si)
        minorant, lobe = minorants.at(si, si.bsdf(), side, agrees(si, side))
        found.append(np.where(np.array(same), np.concatenate([np.array(minorant), np.array(lobe.normal)]), np.nan))
        assert np.array(same).sum() > 50
    found = np.array(found)
    assert np.nanmin(found[:, :3]) >= 0
    np.testing.assert_allclose(np.nanmax(found, 0), np.nanmin(found, 0), rtol=2e-2, atol=1e-4)


@seeds(50)
def test_the_share_of_virtual_lights_is_a_share(seed):
    rng = np.random.default_rng(seed)
    c2, d2 = 10.0 ** rng.uniform(-8, 8, (2, 64))
    geometry = np.append(rng.random(60) / d2[:60], [0, 0, np.inf, np.inf])
    squared_c, term = upload(mi.Float, c2), upload(mi.Float, geometry)
    w, carried = np.array(carried_share(squared_c, term)), np.array(carried_geometry_term(squared_c, term))
    np.testing.assert_allclose(w, 1 / (1 + c2 * geometry), rtol=1e-5, atol=1e-30)
    assert (w >= 0).all() and (w <= 1).all()
    np.testing.assert_allclose(carried[:62], w[:62] * geometry[:62], rtol=1e-5, atol=1e-30)
    np.testing.assert_allclose(carried[62:], 1 / c2[62:], rtol=1e-5)


@seeds(50)
def test_weights_of_two_densities_add_up_however_large_they_are(seed):
    a, b = (upload(mi.Float, x) for x in 10.0 ** np.random.default_rng(seed).uniform(-18, 30, (2, 64)))
    np.testing.assert_allclose(np.array(power_heuristic(a, b) + power_heuristic(b, a)), 1, rtol=1e-5)
    assert not np.array(power_heuristic(mi.Float(0), b)).any()


def test_rough_metal_has_next_to_no_minorant_and_diffuse_walls_all_of_it():
    for material, least, most in (("diffuse", 0.2 / np.pi, 0.7 / np.pi), ("roughconductor", 0, 1e-6)):
        bsdf = mi.load_dict(MATERIALS[material]())
        si, those = dr.zeros(mi.SurfaceInteraction3f), Minorants(Materials([bsdf]))
        si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
        minorant = np.array(those.at(si, mi.BSDFPtr(bsdf), mi.Float(1), mi.Bool(True))[0])
        assert (minorant >= 0.999 * least).all() and (minorant <= 1.001 * most).all()


def test_minorants_are_0_where_none_is_asked_for_and_the_same_elsewhere():
    bsdf, si = mi.load_dict(MATERIALS["diffuse"]()), dr.zeros(mi.SurfaceInteraction3f, 64)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    asked, those = dr.arange(mi.UInt32, 64) % 3 == 0, Minorants(Materials([bsdf]))
    pointer = mi.BSDFPtr(bsdf)
    some, whole = (np.array(those.at(si, pointer, mi.Float(1), mask)[0]) for mask in (asked, mi.Bool(True)))
    assert (whole > 0).all() and (some == np.where(np.array(asked), whole, 0)).all()


# ---------------------- Numbers ----------------------


@pytest.mark.parametrize("samples", [1, 4, 16, 64, 6, 100, 3000])
def test_numbers_are_uniform_and_stratified_in_every_pixel(samples):
    pixels = max(2**18 // samples, 512)
    numbers = Lattice.of_lanes(dr.arange(mi.UInt32, pixels * samples), samples, 7).at(mi.UInt32(3))
    columns = [np.array(x).reshape(-1, pixels, samples) for x in numbers]
    # Numbers have 24 bits
    far = max(samples // 1024, 1)
    for dimension in (x for column in columns for x in column):
        assert dimension.min() >= 0 and dimension.max() < 1
        for sample in (0, -1):
            assert stats.kstest(dimension[:, sample], "uniform").pvalue > 1e-4
        gaps = np.diff(np.sort(dimension, axis=1), axis=1, append=1 + dimension.min(1, keepdims=True))
        assert np.allclose(gaps * samples, 1, atol=1e-3 * far)
    if samples >= 16:
        for pair in columns[1::2]:
            # None is much closer to the first than points of a square grid; in a lattice, that holds for any two
            away = np.abs(pair[:, :64, 1:] - pair[:, :64, :1])
            assert (np.minimum(away, 1 - away) ** 2).sum(0).min() * samples > 0.4


def worst_error(multiplier, count):
    """P_2 of a lattice: its worst error over smooth periodic functions."""
    x = np.stack([np.arange(count), np.arange(count) * multiplier % count]) / count
    return np.prod(1 + 2 * np.pi**2 * (x * x - x + 1 / 6), axis=0).mean() - 1


def test_no_lattice_of_as_many_points_is_much_better():
    """Against all multipliers."""
    for count in (2, 3, 7, 36, 64):
        others = [worst_error(g, count) for g in range(1, count) if np.gcd(g, count) == 1]
        assert worst_error(lattice_multiplier(count), count) == pytest.approx(min(others))
    assert worst_error(lattice_multiplier(1009), 1009) < 1.1 * min(worst_error(g, 1009) for g in range(1, 1009))


def test_the_first_points_of_the_extensible_lattice_are_good_lattices():
    for power in range(4, 11):
        best = min(worst_error(g, 2**power) for g in range(1, 2**power, 2))
        assert worst_error(EXTENSIBLE, 2**power) < (1.4 if power <= 8 else 2.3) * best


def test_products_of_numbers_are_no_noisier_than_those_of_random_ones():
    """Orders that keep halves of the points together would double the variance."""
    samples, pixels = 64, 8192
    numbers = Lattice.of_lanes(dr.arange(mi.UInt32, pixels * samples), samples, 5)
    first, second = (numbers.at(mi.UInt32(vertex)) for vertex in (0, 1))
    chosen = first[0], first[1].x, first[2], first[3].y, second[0]
    halves = [np.where(np.array(x).reshape(pixels, samples) < 0.5, 1, -1) for x in chosen]
    for one, other in itertools.combinations(halves, 2):
        assert (one * other).mean(1).var() * samples < 1.15


def test_numbers_of_other_dimensions_vertices_pixels_and_seeds_are_independent():
    lane = dr.arange(mi.UInt32, 4 * 4096)
    columns = [
        np.array(x).reshape(-1, 4 * 4096)
        for seed, vertex in ((1, 0), (1, 1), (2, 0))
        for x in Lattice.of_lanes(lane, 4, seed).at(mi.UInt32(vertex))
    ]
    correlation = np.corrcoef(np.concatenate(columns))
    assert np.abs(correlation - np.eye(len(correlation))).max() < 0.05
    pixels = np.concatenate(columns).reshape(-1, 4096, 4)
    for dimension in pixels:
        assert abs(np.corrcoef(dimension[:-1, 0], dimension[1:, 0])[0, 1]) < 0.08


# ---------------------- Bounds, lights and clusters ----------------------


def surface_lights(rng, count, spread=1.0):
    position = (rng.normal(size=(count, 3)) * spread).astype(np.float32)
    direction = unit_vectors(rng, count)
    lights = VirtualLights.of(
        "surface", position, direction, rng.uniform(0.01, 1, (count, 3)).astype(np.float32),
        np.ones(count, np.uint32),
    )  # fmt: skip
    facing = direction + 0.3 * unit_vectors(rng, count)
    lights.facing = (facing / np.linalg.norm(facing, axis=1, keepdims=True)).astype(np.float32)
    lights.c = rng.uniform(0, 1, count).astype(np.float32)
    return lights


@seeds(60)
def test_bounds_are_above_what_lights_of_surfaces_contribute(seed):
    """Pairs from a box of points with a cone of normals and a box of lights with one; in double precision."""
    rng, count = np.random.default_rng(seed), 40
    center, extent = rng.normal(size=(2, 3)) * 2, rng.uniform(0, 1, (2, 3)) * 10.0 ** rng.uniform(-3, 0)
    axes, cosines = unit_vectors(rng, 2).astype(np.float64), rng.uniform(-0.2, 1, 2)
    place = center[:, None] + extent[:, None] * rng.uniform(-1, 1, (2, count, 3))
    around = axes[:, None] + 10.0 ** rng.uniform(-2, 0.5) * rng.normal(size=(2, count, 3))
    around /= np.linalg.norm(around, axis=2, keepdims=True)
    around = np.where(((around * axes[:, None]).sum(2) >= cosines[:, None])[..., None], around, axes[:, None])
    c, intensity = 10.0 ** rng.uniform(-3, 1), rng.uniform(0.1, 2)
    offset = place[1][None] - place[0][:, None]
    d2 = (offset**2).sum(2)
    to_light = offset / np.sqrt(d2)[..., None]
    cosine1 = np.maximum((around[0][:, None] * to_light).sum(2), 0)
    cosine2 = np.maximum(-(around[1][None] * to_light).sum(2), 0)
    true = (cosine1 * cosine2 / (d2 + c**2 * cosine1 * cosine2) * intensity).max()
    kinds = mi.Point3f, mi.Vector3f, mi.Vector3f
    box = (upload_vectors(kind, x[:1]) for kind, x in zip(kinds, (center, extent, axes), strict=True))
    receivers = Receivers.of(*box, upload(mi.Float, cosines[:1]))
    node = SimpleNamespace(
        center=points(center[1:]), extent=mi.Vector3f(points(extent[1:])), axis=mi.Vector3f(points(axes[1:])),
        cosine=upload(mi.Float, cosines[1:]), intensity=mi.Color3f(intensity), least_c=mi.Float(c),
    )  # fmt: skip
    bound = float(np.array(contribution_bound("surface", receivers.receiver, node, mi.Float(0)))[0])
    assert bound >= true * (1 - 1e-4)


def test_a_pair_contributes_what_the_split_leaves_to_it():
    """F G w, in double precision; nothing behind the geometric or the shading normal of either end."""
    rng, count = np.random.default_rng(2), 2000
    lights = surface_lights(rng, count)
    position = rng.normal(size=(count, 3)).astype(np.float32)
    normal, flat = unit_vectors(rng, count), unit_vectors(rng, count)
    offset = lights.position.astype(np.float64) - position
    d2 = (offset**2).sum(1)
    to_light = offset / np.sqrt(d2)[:, None]
    cosine1, cosine2 = np.maximum((normal * to_light).sum(1), 0), np.maximum(-(lights.direction * to_light).sum(1), 0)
    c2 = lights.c.astype(np.float64) ** 2
    both = ((lights.facing * to_light).sum(1) < 0) & ((flat * to_light).sum(1) > 0)
    shared = cosine1 * cosine2 / (d2 + c2 * cosine1 * cosine2) * both
    interaction = dr.zeros(mi.Interaction3f, count)
    interaction.p, interaction.n = points(position), mi.Normal3f(points(flat))
    surface = CutLambertianSurface(
        interaction, dr.full(mi.UInt32, 1, count), mi.Normal3f(points(normal)), mi.Color3f(1)
    )
    light = DeviceLights(lights).gather(dr.arange(mi.UInt32, count))
    found = np.array(contribution("surface", surface, light, mi.Float(0))).T
    np.testing.assert_allclose(found, shared[:, None] * lights.intensity, rtol=1e-3, atol=1e-5)


def ranges_of(group):
    """(First light of each node, end of its lights, the caller's indices of the lights), for a group."""
    first, last, light, _ = np.array(group.nodes).reshape(-1, 4).T
    order = np.zeros(group.count, np.uint32)
    leaf = last == first + 1
    order[first[leaf]] = light[leaf]
    return first, last, order


def test_the_first_light_of_a_node_has_the_index_of_the_caller():
    lights = surface_lights(np.random.default_rng(6), 100)
    group = ScatteredGroup.of(lights)
    node = dr.arange(mi.UInt32, group.tree.count)
    found = np.array(group.lights.gather(group._record(node).x).position).T
    np.testing.assert_array_equal(found, lights.position[np.array(group.first_light(node))])


def test_nodes_know_the_least_c_of_their_lights():
    lights = surface_lights(np.random.default_rng(5), 200)
    group = ScatteredGroup.of(lights)
    first, last, order = ranges_of(group)
    least = download(group.tree.gather(dr.arange(mi.UInt32, group.tree.count)).least_c)
    np.testing.assert_array_equal(least, [lights.c[order[a:b]].min() for a, b in zip(first, last, strict=True)])


def test_lights_of_a_node_are_drawn_by_their_share_of_its_intensity():
    rng = np.random.default_rng(0)
    lights = surface_lights(rng, 60)
    group = ScatteredGroup.of(lights)
    first, last, order = ranges_of(group)
    level = lights.intensity.mean(1)
    draws = 200_000
    for node in range(0, len(first), 13):
        inside = order[first[node] : last[node]]
        sample = (np.arange(draws) + 0.5) / draws
        light, scale = group.draw(dr.full(mi.UInt32, node, draws), upload(mi.Float, sample))
        x = np.array(light.position).T
        share = np.array([(x == lights.position[i]).all(1).mean() for i in inside])
        np.testing.assert_allclose(share, level[inside] / level[inside].sum(), atol=1e-4)
        sent = (np.array(light.intensity) * np.array(scale)).mean(1)
        np.testing.assert_allclose(sent, lights.intensity[inside].sum(0), rtol=1e-3)


@pytest.mark.parametrize("count", [2, 3, 4, 9, 1000, 131_072, 160_000, 163_839, 10**7])
def test_the_pilot_has_pairs_all_over_the_image(count):
    view = SimpleNamespace(count=count)
    rays = View.groups(view, 1 << 15, 2)
    first, second = rays.reshape(-1, 2).T
    assert len(rays) <= max(1 << 15, 2) and (first % 2 == 0).all() and (second - first <= 1).all()
    assert (np.diff(first) > 0).all() and second[-1] < count
    assert np.diff(first, append=count).max() <= count / len(first) + 2


@pytest.mark.parametrize(("samples", "most"), [(1, 1), (7, 5), (16, 16), (64, 41), (64, 100)])
def test_so_many_vertices_of_a_pixel_are_lit(samples, most):
    pixels, kept = 3, min(most, samples)
    # A single entry has no weight, and some weights are negative
    weight = np.ones(pixels * samples)
    weight[1], weight[-1] = -1, 0
    light = mi.UnpolarizedSpectrum(upload(mi.Float, weight))
    place = [dr.zeros(kind, len(weight)) for kind in (mi.Point3f, mi.Normal3f, mi.Normal3f)]
    first = GatherVertices(*place, light, dr.full(mi.UInt32, 1, len(weight)))
    later = GatherVertices(*place, dr.zeros(mi.UnpolarizedSpectrum, len(weight)), dr.zeros(mi.UInt32, len(weight)))
    lit = LitVertices.of(first, later, PixelRays.uniform(pixels, samples), most, 1)
    assert lit.alone == 0
    np.testing.assert_allclose(np.abs(np.array(lit.vertices.weight)), samples / kept, rtol=1e-6)
    sample = np.sort(np.array(lit.rays))
    number = [np.count_nonzero(sample // samples == pixel) for pixel in range(pixels)]
    # The entry without weight may be lit
    assert number in ([kept, kept, kept - 1], [kept, kept, kept])


@pytest.mark.parametrize("chosen", [[], [4, 0, 4, 2]])
def test_selected_vertices_have_their_weights_times_the_factors(chosen):
    """With factors and without, by the same kernel."""
    rng, count = np.random.default_rng(2), 5
    columns = rng.normal(size=(4, count, 3))
    place = [kind(points(x)) for kind, x in zip((mi.Point3f, mi.Normal3f, mi.Normal3f), columns[:3], strict=True)]
    weight, depth = mi.UnpolarizedSpectrum(points(columns[3])), dr.arange(mi.UInt32, count) + 1
    vertices, factor = GatherVertices(*place, weight, depth), rng.uniform(1, 2, len(chosen))
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for factors in (None, factor):
            dr.eval(vertices)
            index = upload(mi.UInt32, chosen)
            dr.kernel_history_clear()
            found = vertices.select(index, None if factors is None else upload(mi.Float, factors))
            kernels.append({kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT})
            expected = columns[3][chosen] * (1 if factors is None else factors[:, None])
            assert dr.width(found.depth) == len(chosen) and np.all(np.array(found.depth) == np.array(chosen) + 1)
            if chosen:
                np.testing.assert_allclose(download(found.weight), expected, rtol=1e-6)
                np.testing.assert_allclose(download(found.position), columns[0][chosen], rtol=1e-6)
    assert kernels[0] == kernels[1]


def test_vertices_of_a_cluster_are_drawn_by_weight_and_stand_for_all_of_it():
    rng, count, samples = np.random.default_rng(1), 400, 8
    weight = rng.uniform(0.01, 1, (count, 3))
    normal = unit_vectors(rng, count).astype(np.float64)
    position = points(rng.normal(size=(count, 3)))
    vertices = GatherVertices(
        position, mi.Normal3f(points(normal)), mi.Normal3f(points(normal)), mi.Color3f(points(weight)),
        dr.full(mi.UInt32, 1, count),
    )  # fmt: skip
    rays = PixelRays.uniform(count // samples, samples)
    clusters = PixelClusters(LitVertices(vertices, dr.arange(mi.UInt32, count), 0), rays)
    first, size = np.array(clusters.first), np.array(clusters.size)
    ray_of = np.array(clusters.vertices.at(dr.arange(mi.UInt32, count))[1])
    assert size.sum() == count and (np.repeat(clusters.pixel, size) == ray_of // samples).all()
    draws = 20_000
    for cluster in range(0, clusters.count, 31):
        members = ray_of[first[cluster] : first[cluster] + size[cluster]]
        ray, _, value = clusters.draw(
            dr.full(mi.UInt32, cluster, draws), upload(mi.Float, (np.arange(draws) + 0.5) / draws)
        )  # fmt: skip
        assert set(np.unique(np.array(ray))) == set(members)
        np.testing.assert_allclose(np.array(value).mean(1), weight[members].sum(0), rtol=2e-3)


@pytest.mark.parametrize("alone", [0, 7, 40])
def test_clusters_hold_their_vertices(alone):
    """The first vertices by pixel and facing; each of the last ones is a cluster."""
    rng, count, samples = np.random.default_rng(alone), 40, 8
    together, normal = count - alone, unit_vectors(rng, count).astype(np.float64)
    place = rng.normal(size=(count, 3))
    normals, white = mi.Normal3f(points(normal)), mi.Color3f(points(np.ones((count, 3))))
    vertices = GatherVertices(points(place), normals, normals, white, dr.full(mi.UInt32, 1, count))
    rays = np.concatenate([np.sort(rng.integers(0, 80, together)), np.sort(rng.integers(0, 80, alone))])
    clusters = PixelClusters(LitVertices(vertices, upload(mi.UInt32, rays), alone), PixelRays.uniform(10, samples))
    keys = np.unique((rays // samples * FACINGS + facing(normal))[:together])
    first, size, pixel = (np.array(x) for x in (clusters.first, clusters.size, clusters.pixel))
    assert list(pixel[: len(keys)]) == list(keys // FACINGS) and clusters.count == len(keys) + alone
    assert size.sum() == count and (size[len(size) - alone :] == 1).all() and (np.diff(first) == size[:-1]).all()
    (held, ray), receiver = clusters.vertices.at(dr.arange(mi.UInt32, count)), clusters.receivers.receiver
    ray = np.array(ray)
    assert sorted(ray) == sorted(rays)
    low, high = (np.array(receiver.position + sign * receiver.extent).T for sign in (-1, 1))
    inside, around = np.array(held.position).T, np.array(held.normal).T
    of = np.repeat(np.arange(clusters.count), size)
    assert (ray // samples == pixel[of]).all()
    assert (inside >= low[of] - 1e-6).all() and (inside <= high[of] + 1e-6).all()
    cosine = (around * np.array(receiver.normal).T[of]).sum(1)
    assert (cosine >= np.array(receiver.normal_cosine)[of]).all()


@pytest.mark.stress
def test_later_vertices_are_drawn_by_weight_and_stand_for_all_of_them():
    rng, pixels, samples, most = np.random.default_rng(2), 50, 8, 3
    weights = []
    for share in (0.5, 0.3):
        weight = rng.exponential(size=(pixels * samples, 3)) * (rng.random((pixels * samples, 1)) < share)
        weights.append(np.where(rng.random((pixels * samples, 1)) < 0.2, -weight, weight))
    first, later = (
        GatherVertices(None, None, None, mi.Color3f(*(upload(mi.Float, x) for x in weight.T)), None)
        for weight in weights
    )
    rays, mean, seeds = PixelRays.uniform(pixels, samples), np.zeros(pixels * samples), 4000
    for seed in range(seeds):
        ray, factor = (np.array(x) for x in drawn_later(first, later, rays, most, seed))
        assert (np.diff(ray.astype(int)) >= 0).all()
        assert np.bincount(ray // samples, minlength=pixels).max() <= most
        np.add.at(mean, ray, factor / seeds)
    drawn = np.abs(weights[1]).mean(1) > 0
    assert (mean[~drawn] == 0).all()
    # Systematic sampling: a count is right on average, with a variance below the variance of one draw
    total = np.abs(weights).mean(2).sum(0).reshape(pixels, samples).sum(1).repeat(samples) / most
    share = np.abs(weights[1]).mean(1) / total
    spread = (np.maximum(share, 1e-9) / seeds) ** 0.5
    assert (np.abs(mean - 1)[drawn] * share[drawn] < 5 * spread[drawn]).all()
