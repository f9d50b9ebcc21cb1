"""A bound is an upper bound: for every light of a node, at every point, in double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.pairs import exact, scene_of, unit
from vpl.core.arrays import download, upload
from vpl.lights.device_tree import DeviceTree
from vpl.lights.light_set import light_tree
from vpl.lights.light_tree import CONE_COS, build_light_tree
from vpl.points.bsdf_proxies import MaterialProxy
from vpl.points.surfaces import Receiver
from vpl.transport.bounds import contribution_bound

POINTS = 400


def proxy_of(albedo, peak, exponent, axis):
    """A proxy made of arrays: (n, 3) albedo / pi, (n, 3) peak, (n,) exponent, (n, 3) axis."""
    color = [mi.Color3f(*(upload(mi.Float, values[:, k]) for k in range(3))) for values in (albedo, peak)]
    direction = mi.Vector3f(*(upload(mi.Float, axis[:, k]) for k in range(3)))
    no = dr.full(mi.Bool, False, len(albedo))
    return MaterialProxy(*color, upload(mi.Float, exponent), direction, no, no, True, False)


@pytest.mark.parametrize("kind", ["point", "spot", "oriented", "directional", "environment"])
@pytest.mark.parametrize("spread", [(1, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0), (1e-3, 1, 1e-3)])
@pytest.mark.parametrize("seed", [0, 1])
def test_no_light_exceeds_the_bound_of_its_ancestors(kind, spread, seed):
    rng = np.random.default_rng(seed)
    lights = scene_of(kind, rng, np.array(spread))
    reference = build_light_tree(
        lights.position, None if kind == "point" else lights.direction, lights.intensity, np.random.default_rng(5)
    )
    device = light_tree(lights, 5)
    # Points in and around the lights' box, some exactly on a light's plane
    position = rng.uniform(-2, 2, (POINTS, 3)) * np.maximum(spread, 0.3)
    position[::7, 2] = 0
    position = position.astype(np.float32).astype(np.float64)
    normal, axis = unit(rng, POINTS), unit(rng, POINTS)
    albedo, peak = rng.uniform(0, 0.3, (POINTS, 3)), rng.uniform(0, 5, (POINTS, 3)) * (rng.random((POINTS, 1)) < 0.5)
    exponent = 10 ** rng.uniform(0, 3, POINTS)
    clamp = 0.05 if kind == "oriented" else 0.0
    truth = exact(kind, position, normal, albedo, peak, exponent, axis, lights, clamp)

    def vectors(values):
        return mi.Vector3f(*(upload(mi.Float, values[:, k]) for k in range(3)))

    receiver = Receiver(mi.Point3f(vectors(position)), vectors(normal), proxy_of(albedo, peak, exponent, axis))
    leaves = np.concatenate([[0], np.cumsum(reference.escape == np.arange(len(reference.records)) + 1)])
    worst = 0.0
    for node in range(len(reference.records)):
        below = reference.leaf_order[leaves[node] : leaves[reference.escape[node]]]
        fetched = device.gather(dr.full(mi.UInt32, node, POINTS))
        bound = contribution_bound(kind, receiver, fetched, clamp)
        bound = download(bound).astype(np.float64)
        assert not np.isnan(bound).any() and (bound >= 0).all()
        # The cluster's whole intensity at the place of its best light, and the sum of its lights
        total = truth[:, below].sum(1)
        worst = max(worst, float(np.max(total / np.maximum(bound, 1e-300) * (total > 1e-12 * truth.max()))))
    # A cosine rounded by 2^-21 to a power of up to 1000 is off by 5e-4
    assert worst <= 1 + 1e-3
    assert worst > 0.5, "bounds that are never nearly reached would not find an error in this test"


def test_a_bound_that_is_too_small_would_be_found():
    """The harness above notices a cone that is too narrow."""
    rng = np.random.default_rng(0)
    lights = scene_of("oriented", rng, np.ones(3))
    tree = build_light_tree(lights.position, lights.direction, lights.intensity, np.random.default_rng(5))
    tree.records[:, CONE_COS] = 1.0
    narrow = DeviceTree("oriented", tree, tree.representative).gather(dr.zeros(mi.UInt32, POINTS))
    position, normal = rng.uniform(-3, 3, (POINTS, 3)), unit(rng, POINTS)
    zeros = np.zeros((POINTS, 3))
    albedo = np.full((POINTS, 3), 0.3)
    truth = exact("oriented", position, normal, albedo, zeros, np.ones(POINTS), normal, lights, 0.05).sum(1)
    proxy = proxy_of(albedo, zeros, np.ones(POINTS), normal)

    def vectors(values):
        return mi.Vector3f(*(upload(mi.Float, values[:, k]) for k in range(3)))

    receiver = Receiver(mi.Point3f(vectors(position)), vectors(normal), proxy)
    bound = contribution_bound("oriented", receiver, narrow, 0.05)
    assert np.any(truth > download(bound) * 1.001)
