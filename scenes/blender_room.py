"""Generate a room in the format of Blender's Mitsuba add-on, without Blender.

Purpose: scenes exported from Blender, with principled materials, texture files, PLY meshes (one split by material), a
sun, an area lamp, a glowing mesh, a world sky, and a camera matrix. Names, Blender's defaults and the conversion from
z-up to y-up follow the add-on, which also passes a dictionary to Mitsuba's XML writer.

    ./run -- python scenes/blender_room.py --output scenes/blender_room.xml
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from elements import sky_image, write_image

SIZE, WINDOW = (4.0, 5.0, 2.6), ((1.6, 0.9), (3.6, 2.2))  # metres; window corners (y, z) in the wall x = 4
TEXELS = 128
# Axes of Blender: z up, cameras and lamps along -z; axes of Mitsuba: y up, cameras along z
AXES = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
ABOUT_Y, ABOUT_X = np.diag([-1.0, 1, -1, 1]), np.diag([1.0, -1, -1, 1])
WORLD = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)


class Faces:
    """Quadrilaterals of a mesh in Blender's coordinates, with texture coordinates in metres."""

    def __init__(self):
        self.positions, self.coordinates = [], []

    def quad(self, corner, along, up):
        """Add a parallelogram with normal `along` × `up`."""
        corner, along, up = (np.asarray(vector, float) for vector in (corner, along, up))
        self.positions += [corner, corner + along, corner + along + up, corner + up]
        a, b = np.linalg.norm(along), np.linalg.norm(up)
        self.coordinates += [(0, 0), (a, 0), (a, b), (0, b)]
        return self

    def block(self, low, high):
        """Add the six faces of a cuboid."""
        low = np.asarray(low, float)
        x, y, z = np.diag(np.subtract(high, low))
        for corner, along, up in ((low, y, x), (low, z, y), (low, x, z)):
            self.quad(corner, along, up)
            self.quad(corner + (x + y + z - along - up), up, along)
        return self

    def mesh(self, name):
        """Return the flat-shaded mesh."""
        quads = np.arange(len(self.positions)).reshape(-1, 4)
        return mesh(name, self.positions, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), self.coordinates)


def mesh(name, positions, faces, coordinates=None, normals=None):
    """Return a Mitsuba mesh from Blender coordinates: (n, 3), indices (m, 3), (n, 2), (n, 3)."""
    made = mi.Mesh(
        name, len(positions), len(faces), has_vertex_normals=normals is not None,
        has_vertex_texcoords=coordinates is not None,
    )  # fmt: skip
    parameters = mi.traverse(made)
    values = {"vertex_positions": np.asarray(positions) @ AXES[:3, :3].T, "faces": faces}
    if coordinates is not None:
        values["vertex_texcoords"] = coordinates
    if normals is not None:
        values["vertex_normals"] = np.asarray(normals) @ AXES[:3, :3].T
    for key, value in values.items():
        parameters[key] = type(parameters[key])(np.ravel(value).tolist())
    parameters.update()
    return made


def ball(name, centre, radius, rings=16, segments=32):
    """Return a smooth-shaded UV sphere."""
    polar = np.linspace(0, np.pi, rings + 1)[:, None]
    azimuth = np.linspace(0, 2 * np.pi, segments + 1)
    normals = np.stack(np.broadcast_arrays(
        np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)
    ), axis=-1).reshape(-1, 3)  # fmt: skip
    ring, segment = (index.ravel() for index in np.mgrid[:rings, :segments])
    a = ring * (segments + 1) + segment
    b = a + segments + 1
    faces = np.concatenate([np.stack([a, b, b + 1], 1)[ring < rings - 1], np.stack([a, b + 1, a + 1], 1)[ring > 0]])
    faces = np.concatenate([faces, np.stack([a, b, a + 1], 1)[ring == rings - 1]])
    return mesh(name, centre + radius * normals, faces, None, normals)


