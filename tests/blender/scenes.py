"""The scenes of cases.py: functions that build the current scene of Blender, by name in `CASES`."""

import math

import bpy
import numpy as np

from tests.support.blender import (
    SPP,
    add,
    add_light,
    add_plane,
    add_sphere,
    link,
    manylights_blender,
    material,
    new_scene,
    picture,
    set_world,
)  # fmt: skip

CASES = {}
Progress = manylights_blender.engine.Progress
COLOUR = (0.6, 0.3, 0.1)


def case(function):
    """Register a function that builds a scene under its name."""
    CASES[function.__name__] = function
    return function


def cases(prefix, **variants):
    """Register a function once per variant, with its properties, as `prefix_variant`."""

    def register(function):
        for name, properties in variants.items():
            CASES[f"{prefix}_{name}"] = lambda properties=properties: function(**properties)
        return function

    return register


TILTED = {"rotation_euler": (0.5, 0.3, 0)}


@cases(
    "light",
    point={"kind": "POINT", "shadow_soft_size": 0},
    point_of_a_size={"kind": "POINT", "shadow_soft_size": 0.1},
    sun={"kind": "SUN", "angle": 0, **TILTED},
    real_sun={"kind": "SUN", "angle": math.radians(0.526)},
    large_sun={"kind": "SUN", "angle": 0.3, **TILTED},
    sharp_spot={"kind": "SPOT", "spot_size": 1.0, "spot_blend": 0.0, "shadow_soft_size": 0},
    spot={"kind": "SPOT", "spot_size": 0.6, "spot_blend": 0.15, "shadow_soft_size": 0, "rotation_euler": (0.2, 0, 0)},
    soft_spot={"kind": "SPOT", "spot_size": 1.0, "spot_blend": 1.0, "shadow_soft_size": 0},
    square={"kind": "AREA", "shape": "SQUARE", "size": 1},
    rectangle={"kind": "AREA", "shape": "RECTANGLE", "size": 1, "size_y": 0.3, **TILTED},
    disk={"kind": "AREA", "shape": "DISK", "size": 1},
    scaled_ellipse={"kind": "AREA", "shape": "ELLIPSE", "size": 2, "size_y": 0.5, "scale": (1, 2, 1), **TILTED},
)
def light(**properties):
    """A ball on the ground, lit by one coloured light."""
    new_scene()
    add_plane()
    add_sphere(radius=0.3, location=(0.3, 0.2, 0.3))
    add_light(**properties, color=(1, 0.5, 0.25))


@cases("bounces", none={"bounces": 0}, one={"bounces": 1}, many={"bounces": 8})
def bounces(bounces):
    """A corner of bright walls."""
    new_scene(bounces)
    white = material("BsdfDiffuse", Color=(0.9, 0.9, 0.9))
    add_plane(white, size=3)
    add_plane(white, size=3, location=(1.5, 0, 0), rotation_euler=(0, math.pi / 2, 0))
    add_light("AREA", size=0.5)


@cases(
    "camera",
    wide={},
    tall={"resolution_x": 20},
    vertical={"sensor_fit": "VERTICAL", "sensor_height": 20},
    horizontal={"resolution_x": 20, "sensor_fit": "HORIZONTAL"},
    shifted={"shift_x": 0.1, "shift_y": -0.05},
    tall_shifted={"resolution_x": 20, "shift_x": 0.1, "shift_y": -0.05},
    orthographic={"type": "ORTHO", "ortho_scale": 4},
    tall_orthographic={"type": "ORTHO", "ortho_scale": 4, "resolution_x": 20, "shift_x": 0.1},
    half_size={"resolution_percentage": 50},
)
def view(**properties):
    """Bright boxes without symmetry before a dark world, from a tilted camera."""
    scene = new_scene(spp=256)
    scene.render.resolution_x, scene.render.resolution_y = 40, 24
    glow = material("Emission", Color=(1, 0.5, 0.2), Strength=1.0)
    for place, size in (((0.1, 0.2, 0), 0.8), ((0.9, -0.4, 0), 0.4), ((-0.7, 0.5, -1), 0.3)):
        bpy.ops.mesh.primitive_cube_add(location=place, size=size)
        bpy.context.object.data.materials.append(glow)
    camera = scene.camera
    camera.rotation_euler, camera.scale = (0.1, 0.05, 0.4), (2, 2, 2)
    for key, value in properties.items():
        setattr(camera.data if hasattr(camera.data, key) else scene.render, key, value)


@cases("focus", sharp={"focus_distance": 4}, near={"focus_distance": 2}, on_object={"distance": 2.5})
def focus(distance=None, **properties):
    """A bright ball that is smaller than the circle of confusion, below a lens with a large aperture."""
    scene = new_scene(spp=256)
    add_sphere(material("Emission", Color=(1, 1, 1), Strength=1.0), radius=0.2)
    dof = scene.camera.data.dof
    dof.use_dof, dof.aperture_fstop = True, 0.05
    if distance:
        dof.focus_object = add("target", None, location=(1, 0, 4 - distance))
    for key, value in properties.items():
        setattr(dof, key, value)


