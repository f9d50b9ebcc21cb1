"""Many emitters, chosen through a tree: a cluster by learned probabilities, and an emitter by the way down from it.

Kernels do not grow with the number of emitters.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import finite_or_zero, rgb_to_spectrum, upload
from ...core.interactions import direction_sample, ray_to_emitter
from ...core.shapes import registered_shapes
from ...lights.emission import bounding_sphere, solid_angle_radiance
from ...lights.emitter_groups import EmitterGroups
from ...lights.emitters import Emitters
from ...lights.virtual_lights import DeviceLights, VirtualLights, spot_falloff
from ...points.camera_paths import emitted_towards, scene_traits
from ..emitter_lights import EmitterLights, has_true_normals
from .base import EmitterSample, MetEmitter
from .cell_choice import CellChoice
from .cell_emitters import CellEmitters
from .emitter_tree import EmitterTree, Found
from .glass import Glass

# Largest number of clusters; their number grows with the root of the rays to learn by, as does the number of cells
_MOST_CLUSTERS, _CLUSTERS_BY_RAYS = 256, 0.25
# Fraction of the samples that draw from the root: a cell may receive light invisible from the pilot vertices
_ROOT_SHARE = 0.2
# Fraction of the draws from the root that are uniform over the emitters: near emitters may be hidden or shine elsewhere
_UNIFORM_SHARE = 0.1
# Least fraction of the draws from the root for located emitters, and for distant emitters, in scenes with both: the
# unoccluded light of one kind does not tell what arrives of the other
_LEAST_SHARE = 0.1


class TreeEmitters(CellEmitters):
    """Choice among point, spot, area, environment and directional emitters.

    The probabilities of clusters of located emitters, and of each distant emitter, are learned by spatial cell.  A
    fraction of the samples draws from the root of the tree, which prefers near and bright emitters; in cells without
    knowledge, every sample does.  Distant emitters share a fixed fraction of the draws from the root.

    ``emitters``: each with a constant radiance; ``rays``: approximate number of rays to learn by; ``lights``: virtual
    lights representing the emitters, or None.
    """

    def __init__(self, scene, emitters: Emitters, rays: int, groups: EmitterGroups | None = None):
        self._scene, self._emitters, self._environment = scene, emitters, emitters.environment
        self.traits = scene_traits(scene)
        self.glass = Glass.of(scene, self.traits)
        self.groups = groups
        omni = VirtualLights.concatenate([emitters.points, emitters.spots])
        # A single kernel for both: the cone of a point emitter holds every direction
        omni.kind = "spot"
        self._omni, self._areas = DeviceLights(omni) if omni.count else None, emitters.area.count
        self._first_area = omni.count
        shapes = {index: shape for index, shape in registered_shapes(scene) if shape.is_emitter()}
        shapes = [shapes[int(index)] for index in emitters.area.shape_index]
        boxes = [shape.bbox() for shape in shapes]
        lights = EmitterLights(emitters, omni, np.array([has_true_normals(shape) for shape in shapes], bool))
        self.lights = lights if lights.any else None
        # An additional entry, because Dr.Jit compiles different kernels for arrays of a single entry
        self._is_carried = upload(mi.UInt32, np.append(lights.carried, False))
        center = np.array([np.array(box.center()) for box in boxes], np.float64).reshape(-1, 3)
        radius = np.array([0.5 * np.linalg.norm(np.array(box.extents())) for box in boxes], np.float64)
        intensity = np.concatenate([omni.intensity.mean(1), emitters.area.radiance.mean(1) * emitters.area.area])
        position, radius = np.concatenate([omni.position, center]), np.concatenate([np.zeros(omni.count), radius])
        clusters = int(np.clip(_CLUSTERS_BY_RAYS * rays**0.5, 1, _MOST_CLUSTERS))
        self._tree = EmitterTree(position, radius, intensity, clusters)
        self._directional = DeviceLights(emitters.directional) if emitters.directional.count else None
        self._distant = emitters.directional.count + (self._environment is not None)
        # Of located emitters, by row of the tree, then of distant emitters
        distant = [
            emitters.directional.group,
            [groups.number(self._environment)] if self._environment and groups else [],
        ]
        self._group = upload(mi.UInt32, np.concatenate([omni.group, emitters.area.group, *distant])) if groups else None
        self._share = dr.opaque(mi.Float, self._located_share(float(intensity.sum(dtype=np.float64))))
        # The last source is the draw from the root
        usual = np.zeros(self._tree.clusters + self._distant + 1)
        usual[-1] = 1
        self._clusters = dr.opaque(mi.UInt32, self._tree.clusters)
        self.choice = CellChoice(usual, _ROOT_SHARE, np.array([len(usual) - 1]))

    def _located_share(self, intensity: float) -> float:
        """Fraction of the draws from the root that goes to located emitters, with the total ``intensity``."""
        if not self._distant:
            return 1.0
        # By unoccluded irradiance, with located emitters at half the radius of the scene
        sphere = bounding_sphere(self._scene)
        near = intensity / (0.5 * float(sphere.radius)) ** 2
        distant = float(self._emitters.directional.intensity.mean(1).sum(dtype=np.float64))
        if self._environment is not None:
            distant += solid_angle_radiance(self._environment, sphere.center)
        return float(np.clip(near / max(near + distant, 1e-30), _LEAST_SHARE, 1 - _LEAST_SHARE))

    @staticmethod
    def located(emitters: Emitters) -> int:
        """Number of emitters with a position."""
        return emitters.points.count + emitters.spots.count + emitters.area.count

    # ---------------------- Choice ----------------------

    def _draw(self, source, position, number, member, active):
        """Draw an emitter of each source by two uniform numbers.

        Returns (mask of located emitters, the emitter found in the tree, index among the distant emitters).
        """
        distant = mi.UInt32(max(self._distant - 1, 0))
        usual = source == self._clusters + self._distant
        near = active & dr.select(usual, number < self._share, source < self._clusters)
        index = source - self._clusters
        if self._distant:
            among = mi.UInt32(dr.maximum(number - self._share, 0) / (1 - self._share) * self._distant)
            index = dr.minimum(dr.select(usual, among, index), distant)
        alike, count = usual & (number < self._share * _UNIFORM_SHARE), self._tree.count
        target = dr.select(usual, 0, self._tree.root(source, near & ~usual))
        # A number of its own: `number` has too few bits left for thousands of emitters
        alike_row = dr.minimum(mi.UInt32(member * count), count - 1)
        target = dr.select(alike, self._tree.leaf(alike_row, near & alike), target)
        return near, self._tree.walk(target, member, position, near), index

    def _probability(self, found: Found, cell, active):
        """Probability of drawing a located emitter."""
        learned = self.choice.probability(cell, found.cluster, active) * found.within
        by_tree = self._share * ((1 - _UNIFORM_SHARE) * found.probability + _UNIFORM_SHARE / self._tree.count)
        return learned + self._from_root(cell, active) * by_tree

    def _distant_probability(self, index, cell, active):
        """Probability of drawing a distant emitter, by its index."""
        learned = self.choice.probability(cell, self._clusters + index, active)
        return learned + self._from_root(cell, active) * (1 - self._share) / self._distant

    def _from_root(self, cell, active):
        """Probability of the draw from the root."""
        return self.choice.probability(cell, self._clusters + self._distant, active)

    # ---------------------- Directions ----------------------

    def _toward(self, si, near, row, index, place, active) -> EmitterSample:
        """Sample a direction to each emitter."""
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
        ray = ray_to_emitter(si, toward, target, far)
        group = mi.UInt32(0)
        if self.groups:
            group = dr.gather(mi.UInt32, self._group, dr.select(near, row, self._tree.count + index), active)
        return EmitterSample(toward, weight, density, is_point, ray, group, nearness if self.lights else None)

    def _nearness(self, row, normal, direction, distance, active):
        """See :class:`vpl.split.emitters.base.EmitterSample`, of area emitters."""
        carried = dr.gather(mi.UInt32, self._is_carried, row, active) == 1
        return dr.select(carried, dr.abs(dr.dot(normal, direction)) / dr.square(distance), dr.inf)

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.sample`."""
        source, _, number = self.choice.draw(cell, chosen, active)
        near, found, index = self._draw(source, si.p, number, member, active)
        probability = self._probability(found, cell, near)
        if self._distant:
            probability = dr.select(near, probability, self._distant_probability(index, cell, active & ~near))
        return self._toward(si, near, found.row, index, place, active).chosen_with(probability)

    def emitted(self, si, active) -> mi.UnpolarizedSpectrum:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.emitted`."""
        return emitted_towards(self._emitters, si, active)

    def met(self, vertex, cell, ray, si, has_density, active) -> MetEmitter:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = direction_sample(vertex, si, ray.d)
        density, nearness = mi.Float(0), mi.Float(dr.inf)
        if self._areas:
            after = self._emitters.area.row(si, active & has_density & si.is_valid())
            here, row = active & has_density & si.is_valid() & (after > 0), after - 1
            # The back of a surface is not sampled
            here &= dr.dot(ds.d, ds.n) < 0
            pdf = self._emitters.area.on_shape("pdf_direction", row, origin, ds, here)
            leaf = self._tree.leaf(row + self._first_area, here)
            found = self._tree.walk(leaf, 0, vertex, here)
            density = dr.select(here, pdf * self._probability(found, cell, here), density)
            nearness = dr.select(here, self._nearness(row, si.n, ray.d, si.t, here), nearness)
        if self._environment is not None:
            here = active & has_density & ~si.is_valid()
            # Mitsuba's density is NaN for a black environment
            pdf = finite_or_zero(self._environment.pdf_direction(origin, ds, here))
            probability = self._distant_probability(mi.UInt32(self._distant - 1), cell, here)
            density = dr.select(here, pdf * probability, density)
        return MetEmitter(self.emitted(si, active), density, self._group_met(si), nearness if self.lights else None)
