"""Building blocks of the generated scenes as XML text: those of hall.py, and further shared ones (glossy materials,
rotated slabs, emitters, skies, the command line).
"""

import argparse
from pathlib import Path

import numpy as np
import OpenEXR
from hall import ball, box, corners, numbers, spectrum

__all__ = ["ball", "box", "corners", "numbers", "spectrum"]  # re-exported from hall.py

SKY_SIZE = 128, 64  # texels of a sky, longitude by latitude

HEADER = """<!-- Made by: python scenes/{command}
     {title}; scenes/{script} says what it is for. Metres; z is up. -->
<scene version="3.0.0">
<default name="integrator" value="path"/>
<default name="max_depth" value="{depth}"/>
<default name="spp" value="64"/>
<default name="resx" value="256"/>
<default name="resy" value="192"/>
<integrator type="$integrator"><integer name="max_depth" value="$max_depth"/></integrator>
<sensor type="perspective">
<float name="fov" value="{fov}"/>
<transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 0, 1"/></transform>
<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
<film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="$resy"/>
<string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
</sensor>"""


def header(command, title, fov, origin, target, depth=2):
    """Return the head of a scene: parameters and camera. `command` generates the scene; `depth` is the default
    `max_depth`."""
    script = command.split()[0]
    return HEADER.format(
        command=command,
        script=script,
        title=title,
        fov=fov,
        origin=numbers(origin),
        target=numbers(target),
        depth=depth,
    )


def material(name, colour, gloss=None, roughness=0.2):
    """Return a two-sided material: diffuse, or with `gloss` "plastic" or "metal"."""
    if gloss is None:
        inner = f'<bsdf type="diffuse"><rgb name="reflectance" value="{numbers(colour)}"/></bsdf>'
    else:
        kind, parameter = {
            "plastic": ("roughplastic", "diffuse_reflectance"),
            "metal": ("roughconductor", "specular_reflectance"),
        }[gloss]
        inner = (
            f'<bsdf type="{kind}"><string name="distribution" value="ggx"/><float name="alpha" value="{roughness:g}"/>'
            f'<rgb name="{parameter}" value="{numbers(colour)}"/></bsdf>'
        )
    return f'<bsdf type="twosided" id="{name}">{inner}</bsdf>'


def slab(name, centre, size, axis, angle):
    """Return a cuboid rotated by `angle` degrees about the `axis` "x", "y" or "z" through its centre; `box` rotates
    only about vertical axes."""
    return (
        f'<shape type="cube"><transform name="to_world"><scale value="{numbers(np.asarray(size) / 2)}"/>'
        f'<rotate {axis}="1" angle="{angle:.4g}"/><translate value="{numbers(centre)}"/></transform>'
        f'<ref id="{name}"/></shape>'
    )


def tube(name, start, end, radius):
    """Return a cylinder without caps."""
    return (
        f'<shape type="cylinder"><point name="p0" value="{numbers(start)}"/><point name="p1" value="{numbers(end)}"/>'
        f'<float name="radius" value="{radius:g}"/><ref id="{name}"/></shape>'
    )


def drum(name, base, radius, height):
    """Yield a vertical cylinder with a lid, standing on the point `base`."""
    x, y, z = base
    yield tube(name, base, (x, y, z + height), radius)
    yield flat("disk", name, (x, y, z + height), (0, 0, 1), (radius, radius))


def flat(kind, name, centre, facing, half, emitter=""):
    """Return a "rectangle" or "disk" with half-sizes `half` and normal `facing`, optionally with an emitter. The first
    half-size is horizontal for a vertical shape, and along x for a horizontal shape."""
    centre, facing = np.asarray(centre, float), np.asarray(facing, float)
    # The up vector of `lookat`, which becomes the y axis of the shape, must not be parallel to its direction
    up = "0, 0, 1" if abs(facing[2]) < 0.9 * np.linalg.norm(facing) else "0, 1, 0"
    return (
        f'<shape type="{kind}"><transform name="to_world"><scale x="{half[0]:.3g}" y="{half[1]:.3g}"/>'
        f'<lookat origin="{numbers(centre)}" target="{numbers(centre + facing)}" up="{up}"/></transform>'
        f'<ref id="{name}"/>{emitter}</shape>'
    )


def glow(radiance, colour, random):
    """Return an area emitter with a random radiance around `radiance`, as a child of a shape."""
    return f'<emitter type="area">{spectrum("radiance", radiance, colour, random)}</emitter>'