def quarters():
    """Pixels (64, 128, 3) without symmetry. They are many, as Cycles interpolates before it decodes sRGB."""
    pixels = np.full((64, 128, 3), 0.2)
    pixels[:32, :64], pixels[32:, :64], pixels[32:, 96:] = (0.9, 0.2, 0.1), (0.1, 0.7, 0.2), (0.1, 0.2, 0.8)
    return pixels


@case
def world_colour():
    new_scene()
    set_world((0.2, 0.5, 0.9), 1.5)
    add_sphere()


def environment(**mapping):
    new_scene(spp=128)
    world = set_world()
    node = link(world, "Color", "TexEnvironment")
    node.image = picture("sky", quarters(), is_float=True)
    if mapping:
        nodes = world.node_tree
        turn, places = nodes.nodes.new("ShaderNodeMapping"), nodes.nodes.new("ShaderNodeTexCoord")
        nodes.links.new(turn.outputs[0], node.inputs["Vector"])
        nodes.links.new(places.outputs["Generated"], turn.inputs["Vector"])
        for name, value in mapping.items():
            turn.inputs[name].default_value = value
    add_sphere()
    bpy.context.scene.camera.data.lens = 15


CASES["world_image"] = environment
CASES["world_turned_image"] = lambda: environment(Rotation=(0.3, 0.2, 1.0))


@case
def world_behind_a_lamp():
    """The camera sees the world but not the lamp before it."""
    new_scene()
    set_world((0.2, 0.5, 0.9))
    add_sphere(radius=0.5)
    add_light("AREA", size=1, rotation_euler=(math.pi, 0, 0))


@case
def transparent_film():
    new_scene().render.film_transparent = True
    set_world()
    add_sphere()


@cases(
    "texture",
    srgb={},
    moved={"Location": (0.1, 0.2, 0), "Rotation": (0, 0, 0.4), "Scale": (2, 1, 1)},
    data={"raw": True},
)
def texture(raw=False, **mapping):
    """An image without symmetry on a square."""
    new_scene()
    set_world()
    made = material("BsdfDiffuse")
    node = link(made, "Color", "TexImage")
    node.image = picture("quarters", quarters())
    if raw:
        node.image.colorspace_settings.name = "Non-Color"
    if mapping:
        turn = made.node_tree.nodes.new("ShaderNodeMapping")
        places = made.node_tree.nodes.new("ShaderNodeTexCoord")
        made.node_tree.links.new(places.outputs["UV"], turn.inputs["Vector"])
        made.node_tree.links.new(turn.outputs[0], node.inputs["Vector"])
        for name, value in mapping.items():
            turn.inputs[name].default_value = value
    add_plane(made, size=2.5)


PRINCIPLED = "BsdfPrincipled"


@cases(
    "material",
    diffuse={"kind": "BsdfDiffuse", "Color": COLOUR},
    glossy={"kind": "BsdfAnisotropic", "Color": COLOUR, "Roughness": 0.3},
    glass={"kind": "BsdfGlass", "Color": COLOUR, "Roughness": 0.2},
    emission={"kind": "Emission", "Color": COLOUR, "Strength": 2.0},
    smooth={"kind": PRINCIPLED, "Base_Color": COLOUR, "Roughness": 0.1},
    plastic={"kind": PRINCIPLED, "Base_Color": COLOUR},
    rough={"kind": PRINCIPLED, "Base_Color": COLOUR, "Roughness": 0.9},
    strong_coat={"kind": PRINCIPLED, "Base_Color": COLOUR, "IOR": 2.0, "Specular_IOR_Level": 0.8},
    no_reflection={"kind": PRINCIPLED, "Base_Color": COLOUR, "Specular_IOR_Level": 0.0},
    metal={"kind": PRINCIPLED, "Base_Color": COLOUR, "Roughness": 0.2, "Metallic": 1.0},
    rough_metal={"kind": PRINCIPLED, "Base_Color": COLOUR, "Roughness": 0.9, "Metallic": 1.0},
    half_metal={"kind": PRINCIPLED, "Base_Color": COLOUR, "Metallic": 0.5},
    principled_glass={"kind": PRINCIPLED, "Base_Color": COLOUR, "Roughness": 0.3, "Transmission_Weight": 1.0},
    half_glass={"kind": PRINCIPLED, "Base_Color": COLOUR, "Roughness": 0.3, "Transmission_Weight": 0.5},
    glowing={"kind": PRINCIPLED, "Base_Color": COLOUR, "Emission_Color": COLOUR, "Emission_Strength": 2.0},
    half_transparent={"kind": PRINCIPLED, "Base_Color": COLOUR, "Alpha": 0.5, "Specular_IOR_Level": 0.0},
)
def ball(kind, **inputs):
    """A ball in a grey world, and a lamp without size."""
    new_scene(bounces=6, spp=128)
    set_world((0.4, 0.4, 0.4))
    add_sphere(material(kind, **inputs), radius=1.2)
    add_light("POINT", 300, (2, 1, 3), shadow_soft_size=0)


