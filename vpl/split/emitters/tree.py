"""Many emitters, chosen through a tree: a cluster by learned probabilities, and an emitter by the way down from it.

Kernels do not grow with the number of emitters.
"""

from __future__ import annotations

from heapq import heappop, heappush

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import finite_or_zero, rgb_to_spectrum, upload
from ...core.shapes import registered_shapes
from ...lights.emission import bounding_sphere, solid_angle_radiance
from ...lights.emitter_groups import EmitterGroups
from ...lights.emitters import Emitters
from ...lights.light_set import largest_below, moments_below
from ...lights.light_tree import BOX_MAX, BOX_MIN, INTENSITY, build_light_tree
from ...lights.virtual_lights import DeviceLights, VirtualLights, spot_falloff
from ...points.camera_paths import emitted_towards, scene_traits
from ..emitter_lights import EmitterLights, has_true_normals
from .base import EmitterSample, MetEmitter
from .cell_choice import CellChoice
from .learned import CellEmitters

# Largest number of clusters; their number grows with the root of the rays to learn by, as does the number of cells
_MOST_CLUSTERS, _CLUSTERS_BY_RAYS = 256, 0.25
# Fraction of the samples that draw from the root: a cell may receive light invisible from the pilot vertices
_ROOT_SHARE = 0.2
# Fraction of the draws from the root that are uniform over the emitters: near emitters may be hidden or shine elsewhere
_UNIFORM_SHARE = 0.1
# Least fraction of the draws from the root for located emitters, and for distant emitters, in scenes with both
_LEAST_SHARE = 0.1
# Floats of a node's record in device memory: two vectors of four
_RECORD = 8
# Least distance of a vertex to a node, in standard deviations of the emitters' positions. Below 1, because a vertex
# near the mean is likely to be near some emitters, which would be drawn too rarely
_LEAST_DISTANCE = 0.6
# Least intensity of an emitter relative to the brightest: keeps the probability of every emitter positive
_LEAST_INTENSITY = 1e-12


class EmitterTree:
    """Tree over emitters at ``position`` (n, 3) with a ``radius`` (n,) and a radiant ``intensity`` (n,).

    From the root down, a child is drawn in proportion to its intensity over the squared distance [Conty Estevez and
    Kulla 2018, "Importance sampling of many lights with adaptive tree splitting"].  The tree lies in preorder, so the
    path to a known emitter, and the probability of drawing the emitter, need no record of turns.  ``clusters``: number
    of subtrees at the beginning of a learned choice, limited by ``most_clusters``.
    """

    def __init__(self, position: np.ndarray, radius: np.ndarray, intensity: np.ndarray, most_clusters: int):
        self.count = len(position)
        # The tree needs positive intensities, also of black emitters
        least = _LEAST_INTENSITY * float(intensity.max()) or 1.0
        intensity = np.maximum(intensity, least)
        colours = np.repeat(intensity[:, None], 3, axis=1).astype(np.float32)
        tree = build_light_tree(position.astype(np.float32), None, colours, np.random.default_rng(0))
        low, high = tree.records[:, BOX_MIN].astype(np.float64), tree.records[:, BOX_MAX].astype(np.float64)
        records = np.zeros((len(tree.records), _RECORD), np.float32)
        records[:, 0:3], variance = moments_below(tree, position, intensity)
        # Lower bound of the squared distance of a vertex: emitters extend beyond a single position
        records[:, 3] = _LEAST_DISTANCE**2 * variance + largest_below(tree, radius) ** 2
        leaf = tree.escape == np.arange(len(tree.records)) + 1
        records[:, 4] = tree.records[:, INTENSITY]
        records[:, 5] = tree.escape.astype(np.uint32).view(np.float32)
        records[:, 6] = tree.representative.astype(np.uint32).view(np.float32)
        self._records = upload(mi.Float, records)
        node_of_emitter = np.zeros(len(position), np.uint32)
        node_of_emitter[tree.representative[leaf]] = np.flatnonzero(leaf)
        self._leaf = upload(mi.UInt32, node_of_emitter)
        roots = _cut(tree.escape, records[:, 4], np.linalg.norm(high - low, axis=1), most_clusters)
        self.clusters = len(roots)
        self._root = upload(mi.UInt32, roots)
        self._cluster = upload(mi.UInt32, np.searchsorted(roots, node_of_emitter, side="right") - 1)

    def _escape(self, node):
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._records, node * _RECORD + 5))

    def _importance(self, node, position):
        place = dr.gather(mi.Vector4f, self._records, node * 2)
        intensity = dr.gather(mi.Float, self._records, node * _RECORD + 4)
        return intensity / dr.maximum(dr.squared_norm(place.xyz - position), place.w)

    def _left_share(self, left, right, position):
        """Probability of the left of two children."""
        of_left, of_right = self._importance(left, position), self._importance(right, position)
        share = of_left / (of_left + of_right)
        return dr.select(dr.isfinite(share), share, 0.5)

    def cluster(self, row, active):
        """The cluster of the emitter in a row."""
        return dr.gather(mi.UInt32, self._cluster, row, active)

    def root(self, cluster, active):
        """The node of a cluster."""
        return dr.gather(mi.UInt32, self._root, cluster, active)

    @dr.syntax
    def draw(self, node, position, number, active):
        """Draw an emitter below a node (0: the root) for each position by a uniform number: its row."""
        node = mi.UInt32(node)
        inner = active & (self._escape(node) != node + 1)
        while dr.hint(inner, exclude=[self]):
            left = node + 1
            right = self._escape(left)
            share = self._left_share(left, right, position)
            turns = number >= share
            taken = dr.select(turns, 1 - share, share)
            number = dr.select(turns, number - share, number) / taken
            number = dr.minimum(number, dr.one_minus_epsilon(mi.Float))
            node = dr.select(turns, right, left)
            inner = self._escape(node) != node + 1
        return dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._records, node * _RECORD + 6))

    @dr.syntax
    def probability(self, row, position, active):
        """Probabilities of :meth:`draw` for the emitter of a row: (from the root, from its cluster)."""
        target = dr.gather(mi.UInt32, self._leaf, row, active)
        root = self.root(self.cluster(row, active), active)
        node, probability, within = mi.UInt32(0), mi.Float(1), mi.Float(1)
        inner = active & (target != 0)
        while dr.hint(inner, exclude=[self]):
            left = node + 1
            right = self._escape(left)
            share = self._left_share(left, right, position)
            turns = target >= right
            taken = dr.select(turns, 1 - share, share)
            probability *= taken
            node = dr.select(turns, right, left)
            within = dr.select(node <= root, 1, within * taken)
            inner = node != target
        return dr.select(active, probability, 0), dr.select(active, within, 0)


