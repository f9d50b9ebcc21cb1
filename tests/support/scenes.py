"""Small scenes built from dictionaries for ``mi.load_dict``."""

import mitsuba as mi
import numpy as np

from comparison.scene_files import SceneFile
from tests.support.paths import CORNELL


def rgb(*value):
    """A constant colour."""
    return {"type": "rgb", "value": list(value) if len(value) == 3 else [value[0]] * 3}


def image(values):
    """A bitmap texture, linear, of an array (height, width, channels)."""
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.asarray(values, np.float32))}


def cornell(width=16, **defines):
    """The Cornell box as a scene file."""
    file = SceneFile(CORNELL, defines)
    file.set_width(width)
    return file


def sensor(size=32, spp=4, **more):
    """A camera on the z axis that looks at the origin from a distance of 4; box filter."""
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": spp},
        **more,
    }


def wall(translate, rotate_axis, angle, scale=1.0, reflectance=(0.5, 0.5, 0.5), bsdf=None):
    """A square wall of half-size ``scale``."""
    transform = mi.ScalarTransform4f().translate(translate).rotate(rotate_axis, angle).scale(scale)
    material = bsdf or {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance)}}
    return {"type": "rectangle", "to_world": transform, "bsdf": material}


def closed_box(emitters, size=32, spp=4, scale=1.0, **more):
    """A closed diffuse box of side 2 (times ``scale``), seen from inside; ``emitters``: dictionary of plugins."""
    camera = sensor(size, spp, fov=95)
    camera["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 0.95 * scale], [0, 0, 0], [0, 1, 0])
    camera |= {"near_clip": 1e-3 * scale, "far_clip": 1e3 * scale}
    s = scale
    return {
        "type": "scene",
        "sensor": camera,
        "floor": wall([0, -s, 0], [1, 0, 0], -90, s),
        "ceiling": wall([0, s, 0], [1, 0, 0], 90, s),
        "left": wall([-s, 0, 0], [0, 1, 0], 90, s, (0.6, 0.1, 0.1)),
        "right": wall([s, 0, 0], [0, 1, 0], -90, s, (0.1, 0.5, 0.1)),
        "back": wall([0, 0, -s], [0, 1, 0], 0, s),
        "front": wall([0, 0, s], [0, 1, 0], 180, s),
        **emitters,
        **more,
    }


def area_light(scale=1.0, radiance=(4.0, 4.0, 4.0)):
    """A small square area emitter below the ceiling of the closed box."""
    transform = mi.ScalarTransform4f().translate([0, 0.9 * scale, 0]).rotate([1, 0, 0], 90).scale(0.3 * scale)
    radiance = {"type": "rgb", "value": list(radiance)}
    return {"type": "rectangle", "to_world": transform, "emitter": {"type": "area", "radiance": radiance}}
