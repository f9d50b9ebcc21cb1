"""Building blocks of the generated scenes, as XML text: what hall.py has, and what the other generators share
beyond it (glossy materials, turned slabs, emitters, skies, the command line).
"""

import argparse
from pathlib import Path

import numpy as np
import OpenEXR
from hall import ball, box, corners, numbers, spectrum

__all__ = ["ball", "box", "corners", "numbers", "spectrum"]  # hall.py's, for those who import from here

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
    """Return the opening of a scene: the scene parameters and the camera. `command` is the line that makes it, `depth`
    the usual `max_depth`."""
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
    """Return a two-sided material: diffuse, or with the `gloss` of "plastic" or "metal"."""
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
    """Return a cuboid of the given size, turned by `angle` degrees about the `axis` "x", "y" or "z" through its
    centre: unlike hall.py's boxes, it may lean."""
    return (
        f'<shape type="cube"><transform name="to_world"><scale value="{numbers(np.asarray(size) / 2)}"/>'
        f'<rotate {axis}="1" angle="{angle:.4g}"/><translate value="{numbers(centre)}"/></transform>'
        f'<ref id="{name}"/></shape>'
    )


def tube(name, start, end, radius):
    """Return a cylinder without lids."""
    return (
        f'<shape type="cylinder"><point name="p0" value="{numbers(start)}"/><point name="p1" value="{numbers(end)}"/>'
        f'<float name="radius" value="{radius:g}"/><ref id="{name}"/></shape>'
    )


def drum(name, base, radius, height):
    """Return an upright cylinder with a lid, standing on the point `base`."""
    x, y, z = base
    yield tube(name, base, (x, y, z + height), radius)
    yield flat("disk", name, (x, y, z + height), (0, 0, 1), (radius, radius))


def flat(kind, name, centre, facing, half, emitter=""):
    """Return a "rectangle" or a "disk" of half-sizes `half` that faces the direction `facing`, with an emitter if
    given. The first half-size is the horizontal one of an upright shape, the one along x of a lying one."""
    centre, facing = np.asarray(centre, float), np.asarray(facing, float)
    # Mitsuba's lookat needs an up vector of another direction; the shape's own y axis follows it.
    up = "0, 0, 1" if abs(facing[2]) < 0.9 * np.linalg.norm(facing) else "0, 1, 0"
    return (
        f'<shape type="{kind}"><transform name="to_world"><scale x="{half[0]:.3g}" y="{half[1]:.3g}"/>'
        f'<lookat origin="{numbers(centre)}" target="{numbers(centre + facing)}" up="{up}"/></transform>'
        f'<ref id="{name}"/>{emitter}</shape>'
    )


def glow(radiance, colour, random):
    """Return an area emitter whose strength varies about `radiance`, to be put into a shape."""
    return f'<emitter type="area">{spectrum("radiance", radiance, colour, random)}</emitter>'


def bulb(position, intensity, colour, random):
    """Return a point light whose strength varies about `intensity`."""
    return (
        f'<emitter type="point"><point name="position" value="{numbers(position)}"/>'
        f"{spectrum('intensity', intensity, colour, random)}</emitter>"
    )


def sky(file):
    """Return an environment map that is upright where z is up."""
    return (
        f'<emitter type="envmap"><string name="filename" value="{file}"/>'
        '<transform name="to_world"><rotate x="1" angle="90"/></transform></emitter>'
    )


def sky_image(zenith, horizon, ground, sun, direction, width, halo):
    """Return the texels of a sky: a gradient from `horizon` to `zenith`, `ground` below, and a soft `sun` of that
    radiance about `direction`, `width` degrees across, in a faint halo of `halo` times the radiance."""
    columns, rows = SKY_SIZE
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    polar = (np.arange(rows)[:, None] + 0.5) / rows * np.pi
    # As `sky` turns it: longitude 0 is +y, a quarter further is +x.
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


def downlight(position, cutoff, intensity, colour, random):
    """Return a spot that shines straight down, whose strength varies about `intensity`."""
    below = numbers(np.subtract(position, (0, 0, 1)))
    return (
        f'<emitter type="spot"><transform name="to_world"><lookat origin="{numbers(position)}" target="{below}" '
        f'up="1, 0, 0"/></transform><float name="cutoff_angle" value="{cutoff:g}"/>'
        f"{spectrum('intensity', intensity, colour, random)}</emitter>"
    )


def write_scene(document, name, make, images=None, arguments=None, counts=None):
    """The command line of a generator: write `make(seed, **counts)` to the output, which is `name`.xml by default, and
    the textures of `images` (name: texels) beside it. Each of the `counts` (name: usual number) is an option."""
    command_line = parser(document, f"{name}.xml")
    for what, usual in (counts or {}).items():
        command_line.add_argument(f"--{what}", type=int, default=usual, help=f"how many (default: {usual})")
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
    except (ValueError, OSError) as error:
        command_line.exit(2, f"{name}: {error}\n")


def parser(document, name):
    """Return a command line with the options that all generators have; `document` is the script's docstring."""
    parsed = argparse.ArgumentParser(description=document.split("\n")[0])
    parsed.add_argument("--seed", type=int, default=1, help="seed of what varies by chance (default: 1)")
    parsed.add_argument("--output", type=Path, help=f"file to write (default: {name}); others land in its folder")
    return parsed
