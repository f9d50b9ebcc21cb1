"""Many emitters, chosen by a tree: clusters of them by what a pilot's vertices see, and one of a cluster by the way
down from it.  Kernels do not grow with the number of emitters."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero, rgb_to_spectrum, upload
from ..lights.emission import bounding_sphere, solid_angle_radiance
from ..lights.emitters import Emitters, registered_shapes
from ..lights.virtual_lights import DeviceLights, VirtualLights, spot_falloff
from ..points.camera_paths import emitted_towards
from .emitter_lights import EmitterLights, has_true_normals
from .emitter_samples import EmitterSample, MetEmitter
from .emitter_tree import EmitterTree
from .site_choice import SiteChoice

# Clusters of emitters that are told apart where it is learned what is seen, at most, and how they grow with the root of
# the rays that there are to learn by, of which sites take as large a part
_MOST_CLUSTERS, _CLUSTERS_BY_RAYS = 256, 0.25
# Share of the samples for which the tree is walked from its root
_USUAL_SHARE = 0.2
# Share of the emitters in the tree that are drawn alike where that is not known: near ones may be hidden, or shine
# elsewhere
_UNIFORM_SHARE = 0.1
# Least share of the samples that goes to emitters with a place, and to others, where there are both
_LEAST_SHARE = 0.1


class TreeEmitters:
    """Point, spot and area emitters, environment and directional ones.

    What is learned of, site by site: clusters of emitters with a place, and each of the others.  Where nothing is
    known, and for a share of the samples everywhere, the tree is walked from its root, so that near and bright ones
    come first, and those that are infinitely far away share what is left.

    ``emitters``: with a constant radiance each; ``rays``: about how many there are to learn by.  ``lights``: virtual
    lights that may stand for them, or None.
    """

    def __init__(self, scene, emitters: Emitters, rays: int):
        self._scene, self._emitters, self._environment = scene, emitters, emitters.environment
        omni = VirtualLights.concatenate([emitters.points, emitters.spots])
        # Kernels fetch both alike: the cone of a point emitter is all around
        omni.kind = "spot"
        self._omni, self._areas = DeviceLights(omni) if omni.count else None, emitters.area.count
        self._first_area = omni.count
        shapes = {index: shape for index, shape in registered_shapes(scene) if shape.is_emitter()}
        shapes = [shapes[int(index)] for index in emitters.area.shape_index]
        boxes = [shape.bbox() for shape in shapes]
        lights = EmitterLights(emitters, omni, np.array([has_true_normals(shape) for shape in shapes], bool))
        self.lights = lights if lights.any else None
        # One more, as arrays of one entry make other kernels
        self._is_carried = upload(mi.UInt32, np.append(lights.carried, False))
        center = np.array([np.array(box.center()) for box in boxes], np.float64).reshape(-1, 3)
        radius = np.array([0.5 * np.linalg.norm(np.array(box.extents())) for box in boxes], np.float64)
        intensity = np.concatenate([omni.intensity.mean(1), emitters.area.radiance.mean(1) * emitters.area.area])
        position, radius = np.concatenate([omni.position, center]), np.concatenate([np.zeros(omni.count), radius])
        clusters = int(np.clip(_CLUSTERS_BY_RAYS * rays**0.5, 1, _MOST_CLUSTERS))
        self._tree = EmitterTree(position, radius, intensity, clusters)
        self._directional = DeviceLights(emitters.directional) if emitters.directional.count else None
        self._distant = emitters.directional.count + (self._environment is not None)
        self._share = dr.opaque(mi.Float, self._located_share(float(intensity.sum(dtype=np.float64))))
        # The last source stands for the usual choice
        usual = np.zeros(self._tree.clusters + self._distant + 1)
        usual[-1] = 1
        self._clusters = dr.opaque(mi.UInt32, self._tree.clusters)
        self.choice = SiteChoice(usual, _USUAL_SHARE, np.array([len(usual) - 1]))

    def _located_share(self, intensity: float) -> float:
        """Share of the samples that goes to emitters with a place, of an intensity in all."""
        if not self._distant:
            return 1.0
        # By what would arrive if nothing was between, from half way to the edge of the scene
        sphere = bounding_sphere(self._scene)
        near = intensity / (0.5 * float(sphere.radius)) ** 2
        distant = float(self._emitters.directional.intensity.mean(1).sum(dtype=np.float64))
        if self._environment is not None:
            distant += solid_angle_radiance(self._environment, sphere.center)
        return float(np.clip(near / max(near + distant, 1e-30), _LEAST_SHARE, 1 - _LEAST_SHARE))

    @staticmethod
    def located(emitters: Emitters) -> int:
        """Number of emitters that a tree can hold."""
        return emitters.points.count + emitters.spots.count + emitters.area.count

    # ---------------------- Choice ----------------------

    def _draw(self, source, position, number, member, active):
        """An emitter of each source by two uniform numbers, of what kind and which: (whether it has a place, its row in
        the tree, its index among the distant ones)."""
        distant = mi.UInt32(max(self._distant - 1, 0))
        usual = source == self._clusters + self._distant
        near = active & dr.select(usual, number < self._share, source < self._clusters)
        index = source - self._clusters
        if self._distant:
            among = mi.UInt32(dr.maximum(number - self._share, 0) / (1 - self._share) * self._distant)
            index = dr.minimum(dr.select(usual, among, index), distant)
        alike, count = usual & (number < self._share * _UNIFORM_SHARE), self._tree.count
        node = dr.select(usual, 0, self._tree.root(source, near & ~usual))
        # Numbers of their own: of one that has been divided, too few bits would be left for thousands of emitters
        row = self._tree.draw(node, position, member, near & ~alike)
        alike_row = dr.minimum(mi.UInt32(member * count), count - 1)
        return near, dr.select(alike, alike_row, row), index

    def _probability(self, row, position, site, active):
        """Probability of drawing a row of the tree, and not something distant."""
        by_tree, within = self._tree.probability(row, position, active)
        learned = self.choice.probability(site, self._tree.cluster(row, active), active) * within
        by_tree = self._share * ((1 - _UNIFORM_SHARE) * by_tree + _UNIFORM_SHARE / self._tree.count)
        return learned + self._usual(site, active) * by_tree

    def _distant_probability(self, index, site, active):
        """Probability of drawing something distant, by its index."""
        learned = self.choice.probability(site, self._clusters + index, active)
        return learned + self._usual(site, active) * (1 - self._share) / self._distant

    def _usual(self, site, active):
        """Probability of the usual choice."""
        return self.choice.probability(site, self._clusters + self._distant, active)

    # ---------------------- Directions ----------------------

    def _toward(self, si, near, row, index, place, active) -> EmitterSample:
        """A direction to each emitter."""
        target, toward = mi.Point3f(si.p), mi.Vector3f(0, 0, 1)
        weight, density, is_point, far = mi.UnpolarizedSpectrum(0), mi.Float(0), mi.Bool(False), mi.Bool(False)
        nearness = mi.Float(dr.inf)
        if self._omni is not None:
            here = near & (row < self._first_area)
            light = self._omni.gather(row, here)
            offset = light.position - si.p
            distance2 = dr.squared_norm(offset)
            direction = offset * dr.rsqrt(distance2)
            falloff = spot_falloff(-dr.dot(light.direction, direction), light.cone) / distance2
            falloff = dr.select(here & (distance2 > 0), falloff, 0)
            target, toward = dr.select(here, light.position, target), dr.select(here, direction, toward)
            weight = dr.select(here, rgb_to_spectrum(light.intensity) * falloff, weight)
            density, is_point = dr.select(here, 1, density), is_point | here
            nearness = dr.select(here, 0, nearness)
        if self._areas:
            here, of_area = near & (row >= self._first_area), row - self._first_area
            ds = self._emitters.area.sample_direction(of_area, si, place, here)
            facing = here & (dr.dot(ds.d, ds.n) < 0) & (ds.pdf > 0)
            radiance = self._emitters.area.emitted_in_front(of_area, ds, facing)
            target, toward = dr.select(here, ds.p, target), dr.select(here, ds.d, toward)
            weight, density = dr.select(facing, radiance / ds.pdf, weight), dr.select(facing, ds.pdf, density)
            nearness = dr.select(here, self._nearness(of_area, ds.n, ds.d, ds.dist, here), nearness)
        if self._environment is not None:
            here = active & ~near & (index == self._distant - 1)
            ds, radiance = self._environment.sample_direction(si, place, here)
            toward, far = dr.select(here, ds.d, toward), far | here
            weight = dr.select(here, mi.unpolarized_spectrum(radiance), weight)
            density = dr.select(here, ds.pdf, density)
        if self._directional is not None:
            here = active & ~near & (index < self._emitters.directional.count)
            light = self._directional.gather(index, here)
            toward, far = dr.select(here, -light.direction, toward), far | here
            weight = dr.select(here, rgb_to_spectrum(light.intensity), weight)
            density, is_point = dr.select(here, 1, density), is_point | here
        ray = dr.select(far, si.spawn_ray(toward), si.spawn_ray_to(target))
        return EmitterSample(toward, weight, density, is_point, ray, nearness)

    def _nearness(self, row, normal, direction, distance, active):
        """See :class:`vpl.split.emitter_samples.EmitterSample`, of area emitters."""
        carried = dr.gather(mi.UInt32, self._is_carried, row, active) == 1
        return dr.select(carried, dr.abs(dr.dot(normal, direction)) / dr.square(distance), dr.inf)

    def sample(self, si, site, chosen, member, place, active) -> EmitterSample:
        """As :meth:`vpl.split.next_event.UniformEmitters.sample`."""
        source, _, number = self.choice.draw(site, chosen, active)
        near, row, index = self._draw(source, si.p, number, member, active)
        probability = self._probability(row, si.p, site, near)
        if self._distant:
            probability = dr.select(near, probability, self._distant_probability(index, site, active & ~near))
        return self._toward(si, near, row, index, place, active).chosen_with(probability)

    def met(self, vertex, site, ray, si, has_density, active) -> MetEmitter:
        """As :meth:`vpl.split.next_event.UniformEmitters.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv, ds.d, ds.dist = si.p, si.n, si.uv, ray.d, si.t
        density, nearness = mi.Float(0), mi.Float(dr.inf)
        if self._areas:
            found = self._emitters.area.row(si, active & has_density & si.is_valid())
            here, row = active & has_density & si.is_valid() & (found > 0), found - 1
            pdf = self._emitters.area.on_shape("pdf_direction", row, origin, ds, here)
            density = dr.select(here, pdf * self._probability(row + self._first_area, vertex, site, here), density)
            nearness = dr.select(here, self._nearness(row, si.n, ray.d, si.t, here), nearness)
        if self._environment is not None:
            here = active & has_density & ~si.is_valid()
            # Of a black one, Mitsuba's is no number
            pdf = finite_or_zero(self._environment.pdf_direction(origin, ds, here))
            probability = self._distant_probability(mi.UInt32(self._distant - 1), site, here)
            density = dr.select(here, pdf * probability, density)
        return MetEmitter(emitted_towards(self._emitters, si, active), density, nearness)