def room():
    """Return the room in two parts by material: walls with ceiling, and floor."""
    x, y, z = SIZE
    (y0, z0), (y1, z1) = WINDOW
    walls = Faces()
    walls.quad((0, 0, z), (0, y, 0), (x, 0, 0))
    walls.quad((0, 0, 0), (0, y, 0), (0, 0, z)).quad((x, 0, 0), (-x, 0, 0), (0, 0, z))
    walls.quad((0, y, 0), (x, 0, 0), (0, 0, z))
    for low, high in (((0, 0), (y0, z)), ((y1, 0), (y, z)), ((y0, 0), (y1, z0)), ((y0, z1), (y1, z))):
        walls.quad((x, high[0], low[1]), (0, low[0] - high[0], 0), (0, 0, high[1] - low[1]))
    return walls, Faces().quad((0, 0, 0), (x, 0, 0), (0, y, 0))


def table():
    """Return a table: top and four legs."""
    top = Faces().block((1.2, 3.0, 0.7), (2.8, 4.0, 0.75))
    for corner in ((1.25, 3.05), (2.69, 3.05), (1.25, 3.89), (2.69, 3.89)):
        top.block((*corner, 0), (*np.add(corner, 0.06), 0.7))
    return top


def planks(random):
    """Return the colour and roughness texels, in [0, 1], of a plank floor."""
    row, column = np.mgrid[:TEXELS, :TEXELS]
    plank = column // 16
    tone = random.uniform(0.7, 1.0, TEXELS // 16)[plank] * (1 + 0.1 * np.sin(row / 3 + 7 * plank))
    gap = np.where(column % 16 == 0, 0.4, 1.0)
    colour = np.clip((tone * gap)[..., None] * (0.62, 0.42, 0.27), 0, 1)
    return colour, np.clip(0.25 + 0.3 * (1 - tone * gap), 0.1, 1)


def write_png(path, texels):
    """Write numbers in [0, 1] as bytes without colour conversion."""
    mi.Bitmap(np.uint8(np.round(texels * 255))).write(str(path))


def rgb(*value):
    return {"type": "rgb", "value": list(map(float, value))}


def bitmap(file, **more):
    return {"type": "bitmap", "filename": f"textures/{file}", **more}


def principled(base_color, roughness=0.5, metallic=0.0, specular=0.5, clearcoat=0.0):
    """Return the add-on's translation of Blender's principled node, two-sided."""
    return {"type": "twosided", "bsdf": {
        "type": "principled", "base_color": base_color, "spec_tint": 0.0, "spec_trans": 0.0, "metallic": metallic,
        "anisotropic": 0.0, "roughness": roughness, "sheen": 0.0, "sheen_tint": 0.5, "clearcoat": clearcoat,
        "clearcoat_gloss": 0.03, "specular": specular,
    }}  # fmt: skip


MATERIALS = {
    "mat-Plaster": principled(rgb(0.8, 0.77, 0.72), 0.9, specular=0.2),
    "mat-Floor": principled(bitmap("planks.png"), bitmap("planks_roughness.png", raw=True)),
    "mat-Oak": principled(rgb(0.45, 0.27, 0.14), 0.4, clearcoat=0.3),
    "mat-Brass": principled(rgb(0.9, 0.68, 0.35), 0.3, metallic=1.0),
    "mat-Glaze_001": principled(rgb(0.12, 0.3, 0.5), 0.15),
    "mat-Glass": {"type": "dielectric", "int_ior": 1.45, "specular_transmittance": rgb(1, 1, 1)},
    "empty-emitter-bsdf": {"type": "diffuse", "reflectance": rgb(0, 0, 0)},
}


def transform(matrix):
    """Convert a Blender matrix to a Mitsuba transform."""
    return mi.ScalarTransform4f(AXES @ matrix)


def placed(origin, target):
    """Return Blender's matrix of an object at `origin` whose -z axis points to `target`, both (3,)."""
    back = np.subtract(origin, target) / np.linalg.norm(np.subtract(origin, target))
    right = np.cross((0, 0, 1), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, origin], axis=1)
    return matrix


