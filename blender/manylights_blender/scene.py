"""A scene of Blender as a scene of Mitsuba."""

from collections import defaultdict
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from . import camera, meshes, world
from .lights import Lights
from .materials import Materials
from .problems import Problems
from .textures import Textures

RAYS = ("diffuse", "glossy", "transmission", "shadow")  # of 'Ray Visibility', besides those of the camera
# Objects that show something, and that the export leaves out
LEFT_OUT = ("CURVES", "POINTCLOUD", "VOLUME", "GPENCIL", "GREASEPENCIL")


@dataclass
class Exported:
    """`scene`: the scene of Mitsuba; `problems`: sentences about what it lacks; `hide_emitters`: whether the integrator
    must hide emitters from the camera; `background`: a scene with the world alone, whose image lies behind the
    rendered one, or None."""

    scene: mi.Scene
    problems: list
    hide_emitters: bool
    background: mi.Scene | None


def export(depsgraph):
    """Return the `Exported` scene of an evaluated dependency graph of Blender.

    Raises ValueError without a camera, and for values that Mitsuba cannot represent.
    """
    source = depsgraph.scene_eval
    if source.camera is None:
        raise ValueError("the scene has no camera")
    exporter = _Exporter(depsgraph)
    exporter.collect()
    return exporter.finish(source)


class _Exporter:
    def __init__(self, depsgraph):
        self._depsgraph, self._problems = depsgraph, Problems()
        self._textures = Textures(self._problems)
        self._materials, self._lights = Materials(self._textures), Lights(self._problems)
        self._meshes = {}  # parts and materials of a mesh, by key
        self._places = defaultdict(list)  # matrices of its instances, by key
        self._entries, self._emissive, self._passes = {}, False, False

    def collect(self):
        """Read all objects and their instances."""
        for index, instance in enumerate(self._depsgraph.object_instances):
            one = instance.object
            matrix = np.array(instance.matrix_world)
            if one.type == "LIGHT":
                self._check_rays(one.original, RAYS)
                self._lights.add(f"light{index}", one.data, matrix)
            elif one.type in meshes.HAS_MESH and instance.show_self:
                self._check_object(one.original)
                self._collect_mesh(one, matrix)
            elif one.type in LEFT_OUT:
                self._problems.add(one, f"objects of type {one.type} are not exported")

    def _collect_mesh(self, one, matrix):
        materials = [slot.material for slot in one.material_slots]
        key = (one.data.as_pointer(), *(material and material.name_full for material in materials))
        if key not in self._meshes:
            self._meshes[key] = one.name, meshes.parts_of(one), materials
        self._places[key].append(matrix)

    def _check_object(self, one):
        """Report settings of an object that are not exported."""
        if any(system.settings.render_type == "PATH" for system in one.particle_systems):
            self._problems.add(one, "hair of particles is not exported")
        self._check_rays(one, ("camera", *RAYS))
        for name, label in (("is_holdout", "Holdout"), ("is_shadow_catcher", "Shadow Catcher")):
            if getattr(one, name):
                self._problems.add(one, f"'{label}' is not exported")

    def _check_rays(self, one, rays):
        """Report kinds of rays that do not see an object."""
        hidden = [ray for ray in rays if not getattr(one, f"visible_{ray}")]
        if hidden:
            self._problems.add(
                one, f"'Ray Visibility' is not exported; the object is visible to rays of: {', '.join(hidden)}"
            )

    def finish(self, source):
        """Make the scene of Mitsuba from the collected objects."""
        for number, key in enumerate(self._meshes):
            self._add_mesh(f"mesh{number}", *self._meshes[key], self._places[key])
        if source.render.use_motion_blur:
            self._problems.add_setting("Motion Blur", "not exported")
        sky, sensor = (
            world.read(source.world, self._textures),
            camera.sensor(source.camera, source.render, self._problems),
        )
        background, hide = self._visibility(source.render.film_transparent)
        lit = sky.with_suns(self._lights.suns).emitter()
        entries = self._entries | self._lights.entries | ({"environment": lit} if lit else {})
        scene = mi.load_dict({"type": "scene", "camera": sensor, **entries})
        behind = sky.emitter() if background else None
        behind = mi.load_dict({"type": "scene", "camera": sensor, "environment": behind}) if behind else None
        return Exported(scene, self._problems.sentences, hide, behind)

    def _visibility(self, transparent):
        """Return whether the world is added behind the image, and whether the integrator hides emitters.

        In Blender the camera sees the world and emissive meshes, but no lights. Mitsuba hides all or none. Hidden, the
        world still lies behind surfaces that light passes straight, where alpha is 0: it must not be added.
        """
        seen = [name for name, there in (("emissive", self._emissive), ("transparent", self._passes)) if there]
        meshes_ = f"{' and '.join(seen)} meshes"
        hide = transparent or (self._lights.extended and not seen)
        if transparent and seen:
            self._problems.add_setting("Transparent", f"a transparent film is not exact for {meshes_}")
        elif self._lights.extended and not hide:
            self._problems.add_setting("Lights", f"the camera sees lights with a size, as the scene has {meshes_}")
        return hide and not transparent, hide

    def _add_mesh(self, name, label, parts, materials, places):
        """Add a mesh at all its places: once, if it has one, else as instances of a group."""
        surfaces = [self._surface(part, materials) for part in parts]
        emissive = any(surface.radiance for surface in surfaces)
        self._emissive |= emissive
        self._passes |= any(surface.passes for surface in surfaces)
        if any(surface.radiance and meshes.is_open(part) for part, surface in zip(parts, surfaces, strict=True)):
            self._problems.add_setting(f"Mesh '{label}'", "an open mesh emits light on its front only")
        if len(places) == 1 or emissive:  # Mitsuba's groups contain no emitters
            for place, matrix in enumerate(places):
                for part, surface in zip(parts, surfaces, strict=True):
                    one = f"{name}_{place}_{part.slot}"
                    self._entries[one] = meshes.shape(one, meshes.to_world(part, matrix), surface)
            return
        shapes = {
            f"part{part.slot}": meshes.shape(f"{name}_{part.slot}", part, surface)
            for part, surface in zip(parts, surfaces, strict=True)
        }
        if shapes:
            self._entries[name] = {"type": "shapegroup", **shapes}
            group = {"type": "ref", "id": name}
            for place, matrix in enumerate(places):
                to_world = mi.ScalarTransform4f(matrix)
                self._entries[f"{name}_{place}"] = {"type": "instance", "group": group, "to_world": to_world}

    def _surface(self, part, materials):
        return self._materials.surface(materials[min(part.slot, len(materials) - 1)] if materials else None)
