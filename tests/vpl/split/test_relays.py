"""Relays: balls around glass, directions to them, and their density."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.scenes import area_light, closed_box
from vpl.core.arrays import download
from vpl.core.materials import Materials, tells_density
from vpl.core.sampling import independent_sampler
from vpl.split.relays import Relays, relays_by
from vpl.split.relays_found import _worth, balls_around, points_of_relays

COUNT = 1 << 18
FLAGS = {
    "dielectric": True,
    "roughdielectric": True,
    "conductor": True,
    "roughconductor": False,
    "diffuse": False,
    "plastic": False,
    "thindielectric": False,
}


class EvenChoice:
    """Relays that are drawn with equal probabilities in every cell."""

    def __init__(self, center, radius):
        self.relays = Relays(np.array(center, float), np.array(radius, float), np.ones(len(radius)), Materials([]))
        rows = np.full((2, 1 + self.relays.count), 1 / (1 + self.relays.count))
        self.relays.choice._use(rows)


def mixed(relays, origin, count=COUNT):
    """Directions (count, 3) of a mixture with uniform directions, and densities (count,)."""
    sampler = independent_sampler(0, count)
    origin, cell = mi.Point3f(origin) + dr.zeros(mi.Float, count), dr.zeros(mi.UInt32, count)
    drawn, direction, rest = relays.draw(origin, cell, sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
    assert dr.all((rest >= 0) & (rest < 1))
    uniform = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    direction = dr.select(drawn > 0, direction, uniform)
    everywhere = 0.25 / np.pi * relays.choice.probability(cell, mi.UInt32(0), mi.Bool(True))
    return download(direction), download(relays.density(origin, cell, drawn, direction, everywhere, mi.Bool(True)))


@pytest.mark.parametrize("radius", [[0.5, 0.3], [3.0, 0.3], [0.02, 0.02], [1e-4, 1e-3], [0.0, 1e-6]])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_density_is_that_of_directions(radius, size):
    """Integrals over all directions; the balls overlap or hold the origin in some cases."""
    places = EvenChoice(size * np.array([[1.0, 0.5, 0.2], [1.1, 0.8, 0.1]]), size * np.array(radius))
    direction, density = mixed(places.relays, [0.0, 0.0, 0.0])
    assert (density > 0).all() and np.isfinite(density).all()
    for values, expected in ((np.ones(COUNT), 4 * np.pi), (direction[:, 0] ** 2, 4 / 3 * np.pi)):
        weighted = values / density
        error = weighted.std() / COUNT**0.5
        assert abs(weighted.mean() - expected) < 4.5 * error + 1e-4 * expected


@pytest.mark.parametrize("sine", [0.5, 0.05, 1e-3])
def test_directions_lie_in_cones(sine):
    choice = EvenChoice([[0.0, 0.0, 2.0]], [2.0 * sine])
    direction, density = mixed(choice.relays, [0.0, 0.0, 0.0])
    across = np.linalg.norm(direction[:, :2], axis=1)
    front = direction[:, 2] > 0
    # Half of all directions are uniform. Directions at the edge of the cone may be rounded to either side
    inside, outside = front & (across < 0.999 * sine), ~front | (across > 1.001 * sine)
    assert abs(np.mean(~outside) - 0.5) < 0.05
    of_cone = 0.5 * (1 + (1 - sine**2) ** 0.5) / (2 * np.pi * sine**2)
    assert np.allclose(density[inside], of_cone + 0.125 / np.pi, rtol=1e-3)
    assert np.allclose(density[outside], 0.125 / np.pi, rtol=1e-5)


@pytest.mark.parametrize("material, expected", FLAGS.items())
def test_glass_and_mirrors_are_relays(material, expected):
    bsdf = mi.load_dict(
        {"type": "twosided", "n": {"type": material}} if material == "conductor" else {"type": material}
    )
    assert bool(relays_by(int(bsdf.flags()))) == expected
    assert dr.all(relays_by(mi.UInt32(bsdf.flags())) == expected)


def test_materials_of_parts_tell_no_density():
    """Where paths choose between the BSDF and relays, the density of a sample has to be that of any direction."""
    blend = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "roughplastic"}}
    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}
    for material in (blend, mask, {"type": "twosided", "n": blend}):
        assert not tells_density(mi.load_dict(material))
    for material in ({"type": "twosided", "n": {"type": "diffuse"}}, {"type": "principled"}, {"type": "plastic"}):
        assert tells_density(mi.load_dict(material))


def around(center, radius, count=100):
    direction = np.random.default_rng(1).normal(size=(count, 3))
    return np.array(center) + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_much_light_in_few_directions_is_worth_a_choice():
    light, reach = np.array([1.0, 0.5, 0.5, 0.001, 4.0]), np.array([1.0, 0.01, 0.25, 0.01, 0.9])
    assert list(_worth(light, reach)) == [0, 1]


def test_two_lamps_get_a_ball_each():
    points = np.concatenate([around([0, 0, 0], 0.05), around([1, 0, 0], 0.05)])
    center, radius = balls_around(points, np.array([0.0, 0.0, 9.0]))
    assert len(radius) == 2 and (radius < 0.06).all()
    assert np.allclose(sorted(center[:, 0]), [0, 1], atol=0.01)


def test_a_pane_is_divided_where_it_looks_large():
    pane = np.random.default_rng(2).random((500, 3)) * [2.0, 2.0, 0.0]
    near, far = (balls_around(pane, np.array([1.0, 1.0, distance]))[1] for distance in (1.0, 100.0))
    assert len(far) == 1 and len(near) > 8 and near.max() < 0.5


def test_all_points_are_in_balls():
    points = np.random.default_rng(3).normal(size=(300, 3))
    center, radius = balls_around(points, np.zeros(3))
    distance = np.linalg.norm(points[:, None] - center, axis=2)
    assert len(radius) <= 32 and (distance <= radius + 1e-9).any(1).all()


def test_points_lie_on_glass_alone():
    glass, cube = {"type": "dielectric"}, mi.ScalarTransform4f().translate([0.5, 0, 0]).scale(0.1)
    scene = mi.load_dict(
        closed_box(
            {"light": area_light()},
            ball={"type": "sphere", "center": [-0.5, 0, 0], "radius": 0.1, "bsdf": glass},
            cube={"type": "cube", "to_world": cube, "bsdf": glass},
        )
    )
    points = points_of_relays(scene)
    assert (np.abs(np.abs(points[:, 0]) - 0.5) < 0.11).all() and (np.abs(points[:, 1:]) < 0.11).all()
    assert (points[:, 0] < 0).any() and (points[:, 0] > 0).any()
    assert len(points_of_relays(mi.load_dict(closed_box({"light": area_light()})))) == 0
