"""Shadow rays through smooth glass, such as window panes, vitrines and bulbs.

A shadow ray starts in the direction of a sample of an emitter, is refracted at each surface of glass, and finds light
if it ends at the emitter of the sample.  The direction at its first vertex has the density of the sample, as if there
were no glass, so the ray need not end at the sampled point, as it would in manifold next event estimation [Hanika et
al. 2015].  A pane shifts the end of a ray by less than its thickness.

Samples of the BSDF find the same paths.  Multiple importance sampling weights both by their densities of the direction
at the vertex.  Both must agree on the density of the emitter sample.  So where the refracted path ends at an emitting
surface, shadow rays find its light only if this is also the first emitting surface on the straight line.

Only samples of the BSDF find light that glass reflects, light that passes both glass and null surfaces, and light that
passes rough glass.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...core.arrays import finite_or_zero
from ...core.registry import RegistryTable
from ...core.shapes import SceneShapes, scene_of
from ...points.camera_paths import SceneTraits
from ...transport.contribution import has_end

# The only material of Mitsuba 3.9.1 that refracts without scattering
_CLASS = "SmoothDielectric"
# Largest relative distance between a sampled point of an emitter and the first emitter on the line to it: rounding
_AT_POINT = 2e-4


class Glass:
    """Surfaces of smooth glass in a ``scene`` with ``traits``, those of emitters left out."""

    def __init__(self, scene, traits: SceneTraits):
        shapes = SceneShapes.of(scene)
        found = {index: shape for index, shape in shapes.of_hits if _is_glass(shape)}
        instances = [index for one in shapes.groups_with(found) for index, _ in one.instances]
        self.scene, self.traits = scene, traits
        self._shapes, self._in_groups = list(found.values()), bool(instances)
        self._surfaces = RegistryTable(list(found), 1)
        # On the CPU, an intersection with an instance has no shape
        self._hits = RegistryTable([*found, *instances], 1)
        self._materials = traits.materials.where(lambda bsdf: bsdf.class_name() == _CLASS)
        self._panes = self._sources = None

    @classmethod
    def of(cls, scene, traits: SceneTraits) -> Glass | None:
        """The glass of a scene, None without glass, and on CUDA, where a kernel can trace rays in one scene only."""
        if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
            return None
        return cls(scene, traits) if any(bsdf.class_name() == _CLASS for bsdf in traits.materials.bsdfs) else None

    def make_scenes(self) -> None:
        """Make the scenes that shadow rays need: of the glass, unless a shape group has some, and of the emitting
        surfaces."""
        if self._panes is None and self._shapes and not self._in_groups:
            self._panes = scene_of(self._shapes)
        emitting = [shape for shape in self.scene.shapes() if shape.is_emitter()]
        if self._sources is None and emitting:
            self._sources = scene_of(emitting)

    def is_passed(self, si: mi.SurfaceInteraction3f, sample: mi.BSDFSample3f, active: mi.Bool) -> mi.Bool:
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

    def at_end(
        self, straight: mi.Ray3f, hit: mi.PreliminaryIntersection3f, shape: mi.ShapePtr, active: mi.Bool
    ) -> mi.Bool:  # fmt: skip
        """Whether a refracted ray has arrived where it ``hit`` a ``shape``: at the emitter of the sample.

        ``straight``: the ray to the sampled point, which must lie on the first emitting surface along this ray, or an
        endless ray.
        """
        ends = has_end(straight)
        arrives = active & ~ends & ~hit.is_valid()
        if self._sources is None:
            return arrives
        near = active & ends & hit.is_valid()
        first = self._sources.ray_intersect_preliminary(_endless(straight), active=near)
        # Mitsuba ends shadow rays before the sampled point
        distance = straight.maxt / (1 - mi.math.ShadowEpsilon)
        near &= first.is_valid() & (dr.abs(first.t - distance) < _AT_POINT * distance)
        return arrives | (near & (first.shape == shape))

    def density(self, met, path, end: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Density of the directions in which each ``path`` has left its vertex, under an emitter sampler with the
        method ``met``, where glass has bent the path, which ends at the emitter ``end``."""
        # A branch, because few packets hold a bent path
        return dr.if_stmt(
            (path.vertex, path.cell, path.origin, path.toward, path.ray.time, end.shape, end.is_valid()),
            active,
            lambda *bent: self._density(met, *bent),
            lambda *_: mi.Float(0),
        )

    def _density(self, met, vertex, cell, origin, toward, time, shape, on_surface) -> mi.Float:
        line, hit = mi.Ray3f(origin, toward, time), dr.zeros(mi.PreliminaryIntersection3f)
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