@case
def material_mixed():
    new_scene(bounces=6, spp=128)
    set_world()
    made = material("MixShader")
    made.node_tree.nodes[0].inputs["Fac"].default_value = 0.3
    for index, colour in ((1, COLOUR), (2, (0.1, 0.2, 0.8))):
        link(made, index, "BsdfDiffuse").inputs["Color"].default_value = (*colour, 1)
    add_sphere(made)


@case
def geometry():
    """Modifiers, instances of a collection, a mirrored object, text, two materials and flat faces."""
    new_scene(spp=128)
    set_world((0.3, 0.3, 0.3))
    add_light("SUN", 2, angle=0, rotation_euler=(0.6, 0.3, 0))
    bpy.ops.mesh.primitive_monkey_add(size=0.9, location=(-0.7, 0.7, 0))
    monkey = bpy.context.object
    monkey.scale = (-1, 1, 1)
    for colour in (COLOUR, (0.1, 0.2, 0.8)):
        monkey.data.materials.append(material("BsdfDiffuse", Color=colour))
    monkey.data.polygons.foreach_set("material_index", np.arange(len(monkey.data.polygons)) % 2)
    bpy.ops.mesh.primitive_cube_add(size=0.3, location=(0.3, -0.8, 0))
    modifier = bpy.context.object.modifiers.new("array", "ARRAY")
    modifier.count, modifier.relative_offset_displace = 3, (1.5, 0.3, 0)
    bpy.ops.object.text_add(location=(-1, -0.4, 0))
    group = bpy.data.collections.new("group")
    bpy.ops.mesh.primitive_cone_add(radius1=0.3, depth=0.5)
    group.objects.link(bpy.context.object)
    bpy.context.collection.objects.unlink(bpy.context.object)
    for index in range(3):
        instance = add(f"instance{index}", None, location=(0.9 - 0.5 * index, 0.4 * index, 0), scale=(1, 0.7, 1))
        instance.instance_type, instance.instance_collection = "COLLECTION", group
        instance.rotation_euler = (index, 0.4, 0)


@case
def unsupported():
    """One of each kind that the export reports."""
    scene = new_scene(spp=1)
    made = material("BsdfPrincipled", Sheen_Weight=0.5, Coat_Weight=0.2)
    made.name = "cloth"
    link(made, "Base Color", "TexNoise")
    add_plane(made)
    add_light("SPOT", shadow_soft_size=0.1)
    add_light("AREA", spread=1.0)
    glow = material("Emission", Strength=1.0)
    glow.name = "glow"
    add_plane(glow, size=0.1, location=(0, 0, 0.1)).name = "panel"
    toon = material("BsdfToon")
    toon.name = "toon"
    ball = add_sphere(toon, radius=0.1)
    # Objects of one mesh, of which the second is hidden
    add("first", ball.data)
    add("twin", ball.data).visible_camera = False
    ball.modifiers.new("hair", "PARTICLE_SYSTEM").particle_system.settings.type = "HAIR"
    scene.render.use_motion_blur = scene.render.use_border = True
    world = set_world()
    link(world, "Color", "TexSky")


@case
def unsupported_world():
    """An Image Texture has no coordinates in a world."""
    new_scene(spp=1)
    world = set_world((0.1, 0.2, 0.3))
    for name in ("Color", "Strength"):
        link(world, name, "TexImage").image = picture("speckles", np.full((2, 2, 3), 0.5))


@case
def flat():
    """An object without extent along one axis."""
    new_scene()
    add_plane(scale=(1, 1, 0))
    add_light("POINT", shadow_soft_size=0)


def long_render(seconds):
    """Make a lit plane, whose many samples a time limit ends."""
    scene = new_scene(bounces=2)
    scene.manylights.samples, scene.manylights.time_limit, scene.cycles.samples = 1 << 24, seconds, SPP
    add_plane()
    add_light("POINT", shadow_soft_size=0)


@case
def ended_by_time():
    """A second limits a render of many samples."""
    long_render(1.0)


@case
def ended_by_noise_and_denoised():
    scene = new_scene(bounces=2)
    ours = scene.manylights
    ours.samples, ours.use_noise_threshold, ours.noise_threshold, ours.use_denoising = 1 << 24, True, 0.02, True
    add_plane()
    add_light("AREA", size=1)


@case
def ended_by_escape():
    """The first pass is shown though Esc was pressed before."""
    long_render(30.0)
    Progress.is_stopped = lambda self: True  # cases.py restores it


@case
def ended_by_late_escape():
    """Esc is pressed within a later pass, which is thrown away."""
    ended_by_escape()
    calls = iter(range(1 << 20))
    Progress.is_stopped = lambda self: next(calls) > 30


@case
def without_a_camera():
    new_scene().camera = None


@case
def panoramic_camera():
    new_scene().camera.data.type = "PANO"