def _cut(escape: np.ndarray, intensity: np.ndarray, size: np.ndarray, most: int) -> np.ndarray:
    """A cut of at most ``most`` nodes, sorted: divides the node with the largest intensity × size first."""
    priority = np.asarray(intensity, np.float64) * size
    nodes, leaves = [(-priority[0], 0)], []
    while nodes and len(nodes) + len(leaves) < most:
        _, node = heappop(nodes)
        if escape[node] == node + 1:
            leaves.append(node)
            continue
        for child in (node + 1, escape[node + 1]):
            heappush(nodes, (-priority[child], int(child)))
    return np.sort(leaves + [node for _, node in nodes])


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

        Returns (mask of located emitters, row in the tree, index among the distant emitters).
        """
        distant = mi.UInt32(max(self._distant - 1, 0))
        usual = source == self._clusters + self._distant
        near = active & dr.select(usual, number < self._share, source < self._clusters)
        index = source - self._clusters
        if self._distant:
            among = mi.UInt32(dr.maximum(number - self._share, 0) / (1 - self._share) * self._distant)
            index = dr.minimum(dr.select(usual, among, index), distant)
        alike, count = usual & (number < self._share * _UNIFORM_SHARE), self._tree.count
        node = dr.select(usual, 0, self._tree.root(source, near & ~usual))
        # A number of its own: `number` has too few bits left for thousands of emitters
        row = self._tree.draw(node, position, member, near & ~alike)
        alike_row = dr.minimum(mi.UInt32(member * count), count - 1)
        return near, dr.select(alike, alike_row, row), index

    def _probability(self, row, position, cell, active):
        """Probability of drawing the located emitter in a row of the tree."""
        by_tree, within = self._tree.probability(row, position, active)
        learned = self.choice.probability(cell, self._tree.cluster(row, active), active) * within
        by_tree = self._share * ((1 - _UNIFORM_SHARE) * by_tree + _UNIFORM_SHARE / self._tree.count)
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
        ray = dr.select(far, si.spawn_ray(toward), si.spawn_ray_to(target))
        group = mi.UInt32(0)
        if self.groups:
            group = dr.gather(mi.UInt32, self._group, dr.select(near, row, self._tree.count + index), active)
        return EmitterSample(toward, weight, density, is_point, ray, group, nearness)

    def _nearness(self, row, normal, direction, distance, active):
        """See :class:`vpl.split.emitters.base.EmitterSample`, of area emitters."""
        carried = dr.gather(mi.UInt32, self._is_carried, row, active) == 1
        return dr.select(carried, dr.abs(dr.dot(normal, direction)) / dr.square(distance), dr.inf)

    def sample(self, si, cell, chosen, member, place, active) -> EmitterSample:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.sample`."""
        source, _, number = self.choice.draw(cell, chosen, active)
        near, row, index = self._draw(source, si.p, number, member, active)
        probability = self._probability(row, si.p, cell, near)
        if self._distant:
            probability = dr.select(near, probability, self._distant_probability(index, cell, active & ~near))
        return self._toward(si, near, row, index, place, active).chosen_with(probability)

    def met(self, vertex, cell, ray, si, has_density, active) -> MetEmitter:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.met`."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv, ds.d, ds.dist = si.p, si.n, si.uv, ray.d, si.t
        density, nearness = mi.Float(0), mi.Float(dr.inf)
        if self._areas:
            found = self._emitters.area.row(si, active & has_density & si.is_valid())
            here, row = active & has_density & si.is_valid() & (found > 0), found - 1
            pdf = self._emitters.area.on_shape("pdf_direction", row, origin, ds, here)
            density = dr.select(here, pdf * self._probability(row + self._first_area, vertex, cell, here), density)
            nearness = dr.select(here, self._nearness(row, si.n, ray.d, si.t, here), nearness)
        if self._environment is not None:
            here = active & has_density & ~si.is_valid()
            # Mitsuba's density is NaN for a black environment
            pdf = finite_or_zero(self._environment.pdf_direction(origin, ds, here))
            probability = self._distant_probability(mi.UInt32(self._distant - 1), cell, here)
            density = dr.select(here, pdf * probability, density)
        return MetEmitter(emitted_towards(self._emitters, si, active), density, self._group_met(si), nearness)
