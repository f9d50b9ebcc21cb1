"""Materials: shader nodes as BSDFs and radiance.

Blender's roughness r is the root of the microfacet roughness α of Mitsuba. Every BSDF without transmission is
two-sided, as in Blender.
"""

from dataclasses import dataclass, replace

import bpy
import mitsuba as mi

from .problems import differs
from .textures import rgb, source

# Inputs of the Principled BSDF that must have the value 0
IGNORED = (
    "Subsurface Weight", "Anisotropic", "Coat Weight", "Sheen Weight", "Thin Film Thickness", "Diffuse Roughness",
)  # fmt: skip
SMOOTHEST = 1e-3  # α below which a surface is a mirror: Mitsuba's microfacets lose precision there
GREY, GREY_ROUGHNESS, GREY_IOR = 0.8, 0.5, 1.5  # of an object without a material in Blender


@dataclass
class Surface:
    """A material: dictionary of a BSDF, and of the radiance of an area emitter, each None if there is none; `passes`:
    whether light passes straight, as by 'Alpha'."""

    bsdf: dict | None = None
    radiance: dict | None = None
    passes: bool = False


def two_sided(bsdf):
    """Dictionary of a BSDF on both sides of a surface."""
    return {"type": "twosided", "bsdf": bsdf}


def diffuse(reflectance):
    """Dictionary of a two-sided diffuse BSDF; `reflectance`: a dictionary."""
    return two_sided({"type": "diffuse", "reflectance": reflectance})


BLACK = diffuse(rgb((0, 0, 0)))


def without_material():
    """Dictionary of the BSDF of an object without a material: a Principled BSDF since Blender 5.0, diffuse before."""
    if bpy.app.version < (5, 0, 0):
        return diffuse(rgb([GREY] * 3))
    colour = rgb([GREY] * 3, 1 - ((GREY_IOR - 1) / (GREY_IOR + 1)) ** 2)
    return two_sided({"type": "principled", "base_color": colour, "roughness": GREY_ROUGHNESS, "eta": GREY_IOR})


