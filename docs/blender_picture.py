"""Render the picture of docs/blender.md: a scene made in Blender's module `bpy`, by the add-on and by Cycles.

    ./run -- pip install 'bpy==4.2.23'
    ./run -- python docs/blender_picture.py

Writes docs/blender.jpg. Both engines denoise by Open Image Denoise.
"""

import os
import sys
import tempfile
from pathlib import Path

import bpy
import mitsuba as mi
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.blender import (  # noqa: E402
    add,
    add_light,
    add_plane,
    add_sphere,
    link,
    material,
    new_scene,
    picture,
    rendered,
    set_world,
)  # fmt: skip

WIDTH, HEIGHT, SPP, BOUNCES = 400, 300, 256, 12
GAP, QUALITY = 8, 88  # pixels between both images; quality of the JPEG file
PRINCIPLED = "BsdfPrincipled"
TILES = 16  # of the floor's texture, on each side


def tiles():
    """A floor with an image texture of tiles, of which one row and one column have another colour."""
    pixels = np.where((np.indices((TILES, TILES)).sum(0) % 2)[..., None], (0.85, 0.8, 0.7), (0.35, 0.3, 0.3))
    pixels[TILES // 2], pixels[:, TILES // 2] = (0.2, 0.45, 0.5), (0.7, 0.35, 0.2)
    made = material(PRINCIPLED, Roughness=0.25)
    node = link(made, "Base Color", "TexImage")
    node.image, node.interpolation = picture("tiles", np.repeat(np.repeat(pixels, 16, 0), 16, 1)), "Closest"
    add_plane(made, size=8)


def objects():
    """Balls and a monkey of principled materials."""
    gold = material(PRINCIPLED, Base_Color=(1, 0.7, 0.3), Metallic=1.0, Roughness=0.15)
    glass = material(PRINCIPLED, Base_Color=(0.95, 1, 0.97), Transmission_Weight=1.0, Roughness=0.0)
    red = material(PRINCIPLED, Base_Color=(0.7, 0.06, 0.05), Roughness=0.3)
    blue = material(PRINCIPLED, Base_Color=(0.1, 0.2, 0.6), Roughness=0.7)
    for made, place in ((gold, (-1.1, 0.4, 0.5)), (glass, (-0.2, -0.9, 0.5)), (red, (1.2, 1.5, 0.5))):
        add_sphere(made, radius=0.5, location=place)
    bpy.ops.mesh.primitive_monkey_add(size=1.3, location=(0.7, -0.1, 0.55), rotation=(-0.6, 0, -0.3))
    monkey = bpy.context.object
    monkey.modifiers.new("smooth", "SUBSURF").render_levels = 2
    bpy.ops.object.shade_smooth()
    monkey.data.materials.append(blue)


def build():
    """A scene with a sun, an area light, a blue world and a camera with depth of field."""
    scene = new_scene(BOUNCES, spp=SPP)
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.cycles.use_denoising = scene.manylights.use_denoising = True
    tiles()
    objects()
    set_world((0.35, 0.5, 0.8), 0.5)
    add_light("SUN", 2.5, angle=0.05, rotation_euler=(0.7, 0.2, 0.6))
    add_light("AREA", 80, location=(-2.5, -1.5, 2.5), size=1, rotation_euler=(0.6, -0.6, 0))
    camera = scene.camera
    camera.location, camera.rotation_euler = (0, -5.2, 2.3), (1.2, 0, 0)
    camera.data.lens = 50
    camera.data.dof.use_dof, camera.data.dof.aperture_fstop = True, 0.4
    camera.data.dof.focus_object = add("focus", None, location=(0, -0.6, 0.5))


def main():
    """Render and write the picture."""
    mi.set_variant("llvm_ad_rgb")
    build()
    with tempfile.TemporaryDirectory() as folder:
        images = [rendered(engine, Path(folder))[..., :3] for engine in ("MANYLIGHTS", "CYCLES")]
    gap = np.ones((HEIGHT, GAP, 3), np.float32)
    both = mi.Bitmap(np.concatenate([images[0], gap, images[1]], axis=1))
    both = both.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    both.write(str(ROOT / "docs" / "blender.jpg"), mi.Bitmap.FileFormat.JPEG, QUALITY)
    print("means by the add-on and by Cycles:", *(image.mean((0, 1)) for image in images))


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # bpy may crash while Python ends
