"""Masks between lights and surfaces: each mask is an edge of the light's path, as in ``prb``."""

import mitsuba as mi
import pytest

from tests.support.catalogue import plugin
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import veiled_room
from tests.support.scenes import rgb
from tests.support.statistics import assert_same_mean

ALL_LIGHTS = {"clamping": 0.0, "vpl_count": 250}
WITH_LIGHTS = (
    "vpl", "lightcuts", "mdlightcuts", "lightslice", "matrixrecovery", "illuminationcut", "illuminationcut-adaptive",
)  # fmt: skip


def assert_image_of_prb(description, max_depth, seeds=10):
    scene = mi.load_dict(description)

    def pair(seed):
        found = render(scene, "vpl", 128, seed, max_depth=max_depth, **ALL_LIGHTS)
        return found, render(scene, "prb", 2048, seed, max_depth=max_depth)

    assert_same_mean(pair, seeds, 0.07)


@pytest.mark.parametrize("name", [*WITH_LIGHTS, "manylights"])
def test_no_light_where_paths_are_too_short_to_pass(name):
    """From a wall through four masks to the lamp there are six edges with that from the camera."""
    scene = mi.load_dict(veiled_room())
    for max_depth in (3, 4):
        assert render(scene, mi.load_dict(plugin(name, max_depth=max_depth)), 16).max() == 0


@pytest.mark.parametrize("max_depth", stress(5, 6, 8))
def test_light_through_four_masks(max_depth):
    assert_image_of_prb(veiled_room(), max_depth)


@pytest.mark.stress
@pytest.mark.parametrize("lamp", ["point", *stress("directional", "spot")])
def test_light_from_one_point_or_direction_does_not_pass(lamp):
    """Only next-event estimation finds the emitter, and masks block its rays."""
    aimed = mi.ScalarTransform4f().look_at([0, 0, -0.9], [0.8, -1, 0.4], [0, 1, 0])
    emitter = {
        "point": {"type": "point", "position": [0, 0, -0.8], "intensity": rgb(1.0)},
        "spot": {"type": "spot", "to_world": aimed, "cutoff_angle": 60, "intensity": rgb(1.0)},
        "directional": {"type": "directional", "direction": [0.1, -0.2, 1.0], "irradiance": rgb(1.0)},
    }[lamp]
    box = veiled_room(1, {"lamp": emitter})
    if lamp == "directional":
        del box["back"], box["left"]
    assert_image_of_prb(box, 5)
