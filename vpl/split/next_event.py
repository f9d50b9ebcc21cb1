"""Next-event estimation: how the emitter that a vertex is lit by is chosen, and with what density."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero, rgb_to_spectrum
from ..lights.emission import bounding_sphere, solid_angle_radiance
from ..lights.emitters import Emitters, read_emitters, registered_shapes
from ..lights.virtual_lights import DeviceLights, VirtualLights, spot_falloff
from ..points.camera_paths import emitted_towards
from .emitter_tree import EmitterTree
from .learned_emitters import LearnedEmitters

# With fewer emitters, what is hidden decides more than what is near, and Mitsuba's own choice is as good
_FEWEST_IN_TREE = 64
# Share of the emitters in the tree that are drawn alike: near ones may be hidden, or shine elsewhere
_UNIFORM_SHARE = 0.5
# Least share of the samples that goes to emitters with a place, and to others, where there are both
_LEAST_SHARE = 0.1


def emitters_of(scene):
    """The choice of emitters that suits a scene: :class:`UniformEmitters`, or :class:`TreeEmitters` where they are
    many, and all of kinds that arrays can hold."""
    count = len(scene.emitters())
    if count < _FEWEST_IN_TREE:
        return LearnedEmitters(scene) if count > 1 or scene.environment() is not None else UniformEmitters(scene)
    try:
        emitters = read_emitters(scene)
    except ValueError:
        # There is an emitter of which only Mitsuba knows how to draw a point
        return UniformEmitters(scene)
    if emitters.others or emitters.area.textured or emitters.dropped or not TreeEmitters.located(emitters):
        return UniformEmitters(scene)
    return TreeEmitters(scene, emitters)


class UniformEmitters:
    """Mitsuba's own choice: every emitter with the same probability."""

    def __init__(self, scene):
        self._scene = scene

    def learn(self, position, normal, rays: int, seed: int) -> bool:
        """There is nothing to learn."""
        return False

    def site(self, si, side):
        """Where the choice is a choice of its own: everywhere the same."""
        return mi.UInt32(0)

    def sample(self, si, site, chosen, member, place, active):
        """A direction to an emitter: (direction, visible radiance over density, density per solid angle, whether the
        emitter is a point or a direction)."""
        ds, weight = self._scene.sample_emitter_direction(si, place, True, active)
        return ds.d, finite_or_zero(mi.unpolarized_spectrum(weight)), ds.pdf, ds.delta

    def met(self, vertex, site, ray, si, has_density, active):
        """Radiance that a ray from ``vertex`` met at ``si``, and the density with which :meth:`sample` would have drawn
        it there."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        density = self._scene.pdf_emitter_direction(origin, ds, active & has_density)
        emitted = si.emitter(self._scene, active).eval(si, active)
        return finite_or_zero(mi.unpolarized_spectrum(emitted)) & active, density


class TreeEmitters:
    """Point, spot and area emitters chosen by a tree, near and bright ones first; environment and directional emitters
    share what is left.  Its kernels do not grow with the number of emitters.

    ``emitters``: with a constant radiance each.
    """

    def __init__(self, scene, emitters: Emitters):
        self._scene, self._emitters, self._environment = scene, emitters, emitters.environment
        omni = VirtualLights.concatenate([emitters.points, emitters.spots])
        # Kernels fetch both alike: the cone of a point emitter is all around
        omni.kind = "spot"
        self._omni, self._areas = DeviceLights(omni) if omni.count else None, emitters.area.count
        self._first_area = omni.count
        boxes = {index: shape.bbox() for index, shape in registered_shapes(scene) if shape.is_emitter()}
        boxes = [boxes[int(index)] for index in emitters.area.shape_index]
        center = np.array([np.array(box.center()) for box in boxes], np.float64).reshape(-1, 3)
        radius = np.array([0.5 * np.linalg.norm(np.array(box.extents())) for box in boxes], np.float64)
        intensity = np.concatenate([omni.intensity.mean(1), emitters.area.radiance.mean(1) * emitters.area.area])
        self._tree = EmitterTree(
            np.concatenate([omni.position, center]), np.concatenate([np.zeros(omni.count), radius]), intensity
        )  # fmt: skip
        self._directional = DeviceLights(emitters.directional) if emitters.directional.count else None
        self._distant = emitters.directional.count + (self._environment is not None)
        sphere = bounding_sphere(scene)
        self._share = mi.Float(1)
        if self._distant:
            # By what would arrive if nothing was between, from half way to the edge of the scene
            near = float(intensity.sum(dtype=np.float64)) / (0.5 * float(sphere.radius)) ** 2
            distant = float(emitters.directional.intensity.mean(1).sum(dtype=np.float64))
            if self._environment is not None:
                distant += solid_angle_radiance(self._environment, sphere.center)
            share = float(np.clip(near / max(near + distant, 1e-30), _LEAST_SHARE, 1 - _LEAST_SHARE))
            self._share = dr.opaque(mi.Float, share)

    @staticmethod
    def located(emitters: Emitters) -> int:
        """Number of emitters that a tree can hold."""
        return emitters.points.count + emitters.spots.count + emitters.area.count

    def _draw(self, position, number, active):
        """A row of the tree for each position, by a uniform number."""
        alike, count = number < _UNIFORM_SHARE, self._tree.count
        by_tree = dr.clip((number - _UNIFORM_SHARE) / (1 - _UNIFORM_SHARE), 0, dr.one_minus_epsilon(mi.Float))
        row = self._tree.draw(position, by_tree, active & ~alike)
        return dr.select(alike, dr.minimum(mi.UInt32(number * (count / _UNIFORM_SHARE)), count - 1), row)

    def _probability(self, row, position, active):
        """Probability of drawing a row of the tree, and not something distant."""
        by_tree = self._tree.probability(row, position, active)
        return self._share * ((1 - _UNIFORM_SHARE) * by_tree + _UNIFORM_SHARE / self._tree.count)

    def learn(self, position, normal, rays: int, seed: int) -> bool:
        """As :meth:`UniformEmitters.learn`."""
        return False

    def site(self, si, side):
        """As :meth:`UniformEmitters.site`."""
        return mi.UInt32(0)

    def sample(self, si, site, chosen, member, place, active):
        """As :meth:`UniformEmitters.sample`."""
        near = active & (chosen < self._share)
        number = dr.minimum(chosen / self._share, dr.one_minus_epsilon(mi.Float))
        row = self._draw(si.p, number, near)
        probability = self._probability(row, si.p, near)
        target, toward = mi.Point3f(si.p), mi.Vector3f(0, 0, 1)
        weight, density, is_point, far = mi.UnpolarizedSpectrum(0), mi.Float(0), mi.Bool(False), mi.Bool(False)
        if self._omni is not None:
            here = near & (row < self._first_area)
            light = self._omni.gather(row, here)
            offset = light.position - si.p
            distance2 = dr.squared_norm(offset)
            direction = offset * dr.rsqrt(distance2)
            falloff = spot_falloff(-dr.dot(light.direction, direction), light.cone) / distance2
            falloff = dr.select(here & (distance2 > 0), falloff, 0)
            target, toward = dr.select(here, light.position, target), dr.select(here, direction, toward)
            weight = dr.select(here, rgb_to_spectrum(light.intensity) * falloff / probability, weight)
            density, is_point = dr.select(here, probability, density), is_point | here
        if self._areas:
            here = near & (row >= self._first_area)
            row -= self._first_area
            ds = self._emitters.area.sample_direction(row, si, place, here)
            facing = here & (dr.dot(ds.d, ds.n) < 0) & (ds.pdf > 0)
            radiance = self._emitters.area.emitted_in_front(row, ds, facing)
            target, toward = dr.select(here, ds.p, target), dr.select(here, ds.d, toward)
            weight = dr.select(facing, radiance / (ds.pdf * probability), weight)
            density = dr.select(facing, ds.pdf * probability, density)
        if self._distant:
            one = (1 - self._share) / self._distant
            index = mi.UInt32(dr.maximum(chosen - self._share, 0) / one)
            last = mi.UInt32(self._distant - 1)
            index = dr.minimum(index, last)
            if self._environment is not None:
                here = active & ~near & (index == last)
                ds, radiance = self._environment.sample_direction(si, place, here)
                toward, far = dr.select(here, ds.d, toward), far | here
                weight = dr.select(here, mi.unpolarized_spectrum(radiance) / one, weight)
                density = dr.select(here, ds.pdf * one, density)
            if self._directional is not None:
                here = active & ~near & (index < self._emitters.directional.count)
                light = self._directional.gather(index, here)
                toward, far = dr.select(here, -light.direction, toward), far | here
                weight = dr.select(here, rgb_to_spectrum(light.intensity) / one, weight)
                density, is_point = dr.select(here, one, density), is_point | here
        weight = finite_or_zero(weight)
        arrives = active & (dr.max(weight) > 0) & (density > 0)
        ray = dr.select(far, si.spawn_ray(toward), si.spawn_ray_to(target))
        blocked = self._scene.ray_test(ray, arrives)
        return toward, dr.select(arrives & ~blocked, weight, 0), density, is_point

    def met(self, vertex, site, ray, si, has_density, active):
        """As :meth:`UniformEmitters.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv, ds.d, ds.dist = si.p, si.n, si.uv, ray.d, si.t
        density = mi.Float(0)
        if self._areas:
            row = self._emitters.area.row(si, active & has_density & si.is_valid())
            here = active & has_density & si.is_valid() & (row > 0)
            row -= 1
            pdf = self._emitters.area.on_shape("pdf_direction", row, origin, ds, here)
            density = dr.select(here, pdf * self._probability(row + self._first_area, vertex, here), density)
        if self._environment is not None:
            here = active & has_density & ~si.is_valid()
            pdf = self._environment.pdf_direction(origin, ds, here)
            density = dr.select(here, pdf * (1 - self._share) / self._distant, density)
        return emitted_towards(self._emitters, si, active), density
