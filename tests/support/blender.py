"""Small scenes in the module `bpy`, Blender without a window, rendered by Cycles and by the add-on.

Imports `bpy`: no test imports this module in its own process.
"""

import sys

import bpy
import mitsuba as mi
import numpy as np

from .paths import ROOT

sys.path.append(str(ROOT / "blender"))
import manylights_blender

SIZE, SPP = 32, 64


def new_scene(bounces=0, size=SIZE, spp=SPP):
    """An empty scene with a camera 4 above the origin that looks down; both engines render `spp` samples."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if not hasattr(bpy.types.Scene, "manylights"):
        manylights_blender.register()
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = spp, False, False
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = bounces
    scene.cycles.transmission_bounces = bounces
    scene.cycles.sample_clamp_indirect, scene.cycles.blur_glossy = 0, 0
    ours = scene.manylights
    ours.samples, ours.use_noise_threshold, ours.use_denoising, ours.max_bounces = spp, False, False, bounces
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.image_settings.color_mode = "RGBA"
    scene.camera = add("camera", bpy.data.cameras.new("camera"), location=(0, 0, 4))
    return scene


def add(name, data, **properties):
    """Add an object with properties to the scene, and return it."""
    made = bpy.data.objects.new(name, data)
    for key, value in properties.items():
        setattr(made, key, value)
    bpy.context.scene.collection.objects.link(made)
    return made


def add_light(kind, energy=10, location=(0, 0, 2), **properties):
    """Add a light that shines down, with properties of the object (rotation, scale) and of the light."""
    light = bpy.data.lights.new(kind.lower(), kind)
    light.energy = energy
    placed = {key: properties.pop(key) for key in ("rotation_euler", "scale") if key in properties}
    for key, value in properties.items():
        setattr(light, key, value)
    return add("light", light, location=location, **placed)


def add_plane(material=None, size=20.0, **properties):
    """Add a square around the origin with texture coordinates, of a material or of Blender's grey."""
    mesh, half = bpy.data.meshes.new("plane"), size / 2
    mesh.from_pydata([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new().data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    if material:
        mesh.materials.append(material)
    return add("plane", mesh, **properties)


def add_sphere(material=None, radius=1.0, **properties):
    """Add a smooth sphere."""
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, segments=32, ring_count=16)
    sphere = bpy.context.object
    bpy.ops.object.shade_smooth()
    if material:
        sphere.data.materials.append(material)
    for key, value in properties.items():
        setattr(sphere, key, value)
    return sphere


def material(kind, **inputs):
    """A material of one shader node `ShaderNode<kind>` with values at its inputs (`Base_Color` is Base Color)."""
    made = bpy.data.materials.new(kind)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    shader, output = tree.nodes.new(f"ShaderNode{kind}"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    for name, value in inputs.items():
        shader.inputs[name.replace("_", " ")].default_value = (*value, 1) if isinstance(value, tuple) else value
    return made


def link(made, shader_input, node_kind, output=0):
    """Link a new node to an input of the first shader of a material or world, and return the node."""
    tree = made.node_tree
    node = tree.nodes.new(f"ShaderNode{node_kind}")
    tree.links.new(node.outputs[output], tree.nodes[0].inputs[shader_input])
    return node


def picture(name, pixels, is_float=False):
    """An image of Blender with pixels (height, width, 3), highest row first, in the encoding of its colour space."""
    height, width = pixels.shape[:2]
    made = bpy.data.images.new(name, width, height, float_buffer=is_float)
    made.pixels.foreach_set(np.dstack([pixels, np.ones((height, width))])[::-1].astype(np.float32).ravel())
    return made


def set_world(colour=(1, 1, 1), strength=1.0):
    """A world of one colour; returns it. The first of its nodes is the Background."""
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes.clear()
    background, output = (world.node_tree.nodes.new(f"ShaderNode{kind}") for kind in ("Background", "OutputWorld"))
    world.node_tree.links.new(background.outputs[0], output.inputs["Surface"])
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (*colour, 1), strength
    bpy.context.scene.world = world
    return world


def rendered(engine, folder):
    """Render the scene by an engine of Blender; return RGBA (height, width, 4), highest row first."""
    scene = bpy.context.scene
    scene.render.engine, scene.render.filepath = engine, str(folder / f"{engine}.exr")
    bpy.ops.render.render(write_still=True)
    return np.array(mi.Bitmap(scene.render.filepath))