def bulb(position, intensity, colour, random):
    """Return a point emitter with a random intensity around `intensity`."""
    return (
        f'<emitter type="point"><point name="position" value="{numbers(position)}"/>'
        f"{spectrum('intensity', intensity, colour, random)}</emitter>"
    )


def sky(file):
    """Return an environment map rotated to z-up."""
    return (
        f'<emitter type="envmap"><string name="filename" value="{file}"/>'
        '<transform name="to_world"><rotate x="1" angle="90"/></transform></emitter>'
    )


def sky_image(zenith, horizon, ground, sun, direction, width, halo):
    """Return the texels of a sky: a gradient from `horizon` to `zenith`, `ground` below, and a soft `sun` of this
    radiance around `direction`, `width` degrees wide, with a halo of `halo` times the radiance."""
    columns, rows = SKY_SIZE
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    polar = (np.arange(rows)[:, None] + 0.5) / rows * np.pi
    # With the rotation of `sky`, longitude 0 is +y and longitude 90° is +x
    directions = np.stack(
        [np.sin(polar) * np.sin(azimuth), np.sin(polar) * np.cos(azimuth), np.cos(polar) + 0 * azimuth], axis=-1
    )
    height = directions[..., 2:]
    image = np.asarray(horizon) + (np.asarray(zenith) - horizon) * np.clip(height, 0, 1) ** 0.5
    image = np.where(height < 0, np.asarray(ground, float), image)
    away = np.degrees(np.arccos(np.clip(directions @ (np.asarray(direction) / np.linalg.norm(direction)), -1, 1)))
    disc = np.exp(-((2 * away / width) ** 2)) + halo * np.exp(-((away / (6 * width)) ** 2))
    return image + np.asarray(sun) * disc[..., None] * (height >= 0)


def write_image(path, image):
    """Write an OpenEXR image in half precision."""
    attributes = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(attributes, {"RGB": np.ascontiguousarray(image, np.float16)}) as file:
        file.write(str(path))


def write_mesh(path, triangles):
    """Write a binary PLY file; triangles share no vertices and so are flat-shaded."""
    vertices = np.round(triangles.reshape(-1, 3), 3).astype("<f4")
    faces = np.empty(len(triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, np.arange(len(vertices)).reshape(-1, 3)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head.encode() + vertices.tobytes() + faces.tobytes())


def downlight(position, cutoff, intensity, colour, random):
    """Return a spot emitter pointing straight down, with a random intensity around `intensity`."""
    below = numbers(np.subtract(position, (0, 0, 1)))
    return (
        f'<emitter type="spot"><transform name="to_world"><lookat origin="{numbers(position)}" target="{below}" '
        f'up="1, 0, 0"/></transform><float name="cutoff_angle" value="{cutoff:g}"/>'
        f"{spectrum('intensity', intensity, colour, random)}</emitter>"
    )


def write_scene(document, name, make, images=None, arguments=None, counts=None, meshes=None):
    """Run the command line of a generator: write `make(seed, **counts)` to the output (default: `name`.xml), and
    textures `images` (name -> texels) and `meshes` (name -> triangles) beside it. Each entry of `counts` (name ->
    default) becomes an option."""
    command_line = parser(document, f"{name}.xml")
    for what, usual in (counts or {}).items():
        command_line.add_argument(f"--{what}", type=int, default=usual, help=f"number of {what} (default: {usual})")
    options = command_line.parse_args(arguments)
    output = options.output or Path(f"{name}.xml")
    given = {what: getattr(options, what) for what in counts or {}}
    try:
        for what, number in given.items():
            if number < 0:
                raise ValueError(f"the number of {what} must not be negative, got {number}")
        output.write_text(make(options.seed, **given))
        for file, texels in (images or {}).items():
            write_image(output.parent / file, texels)
        for file, triangles in (meshes or {}).items():
            write_mesh(output.parent / file, triangles)
    except (ValueError, OSError) as error:
        command_line.exit(2, f"{name}: {error}\n")


def parser(document, name):
    """Return an argument parser with the options common to all generators; `document` is the script's docstring."""
    parsed = argparse.ArgumentParser(description=document.split("\n")[0])
    parsed.add_argument("--seed", type=int, default=1, help="seed of random variations (default: 1)")
    parsed.add_argument("--output", type=Path, help=f"output file (default: {name}); further files go to its folder")
    return parsed
