"""Rooms with unusual emitters or materials."""

import math

import mitsuba as mi
import numpy as np

from tests.support.scenes import area_light, closed_box, rgb, sensor, wall
from vpl.core.arrays import upload


def lamp_behind_the_camera():
    """A square lamp that the camera of the closed box does not see: it would be most of the noise."""
    transform = mi.ScalarTransform4f().translate([0, 0.9, 0.6]).rotate([1, 0, 0], 90).scale(0.3)
    return {"light": {"type": "rectangle", "to_world": transform, "emitter": {"type": "area", "radiance": rgb(4.0)}}}


def bulb():
    return {"bulb": {"type": "point", "position": [0.3, 0.4, 0.6], "intensity": rgb(1.0)}}


def glowing_octahedron(flip=False):
    """A glowing mesh with the normals of a ball: near the outline, visible faces shine away from the camera."""
    emitter = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": 4.0}})
    return {"lamp": smooth_octahedron(emitter, [0, 0.1, 0], flip)}


def smooth_octahedron(of_surface, place, flip=False, size=0.4):
    """A mesh at a ``place`` with the normals of a ball; ``of_surface``: emitter or material."""
    props = mi.Properties()
    props["of_surface"], props["flip_normals"] = of_surface, flip
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[x, y, z] if np.linalg.det(corners[[x, y, z]]) > 0 else [x, z, y]
             for x in (0, 3) for y in (1, 4) for z in (2, 5)]  # fmt: skip
    mesh = mi.Mesh("octahedron", len(corners), len(faces), props, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    turned = corners @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    parameters["vertex_positions"] = upload(mi.Float, size * turned + place)
    parameters["vertex_normals"] = upload(mi.Float, turned)
    parameters["faces"] = upload(mi.UInt32, np.array(faces))
    parameters.update()
    return mesh


def veiled_room(veils=4, lamp=None):
    """A room divided by masks; without a lamp, its back wall shines."""
    box = closed_box(lamp or {}, 16)
    if lamp is None:
        box["back"]["emitter"] = {"type": "area", "radiance": rgb(1.0)}
    for k in range(veils):
        mask = {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}}
        box[f"veil{k}"] = wall([0, 0, -0.6 + 0.1 * k], [0, 1, 0], 0, 1.0, bsdf=mask)
    return box


def sunny(shape=(250, 500), sun=(80, 123), level=1e5, turn=0.0):
    """A grey sky with a sun of one texel."""
    pixels = np.full((*shape, 3), 0.2, np.float32)
    pixels[sun] = level
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], turn).rotate([0, 0, 1], turn / 3)
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": turned}}


GLOSSY = {"type": "roughconductor", "alpha": 0.2, "distribution": "ggx"}


COATED = {"type": "roughplastic", "alpha": 0.15, "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}}


def many_kinds():
    """A closed box with point, spot and area emitters, a directional one that cannot get in, and glossy things."""
    rng = np.random.default_rng(0)
    lights = {"lamp": area_light(), "sun": {"type": "directional", "direction": [0, -1, 0]}}
    for k in range(12):
        x, y, z = map(float, rng.uniform(-0.8, 0.8, 3))
        color = {"type": "rgb", "value": list(map(float, rng.uniform(0, 0.3, 3)))}
        lights[f"point{k}"] = {"type": "point", "position": [x, y, z], "intensity": color}
        aim = mi.ScalarTransform4f().look_at([x, y, z], [z, x, y], [0, 0, 1])
        lights[f"spot{k}"] = {"type": "spot", "to_world": aim, "intensity": color, "cutoff_angle": 20.0 + 3 * k}
    return closed_box(
        lights,
        ball={"type": "sphere", "radius": 0.3, "center": [0.3, -0.7, -0.3], "bsdf": GLOSSY},
        panel=wall([-0.5, -0.4, -0.6], [0, 1, 0], 30, 0.4, bsdf=COATED),
    )


def glossy_room():
    """Of ``many_kinds()`` the camera sees little that is glossy: here two walls are as well."""
    scene = many_kinds()
    scene["floor"]["bsdf"], scene["left"]["bsdf"] = GLOSSY, COATED
    return mi.load_dict(scene)


ODD_SCENES = {
    "no emitters": lambda: closed_box({}),
    "no geometry": lambda: {"type": "scene", "sensor": sensor(), "sky": {"type": "constant"}},
    "nothing at all": lambda: {"type": "scene", "sensor": sensor()},
    "camera sees nothing": lambda: {
        "type": "scene", "sensor": sensor(), "ball": {"type": "sphere", "center": [0, 0, 90]}, "bulb": {"type": "point"}
    },
    "zero-power lights": lambda: closed_box(
        {"lamp": area_light(radiance=[0, 0, 0]), "bulb": {"type": "point", "intensity": 0.0}}
    ),
    "light in a closed box": lambda: closed_box(
        {"case": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.2)}, "bulb": {"type": "point"}}
    ),
    "NaN light": lambda: closed_box(
        {"lamp": area_light(), "bad": {"type": "point", "intensity": {"type": "rgb", "value": [math.nan] * 3}}}
    ),
    "NaN texture": lambda: closed_box(
        {"lamp": area_light()},
        bad=wall([0, 0, -0.9], [0, 1, 0], 0, 0.5, bsdf={
            "type": "diffuse",
            "reflectance": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((2, 2, 3), np.nan, np.float32))},
        }),
    ),
}  # fmt: skip
