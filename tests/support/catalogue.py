"""Small examples of Mitsuba's materials, emitters, sensors and films.

Functions that return dictionaries for ``mi.load_dict``; they are called when the variant is set.
"""

import mitsuba as mi
import numpy as np

from tests.support.scenes import image, rgb, sensor, wall

# Every plugin of ours, with parameters that make a small render quick
PLUGINS = {
    "manylights": {},
    "vpl": {"vpl_count": 60},
    "lightcuts": {"vpl_count": 200},
    "mdlightcuts": {"vpl_count": 200},
    "lightslice": {"vpl_count": 200, "slices": 20, "columns": 40},
    "matrixrecovery": {"vpl_count": 200, "slice_rows": 100},
    "illuminationcut": {"vpl_count": 200},
    "illuminationcut-adaptive": {"vpl_count": 200, "visibility": "adaptive"},
    "adaptivedirect": {"max_samples": 300},
    "unoccludeddirect": {"max_samples": 300},
}


def plugin(name, **more):
    """The dictionary of a plugin of the list above."""
    return {"type": name.split("-")[0], **PLUGINS[name], **more}


def _random(*shape):
    return np.random.default_rng(0).uniform(0.1, 0.9, shape)


def _normals():
    tilted = np.concatenate([_random(8, 8, 2) * 0.6 - 0.3, np.ones((8, 8, 1))], -1)
    return 0.5 + 0.5 * tilted / np.linalg.norm(tilted, axis=-1, keepdims=True)


MATERIALS = {
    "diffuse": lambda: {"type": "diffuse", "reflectance": rgb(0.7, 0.4, 0.2)},
    "textured": lambda: {"type": "diffuse", "reflectance": image(_random(8, 8, 3))},
    "black": lambda: {"type": "diffuse", "reflectance": rgb(0.0)},
    "conductor": lambda: {"type": "conductor", "material": "Au"},
    "roughconductor": lambda: {"type": "roughconductor", "alpha": 0.2},
    "sharpconductor": lambda: {"type": "roughconductor", "alpha": 0.002, "distribution": "ggx"},
    "plastic": lambda: {"type": "plastic"},
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.15},
    "dielectric": lambda: {"type": "dielectric"},
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.2},
    "thindielectric": lambda: {"type": "thindielectric"},
    "principled": lambda: {
        "type": "principled", "base_color": rgb(0.6, 0.3, 0.2), "metallic": 0.3, "roughness": 0.4, "specular": 0.6,
        "spec_trans": 0.3, "clearcoat": 0.4, "sheen": 0.3,
    },
    "principledthin": lambda: {
        "type": "principledthin", "base_color": rgb(0.6, 0.3, 0.2), "roughness": 0.4, "spec_trans": 0.4,
        "diff_trans": 0.8,
    },
    "blendbsdf": lambda: {
        "type": "blendbsdf", "weight": image(_random(8, 8, 1)), "a": {"type": "conductor"}, "b": {"type": "diffuse"},
    },
    "bumpmap": lambda: {
        "type": "bumpmap", "bump": image(_random(8, 8, 1)), "scale": 0.2, "nested": {"type": "diffuse"},
    },
    "normalmap": lambda: {"type": "normalmap", "normalmap": image(_normals()), "nested": {"type": "roughconductor"}},
    "mask": lambda: {"type": "mask", "opacity": image(_random(8, 8, 1)), "nested": {"type": "plastic"}},
    "null": lambda: {"type": "null"},
    "twosided": lambda: {
        "type": "twosided", "front": {"type": "diffuse", "reflectance": rgb(0.2, 0.6, 0.3)},
        "back": {"type": "roughplastic"},
    },
    "hair": lambda: {"type": "hair"},
    "pplastic": lambda: {"type": "pplastic", "alpha": 0.2},
}  # fmt: skip


def _glow(shape, **more):
    return {"lamp": {"type": shape, "emitter": {"type": "area", "radiance": rgb(6.0, 5.0, 4.0)}, **more}}


def _above(scale=0.3):
    return mi.ScalarTransform4f().translate([0.2, 2.1, 0.3]).rotate([1, 0, 0], 90).scale(scale)


def _from_above():
    return mi.ScalarTransform4f().look_at([0.4, 2.2, 1.0], [0, -0.5, 0], [0, 0, 1])


