"""Gather points for kernels: origins of shadow rays, and reflection of light.

Points with an exactly Lambertian BSDF are stored as position, normal and albedo.  The remaining points store the whole
surface interaction and call the scene's BSDF.  Separate batches keep BSDF calls out of Lambertian kernels.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import finite_or_zero, rgb_to_spectrum
from .bsdf_proxies import MaterialProxy
from .camera_paths import GatherPoints

# Reflectance of a glossy lobe above a diffuse lobe: Fresnel reflectance of glass at normal incidence
_GLOSS = 0.04


@dataclass
class Surface:
    """Surfaces in a kernel, one per lane.

    ``interaction``: position, geometric normal and time; ``depth``: edges from the camera.
    """

    interaction: mi.Interaction3f
    depth: mi.UInt32


@dataclass
class LambertianSurface(Surface):
    """Diffuse surfaces.  ``normal``: axis of the cosine lobe, for example the shading normal on the viewer's side;
    ``albedo``: reflectance / pi."""

    normal: mi.Normal3f
    albedo: mi.Color3f

    def material(self):
        """None: only the albedo distinguishes materials."""
        return None

    def reflectance(self):
        """Exact hemispherical reflectance."""
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
class CutLambertianSurface(LambertianSurface):
    """The same, without light from below: ``interaction.n`` is the geometric normal on the viewer's side."""

    def reflected(self, to_light, active):
        """BSDF times cosine for light from a world space direction."""
        return super().reflected(to_light, active & (dr.dot(self.interaction.n, to_light) > 0))


@dataclass
class ScatteringSurface(Surface):
    """Any material: ``interaction`` is a full surface interaction."""

    def material(self):
        """A number for the BSDF of each surface."""
        return dr.reinterpret_array(mi.UInt32, self.interaction.bsdf())

    def reflectance(self):
        """Approximate hemispherical reflectance: the diffuse lobe's plus a constant, or 1 without diffuse lobe."""
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

        Samples of delta lobes have zero weight and density.
        """
        si = self.interaction
        sample, value = si.bsdf().sample(mi.BSDFContext(), si, sample1, sample2, active)
        smooth = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Smooth)
        weight, density = finite_or_zero(mi.unpolarized_spectrum(value)), finite_or_zero(sample.pdf)
        return si.to_world(sample.wo), weight & smooth, density & smooth


@dataclass
class Batch:
    """Gather points with one surface class, evaluated.

    ``index``: rows in :class:`vpl.points.camera_paths.GatherPoints`; ``surfaces``: for shading; ``normal``: shading
    normal on the viewer's side; ``proxy``: upper bounds of the BSDFs.
    """

    index: mi.UInt32
    surfaces: LambertianSurface | ScatteringSurface
    normal: mi.Normal3f
    proxy: MaterialProxy

    @property
    def count(self) -> int:
        return dr.width(self.index)

    @property
    def position(self):
        return self.surfaces.interaction.p

    @property
    def receiver(self) -> Receiver:
        """The points for error bounds."""
        return Receiver(self.position, self.normal, self.proxy)

    def surfaces_at(self, row, active=True):
        """Surfaces at the given rows of this batch, as lazy gathers."""
        return _gather(self.surfaces, row, active)

    def select(self, row) -> Batch:
        """Batch of the given rows, evaluated."""
        part = Batch(
            dr.gather(mi.UInt32, self.index, row), _gather(self.surfaces, row, True),
            dr.gather(mi.Normal3f, self.normal, row), self.proxy.select(row),
        )  # fmt: skip
        dr.eval(part.index, vars(part.surfaces), part.normal, vars(part.proxy))
        return part


def _gather(surfaces: Surface, row, active):
    return type(surfaces)(**{k: dr.gather(type(v), v, row, active) for k, v in vars(surfaces).items()})


def make_batches(points: GatherPoints, proxy: MaterialProxy) -> list[Batch]:
    """Split gather points into a Lambertian batch and a batch of the remaining points; empty batches are omitted."""
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
            # Every field that kernels gather is an array: literals would give selected rows different kernels
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
    """Gather points, or nodes of a point tree, in a kernel: one per lane.

    ``position``: of a point, or the centre of a node's box; ``normal``: shading normal on the viewer's side, or the
    axis of a node's cone of normals; ``extent``: half extents of the box (None for points); ``normal_cosine``,
    ``mirror_cosine``: cosines of the half-angles of the cones of normals and of proxy axes (None for points);
    ``by_expected_error``: whether light cuts compare thresholds with :func:`vpl.transport.bounds.expected_error`,
    which needs a white proxy, boxes and cones, instead of the bound.
    """

    position: mi.Point3f
    normal: mi.Normal3f | mi.Vector3f
    proxy: MaterialProxy
    extent: mi.Point3f | None = None
    normal_cosine: mi.Float | None = None
    mirror_cosine: mi.Float | None = None
    by_expected_error: bool = False

    @property
    def count(self) -> int:
        return dr.width(self.position)

    def select(self, index: mi.UInt32) -> Receiver:
        """The receivers at ``index``, evaluated."""
        picked = {
            name: None if value is None else dr.gather(type(value), value, index)
            for name, value in vars(self).items()
            if name not in ("proxy", "by_expected_error")
        }
        picked = Receiver(**picked, proxy=self.proxy.select(index), by_expected_error=self.by_expected_error)
        dr.eval(picked)
        return picked