class Materials:
    """Materials of one export. `surface` returns the `Surface` of a material, made once."""

    def __init__(self, textures):
        self._textures, self._problems, self._made = textures, textures.problems, {}

    def surface(self, material):
        """Return the `Surface` of a material, or of None, with an object of Mitsuba for its BSDF."""
        key = material and material.name_full
        if key not in self._made:
            found = Surface(without_material()) if material is None else self._read(material)
            self._made[key] = replace(found, bsdf=mi.load_dict(found.bsdf or BLACK))
        return self._made[key]

    def _read(self, material):
        if not material.use_nodes or material.node_tree is None:
            return Surface(diffuse(rgb(material.diffuse_color)))
        output = material.node_tree.get_output_node("ALL") or material.node_tree.get_output_node("CYCLES")
        if output is None:
            return Surface()
        for name in ("Volume", "Displacement"):
            if output.inputs[name].is_linked:
                self._problems.add(material, f"'{name}' is not exported")
        return self._shader(material, output.inputs["Surface"])

    def _shader(self, material, socket):
        """Return the `Surface` of the shader that feeds a socket."""
        node, _ = source(socket)
        if node is None:
            return Surface()
        read = READERS.get(node.bl_idname)
        if read is None:
            self._problems.add(material, f"shader '{node.name}' ({node.bl_idname}) is not exported; it becomes black")
            return Surface()
        if "Normal" in node.inputs and node.inputs["Normal"].is_linked:
            self._problems.add(material, f"'Normal' of node '{node.name}' is not exported")
        return read(self, material, node)

    def _colour(self, material, node, name, **more):
        return self._textures.colour(material, node.inputs[name], **more)

    def _number(self, material, node, name):
        return self._textures.number(material, node.inputs[name])

    def _constant(self, material, node, name):
        """Number of an input that Mitsuba does not take as a texture."""
        value = self._number(material, node, name)
        if isinstance(value, float):
            return value
        self._problems.add(material, f"the texture at '{name}' of node '{node.name}' is not exported")
        return float(node.inputs[name].default_value)

    def _principled(self, material, node):
        for name in IGNORED:
            if name in node.inputs and differs(node.inputs[name], 0):
                self._problems.add(material, f"'{name}' of the Principled BSDF is not exported")
        bsdf = self._principled_bsdf(material, node)
        alpha = self._number(material, node, "Alpha")
        passes = alpha != 1.0
        if passes:
            bsdf = {"type": "mask", "opacity": alpha, "bsdf": bsdf}
        strength = self._constant(material, node, "Emission Strength")
        return Surface(bsdf, self._radiance(material, node, "Emission Color", strength), passes)

    def _radiance(self, material, node, name, strength):
        """Colour of an input times the strength; None if it is black everywhere."""
        radiance = self._colour(material, node, name, scale=strength) if strength else None
        return None if radiance and radiance["type"] == "rgb" and not any(radiance["value"]) else radiance

    def _principled_bsdf(self, material, node):
        """Blender weakens the diffuse part by what the interface reflects, and Mitsuba's `principled` does not: the
        base colour of the dielectric share is scaled by the transmittance at normal incidence."""
        metallic, roughness = self._number(material, node, "Metallic"), self._number(material, node, "Roughness")
        transmission = self._number(material, node, "Transmission Weight")
        if (metallic, transmission) == (0.0, 1.0) and isinstance(roughness, float):
            colour = self._colour(material, node, "Base Color", power=0.5)  # of each of two interfaces
            return glass(self._constant(material, node, "IOR"), roughness, transmittance=colour)
        reflected = self._reflectance(material, node)
        dielectric = 1 - metallic if isinstance(metallic, float) else 0
        opaque = 1 - transmission if isinstance(transmission, float) else 0
        colour = self._colour(material, node, "Base Color", scale=1 - reflected * dielectric * opaque)
        if (metallic, transmission, reflected) == (0.0, 0.0, 0.0):
            return diffuse(colour)
        ior = (1 + reflected**0.5) / (1 - reflected**0.5)
        bsdf = {
            "type": "principled", "base_color": colour, "roughness": roughness, "metallic": metallic, "eta": ior,
            "spec_trans": transmission,
        }  # fmt: skip
        return two_sided(bsdf) if transmission == 0.0 else bsdf

    def _reflectance(self, material, node):
        """Reflectance of the interface at normal incidence, which 'Specular IOR Level' scales by twice its value."""
        ior, level = (self._constant(material, node, name) for name in ("IOR", "Specular IOR Level"))
        reflected = ((ior - 1) / (ior + 1)) ** 2 * 2 * level
        if reflected >= 1:
            raise ValueError(
                f"material '{material.name}': twice 'Specular IOR Level' times ((IOR - 1) / (IOR + 1))² must be below "
                f"1, got {reflected:g} with 'IOR' {ior:g} and level {level:g}"
            )
        return reflected

    def _diffuse(self, material, node):
        if differs(node.inputs["Roughness"], 0):
            self._problems.add(material, f"'Roughness' of node '{node.name}' is not exported")
        return Surface(diffuse(self._colour(material, node, "Color")))

    def _glossy(self, material, node):
        if differs(node.inputs["Anisotropy"], 0):
            self._problems.add(material, f"'Anisotropy' of node '{node.name}' is not exported")
        colour, alpha = self._colour(material, node, "Color"), self._number(material, node, "Roughness")
        if isinstance(alpha, dict):
            self._problems.add(material, f"the texture at 'Roughness' of node '{node.name}' is not exported")
            alpha = float(node.inputs["Roughness"].default_value)
        metal = {"material": "none", "specular_reflectance": colour}
        if alpha**2 < SMOOTHEST:
            return Surface(two_sided({"type": "conductor", **metal}))
        return Surface(two_sided({"type": "roughconductor", "distribution": "ggx", "alpha": alpha**2, **metal}))

    def _glass(self, material, node):
        colour = self._colour(material, node, "Color")
        ior, roughness = self._constant(material, node, "IOR"), self._constant(material, node, "Roughness")
        return Surface(glass(ior, roughness, transmittance=colour, reflectance=colour))

    def _transparent(self, material, node):
        if list(node.inputs["Color"].default_value[:3]) != [1, 1, 1] or node.inputs["Color"].is_linked:
            self._problems.add(material, f"'Color' of node '{node.name}' is not exported; the surface passes all light")
        return Surface({"type": "null"}, passes=True)

    def _emission(self, material, node):
        strength = self._constant(material, node, "Strength")
        return Surface(None, self._radiance(material, node, "Color", strength))

    def _mix(self, material, node):
        share = self._number(material, node, "Fac")
        first, second = (self._shader(material, node.inputs[index]) for index in (1, 2))
        if first.radiance or second.radiance:
            self._problems.add(material, f"emission below node '{node.name}' is not exported")
        bsdfs = {"first": first.bsdf or BLACK, "second": second.bsdf or BLACK}
        return Surface({"type": "blendbsdf", "weight": share, **bsdfs}, passes=first.passes or second.passes)

    def _add(self, material, node):
        first, second = (self._shader(material, node.inputs[index]) for index in (0, 1))
        for name in ("bsdf", "radiance"):
            if getattr(first, name) and getattr(second, name):
                self._problems.add(material, f"node '{node.name}' adds two of a kind; only the first is exported")
        return Surface(first.bsdf or second.bsdf, first.radiance or second.radiance, first.passes or second.passes)


READERS = {
    "ShaderNodeBsdfPrincipled": Materials._principled,
    "ShaderNodeBsdfDiffuse": Materials._diffuse,
    "ShaderNodeBsdfAnisotropic": Materials._glossy,  # Blender's name of the Glossy BSDF since 4.0
    "ShaderNodeBsdfGlass": Materials._glass,
    "ShaderNodeBsdfTransparent": Materials._transparent,
    "ShaderNodeEmission": Materials._emission,
    "ShaderNodeMixShader": Materials._mix,
    "ShaderNodeAddShader": Materials._add,
}


def glass(ior, roughness, transmittance, reflectance=None):
    """Dictionary of a dielectric interface; `reflectance`: by default white."""
    kind = {"type": "dielectric"} if roughness**2 < SMOOTHEST else {
        "type": "roughdielectric", "distribution": "ggx", "alpha": roughness**2
    }  # fmt: skip
    colours = {"specular_transmittance": transmittance, "specular_reflectance": reflectance or rgb((1, 1, 1))}
    return {**kind, "int_ior": ior, "ext_ior": 1.0, **colours}