EMITTERS = {
    "point": lambda: {"lamp": {"type": "point", "position": [0.3, 1.5, 0.8], "intensity": rgb(3.0, 2.0, 1.0)}},
    "spot": lambda: {"lamp": {"type": "spot", "to_world": _from_above(), "cutoff_angle": 40.0, "intensity": rgb(5.0)}},
    "texturedspot": lambda: {
        "lamp": {"type": "spot", "to_world": _from_above(), "cutoff_angle": 40.0, "texture": image(_random(8, 8, 3))}
    },
    "directional": lambda: {"lamp": {"type": "directional", "direction": [0.3, -1.0, -0.5], "irradiance": rgb(2.0)}},
    "directionalarea": lambda: {
        "lamp": {
            "type": "rectangle", "to_world": _above(0.8), "emitter": {"type": "directionalarea", "radiance": rgb(2.0)}
        }
    },
    "rectangle": lambda: _glow("rectangle", to_world=_above()),
    "sphere": lambda: _glow("sphere", center=[0.3, 2.2, 0.5], radius=0.2),
    "disk": lambda: _glow("disk", to_world=_above()),
    "cylinder": lambda: _glow("cylinder", p0=[-0.4, 2.2, 0.5], p1=[0.4, 2.3, 0.6], radius=0.1),
    "mesh": lambda: _glow("cube", to_world=_above(0.2)),
    "texturedarea": lambda: {
        "lamp": {
            "type": "rectangle", "to_world": _above(),
            "emitter": {"type": "area", "radiance": image(4 * _random(8, 8, 3))},
        }
    },
    "envmap": lambda: {"sky": {"type": "envmap", "bitmap": mi.Bitmap(np.float32(_random(8, 16, 3) ** 3))}},
    "constant": lambda: {"sky": {"type": "constant", "radiance": rgb(0.8, 0.9, 1.0)}},
    "projector": lambda: {
        "lamp": {"type": "projector", "to_world": _from_above(), "fov": 40.0, "irradiance": image(9 * _random(8, 8, 3))}
    },
    "sunsky": lambda: {"sky": {"type": "sunsky", "sun_direction": [0.3, 0.4, 0.8], "turbidity": 3.0}},
    "sky": lambda: {"sky": {"type": "sunsky", "sun_scale": 0.0, "sun_direction": [0.3, 0.4, 0.8]}},
    "sun": lambda: {"sky": {"type": "sunsky", "sky_scale": 0.0, "sun_direction": [0.3, 0.4, 0.8]}},
}  # fmt: skip


def stage(emitters, objects, size=24, spp=4, **camera):
    """A floor and a wall with ``objects`` (dictionaries of shapes) in front, open to the environment."""
    return {
        "type": "scene",
        "sensor": sensor(size, spp, fov=45, **camera),
        "floor": wall([0, -1, 0], [1, 0, 0], -90, 3.0),
        "back": wall([0, 1, -1.5], [0, 1, 0], 0, 3.0, (0.6, 0.5, 0.4)),
        **objects,
        **emitters,
    }


def one_of(material):
    """A sphere and a slanted square of the same material."""
    bsdf = {**material, "id": "material"}
    slanted = mi.ScalarTransform4f().translate([0.7, -0.2, 0.2]).rotate([0, 1, 0], -25).scale(0.5)
    return {
        "ball": {"type": "sphere", "center": [-0.6, -0.4, 0.3], "radius": 0.55, "bsdf": bsdf},
        "square": {"type": "rectangle", "to_world": slanted, "bsdf": {"type": "ref", "id": "material"}},
    }


def all_materials():
    """Rows of small visible spheres, one per material."""
    objects = {}
    for number, (name, material) in enumerate(MATERIALS.items()):
        row, column = divmod(number, 6)
        center = [-1.2 + 0.48 * column, -0.7 + 0.45 * row, 0.3 - 0.3 * row]
        objects[f"ball_{name}"] = {"type": "sphere", "center": center, "radius": 0.2, "bsdf": material()}
    return objects


def _on(film, kind, **more):
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sampler = {"type": "independent", "sample_count": 4}
    return {"type": kind, "film": film, "sampler": sampler, **({"to_world": to_world} | more)}


def _two_cameras(film):
    halves = film | {"width": film["width"] // 2}
    first, second = (_on(halves, "perspective", fov=fov) for fov in (30, 50))
    return {"type": "batch", "film": film, "sampler": first["sampler"], "first": first, "second": second}


def _in_front_of(x):
    return mi.ScalarTransform4f().look_at([x, 0, 4], [x, 0, 0], [0, 1, 0])


# Sensors around a film; meters of a single number take a film of one pixel
SENSORS = {
    "perspective": lambda film: _on(film, "perspective", fov=45),
    "shutter": lambda film: _on(film, "perspective", fov=45, shutter_open=0.0, shutter_close=1.0),
    "thinlens": lambda film: _on(film, "thinlens", fov=45, aperture_radius=0.1, focus_distance=4.0),
    "orthographic": lambda film: _on(film, "orthographic", to_world=_in_front_of(0).scale(1.5)),
    "radiancemeter": lambda film: _on(film, "radiancemeter", to_world=_in_front_of(0.3)),
    "distant": lambda film: _on(film, "distant", to_world=_from_above(), target=[0.2, -1.0, 0.5]),
    "batch": _two_cameras,
}
ONE_PIXEL = ("radiancemeter", "distant")


def film(width=16, height=16, **more):
    """A film with a box filter."""
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **more}


PIXELS = ("luminance", "luminance_alpha", "rgb", "rgba", "xyz", "xyza")
FILMS = {
    **{f"{pixel} {component}": {"pixel_format": pixel, "component_format": component}
       for pixel in PIXELS for component in ("float16", "float32", "uint32")},
    "crop": {"crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 7, "crop_height": 4},
    "border": {"sample_border": True, "rfilter": {"type": "tent"}},
    "gaussian": {"rfilter": {"type": "gaussian"}},
}  # fmt: skip
