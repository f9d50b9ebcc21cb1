"""Surfaces with bump or normal maps: their shapes, and the scattering of light paths at them.

A bump or normal map shades with a perturbed normal, which Mitsuba does not expose.  Mitsuba flips the normal if it
faces away from the viewer, and attenuates light at grazing angles.  The BSDF is not symmetric: Veach's correction for
shading normals and samples drawn from the light's side are both incorrect, and reflection stops at the horizon of the
perturbed normal.  Therefore light paths evaluate the BSDF in the direction of camera paths: from the arriving light to
a randomly drawn view direction.  Three BSDF evaluations estimate the perturbed normal, which restricts only the
directions in which a virtual light emits.  The flux of the lights is correct for any estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, finite_or_zero
from ..core.registry import RegistryTable
from ..core.shapes import SceneShapes

# Class names in Mitsuba's printed form
_MAPS = ("BumpMap[", "NormalMap[")
# Fraction of cosine-distributed directions: BSDF samples do not cover directions for which Mitsuba flips the normal
_COSINE_SHARE = 0.5
# Largest density of a diffuse lobe, per steradian, with 0.1% for rounding
_DIFFUSE_DENSITY = 1.001 / np.pi


def is_perturbed(bsdf: mi.BSDF) -> bool:
    """Whether a material is or contains a bump or normal map."""
    printed = str(bsdf)
    return any(name in printed for name in _MAPS)


def perturbed_shapes(shapes: SceneShapes) -> tuple[int, ...]:
    """Registry indices of the shapes with a bump or normal map."""
    of_shapes = [(index, shape.bsdf()) for index, shape in shapes.of_hits]
    # Printing a material takes long, and shapes share materials
    judged = {id(bsdf): is_perturbed(bsdf) for bsdf in {id(bsdf): bsdf for _, bsdf in of_shapes}.values()}
    return tuple(index for index, bsdf in of_shapes if judged[id(bsdf)])


@dataclass(init=False)
class Perturbed:
    """Shapes with a bump or normal map; ``exist``: whether the scene has any.

    A dataclass, because Dr.Jit's frozen functions require one.
    """

    exist: bool
    _table: RegistryTable | None

    def __init__(self, scene):
        shapes = perturbed_shapes(SceneShapes.of(scene))
        self.exist = len(shapes) > 0
        self._table = RegistryTable(shapes, 1) if shapes else None

    def at(self, si, active):
        """Whether ``si`` lies on a shape with a bump or normal map."""
        return self._table.at(si.shape, active) == 1 if self.exist else mi.Bool(False)


@dataclass
class Scattered:
    """Result of scattering light paths at surfaces, one per lane.

    ``stored``: whether to store a virtual light; ``leaving``: its flux; ``normal``: unit normal on its emitting side;
    ``facing``: vector whose hemisphere bounds its emission; ``goes_on``: whether the path continues; ``direction``:
    next direction, unit vector in world space; ``following``: flux of the continued path; ``delta``: whether a delta
    lobe scattered the path.  Fluxes are spectra relative to the emitted flux.
    """

    stored: mi.Bool
    leaving: mi.UnpolarizedSpectrum
    normal: mi.Normal3f
    facing: mi.Normal3f | mi.Vector3f
    goes_on: mi.Bool
    direction: mi.Vector3f
    following: mi.UnpolarizedSpectrum
    delta: mi.Bool


def scatter_perturbed(si, sampler, throughput, lobe_limit: float, active) -> Scattered:
    """Scatter light paths at perturbed surfaces.  ``lobe_limit``: see :class:`vpl.lights.tracing.LightPathSettings`."""
    bsdf = si.bsdf()
    arrived = dr.dot(si.n, si.to_world(si.wi))
    active &= arrived * si.wi.z > 0
    flux = throughput / dr.abs(arrived)
    outward = si.n * dr.mulsign(mi.Float(1), arrived)
    leaving, normal, facing = _light(si, bsdf, sampler, outward, lobe_limit, active)
    leaving = finite_or_zero(flux * leaving)

    # ---- Next direction: BSDF sample or cosine-distributed
    context = mi.BSDFContext()
    smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    by_cosine = smooth & (sampler.next_1d() < _COSINE_SHARE)
    # The weight of a delta lobe is one of flux; the direction is the same in both modes
    flux_context = mi.BSDFContext(mi.TransportMode.Importance)
    sample, weight = bsdf.sample(flux_context, si, sampler.next_1d(), sampler.next_2d(), active)
    drawn = mi.Frame3f(outward).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    direction = dr.select(by_cosine, drawn, si.to_world(sample.wo))
    delta = ~by_cosine & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    local, left = si.to_local(direction), dr.dot(outward, direction)
    value, _ = _seen_from(si, bsdf, context, direction, active & ~delta)
    density = bsdf.pdf(context, si, local, active & ~delta) * (1 - _COSINE_SHARE)
    density += dr.maximum(left, 0) * (dr.inv_pi * _COSINE_SHARE)
    following = flux * value * dr.abs(left) / density
    # Reflection by a mirror leaves the beam's solid angle unchanged
    mirrored = mi.unpolarized_spectrum(weight) * throughput * dr.select(left > 0, left / dr.abs(arrived), 1)
    mirrored /= dr.select(smooth, 1 - _COSINE_SHARE, 1)
    following = finite_or_zero(dr.select(delta, mirrored, following))
    goes_on = active & (dr.dot(si.n, direction) * local.z > 0) & dr.any(following > 0)
    return Scattered(
        active & dr.any(leaving > 0), leaving, normal, facing, goes_on, direction, following, delta
    )  # fmt: skip


def _seen_from(si, bsdf, context, view, active):
    """(BSDF times cosine of the light, density of sampling the light's direction) for a world space view direction."""
    viewed = mi.SurfaceInteraction3f(si)
    viewed.wi = si.to_local(view)
    value, density = bsdf.eval_pdf(context, viewed, si.wi, active)
    return finite_or_zero(mi.unpolarized_spectrum(value)), density


def _diffuse_only() -> mi.BSDFContext:
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Diffuse
    return context


def _light(si, bsdf, sampler, outward, lobe_limit: float, active):
    """Virtual light at a surface: (flux per irradiance, normal, facing).

    The perturbed normal divides the hemisphere into two regions, and a light emits diffusely into one of them.  A
    cosine-distributed view direction selects the region, in proportion to its flux, and evaluates the BSDF.
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
    # Above the limit only the diffuse lobe counts. A BSDF that ignores the lobe mask exceeds a diffuse lobe's density
    value = dr.select(density <= lobe_limit, value, dr.select(of_diffuse <= _DIFFUSE_DENSITY, diffuse, 0))
    return value * dr.pi * dr.select(transmits, 2, 1) / share, normal, facing


def _normal(si, bsdf, outward, active):
    """Perturbed normal of a material, in world space.

    Photometric stereo: diffuse reflection towards the geometric normal under light from three directions.  Exact if
    the three directions lie above the perturbed horizon.
    """
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
