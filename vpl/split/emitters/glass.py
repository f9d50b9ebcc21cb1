"""Shadow rays through smooth glass, such as window panes, vitrines and bulbs.

A shadow ray starts in the direction of a sample of an emitter, is refracted at each surface of glass, and finds light
if it ends at the emitter of the sample.  The direction at its first vertex has the density of the sample, as if there
were no glass, so the ray need not end at the sampled point, as it would in manifold next event estimation [Hanika et
al. 2015].  A pane shifts the end of a ray by less than its thickness.

Samples of the BSDF find the same paths.  Multiple importance sampling weights both by their densities of the direction
at the vertex.  Both must agree on the density of the emitter sample.  So shadow rays find light only if the straight
line in this direction meets the emitter at which the refracted path ends before any other emitter.

Only samples of the BSDF find light that glass reflects, light that passes both glass and null surfaces, and light that
passes rough glass.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ...core.arrays import finite_or_zero
from ...core.materials import Materials
from ...core.registry import RegistryTable
from ...core.shapes import SceneShapes, scene_of
from ...points.camera_paths import SceneTraits

# The only material of Mitsuba 3.9.1 that refracts without scattering
_CLASS = "SmoothDielectric"
# Largest relative distance between a sampled point of an emitter and the first emitter on the line to it
_AT_POINT = 1e-3


@dataclass(frozen=True)
class Glass:
    """Surfaces of smooth glass in a ``scene`` with ``traits``.

    ``shapes`` (registry index, shape): surfaces of glass that are no emitters, with those of shape groups;
    ``instances``: registry indices of the instances of groups with such surfaces.
    """

    scene: mi.Scene
    traits: SceneTraits
    shapes: tuple
    instances: tuple

    @classmethod
    def of(cls, scene, traits: SceneTraits) -> Glass | None:
        """The glass of a scene, None without glass, and on CUDA, where a kernel can trace rays in one scene only."""
        shapes = SceneShapes.of(scene)
        found = {index: shape for index, shape in shapes.of_hits if _is_glass(shape)}
        if not found or dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
            return None
        groups = [one for one in shapes.groups if any(index in found for index, _ in one.shapes)]
        return cls(scene, traits, tuple(found.items()), tuple(index for one in groups for index, _ in one.instances))

    # ---------------------- Surfaces ----------------------

    @cached_property
    def _materials(self) -> Materials:
        return self.traits.materials.where(lambda bsdf: bsdf.class_name() == _CLASS)

    @cached_property
    def _surfaces(self) -> RegistryTable:
        return RegistryTable([index for index, _ in self.shapes], 1)

    @cached_property
    def _hits(self) -> RegistryTable:
        """On the CPU, an intersection with an instance has no shape."""
        return RegistryTable([*(index for index, _ in self.shapes), *self.instances], 1)

    @cached_property
    def _panes(self) -> mi.Scene | None:
        """A scene of the glass alone, None if a shape group has some."""
        return None if self.instances else scene_of([shape for _, shape in self.shapes])

    @cached_property
    def _sources(self) -> mi.Scene | None:
        """A scene of the emitting surfaces alone, None without such surfaces."""
        shapes = [shape for shape in self.scene.shapes() if shape.is_emitter()]
        return scene_of(shapes) if shapes else None

    def refracts(self, si: mi.SurfaceInteraction3f, sample: mi.BSDFSample3f, active: mi.Bool) -> mi.Bool:
        """Whether a ``sample`` of the BSDF at ``si`` passes a surface of glass."""
        passes = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaTransmission)
        return passes & (self._surfaces.at(si.shape, passes) == 1)

    # ---------------------- Shadow rays ----------------------

    def light(self, emitted, ray: mi.Ray3f, most: mi.UInt32, active: mi.Bool):
        """(Radiance that arrives along each shadow ray by way of glass, number of its surfaces on the way).

        ``emitted``: see :meth:`vpl.split.emitters.base.EmitterSampler.emitted`; ``ray``: to a point of an emitter, or
        endless; ``most``: surfaces that the light may pass.
        """
        if self._panes is not None:
            active = active & self._panes.ray_test(ray, active)
        return _refracted(self, emitted, ray, most, active)

    def at_end(self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, shape: mi.ShapePtr, active: mi.Bool) -> mi.Bool:
        """Whether the refracted shadow rays ``ray`` have arrived where they ``hit`` a ``shape``: at the emitter of the
        sample, if it is the first emitter on the straight line."""
        endless = ~(dr.isfinite(ray.maxt) & (ray.maxt < dr.largest(mi.Float)))
        arrives = active & endless & ~hit.is_valid()
        if self._sources is None:
            return arrives
        near = active & ~endless & hit.is_valid()
        first = self._sources.ray_intersect_preliminary(_endless(ray), active=near)
        near &= first.is_valid() & (dr.abs(first.t - ray.maxt) < _AT_POINT * ray.maxt)
        return arrives | (near & (first.shape == shape))

    def density(self, met, path, end: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Density of the directions in which each ``path`` has left its vertex, under an emitter sampler with the
        method ``met``, where glass has bent the path, which ends at the emitter ``end``."""
        # A branch, because few packets hold a bent path
        return dr.if_stmt(
            (path.vertex, path.cell, path.toward, path.ray.time, end.shape, end.is_valid()),
            active,
            lambda *bent: self._density(met, *bent),
            lambda *_: mi.Float(0),
        )

    def _density(self, met, vertex, cell, toward, time, shape, on_surface) -> mi.Float:
        line, hit = mi.Ray3f(vertex, toward, time), dr.zeros(mi.PreliminaryIntersection3f)
        hit.t = dr.inf
        if self._sources is not None:
            hit = self._sources.ray_intersect_preliminary(line, active=on_surface)
        same = dr.select(on_surface, hit.is_valid() & (hit.shape == shape), ~hit.is_valid())
        first = self.traits.interactions.at(hit, line, on_surface)
        return dr.select(same, met(vertex, cell, line, first, mi.Bool(True), same).density, 0)


