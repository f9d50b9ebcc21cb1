"""Shapes of a scene by their index in Mitsuba's registry, with the shapes of its shape groups."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .arrays import download
from .parameters import children_of

# Class name of instances of shape groups
INSTANCE = "Instance"


def registered_shapes(scene) -> list:
    """(Registry index, shape) of every shape of a scene."""
    registry = download(dr.reinterpret_array(mi.UInt32, scene.shapes_dr())) if scene.shapes() else []
    return [(int(index), shape) for index, shape in zip(registry, scene.shapes(), strict=True)]


@dataclass(frozen=True)
class ShapeGroup:
    """(Registry index, shape) of the ``shapes`` of a group, and of its ``instances``."""

    shapes: list
    instances: list


@dataclass(frozen=True)
class SceneShapes:
    """(Registry index, shape) of the ``own`` shapes of a scene, instances included; ``groups``: those that instances
    may be of."""

    own: list
    groups: list[ShapeGroup]

    @classmethod
    def of(cls, scene) -> SceneShapes:
        """Mitsuba 3.9.1 accepts groups as children of a scene only, and lists them nowhere else."""
        own = registered_shapes(scene)
        instances = [row for row in own if row[1].class_name() == INSTANCE]
        if not instances:
            return cls(own, [])
        groups = [shape for shape in children_of(scene, mi.Shape) if shape.class_name().startswith("ShapeGroup")]
        # Mitsuba tells the group of an instance in its printed form alone
        printed = [(row, str(row[1])) for row in instances]
        of_group = {group: [row for row, text in printed if f'name = "{group.id()}"' in text] for group in groups}
        return cls(own, [ShapeGroup(_children(group), found) for group, found in of_group.items()])

    @property
    def of_hits(self) -> list:
        """(Registry index, shape) of every shape that surface interactions have: those of groups instead of
        instances."""
        nested = [row for group in self.groups for row in group.shapes]
        return [row for row in self.own if row[1].class_name() != INSTANCE] + nested

    def groups_with(self, indices) -> list[ShapeGroup]:
        """The groups with one of the shapes of some registry ``indices``."""
        return [one for one in self.groups if any(index in indices for index, _ in one.shapes)]


def _children(group) -> list:
    """(Registry index, shape) of the shapes of a group."""
    shapes = children_of(group, mi.Shape)
    return [(int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]), shape) for shape in shapes]


def scene_of(shapes: list) -> mi.Scene:
    """A scene of some ``shapes`` of another scene, for rays that only these shapes may stop.

    ``mi.load_dict`` gives objects new identifiers, by which ``mi.traverse`` names their parameters: the shapes keep
    those of their scene.
    """
    names = [shape.id() for shape in shapes]
    try:
        return mi.load_dict({"type": "scene", **{f"shape_{number}": shape for number, shape in enumerate(shapes)}})
    finally:
        for shape, name in zip(shapes, names, strict=True):
            shape.set_id(name)
