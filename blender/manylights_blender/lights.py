"""Blender's lights as Mitsuba's emitters.

A light of Blender shines along its −Z axis. Power is in watts, for suns in W/m². With power P, a point or spot light
has the radiant intensity P / 4π, and an area light of area A has the radiance P / πA, as in Cycles. Lights reflect
nothing.
"""

import math
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from .materials import BLACK
from .textures import rgb, source

# Turns by 180°: Mitsuba's emitters shine along +Z
TURN = np.diag([-1.0, 1.0, -1.0, 1.0])
# Smallest angle of a sun with a disc, in radians (the real sun's is 0.53°); smaller suns have no visible penumbra, and
# would need a large environment map
SMALLEST_SUN = math.radians(0.5)


@dataclass
class Sun:
    """A sun with a disc: unit vector `towards` it, irradiance `strength` (3) of a facing surface in W/m², and `angle`
    of its diameter in radians."""

    towards: np.ndarray
    strength: np.ndarray
    angle: float


@dataclass
class Lights:
    """Lights of one export. `entries`: dictionaries for Mitsuba's scene by name; `suns`: suns with a disc, which belong
    into the environment; `extended`: whether a light has an area, so that Mitsuba's camera could see it."""

    problems: object
    entries: dict = field(default_factory=dict)
    suns: list = field(default_factory=list)
    extended: bool = False

    def add(self, name, light, matrix):
        """Add a light of Blender under a `name` of its own. `matrix`: (4, 4), its place in the world."""
        strength = self._strength(light)
        if not strength.any() or _is_portal(light):
            return
        made = {"POINT": self._point, "SUN": self._sun, "SPOT": self._spot, "AREA": self._area}[light.type](
            light, strength, matrix
        )
        self.extended |= light.type == "AREA" or (light.type, made and made["type"]) in (
            ("POINT", "sphere"),
            ("SUN", None),
        )
        if made is not None:
            self.entries[name] = made

    def _strength(self, light):
        """Colour times power (3), with the factors of a node Emission."""
        strength = np.array(light.color) * light.energy * 2.0 ** getattr(light, "exposure", 0.0)
        if not getattr(light, "normalize", True):
            self.problems.add(light, "'Normalize' switched off is not exported")
        if getattr(light, "use_temperature", False):
            strength *= np.array(light.temperature_color)
        if not light.use_nodes or light.node_tree is None:
            return strength
        output = light.node_tree.get_output_node("ALL") or light.node_tree.get_output_node("CYCLES")
        node = output and source(output.inputs["Surface"])[0]
        if node is None or node.bl_idname != "ShaderNodeEmission" or any(one.is_linked for one in node.inputs):
            self.problems.add(light, "its nodes are not exported, unless they are an Emission with constant inputs")
            return strength
        return strength * np.array(node.inputs["Color"].default_value[:3]) * node.inputs["Strength"].default_value

    def _point(self, light, strength, matrix):
        intensity, radius = strength / (4 * math.pi), light.shadow_soft_size
        centre = [float(value) for value in matrix[:3, 3]]
        if radius == 0:
            return {"type": "point", "position": centre, "intensity": rgb(intensity)}
        radiance = rgb(intensity / (math.pi * radius**2))
        return {"type": "sphere", "center": centre, "radius": radius, "bsdf": BLACK, "emitter": _emission(radiance)}

    def _sun(self, light, strength, matrix):
        towards = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        if light.angle >= SMALLEST_SUN:
            self.suns.append(Sun(towards, strength, light.angle))
            return None
        return {"type": "directional", "direction": [float(-value) for value in towards], "irradiance": rgb(strength)}

    def _spot(self, light, strength, matrix):
        if light.shadow_soft_size > 0:
            self.problems.add(light, "the radius of a spot light is not exported; its shadows are sharp")
        cutoff = light.spot_size / 2
        if not 0 < cutoff < math.pi / 2:
            raise ValueError(
                f"light '{light.name}': the size of a spot light must be below 180°, got {2 * math.degrees(cutoff):g}°"
            )
        return {
            "type": "spot",
            "to_world": mi.ScalarTransform4f(_rigid(matrix) @ TURN),
            "intensity": rgb(strength / (4 * math.pi)),
            "cutoff_angle": math.degrees(cutoff),
            "beam_width": math.degrees(beam_width(cutoff, light.spot_blend)),
        }

    def _area(self, light, strength, matrix):
        if light.spread < math.pi - 1e-4:
            self.problems.add(light, "'Spread' below 180° is not exported")
        width = light.size
        height = light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else width
        to_world = matrix @ np.diag([width / 2, height / 2, 1.0, 1.0])
        round_ = light.shape in ("DISK", "ELLIPSE")
        area = np.linalg.norm(np.cross(to_world[:3, 0], to_world[:3, 1])) * (math.pi if round_ else 4)
        if area == 0:
            raise ValueError(f"light '{light.name}': an area light must have an area, got size 0")
        return {
            "type": "disk" if round_ else "rectangle",
            "to_world": mi.ScalarTransform4f(to_world @ TURN),
            "bsdf": BLACK,
            "emitter": _emission(rgb(strength / (math.pi * area))),
        }


def _is_portal(light):
    """Whether a light only helps Cycles to sample the world, and shines no light."""
    return light.type == "AREA" and getattr(getattr(light, "cycles", None), "is_portal", False)


def _emission(radiance):
    return {"type": "area", "radiance": radiance}


def _rigid(matrix):
    """Return a matrix (4, 4) without its scale."""
    rigid = matrix.copy()
    rigid[:3, :3] /= np.linalg.norm(rigid[:3, :3], axis=0)
    return rigid


def beam_width(cutoff, blend):
    """Return the angle inside which Mitsuba's spot has its full intensity, in radians, for equal flux.

    Mitsuba's intensity falls linearly in the angle, Blender's by a smooth step in the cosine over the share `blend` of
    the cone, which has the flux of a sharp cone at the middle of the step. `cutoff`: half the size of the spot.
    """
    wanted = (1 - math.cos(cutoff)) * (1 - blend / 2)
    low, high = 0.0, cutoff
    for _ in range(50):  # bisection, beyond the precision of float32
        middle = (low + high) / 2
        flux = 1 - (math.sin(cutoff) - math.sin(middle)) / (cutoff - middle)
        low, high = (middle, high) if flux < wanted else (low, middle)
    return min(high, cutoff * (1 - 1e-4))  # Mitsuba divides by the difference of both angles
