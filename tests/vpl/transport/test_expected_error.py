"""Expected error of a light that represents a cluster: against bounds, and against representatives drawn by NumPy."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from tests.support.properties import seeds, unit_vectors
from vpl.core.arrays import download, upload, upload_vectors
from vpl.split.pixel_clusters import Receivers
from vpl.transport.bounds import LEAST_CHANGE, contribution_bound, expected_error

PAIRS, DRAWS = 400, 256


def pairs(rng, receivers: dict, lights: dict):
    """(Receivers, nodes) of boxes and cones: ``position``, ``extent``, ``axis`` (n, 3), ``cosine`` (n,) of each."""

    def box(of: dict):
        kinds = (mi.Point3f, "position"), (mi.Vector3f, "extent"), (mi.Vector3f, "axis")
        return *(upload_vectors(kind, of[name]) for kind, name in kinds), upload(mi.Float, of["cosine"])

    receiver = Receivers.of(*box(receivers)).receiver
    center, extent, axis, cosine = box(lights)
    intensity, c = (upload(mi.Float, x) for x in 10.0 ** rng.uniform(-2, 1, (2, len(lights["cosine"]))))
    node = SimpleNamespace(
        center=center, extent=extent, axis=axis, cosine=cosine, intensity=mi.Color3f(intensity), least_c=c
    )
    return receiver, node


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


@seeds(20)
def test_an_expected_error_lies_between_a_part_of_the_bound_and_the_bound(seed):
    rng = np.random.default_rng(seed)
    spread = 10.0 ** rng.uniform(-3, 1)
    receiver, node = pairs(rng, random_boxes(rng, spread), random_boxes(rng, spread))
    bound = contribution_bound("surface", receiver, node, mi.Float(0))
    error, bound = (download(x).astype(np.float64) for x in (expected_error("surface", receiver, node, bound), bound))
    assert (error <= bound * (1 + 1e-5)).all()
    assert (error >= bound * LEAST_CHANGE**0.5 * (1 - 1e-5)).all()
    # Small clusters that see each other vary less than their bound
    assert spread > 0.01 or (error[bound > 0] < 0.9 * bound[bound > 0]).mean() > 0.1


def test_errors_follow_the_deviation_of_representatives_more_closely_than_bounds():
    """The correlation of logarithms, for pairs with bounds that a cut would compare."""
    rng = np.random.default_rng(1)
    receivers, lights = random_boxes(rng, 0.1), random_boxes(rng, 1.0)
    receiver, node = pairs(rng, receivers, lights)
    bound = contribution_bound("surface", receiver, node, mi.Float(0))
    error, bound = (download(x).astype(np.float64) for x in (expected_error("surface", receiver, node, bound), bound))
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
    bound = contribution_bound("surface", receiver, node, mi.Float(0))
    error = download(expected_error("surface", receiver, node, bound))
    assert np.isfinite(error).all() and (error <= download(bound) * (1 + 1e-5)).all()


def test_other_kinds_of_lights_have_the_error_of_their_bound():
    bound = dr.opaque(mi.Float, 0.5, 3)
    assert expected_error("spot", None, None, bound) is bound
