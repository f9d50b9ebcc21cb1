"""Blender's world, and suns with a disc, as Mitsuba's environment emitter.

In Blender's equirectangular images, rows go from +Z down, and columns from −X by way of +Y to +X and −Y. Row i of n is
at the polar angle π (i + ½) / n in Blender and π i / (n − 1) in Mitsuba: an image of the world is up to half a row off.
"""

import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from .textures import MISSING, rgb, source

# From Mitsuba's environment map, whose pole is +Y, to Blender's equirectangular images, whose pole is +Z
AXES = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
DISC_PIXELS = 2  # fewest pixels of the radius of a sun's disc in the environment map


@dataclass
class Sky:
    """Radiance from infinity: `colour` (3) times the `image` (h, w, 3) float32, highest row first, or alone if `image`
    is None. `rotation` (3, 3): from the directions of the image to those of the world."""

    colour: np.ndarray
    image: np.ndarray | None = None
    rotation: np.ndarray = None

    def emitter(self):
        """Dictionary of the emitter of Mitsuba, None if it is black."""
        if not self.colour.any():
            return None
        if self.image is None:
            return {"type": "constant", "radiance": rgb(self.colour)}
        to_world = np.eye(4)
        to_world[:3, :3] = self.rotation
        pixels = np.ascontiguousarray(self.image * self.colour, np.float32)
        return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f(to_world @ AXES)}

    def with_suns(self, suns):
        """Return a `Sky` that also has the discs of suns (`lights.Sun`)."""
        if not suns:
            return self
        width = math.ceil(2 * math.pi * DISC_PIXELS / (min(sun.angle for sun in suns) / 2))
        width = max(width, self.image.shape[1] if self.image is not None else 0)
        towards, solid_angles = _directions(width)
        image = self._at(towards) * self.colour
        for sun in suns:
            image += _disc(sun, towards, solid_angles, width)
        return Sky(np.ones(3), np.float32(image), np.eye(3))

    def _at(self, towards):
        """Values of the image in directions (h, w, 3) of the world, linear between pixels; 1 without image."""
        if self.image is None:
            return np.ones((*towards.shape[:2], 3), np.float32)
        x, y, z = np.moveaxis(towards @ self.rotation, -1, 0)
        height, width = self.image.shape[:2]
        column = (0.5 - np.arctan2(y, x) / (2 * math.pi)) * width - 0.5
        row = np.clip(np.arccos(np.clip(z, -1, 1)) / math.pi * height - 0.5, 0, height - 1)
        left, top = np.floor(column).astype(int), np.minimum(np.floor(row).astype(int), height - 2)
        a, b = (column - left)[..., None], (row - top)[..., None]
        upper, lower = (
            self.image[one, left % width] * (1 - a) + self.image[one, (left + 1) % width] * a for one in (top, top + 1)
        )
        return upper * (1 - b) + lower * b


def _directions(width):
    """Directions of the pixels of Mitsuba's environment map (width / 2 + 1, width, 3), and their solid angles
    (width / 2 + 1, 1). The first and the last row are at the poles, and values between pixels are linear."""
    step = math.pi / math.ceil(width / 2)
    azimuth = 2 * math.pi * (0.5 - (np.arange(width) + 0.5) / width)
    polar = step * np.arange(math.ceil(width / 2) + 1)[:, None]
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    towards = np.stack([x, y, np.broadcast_to(np.cos(polar), x.shape)], axis=-1)
    heights = np.sin(polar) * 2 * (1 - math.cos(step)) / step  # integral of a row's linear weight times the sine
    heights[[0, -1]] = 1 - math.sin(step) / step
    return towards, 2 * math.pi / width * heights


def _disc(sun, towards, solid_angles, width):
    """Radiance (h, w, 3) of a sun, scaled so that a surface that faces it receives exactly its irradiance."""
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(towards - sun.towards, axis=-1) / 2, 1))
    coverage = np.clip((sun.angle / 2 - angle) * width / (2 * math.pi) + 0.5, 0, 1)
    received = (coverage * solid_angles * np.maximum(np.cos(angle), 0)).sum()
    return coverage[..., None] * sun.strength / received


def read(world, textures):
    """Return the `Sky` of a world of Blender, black without a world."""
    if world is None:
        return Sky(np.zeros(3))
    if not world.use_nodes or world.node_tree is None:
        return Sky(np.array(world.color))
    output = world.node_tree.get_output_node("ALL") or world.node_tree.get_output_node("CYCLES")
    if output is None:
        return Sky(np.zeros(3))
    if output.inputs["Volume"].is_linked:
        textures.problems.add(world, "'Volume' is not exported")
    node, _ = source(output.inputs["Surface"])
    if node is None:
        return Sky(np.zeros(3))
    if node.bl_idname != "ShaderNodeBackground":
        textures.problems.add(world, f"shader '{node.name}' is not exported; the world becomes black")
        return Sky(np.zeros(3))
    strength = textures.constant(world, node.inputs["Strength"])
    image_node, _ = source(node.inputs["Color"])
    if image_node is not None and image_node.bl_idname == "ShaderNodeTexEnvironment":
        return _environment(world, image_node, textures, strength)
    return Sky(textures.constant(world, node.inputs["Color"]) * strength)


def _environment(world, node, textures, strength):
    if node.projection != "EQUIRECTANGULAR":
        textures.problems.add(world, f"projection '{node.projection}' of node '{node.name}' is not exported")
    pixels = textures.pixels(world, node.image)
    if pixels is None:
        return Sky(np.array(MISSING) * strength)
    return Sky(np.full(3, strength), pixels[::-1, :, :3], _rotation(world, node.inputs["Vector"], textures))


def _rotation(world, socket, textures):
    """Rotation (3, 3) from directions of the image to the world, of a Mapping node that only rotates."""
    node, output = source(socket)
    if node is None or (node.bl_idname == "ShaderNodeTexCoord" and output.name == "Generated"):
        return np.eye(3)
    if node.bl_idname == "ShaderNodeMapping" and node.vector_type in ("POINT", "VECTOR", "TEXTURE"):
        below = _rotation(world, node.inputs["Vector"], textures)
        rotation, scale = node.inputs["Rotation"].default_value, node.inputs["Scale"].default_value
        moved = node.vector_type != "VECTOR" and any(node.inputs["Location"].default_value)
        if list(scale) != [1, 1, 1] or moved:
            textures.problems.add(world, f"'Location' and 'Scale' of node '{node.name}' are not exported")
        matrix = np.array(rotation.to_matrix())
        return below @ (matrix if node.vector_type == "TEXTURE" else matrix.T)
    textures.problems.add(world, f"texture coordinates from node '{node.name}' are not exported")
    return np.eye(3)
