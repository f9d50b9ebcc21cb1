"""Gather points as the evaluation sees them: where shadow rays start, and how light from a direction is reflected.

Points whose BSDF was found to be exactly Lambertian are kept as position, normal and albedo; all others keep the whole
surface interaction and call the scene's BSDF.  The two lie in separate batches, so that no kernel pays for both.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import finite_or_zero, rgb_to_spectrum
from .bsdf_proxies import MaterialProxy
from .camera_paths import GatherPoints

# Reflectance of a glossy lobe over a diffuse one: a dielectric's from above
_GLOSS = 0.04


@dataclass
class Surface:
    """Surfaces in a kernel, one per lane: ``interaction`` (position, geometric normal, time) and ``depth``."""

    interaction: object
    depth: object


@dataclass
class LambertianSurface(Surface):
    """Diffuse surfaces.  ``normal``: shading normal on the viewer's side; ``albedo``: reflectance / pi."""

    normal: object
    albedo: object

    def material(self):
        """None: an albedo is all that tells one material from another."""
        return None

    def reflectance(self):
        """Share of the light from all around that is reflected, exactly."""
        return rgb_to_spectrum(self.albedo * dr.pi)

    def reflected(self, to_light, active):
        """BSDF times cosine for light from a world space direction."""
        return rgb_to_spectrum(self.albedo * dr.maximum(dr.dot(self.normal, to_light), 0)) & active

    def reflected_with_density(self, to_light, active):
        """(BSDF times cosine, density of :meth:`sample`) for light from a world space direction."""
        density = dr.maximum(dr.dot(self.normal, to_light), 0) * dr.inv_pi
        return self.reflected(to_light, active), density & active

    def sample(self, sample1, sample2, active):
        """Draw a direction: (world space direction, BSDF times cosine over density, density per solid angle)."""
        local = mi.warp.square_to_cosine_hemisphere(sample2)
        density = mi.warp.square_to_cosine_hemisphere_pdf(local)
        weight = rgb_to_spectrum(self.albedo * dr.pi) & active
        return mi.Frame3f(self.normal).to_world(local), weight, density & active


@dataclass
class ScatteringSurface(Surface):
    """Any material: ``interaction`` is a full surface interaction."""

    def material(self):
        """A number for the BSDF of each surface."""
        return dr.reinterpret_array(mi.UInt32, self.interaction.bsdf())

    def reflectance(self):
        """Share of the light from all around that is reflected, roughly: as if only diffuse lobes had colours."""
        bsdf = self.interaction.bsdf()
        diffuse = finite_or_zero(mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(self.interaction)))
        has_diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
        return dr.select(has_diffuse, dr.minimum(diffuse + _GLOSS, 1), 1)

    def reflected(self, to_light, active):
        """BSDF times cosine for light from a world space direction."""
        si = self.interaction
        return mi.unpolarized_spectrum(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(to_light), active))

    def reflected_with_density(self, to_light, active):
        """(BSDF times cosine, density of :meth:`sample`) for light from a world space direction."""
        si = self.interaction
        value, density = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(to_light), active)
        return finite_or_zero(mi.unpolarized_spectrum(value)), finite_or_zero(density)

    def sample(self, sample1, sample2, active):
        """Draw a direction: (world space direction, BSDF times cosine over density, density per solid angle).

        Samples of delta lobes have no weight and no density here.
        """
        si = self.interaction
        sample, value = si.bsdf().sample(mi.BSDFContext(), si, sample1, sample2, active)
        smooth = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Smooth)
        weight, density = finite_or_zero(mi.unpolarized_spectrum(value)), finite_or_zero(sample.pdf)
        return si.to_world(sample.wo), weight & smooth, density & smooth


@dataclass
class Batch:
    """Gather points of one sort, evaluated: ``index``, their rows among all gather points, and what bounds need.

    ``surfaces``: one of the surface classes; ``normal``: shading normal towards the viewer; ``proxy``: for the bounds.
    """

    index: object
    surfaces: Surface
    normal: object
    proxy: MaterialProxy

    @property
    def count(self) -> int:
        return dr.width(self.index)

    @property
    def position(self):
        return self.surfaces.interaction.p

    @property
    def receiver(self) -> Receiver:
        """The points as bounds see them."""
        return Receiver(self.position, self.normal, self.proxy)

    def surfaces_at(self, row, active=True):
        """The surfaces of some rows of this batch, as lazy gathers."""
        return _gather(self.surfaces, row, active)

    def select(self, row) -> Batch:
        """A batch of some of the rows, evaluated."""
        part = Batch(
            dr.gather(mi.UInt32, self.index, row), _gather(self.surfaces, row, True),
            dr.gather(mi.Normal3f, self.normal, row), self.proxy.select(row),
        )  # fmt: skip
        dr.eval(part.index, vars(part.surfaces), part.normal, vars(part.proxy))
        return part


def _gather(surfaces: Surface, row, active):
    return type(surfaces)(**{k: dr.gather(type(v), v, row, active) for k, v in vars(surfaces).items()})


def make_batches(points: GatherPoints, proxy: MaterialProxy) -> list[Batch]:
    """Split gather points into Lambertian ones and all others; batches without a point are left out."""
    batches = []
    for lambertian in (True, False):
        index = dr.compress(proxy.lambertian if lambertian else ~proxy.lambertian)
        if len(index) == 0:
            continue
        part, part_proxy = points.select(index), proxy.select(index)
        part_proxy.glossy &= not lambertian
        part_proxy.without_cosines &= not lambertian
        normal = part.si.sh_frame.n * dr.mulsign(mi.Float(1), mi.Frame3f.cos_theta(part.si.wi))
        if lambertian:
            interaction = dr.zeros(mi.Interaction3f, len(index))
            # All that is gathered is an array: a literal here would make kernels of parts of the batch other ones
            for name in ("p", "n", "t", "time"):
                setattr(interaction, name, getattr(part.si, name))
            surfaces = LambertianSurface(interaction, part.depth, normal, part_proxy.base)
        else:
            surfaces = ScatteringSurface(part.si, part.depth)
        dr.eval(vars(surfaces), normal, vars(part_proxy))
        batches.append(Batch(index, surfaces, normal, part_proxy))
    return batches


@dataclass
class Receiver:
    """Gather points, or boxes of them, in a kernel: one per lane.

    ``position``: of a point, or the centre of a box of half extents ``extent`` (None for points); ``normal``: shading
    normal on the side of the outgoing direction, or the axis of a cone around the normals of half-angle
    acos(``normal_cosine``); ``mirror_cosine``: the same for the proxy's axis.
    """

    position: object
    normal: object
    proxy: MaterialProxy
    extent: object = None
    normal_cosine: object = None
    mirror_cosine: object = None
