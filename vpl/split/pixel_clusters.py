"""Light from virtual lights at gather vertices: a light cut for the vertices of a pixel with similar normals.

These vertices form a cluster.  Bounds on the box and the cone of normals choose a light cut for the whole cluster, as
in Multidimensional Lightcuts [MDLC].  For each pair of the cluster and a node of the cut, a vertex is drawn by weight
and a light of the node by intensity, anew for every pair.  Neighbouring pixels therefore share no representative
lights.  The error is uncorrelated noise: samples average the noise out, and a denoiser recognises noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, channel_mean, download, upload, upload_vectors
from ..core.sampling import derived_seed, find_interval, independent_sampler, precise_sample, running_sums
from ..cuts.light_cuts import collect_cuts, limited_cuts, upload_thresholds
from ..points.bsdf_proxies import MaterialProxy
from ..points.surfaces import LambertianSurface, Receiver
from ..transport.evaluation import Transport, evaluate_pairs
from .contributions import LayerSums
from .gather_vertices import LitVertices
from .pixel_rays import PixelRays
from .spatial_cells import FACINGS, facing


@dataclass
class Receivers:
    """Clusters in the form of gather points for :mod:`vpl.cuts.light_cuts`: boxes with cones of normals, evaluated."""

    receiver: Receiver

    @classmethod
    def of(cls, center, extent, axis, cosine) -> Receivers:
        """From boxes (n, 3) and cones of normals: axes (n, 3), cosines of half-angles (n,)."""
        count = len(center)
        white, no = mi.Color3f(*(dr.opaque(mi.Float, 1.0, count) for _ in range(3))), mi.Bool(False)
        proxy = MaterialProxy(white, None, None, None, no, no, False, False)
        center, extent, axis = (
            upload_vectors(kind, x) for kind, x in ((mi.Point3f, center), (mi.Vector3f, extent), (mi.Vector3f, axis))
        )
        return cls(Receiver(center, axis, proxy, extent, upload(mi.Float, cosine)))

    @property
    def count(self) -> int:
        return dr.width(self.receiver.position)

    def select(self, index) -> Receivers:
        """The clusters at ``index``, evaluated."""
        one = self.receiver
        position, normal, extent, cosine, base = (
            dr.gather(type(x), x, index)
            for x in (one.position, one.normal, one.extent, one.normal_cosine, one.proxy.base)
        )
        dr.eval(position, normal, extent, cosine, base)
        no = mi.Bool(False)
        return Receivers(
            Receiver(position, normal, MaterialProxy(base, None, None, None, no, no, False, False), extent, cosine)
        )


class PixelClusters:
    """Clusters of lit vertices (at least one) by pixel and facing; each later vertex is a separate cluster.

    ``camera_rays`` of the pixels.
    """

    def __init__(self, lit: LitVertices, camera_rays: PixelRays):
        vertices, rays, alone = lit.vertices, lit.rays, lit.alone
        # Shape (3, n): NumPy is several times faster
        position, normal = (np.stack([download(x) for x in vector]) for vector in (vertices.position, vertices.normal))
        pixel = camera_rays.pixel_of(download(rays)).astype(np.int64)
        key = pixel * FACINGS + facing(normal.T)
        key[len(key) - alone :] = (pixel.max() + 1) * FACINGS + np.arange(alone)
        order = np.argsort(key, kind="stable")
        position, normal, key = position.take(order, 1), normal.take(order, 1), key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        low, high = np.minimum.reduceat(position, first, 1), np.maximum.reduceat(position, first, 1)
        axis = np.add.reduceat(normal, first, 1)
        axis /= np.maximum(np.linalg.norm(axis, axis=0), 1e-20)
        size = np.diff(first, append=len(key))
        self.cluster = np.repeat(np.arange(len(first)), size)
        cosine = np.minimum.reduceat((normal * axis.take(self.cluster, 1)).sum(0), first)
        self.pixel = pixel[order[first]]
        # Rounded down by 16 units in the last place, so the cone holds every normal
        box = 0.5 * (low + high), 0.5 * (high - low), axis
        self.receivers = Receivers.of(*(x.T for x in box), np.maximum(cosine - 2e-6, -1))
        self.first, self.size = upload(mi.UInt32, first), upload(mi.UInt32, size)
        along = upload(mi.UInt32, order)
        self.ray, self._weight = (
            dr.gather(mi.UInt32, rays, along),
            dr.gather(mi.UnpolarizedSpectrum, vertices.weight, along),
        )
        at = [dr.gather(type(x), x, along) for x in (vertices.position, vertices.flat, vertices.normal, vertices.depth)]
        self._level = channel_mean(dr.abs(self._weight))
        self.cumulative = running_sums(self._level)
        sums = download(self.cumulative)
        self.weight = sums[first + size] - sums[first]
        dr.eval(at, self.ray, self._weight, self._level)
        self._vertices = at

    @property
    def count(self) -> int:
        return self.receivers.count

    def draw(self, cluster, sample):
        """Draw a vertex of each cluster by weight: (camera ray, white Lambertian surface, weight over probability)."""
        first = dr.gather(mi.UInt32, self.first, cluster)
        last = first + dr.gather(mi.UInt32, self.size, cluster)
        row = find_interval(self.cumulative, first, last, sample)
        whole = dr.gather(type(self.cumulative), self.cumulative, last) - dr.gather(
            type(self.cumulative), self.cumulative, first
        )
        interaction = dr.zeros(mi.Interaction3f, dr.width(row))
        position, flat, normal, depth = (dr.gather(type(x), x, row) for x in self._vertices)
        interaction.p, interaction.n = position, flat
        surface = LambertianSurface(interaction, depth, normal, mi.Color3f(1))
        factor = mi.Float(whole) / dr.gather(mi.Float, self._level, row)
        return (
            dr.gather(mi.UInt32, self.ray, row),
            surface,
            dr.gather(mi.UnpolarizedSpectrum, self._weight, row) * factor,
        )


def light_clusters(
    transport: Transport, clusters: PixelClusters, allowed: np.ndarray, max_cut: int, seed: int, result,
    sums: LayerSums | None,
) -> int:  # fmt: skip
    """Add the light of virtual lights at the clusters to ``result``, per camera ray; returns the number of shadow rays.

    ``allowed`` (clusters,): largest bound of a pair, as a contribution to the sum over the samples of the pixel;
    ``sums`` by layer.  A light of a node is drawn in proportion to intensity, so the drawn lights of a group have the
    expectation of the lights of the group.
    """
    with np.errstate(over="ignore"):  # a cluster without weight may have any error
        allowed = allowed / np.maximum(clusters.weight, np.finfo(np.float64).tiny)
    threshold, sizes, _ = limited_cuts(transport.lights, clusters.receivers, upload_thresholds(allowed), max_cut)
    rays = 0
    for number, chunk in enumerate(collect_cuts(transport.lights, clusters.receivers, threshold, sizes)):
        sampler = independent_sampler(derived_seed(seed, number), dr.width(chunk.rows))
        cluster = dr.gather(mi.UInt32, chunk.points, chunk.rows)
        ray, surface, weight = clusters.draw(cluster, precise_sample(sampler))
        light, scale = chunk.group.draw(chunk.nodes, precise_sample(sampler))
        value, traced = evaluate_pairs(transport, chunk.group, surface, light, scale)
        value = mi.UnpolarizedSpectrum(value) * weight * dr.opaque(mi.Float, chunk.group.sign)
        value = dr.select(chunk.written & dr.all(dr.isfinite(value)), value, 0)
        add_at(result, value, ray)
        if sums is not None:
            sums.add(value, ray, surface.depth + light.depth + 1, light.group)
        dr.eval(result, traced)
        rays += int(dr.count(traced)[0])
    return rays