@dr.syntax
def _refracted(glass: Glass, emitted, first: mi.Ray3f, most, active):
    """Follow shadow rays through at most ``most`` surfaces of glass, without reflection: see :meth:`Glass.light`."""
    ray, left, going = _endless(first), mi.UInt32(most), mi.Bool(active)
    passed, radiance = dr.select(going, mi.UnpolarizedSpectrum(1), 0), dr.zeros(mi.UnpolarizedSpectrum)
    while dr.hint(going, exclude=[glass, first, most]):
        hit = glass.scene.ray_intersect_preliminary(ray, active=going)
        on_glass = (glass._hits.at(hit.shape, going) == 1) | (glass._hits.at(hit.instance, going) == 1)
        crossed = going & hit.is_valid() & on_glass
        si = glass.traits.interactions.at(hit, ray, going)
        arrived = glass.at_end(first, hit, si.shape, going & ~crossed & (left < most))
        radiance = dr.select(arrived, passed * emitted(si, arrived), radiance)
        direction, share = glass._materials.call(si.bsdf(), _through, si, active=crossed)
        passed = dr.select(crossed, passed * share, passed)
        going = crossed & (left > 0) & dr.any(passed > 0)
        left -= dr.select(going, mi.UInt32(1), 0)
        ray = dr.select(going, si.spawn_ray(si.to_world(direction)), ray)
    return radiance, most - left


def _through(bsdf, si, active):
    """(Direction, fraction of the radiance) of the light that a surface of glass refracts."""
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.DeltaTransmission
    # The numbers choose between reflection and refraction, of which the context leaves one
    sample, share = bsdf.sample(context, si, 0.5, mi.Point2f(0.5), active)
    return sample.wo, finite_or_zero(mi.unpolarized_spectrum(share))


def _endless(ray: mi.Ray3f) -> mi.Ray3f:
    return mi.Ray3f(ray.o, ray.d, ray.time)


def _is_glass(shape) -> bool:
    return shape.bsdf().class_name() == _CLASS and not shape.is_emitter()
