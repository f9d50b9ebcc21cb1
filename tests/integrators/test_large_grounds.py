"""The plugin ``manylights`` where the ground is much larger than the room: a planet, or a plane up to the horizon.

On such a ground, ``path`` itself loses the light of some points, whose own surface blocks their shadow rays.  How many,
depends on the directions from which paths arrive, so its means are found to some tenths of a percent only.
"""

import itertools

import mitsuba as mi
import numpy as np
import pytest

from tests.support.marks import not_on_cuda, stress
from tests.support.rendering import render, render_with_statistics
from tests.support.rooms import lamp_behind_the_camera
from tests.support.scenes import closed_box, rgb

pytestmark = pytest.mark.usefixtures("lights_cost_nothing")
LARGE_HITS = "OptiX finds hits on a plane of a million units to within 0.2 units"


def planet(size):
    """A lit room on a sphere."""
    box = closed_box(lamp_behind_the_camera(), 32)
    box["floor"] = {"type": "sphere", "center": [0, -1 - size, 0], "radius": size}
    return box


def cylinder(size):
    """A lit room on the side of a cylinder."""
    box = closed_box(lamp_behind_the_camera(), 32)
    box["floor"] = {"type": "cylinder", "p0": [0, -1 - size, -size], "p1": [0, -1 - size, size], "radius": size}
    return box


def plane(size):
    """A room without its left wall on a flat cube, in the sun."""
    sun = {"sun": {"type": "directional", "direction": [0.5, -0.6, -0.3], "irradiance": rgb(3.0)}}
    box = closed_box(sun, 32)
    del box["left"]
    flat = mi.ScalarTransform4f().translate([0, -1.01, 0]).scale([size, 0.01, size])
    box["floor"] = {"type": "cube", "to_world": flat}
    return box


def tilted(size):
    """A lit room on a square, no vertex of which has a coordinate of 0."""
    box = closed_box(lamp_behind_the_camera(), 32)
    turned = mi.ScalarTransform4f().rotate([0.3, 0.2, 1], 7).translate([0, -1.2, 0]).rotate([1, 0, 0], -90)
    box["floor"] = {"type": "rectangle", "to_world": turned.rotate([0, 0, 1], 30).scale(size)}
    return box


GROUNDS = list(itertools.product([planet, cylinder, plane, tilted], [1e5, 1e6]))
QUICK = ((plane, 1e6),)


@not_on_cuda(LARGE_HITS)
@pytest.mark.parametrize(("ground", "size"), [*QUICK, *stress(*(pair for pair in GROUNDS if pair not in QUICK))])
def test_a_large_ground(ground, size):
    scene, found = mi.load_dict(ground(size)), []
    for seed in range(8):
        image, statistics = render_with_statistics("manylights", scene, 128, seed, max_depth=5)
        assert statistics["light_paths"] > 0
        found.append(image)
    expected = np.mean([render(scene, "path", 256, 1000 + seed, max_depth=5) for seed in range(8)])
    assert np.mean(found) == pytest.approx(expected, rel=0.012)
    # No pixel is a firefly
    assert np.max(found) < 1.5 * np.max(render(scene, "path", 256, max_depth=5))
