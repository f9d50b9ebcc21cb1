"""Random lines, their density, and c: each against its definition."""

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import example

from tests.support.properties import points, seeds, unit_vectors
from vpl.core.arrays import download, upload_vectors
from vpl.split.arrival_octree import SCENE_SHARE, ArrivalOctree
from vpl.split.line_sampling import LineSampler
from vpl.split.local_c import LocalC


def cells_on_sphere_and_plane(seed, tilt):
    """Points on the outside of a sphere and on top of a plane; `tilt`: whether their normals are given."""
    rng = np.random.default_rng(seed)
    ball = unit_vectors(rng, 300).astype(np.float64)
    plane = np.column_stack([rng.uniform(-2, 2, (300, 2)), np.full(300, -1.5)])
    position = np.concatenate([0.8 * ball, plane])
    normal = np.concatenate([ball, np.repeat([[0.0, 0.0, 1.0]], 300, 0)]) * tilt
    return ArrivalOctree(position, normal, rng.uniform(0.1, 1, 600), [-2.5] * 3, 5.0, rng)


def rays_of(lines):
    """(Origins, directions, lengths) in double precision."""
    return tuple(download(x).astype(np.float64) for x in (lines.origin, lines.direction, lines.length))


def density_of(sampler, position, normal):
    sides = (upload_vectors(mi.Vector3f, np.float32(x)) for x in (position, normal))
    return sampler.density.per_area(download(sampler.density.at(*sides)))


def hits_of_sphere(lines, radius=0.8):
    """(position, normal of the hit side) of all hits."""
    o, d, length = rays_of(lines)
    b = (o * d).sum(1)
    disc = b**2 - (o**2).sum(1) + radius**2
    found = []
    for sign in (-1, 1):
        t = -b + sign * np.sqrt(np.maximum(disc, 0))
        ok = (disc > 0) & (t > 0) & (t < length)
        p = (o + t[:, None] * d)[ok]
        found.append((p, -sign * p / radius))
    return tuple(np.concatenate(columns) for columns in zip(*found, strict=True))


def hits_of_plane(lines, height=-1.5):
    o, d, length = rays_of(lines)
    t = (height - o[:, 2]) / d[:, 2]
    p = o + t[:, None] * d
    ok = (t > 0) & (t < length) & (np.abs(p[:, :2]) < 2).all(1)
    return p[ok], np.where(d[ok, 2:] < 0, 1.0, -1.0) * [[0, 0, 1]]


@pytest.mark.parametrize("tilt", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_lines_meet_surfaces_with_the_density_that_is_said(seed, tilt):
    """The mean of 1 / density over hits is the area of each side, in every octant and quadrant."""
    cells, count = cells_on_sphere_and_plane(seed, tilt), 400_000
    sampler = LineSampler(cells)
    lines = sampler.draw(count, seed + 100)
    for hits, area in ((hits_of_sphere, 4 * np.pi * 0.64 / 8), (hits_of_plane, 16 / 4)):
        position, normal = hits(lines)
        density = density_of(sampler, position, np.broadcast_to(normal, position.shape))
        assert (density > 0).all()
        outside = (normal * (position if hits is hits_of_sphere else [[0, 0, 1]])).sum(1) > 0
        parts = position[:, 0] > 0, position[:, 1] > 0, (position[:, 2] > 0) & (hits is hits_of_sphere)
        key = sum(part * 2**k for k, part in enumerate(parts))
        for side in (False, True):
            for octant in np.unique(key):
                weight = np.where((outside == side) & (key == octant), 1 / density, 0)
                error = np.sqrt((weight**2).sum()) / count
                assert abs(weight.sum() / count - area) < 5 * error


@seeds(20)
@example(seed=314197)  # all arrivals coincide, ten thousand extents of the scene from the origin
def test_densities_are_sums_over_the_boxes(seed):
    """Places in and beside boxes, near and far from the origin; against a loop over all boxes."""
    rng = np.random.default_rng(seed)
    count, size, offset = int(rng.integers(2, 400)), 10.0 ** rng.uniform(-3, 3), rng.choice([0, 1, 1e4])
    # Clusters of very different sizes make leaves on many levels
    spread = size * 10.0 ** -rng.uniform(0, 4, (count, 1))
    position = offset * size + spread * (rng.random((count, 3)) - 0.5) * np.where(rng.random(3) < 0.2, 0, 1)
    normal = unit_vectors(rng, count).astype(np.float64)
    low, extent = (offset - 0.6) * size * np.ones(3), 1.2 * size
    octree = ArrivalOctree(position, normal, rng.uniform(0.1, 1, count), low, extent, rng)
    place = np.concatenate(
        [position, position + rng.normal(size=(count, 3)) * spread, low + extent * rng.random((count, 3))]
    )
    # The values of single precision, in double
    place, side = (np.float64(np.float32(x)) for x in (place, unit_vectors(rng, 3 * count)))
    expected = np.full(3 * count, SCENE_SHARE / (6 * extent**2))
    for boxes in (octree.leaves, octree.parents):
        for k in range(len(boxes.chance)):
            inside = ((place >= boxes.low[k]) & (place <= boxes.low[k] + boxes.size[k])).all(1)
            expected += inside * boxes.chance[k] / boxes.surface[k] * (1 + side @ boxes.turn[k])
    found = density_of(LineSampler(octree), place, side)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_c_is_proportional_to_the_distance_between_lights():
    """c² times the density of lights is k², everywhere, and c may be constant."""
    rng = np.random.default_rng(4)
    density = LineSampler(cells_on_sphere_and_plane(0, 1)).density
    position, normal = points(rng.uniform(-2.5, 2.5, (500, 3))), mi.Vector3f(points(unit_vectors(rng, 500)))
    c2 = download(LocalC.of(density, 1000, 3.0).squared(position, normal))
    np.testing.assert_allclose(c2 * 1000 * density.per_area(download(density.at(position, normal))), 9, rtol=1e-4)
    assert c2.max() > 10 * c2.min()
    np.testing.assert_allclose(download(LocalC.constant(0.3).squared(position, normal)), 0.09, rtol=1e-6)


@seeds(20)
def test_lines_stay_in_the_scene_and_every_side_has_a_density(seed):
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-4, 4)
    count = int(rng.integers(1, 200))
    flat = rng.random(3) < 0.3
    position = np.where(flat, 0.5, rng.random((count, 3))) * size
    normal = unit_vectors(rng, count)
    cells = ArrivalOctree(position, normal, rng.uniform(0.1, 1, count), [-0.1 * size] * 3, 1.2 * size, rng)
    cells.choose_by(rng.random(len(cells.leaf_weight)) + 1e-3)
    sampler = LineSampler(cells)
    for side in (normal, -normal):
        density = density_of(sampler, position, side)
        assert (density > 0).all() and np.isfinite(density).all()
    origin, direction, length = rays_of(sampler.draw(500, seed))
    assert np.isfinite(origin).all() and (length >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-5)
