"""Surfaces with bump or normal maps: which these are, and how light paths are scattered by them.

Such a material shades with a normal of its own, which nobody else gets to know; it turns the normal round where it
would face away from the viewer, and dims light that arrives at grazing angles.  So it is not symmetric, neither Veach's
correction for shading normals nor samples that are drawn from the light's side are enough, and the light that it sends
on ends where that normal faces away.  Here the material is asked as a path from the camera asks it: what goes from the
light to a viewer, of whom the direction is drawn.  The normal is told by three such questions and decides only where a
light shines: the flux of lights is right whatever is found for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, finite_or_zero
from ..core.registry import RegistryTable
from .emitters import registered_shapes

# As Mitsuba prints them
_MAPS = ("BumpMap[", "NormalMap[")
# Share of directions that are drawn by the cosine: samples of the material do not reach where it turns its normal round
_COSINE_SHARE = 0.5
# Largest density of a diffuse lobe, per steradian, beyond rounding
_DIFFUSE_DENSITY = 1.001 / np.pi


def perturbed_shapes(scene) -> tuple:
    """Registry indices of the shapes of a scene whose material has such a map."""
    return tuple(index for index, shape in registered_shapes(scene) if any(name in str(shape.bsdf()) for name in _MAPS))


@dataclass(init=False)
class Perturbed:
    """Shapes whose material shades with a normal of its own.

    ``exist``: whether there are any; ``everywhere``: whether they cannot be told from others, as in shape groups.
    The fields of a dataclass, unlike those of other classes, may be given to functions that Dr.Jit freezes.
    """

    exist: bool
    everywhere: bool
    _table: RegistryTable | None

    def __init__(self, scene):
        shapes = perturbed_shapes(scene)
        groups = (shape for shape in scene.shapes() if shape.class_name() in ("Instance", "ShapeGroup"))
        self.everywhere = any(name in str(shape) for shape in groups for name in _MAPS)
        self.exist = self.everywhere or len(shapes) > 0
        self._table = RegistryTable(shapes, 1) if shapes else None

    def at(self, si, active):
        """Whether ``si`` lies on one of them."""
        if self.everywhere or self._table is None:
            return mi.Bool(self.everywhere)
        return self._table.at(si.shape, active) == 1


@dataclass
class Scattered:
    """What becomes of light paths at surfaces, one per lane.

    ``stored``: whether a light is left there, ``leaving``: its flux, ``normal``: unit vector, on the side to which it
    shines, ``facing``: it shines to directions on the side of this vector only; ``goes_on``: whether the path does,
    ``direction``: in which, unit vector in world space, ``following``: with what flux, ``delta``: whether by a lobe
    without an extent.  Fluxes are spectra, relative to what the emitter gave.
    """

    stored: object
    leaving: object
    normal: object
    facing: object
    goes_on: object
    direction: object
    following: object
    delta: object


def scatter_perturbed(si, sampler, throughput, lobe_limit: float, active) -> Scattered:
    """Scatter light paths at perturbed surfaces.  ``lobe_limit``: see :class:`vpl.lights.tracing.PathLimits`."""
    bsdf = si.bsdf()
    arrived = dr.dot(si.n, si.to_world(si.wi))
    active &= arrived * si.wi.z > 0
    flux = throughput / dr.abs(arrived)
    outward = si.n * dr.mulsign(mi.Float(1), arrived)
    leaving, normal, facing = _light(si, bsdf, sampler, outward, lobe_limit, active)
    leaving = finite_or_zero(flux * leaving)

    # ---------------------- Next direction: by the material, or by the cosine ----------------------
    context = mi.BSDFContext()
    smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    by_cosine = smooth & (sampler.next_1d() < _COSINE_SHARE)
    sample, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
    drawn = mi.Frame3f(outward).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    direction = dr.select(by_cosine, drawn, si.to_world(sample.wo))
    delta = ~by_cosine & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    local, left = si.to_local(direction), dr.dot(outward, direction)
    value, _ = _seen_from(si, bsdf, context, direction, active & ~delta)
    density = bsdf.pdf(context, si, local, active & ~delta) * (1 - _COSINE_SHARE)
    density += dr.maximum(left, 0) * (dr.inv_pi * _COSINE_SHARE)
    following = flux * value * dr.abs(left) / density
    # A mirror turns beams without making them wider
    straight = mi.unpolarized_spectrum(weight) * throughput * dr.select(left > 0, left / dr.abs(arrived), 1)
    straight /= dr.select(smooth, 1 - _COSINE_SHARE, 1)
    following = finite_or_zero(dr.select(delta, straight, following))
    goes_on = active & (dr.dot(si.n, direction) * local.z > 0) & dr.any(following > 0)
    return Scattered(
        active & dr.any(leaving > 0), leaving, normal, facing, goes_on, direction, following, delta
    )  # fmt: skip


def _seen_from(si, bsdf, context, view, active):
    """BSDF times the light's cosine for a viewer in a world space direction, and the density with which a path from
    there goes to the light."""
    viewed = mi.SurfaceInteraction3f(si)
    viewed.wi = si.to_local(view)
    value, density = bsdf.eval_pdf(context, viewed, si.wi, active)
    return finite_or_zero(mi.unpolarized_spectrum(value)), density


def _diffuse_only() -> mi.BSDFContext:
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Diffuse
    return context


def _light(si, bsdf, sampler, outward, lobe_limit: float, active):
    """What light is left at a surface: (flux per irradiance, normal, facing).

    It is seen alike from all directions on either side of the material's normal: one of these two regions is drawn by
    the flux that goes there, with a direction in it for which the material is asked.
    """
    normal_of_material = _normal(si, bsdf, outward, active)
    both = int(mi.BSDFFlags.DiffuseTransmission) | int(mi.BSDFFlags.GlossyTransmission)
    transmits = (bsdf.flags() & both) != 0
    crosses = transmits & (sampler.next_1d() < 0.5)
    normal = dr.select(crosses, -outward, outward)
    facing = dr.select(crosses, normal, normal_of_material)
    view = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    facing *= dr.mulsign(mi.Float(1), dr.dot(facing, view))
    share = 0.5 * (1 + dr.dot(normal, facing))
    value, density = _seen_from(si, bsdf, mi.BSDFContext(), view, active)
    diffuse, of_diffuse = _seen_from(si, bsdf, _diffuse_only(), view, active)
    # Materials that do not tell their lobes apart have too great a density where they are sharp
    value = dr.select(density <= lobe_limit, value, dr.select(of_diffuse <= _DIFFUSE_DENSITY, diffuse, 0))
    return value * dr.pi * dr.select(transmits, 2, 1) / share, normal, facing


def _normal(si, bsdf, outward, active):
    """The normal that a material shades with, from what of its diffuse reflection is seen from above if light comes
    from three directions around: the brighter, the nearer.  Exact if none of them is below its horizon."""
    viewed, context = mi.SurfaceInteraction3f(si), _diffuse_only()
    side = dr.mulsign(mi.Float(1), si.wi.z)
    viewed.wi = mi.Vector3f(0, 0, side)
    found = mi.Vector3f(0)
    for angle in 2 * np.pi / 3 * np.arange(3):
        x, y = float(np.cos(angle)), float(np.sin(angle))
        toward = mi.Vector3f(x, y, side) * np.sqrt(0.5)
        level = channel_mean(finite_or_zero(mi.unpolarized_spectrum(bsdf.eval(context, viewed, toward, active))))
        found += mi.Vector3f(2 * x, 2 * y, side) * level
    return dr.select(dr.squared_norm(found) > 0, si.to_world(dr.normalize(found)), outward)
