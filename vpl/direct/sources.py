"""Sources of direct light behind one interface: rows of arrays, grouped into clusters.

A *source* is a point or spot emitter, a piece of an area emitter, a directional emitter, a region of the environment,
or an emitter of unknown kind, sampled by Mitsuba.  Sources at finite positions form the cluster forest [IAS section
4.3.1].  Every source without a position is a cluster of its own.  *Nodes* are the clusters: the forest in preorder,
then the single sources.  The *rank* of a source is its position along the leaves: every node holds a range of ranks.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero, rgb_to_spectrum, select_record, upload
from ..core.sampling import find_interval
from ..lights.emission import bounding_sphere, other_power
from ..lights.emitters import Emitters
from ..lights.virtual_lights import DeviceLights, VirtualLights, geometry
from .emitter_clusters import build_cluster_forest
from .emitter_pieces import EmitterPieces
from .environment_regions import regions_of

# Radius of nodes without a finite position
RADIUS_AT_INFINITY = -1.0


@dataclass
class Nodes:
    """Clusters as NumPy arrays of m rows.

    - ``center`` (m, 3), ``radius`` (m,), float64: bounding spheres, world units; radius RADIUS_AT_INFINITY, and an
      undefined centre, for nodes at infinity
    - ``axis`` (m, 3), ``cone_cos`` (m,), float64: cone of the directions that sources face, -1 for omnidirectional
      sources; for nodes at infinity, cone of the directions towards the source
    - ``intensity`` (m,), float64: radiant intensity, or irradiance for nodes at infinity
    - ``centroid`` (m, 3), float64: intensity-weighted mean position
    - ``escape`` (m,), uint32: node after this node's subtree
    - ``first``, ``last`` (m,), uint32: range of ranks of the node's sources
    - ``extended`` (m,), int64: number of sources with an extent
    """

    center: np.ndarray
    radius: np.ndarray
    axis: np.ndarray
    cone_cos: np.ndarray
    intensity: np.ndarray
    centroid: np.ndarray
    escape: np.ndarray
    first: np.ndarray
    last: np.ndarray
    extended: np.ndarray

    @property
    def count(self) -> int:
        return len(self.radius)

    @property
    def infinite(self) -> np.ndarray:
        return self.radius == RADIUS_AT_INFINITY


@dataclass
class SourceSample:
    """Points on sources in a kernel, one per lane.

    ``direction``: unit vector to the point; ``p``: end of the shadow ray; ``value``: incident radiance over density, or
    intensity over squared distance for sources without extent; ``pdf``: density per solid angle given the source, 0 for
    sources without extent.
    """

    direction: mi.Vector3f
    p: mi.Point3f
    value: mi.UnpolarizedSpectrum
    pdf: mi.Float


@dataclass
class DeviceNode:
    """Clusters in a kernel, one per lane; see :class:`Nodes`."""

    centroid: mi.Point3f
    radius: mi.Float
    axis: mi.Vector3f
    cone_cos: mi.Float
    intensity: mi.Float
    first: mi.UInt32
    last: mi.UInt32

    @property
    def infinite(self):
        """Mask of the nodes at infinity."""
        return self.radius == RADIUS_AT_INFINITY


class Sources:
    """The sources of a scene.  ``regions``: largest number of regions of the environment [IAS section 4.3.1]."""

    def __init__(self, scene, emitters: Emitters, regions: int = 300):
        self.emitters = emitters
        self._reach = 2 * float(bounding_sphere(scene).radius)
        self._pieces = EmitterPieces(scene, emitters.area)
        self._regions = None if emitters.environment is None else regions_of(emitters.environment, regions)
        self._others = [emitter for _, emitter in emitters.others]
        counts = (
            emitters.points.count, emitters.spots.count, self._pieces.count, emitters.directional.count,
            0 if self._regions is None else self._regions.count, len(self._others),
        )  # fmt: skip
        self._begin = np.concatenate([[0], np.cumsum(counts)])
        self._device = [
            DeviceLights(lights) if lights.count else None
            for lights in (emitters.points, emitters.spots, emitters.directional)
        ]
        self.nodes, order, intensity = self._cluster(scene)
        self.count = len(order)
        self.extended = bool(self._pieces.count or self._regions is not None)
        self._store(order, intensity)

    def _cluster(self, scene) -> tuple[Nodes, np.ndarray, np.ndarray]:
        """(Nodes, source of every rank, intensity of every rank)."""
        finite, rows = self._finite_sources()
        forest = build_cluster_forest(*finite)
        order = rows[forest.leaf_order]
        extended = np.cumsum(np.concatenate([[0], (order >= self._begin[2])]))
        counts = extended[forest.last] - extended[forest.first]
        nodes = Nodes(**{f.name: counts if f.name == "extended" else getattr(forest, f.name) for f in fields(Nodes)})
        single, more = self._single_nodes(scene, len(order))
        joined = Nodes(*(np.concatenate([getattr(nodes, f.name), getattr(single, f.name)]) for f in fields(Nodes)))
        joined.escape[nodes.count :] = np.arange(nodes.count, joined.count) + 1
        intensity = np.concatenate([finite[4][forest.leaf_order], single.intensity])
        return joined, np.concatenate([order, more]), intensity

    def _finite_sources(self):
        """(Centre, radius, axis, cosine of the cone, intensity) of emitting sources at finite positions; their rows."""

        def of(lights: VirtualLights):
            level = lights.intensity.mean(1, dtype=np.float64)
            # A spot emitter that also emits backwards is clustered with the point emitters
            cosine = np.where(lights.cone[:, 0] <= np.pi / 2, 1.0, -1.0)
            return lights.position.astype(np.float64), np.zeros(lights.count), lights.direction, cosine, level

        pieces = self._pieces
        parts = [
            of(self.emitters.points),
            of(self.emitters.spots),
            (pieces.center, pieces.radius, pieces.axis, pieces.cone_cos, pieces.intensity),
        ]
        columns = [np.concatenate(column).astype(np.float64) for column in zip(*parts, strict=True)]
        keep = np.flatnonzero((columns[4] > 0) & np.isfinite(columns[4]))
        return [column[keep] for column in columns], keep

    def _single_nodes(self, scene, rank: int) -> tuple[Nodes, np.ndarray]:
        """Nodes of single sources, from ``rank`` on, and the rows of these sources: directional, regions, unknown."""
        suns, regions, sphere = self.emitters.directional, self._regions, bounding_sphere(scene)
        rows = [(-d, 1.0, i) for d, i in zip(suns.direction, suns.intensity.mean(1, dtype=np.float64), strict=True)]
        if regions is not None:
            rows += zip(regions.axis, regions.cone_cos, regions.irradiance, strict=True)
        # Emitters of unknown kind are assumed to light the cross section of the scene with their whole power
        cross_section = np.pi * float(sphere.radius) ** 2
        rows += [((0.0, 0.0, 1.0), -1.0, other_power(emitter, sphere) / cross_section) for emitter in self._others]
        axis = np.array([row[0] for row in rows], np.float64).reshape(-1, 3)
        cone_cos, intensity = (np.array([row[k] for row in rows], np.float64) for k in (1, 2))
        keep = np.flatnonzero(intensity > 0)
        count, nothing = len(keep), np.zeros((len(keep), 3))
        ranks = (rank + np.arange(count)).astype(np.uint32)
        nodes = Nodes(
            nothing, np.full(count, RADIUS_AT_INFINITY), axis[keep], cone_cos[keep], intensity[keep], nothing,
            np.zeros(count, np.uint32), ranks, ranks + np.uint32(1), (keep >= suns.count).astype(np.int64),
        )  # fmt: skip
        return nodes, self._begin[3] + keep

    def _store(self, order, intensity):
        nodes = self.nodes
        records = np.zeros((nodes.count, 12), np.float32)
        records[:, 0:3], records[:, 3], records[:, 4:7] = nodes.centroid, nodes.radius, nodes.axis
        records[:, 7], records[:, 8] = nodes.cone_cos, nodes.intensity
        bits = records.view(np.uint32)
        bits[:, 9], bits[:, 10] = nodes.first, nodes.last
        self._records = upload(mi.Float, records)
        self._order = upload(mi.UInt32, order)
        rank = np.full(self._begin[-1], self.count, np.uint32)
        rank[order] = np.arange(self.count)
        self._rank = upload(mi.UInt32, rank)
        # Relative to the greatest intensity, against overflow and underflow
        scaled = intensity / intensity.max(initial=1e-300)
        self._cumulative = upload(dr.float64_array_t(mi.Float), np.concatenate([[0.0], np.cumsum(scaled)]))

    def node(self, index, active=True) -> DeviceNode:
        """Fetch one node per lane."""
        a, b, c = (dr.gather(mi.Vector4f, self._records, index * 3 + k, active) for k in range(3))
        first, last = (dr.reinterpret_array(mi.UInt32, x) for x in (c.y, c.z))
        return DeviceNode(mi.Point3f(a.xyz), a.w, b.xyz, b.w, c.x, first, last)

    def member(self, node: DeviceNode, sample):
        """Draw a source of each node by intensity [IAS section 4.3]: (rank, probability)."""
        rank = find_interval(self._cumulative, node.first, node.last, sample)
        return rank, self.member_probability(node, rank)

    def member_probability(self, node: DeviceNode, rank, active=True):
        """Probability that :meth:`member` draws the source of a rank from the node."""
        low, high, begin, end = (
            dr.gather(type(self._cumulative), self._cumulative, index, active)
            for index in (rank, rank + 1, node.first, node.last)
        )
        # If the node's intensity is lost to rounding in the running sum, :func:`find_interval` returns the last source
        rise = end - begin
        share = dr.select(rise > 0, (high - low) / rise, dr.select(rank + 1 == node.last, 1, 0))
        return dr.select(node.last == node.first + 1, 1, mi.Float(share))

    def sample(self, rank, interaction, member, sample, active) -> SourceSample:
        """Sample a point on the source of each rank for the reference point ``interaction``.

        ``member``: uniform number that draws the cell of a region; ``sample``: two uniform numbers.
        """
        row = dr.gather(mi.UInt32, self._order, rank, active)
        result = SourceSample(mi.Vector3f(0, 0, 1), interaction.p, mi.UnpolarizedSpectrum(0), mi.Float(0))
        for kind, begin, lights in zip(("point", "spot", "directional"), self._begin[[0, 1, 3]], self._device,
                                       strict=True):  # fmt: skip
            if lights is not None:
                here = active & self._within(row, begin, lights.count)
                found = self._sample_delta(kind, lights, row - int(begin), interaction, here)
                result = select_record(here, found, result)
        if self._pieces.count:
            here = active & self._within(row, self._begin[2], self._pieces.count)
            found, value = self._pieces.sample(row - int(self._begin[2]), interaction, sample, here)
            direction = dr.normalize(found.p - interaction.p)
            result = select_record(here, SourceSample(direction, found.p, value, found.pdf), result)
        if self._regions is not None:
            here = active & self._within(row, self._begin[4], self._regions.count)
            direction, value, pdf = self._regions.sample(row - int(self._begin[4]), member, sample, here)
            far = interaction.p + direction * self._reach
            result = select_record(here, SourceSample(direction, far, value, pdf), result)
        for number, emitter in enumerate(self._others):
            here = active & (row == int(self._begin[5]) + number)
            ds, weight = emitter.sample_direction(interaction, sample, here)
            value = finite_or_zero(mi.unpolarized_spectrum(weight))
            # Density 0 marks sources that BSDF samples never hit, here even with an extent
            result = select_record(here, SourceSample(ds.d, ds.p, value, mi.Float(0)), result)
        return result

    def _sample_delta(self, kind, lights: DeviceLights, row, interaction, active) -> SourceSample:
        light = lights.gather(row, active)
        direction, factor = geometry(kind, interaction.p, light, 0)
        end = interaction.p + direction * self._reach if kind == "directional" else light.position
        return SourceSample(direction, mi.Point3f(end), rgb_to_spectrum(light.intensity) * factor, mi.Float(0))

    @staticmethod
    def _within(row, begin: int, count: int):
        return (row >= int(begin)) & (row < int(begin) + count)

    def find(self, hit, ray, active):
        """Source that a ray from a gather point hits, for multiple importance sampling.

        ``hit``: preliminary intersection.  Returns (radiance towards the ray's origin, rank of the source or ``count``
        without a source, density of :meth:`sample` for the direction given the source).
        """
        radiance, pdf = dr.zeros(mi.UnpolarizedSpectrum, dr.width(ray.d)), mi.Float(0)
        row, found = mi.UInt32(0), mi.Bool(False)
        if self._pieces.count:
            piece, found, radiance, pdf = self._pieces.found(hit, ray, active)
            row = piece + int(self._begin[2])
        if self._regions is not None:
            sky = active & ~hit.is_valid()
            region, density = self._regions.find(ray.d, sky)
            radiance = dr.select(sky, self._regions.radiance(ray.d, sky), radiance)
            row, pdf = dr.select(sky, region + int(self._begin[4]), row), dr.select(sky, density, pdf)
            found |= sky
        if not self.extended:
            return radiance, mi.UInt32(self.count), pdf
        rank = dr.gather(mi.UInt32, self._rank, row, found)
        return radiance & found, dr.select(found, rank, self.count), pdf & found
