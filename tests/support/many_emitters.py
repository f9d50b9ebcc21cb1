"""Scenes of many emitters, and emitter samplers for these."""

import mitsuba as mi
import numpy as np

from tests.support.properties import unit_vectors
from tests.support.scenes import rgb
from vpl.core.arrays import upload_vectors
from vpl.lights.emitters import read_emitters
from vpl.split.emitters.irradiance import Places
from vpl.split.emitters.tree_emitters import TreeEmitters


def panels(number, rng):
    """Small area emitters in the upper half of the closed box, that face down."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(0.02)
    places = rng.uniform([-0.9, 0.0, -0.9], [0.9, 0.9, 0.9], (number, 3))
    return {
        f"panel{i}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate(list(place)) @ turned,
            "emitter": {"type": "area", "radiance": rgb(float(rng.uniform(1, 5)))},
        }
        for i, place in enumerate(places)
    }


def bulbs(number, rng):
    """Point emitters in the closed box."""
    places = rng.uniform(-0.9, 0.9, (number, 3))
    return {
        f"bulb{i}": {"type": "point", "position": list(place), "intensity": rgb(float(rng.uniform(0.1, 2)))}
        for i, place in enumerate(places)
    }


def vertices(rng, count=4000):
    return rng.uniform(-0.9, 0.9, (count, 3)).astype(np.float32), unit_vectors(rng, count)


def interactions(position, normal):
    facing = upload_vectors(mi.Normal3f, normal)
    return Places(upload_vectors(mi.Point3f, position), facing, facing).interaction()


def sampler_of(scene, rng, learns):
    """The emitter sampler of a scene; with ``learns``, it has learned from vertices all over the closed box."""
    emitters = TreeEmitters(scene, read_emitters(scene), 1 << 17)
    if learns:
        assert emitters.learn(*vertices(rng), 1 << 17, 0)
    return emitters
