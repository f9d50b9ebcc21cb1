"""Expected error of a light that represents a cluster: its definition, drawn pairs, and the cuts that compare it."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.properties import seeds, unit_vectors
from vpl.core.arrays import download, upload, upload_vectors
from vpl.cuts.light_cuts import collect_cuts, cuts_at
from vpl.lights.light_set import LightSet, ScatteredGroup
from vpl.lights.virtual_lights import VirtualLights
from vpl.split.pixel_clusters import Receivers
from vpl.transport.bounds import LEAST_CHANGE, contribution_bound, expected_error

PAIRS, DRAWS = 400, 256


def uploaded(boxes: dict):
    """Boxes and cones on the device."""
    kinds = (mi.Point3f, "position"), (mi.Vector3f, "extent"), (mi.Vector3f, "axis")
    return *(upload_vectors(kind, boxes[name]) for kind, name in kinds), upload(mi.Float, boxes["cosine"])


def pairs(rng, receivers: dict, lights: dict):
    """(Receiver, node) of boxes and cones: ``position``, ``extent``, ``axis`` (n, 3), ``cosine`` (n,) of each."""
    receiver = Receivers.of(*uploaded(receivers)).receiver
    center, extent, axis, cosine = uploaded(lights)
    intensity, c = (upload(mi.Float, x) for x in 10.0 ** rng.uniform(-2, 1, (2, len(lights["cosine"]))))
    node = SimpleNamespace(
        center=center, extent=extent, axis=axis, cosine=cosine, intensity=mi.Color3f(intensity), least_c=c
    )
    return receiver, node


def errors(receiver, node) -> tuple[np.ndarray, np.ndarray]:
    """(Expected errors, bounds) of pairs, (n,) float64."""
    bound = contribution_bound("surface", receiver, node, mi.Float(0))
    return tuple(download(x).astype(np.float64) for x in (expected_error("surface", receiver, node, bound), bound))


def random_boxes(rng, spread: float) -> dict:
    """Boxes with cones, in a room with a size of some units."""
    return {
        "position": rng.uniform(-3, 3, (PAIRS, 3)), "extent": spread * rng.uniform(0, 1, (PAIRS, 3)),
        "axis": unit_vectors(rng, PAIRS), "cosine": np.cos(rng.uniform(0, 1, PAIRS) * rng.choice([0.01, 1.0], PAIRS)),
    }  # fmt: skip


def members(rng, boxes: dict):
    """Positions and normals (n, draws, 3) in boxes and cones."""
    position = boxes["position"][:, None] + boxes["extent"][:, None] * rng.uniform(-1, 1, (PAIRS, DRAWS, 3))
    # Uniform over the cap of each cone
    z = 1 - rng.random((PAIRS, DRAWS)) * (1 - boxes["cosine"])[:, None]
    around = np.cross(boxes["axis"][:, None], rng.normal(size=(PAIRS, DRAWS, 3)))
    around /= np.linalg.norm(around, axis=2, keepdims=True)
    normal = z[..., None] * boxes["axis"][:, None] + np.sqrt(1 - z**2)[..., None] * around
    return position, normal


def drawn(rng, receivers: dict, lights: dict, node) -> np.ndarray:
    """Contributions of drawn pairs of members, (n, draws)."""
    (x, n), (y, m) = members(rng, receivers), members(rng, lights)
    offset = y - x
    d2 = (offset**2).sum(2)
    toward = offset / np.sqrt(d2)[..., None]
    cosines = np.maximum((n * toward).sum(2), 0) * np.maximum(-(m * toward).sum(2), 0)
    c2 = download(node.least_c).astype(np.float64)[:, None] ** 2
    return download(node.intensity.x)[:, None] * cosines / (d2 + c2 * cosines)


def definition(receivers: dict, lights: dict, node, bound: np.ndarray) -> np.ndarray:
    """The expected error by its definition, in double precision."""
    offset = lights["position"] - receivers["position"]
    distance = np.linalg.norm(offset, axis=1)
    cosines = [(x["axis"] * offset).sum(1) / distance * sign for x, sign in ((receivers, 1), (lights, -1))]
    a, b = (np.arccos(np.clip(cosine, -1, 1)) for cosine in cosines)
    of_a, of_b = (np.maximum(cosine, 0) for cosine in cosines)
    extent = np.linalg.norm(receivers["extent"] + lights["extent"], axis=1) / distance
    # Of the rounded cosines that the kernel gets: those of narrow cones are almost 1
    chord_a, chord_b = (np.sqrt(2 - 2 * x["cosine"].astype(np.float32).astype(np.float64)) for x in (receivers, lights))
    change = extent * (2 * of_a * of_b + np.sin(a) * of_b + of_a * np.sin(b)) + chord_a * of_b + chord_b * of_a
    w = 1 / (1 + download(node.least_c).astype(np.float64) ** 2 * of_a * of_b / distance**2)
    change *= download(node.intensity.x) * w**2 / distance**2
    return np.sqrt(np.clip(change, LEAST_CHANGE * bound, bound) * bound)


@seeds(20)
def test_an_expected_error_is_that_of_its_definition(seed):
    rng = np.random.default_rng(seed)
    receivers, lights = (random_boxes(rng, 10.0 ** rng.uniform(-3, 1)) for _ in range(2))
    receiver, node = pairs(rng, receivers, lights)
    error, bound = errors(receiver, node)
    np.testing.assert_allclose(error, definition(receivers, lights, node, bound), rtol=1e-2, atol=1e-30)


def test_the_change_of_a_small_cluster_holds_the_deviation_of_its_members():
    """Without cones, the first-order change is at least the difference between any member and the centres."""
    rng = np.random.default_rng(3)
    receivers, lights = (random_boxes(rng, 1e-3) | {"cosine": np.ones(PAIRS)} for _ in range(2))
    receiver, node = pairs(rng, receivers, lights)
    error, bound = errors(receiver, node)
    centers = [x | {"extent": 0 * x["extent"]} for x in (receivers, lights)]
    at_center = drawn(rng, *centers, node)[:, :1]
    change, found = error**2 / np.maximum(bound, 1e-30), drawn(rng, receivers, lights, node)
    lit = (at_center[:, 0] > 0) & (error < 0.99 * bound)
    assert lit.sum() > PAIRS // 8
    assert (np.abs(found - at_center).max(1)[lit] <= 1.1 * change[lit]).all()


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_errors_grow_with_the_light(scale):
    rng = np.random.default_rng(4)
    receiver, node = pairs(rng, random_boxes(rng, 0.5), random_boxes(rng, 0.5))
    scaled = SimpleNamespace(**vars(node) | {"intensity": node.intensity * scale})
    (error, _), (of_scaled, _) = (errors(receiver, one) for one in (node, scaled))
    np.testing.assert_allclose(of_scaled / scale, error, rtol=1e-4)


def test_cuts_of_pixels_compare_expected_errors():
    """Their nodes are leaves or have an error up to the threshold, some with a larger bound; the same cuts for a
    selection of receivers."""
    rng = np.random.default_rng(6)
    position, normal = rng.uniform(-3, 3, (300, 3)), unit_vectors(rng, 300)
    lights = VirtualLights.of("surface", position, normal, 10.0 ** rng.uniform(-2, 0, (300, 3)))
    lights.facing, lights.c = lights.direction, np.full(300, 0.5, np.float32)
    group = ScatteredGroup.of(lights)
    lights, receivers = LightSet([group], 0, np.inf, 0, 0, {}), Receivers.of(*uploaded(random_boxes(rng, 0.1)))
    threshold = dr.opaque(mi.Float, 0.01, PAIRS)
    sizes = cuts_at(lights, receivers, threshold)
    (chunk,) = collect_cuts(lights, receivers, threshold, sizes)
    node, receiver = group.tree.gather(chunk.nodes), receivers.select(chunk.rows).receiver
    (error, bound), leaf = errors(receiver, node), download(node.escape == chunk.nodes + 1)
    assert ((error <= 0.01 * (1 + 1e-5)) | leaf).all() and (error[~leaf] > 0).any()
    assert (bound[~leaf] > 0.01).mean() > 0.05
    rows = np.arange(0, PAIRS, 7)
    some = cuts_at(lights, receivers.select(upload(mi.UInt32, rows)), dr.opaque(mi.Float, 0.01, len(rows)))
    np.testing.assert_array_equal(some.total(), sizes.total()[rows])


def test_errors_follow_the_deviation_of_representatives_more_closely_than_bounds():
    """The correlation of logarithms, for pairs that see each other."""
    rng = np.random.default_rng(1)
    receivers, lights = random_boxes(rng, 0.1), random_boxes(rng, 1.0)
    receiver, node = pairs(rng, receivers, lights)
    error, bound = errors(receiver, node)
    deviation = drawn(rng, receivers, lights, node).std(1)
    seen = (bound > 0) & (deviation > 0)
    assert seen.sum() > PAIRS // 4
    by_error, by_bound = (np.corrcoef(np.log(x[seen]), np.log(deviation[seen]))[0, 1] for x in (error, bound))
    assert by_error > by_bound + 0.02


def test_clusters_around_the_same_point_have_the_error_of_their_bound_or_less():
    """No NaN where centres coincide, even for boxes and cones without extent."""
    rng = np.random.default_rng(2)
    boxes = random_boxes(rng, 1.0) | {"cosine": np.ones(PAIRS)}
    boxes["extent"][: PAIRS // 2] = 0
    receiver, node = pairs(rng, boxes, boxes)
    error, bound = errors(receiver, node)
    assert np.isfinite(error).all() and (error <= bound * (1 + 1e-5)).all()


def test_other_kinds_of_lights_have_the_error_of_their_bound():
    bound = dr.opaque(mi.Float, 0.5, 3)
    assert expected_error("spot", None, None, bound) is bound