def lights():
    """Yield world, sun and area lamp as converted by the add-on."""
    yield {"type": "envmap", "filename": "textures/sky.exr", "scale": 1.0, "to_world": transform(WORLD)}
    sun = placed((9.0, 1.0, 6.5), (1.6, 2.6, 0.0))
    yield {"type": "directional", "irradiance": rgb(12, 10.8, 9), "to_world": transform(sun @ ABOUT_X)}
    size, watts = (0.9, 0.3), 40.0
    lamp = placed((0.9, 1.0, 2.5), (1.3, 2.0, 0.7)) @ np.diag([size[0] / 2, size[1] / 2, 0.5, 1])
    radiance = watts / (4 * size[0] * size[1])
    yield {
        "type": "rectangle", "flip_normals": True, "to_world": transform(lamp),
        "emitter": {"type": "area", "radiance": rgb(radiance, 0.9 * radiance, 0.7 * radiance)},
        "bsdf": {"type": "null"},
    }  # fmt: skip


def camera():
    """Return a Blender camera with a focal length of 28 mm."""
    return {
        "type": "perspective", "fov_axis": "x", "fov": float(np.degrees(2 * np.arctan(18 / 28))),
        "principal_point_offset_x": 0.0, "principal_point_offset_y": -0.0, "near_clip": 0.1, "far_clip": 100.0,
        "to_world": transform(placed((0.5, 0.3, 1.5), (2.4, 3.6, 0.75)) @ ABOUT_Y),
        "sampler": {"type": "independent", "sample_count": 64},
        "film": {"type": "hdrfilm", "width": 256, "height": 192, "rfilter": {"type": "gaussian", "stddev": 0.5}},
    }  # fmt: skip


def shapes():
    """Yield (name, mesh, material, emitter or None) of each mesh."""
    walls, floor = room()
    lantern = {"type": "area", "radiance": rgb(9, 5.4, 2.4)}
    yield "Room-Plaster", walls.mesh("Room-Plaster"), "mat-Plaster", None
    yield "Room-Floor", floor.mesh("Room-Floor"), "mat-Floor", None
    yield "Table", table().mesh("Table"), "mat-Oak", None
    yield "Bowl", ball("Bowl", (2.3, 3.3, 0.9), 0.15), "mat-Glaze_001", None
    yield "Marble", ball("Marble", (1.75, 3.2, 0.85), 0.1), "mat-Glass", None
    yield "Globe", ball("Globe", (0.9, 4.3, 0.35), 0.35), "mat-Brass", None
    yield "Lantern", ball("Lantern", (1.5, 3.7, 0.87), 0.12, 8, 16), "empty-emitter-bsdf", lantern


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="seed of the floor's planks (default: 1)")
    parser.add_argument("--output", type=Path, default=Path("blender_room.xml"), help="output file; meshes and "
                        "textures go to folders beside it (default: blender_room.xml)")  # fmt: skip
    options = parser.parse_args(arguments)
    folder = options.output.parent
    for name in ("meshes", "textures"):
        (folder / name).mkdir(exist_ok=True)
    colour, roughness = planks(np.random.default_rng(options.seed))
    write_png(folder / "textures/planks.png", colour)
    write_png(folder / "textures/planks_roughness.png", roughness)
    sky = sky_image((0.35, 0.6, 1.1), (0.9, 1.0, 1.1), (0.2, 0.18, 0.15), (0, 0, 0), (0, 0, 1), 1, 0)
    write_image(folder / "textures/sky.exr", sky)

    world, *lamps = lights()
    plugins = [{"type": "path", "max_depth": 12}, world, *lamps, camera()]
    for name, one, material, emitter in shapes():
        one.write_ply(str(folder / f"meshes/{name}.ply"))
        shape = {"type": "ply", "filename": f"meshes/{name}.ply"}
        shape |= {} if one.has_vertex_normals() else {"face_normals": True}
        shape |= {"bsdf": {"type": "ref", "id": material}}
        plugins.append(shape | ({"emitter": emitter} if emitter else {}))
    scene = {"type": "scene", **MATERIALS, **{f"elm__{number}": plugin for number, plugin in enumerate(plugins)}}
    state = mi.parser.parse_dict(config := mi.parser.ParserConfig(mi.variant()), scene)
    mi.parser.transform_reorder(config, state)
    mi.parser.write_file(state, str(options.output), True)


if __name__ == "__main__":
    mi.set_variant("scalar_rgb")
    main()
