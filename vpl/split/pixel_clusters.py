"""Light from virtual lights at gather vertices: a light cut for the vertices of a pixel with similar normals.

These vertices form a cluster.  The box and the cone of normals choose a light cut for the whole cluster, as in
Multidimensional Lightcuts [MDLC], but by expected errors (:func:`vpl.transport.bounds.expected_error`) instead of upper
bounds.  For each pair of the cluster and a node of the cut, a vertex is drawn by weight and a light of the node by
intensity.  Neighbouring pixels therefore share no representative lights.  Their errors are uncorrelated noise: samples
average the noise out, and a denoiser recognises noise.

Vertices are drawn by systematic sampling along the cut, from a random start for each cluster.  Successive nodes of a
cut are near each other.  They light successive vertices, which mostly belong to different cells of a finer film.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, channel_mean
from ..core.loops import recorded_once
from ..core.sampling import PairNumbers, derived_seed, find_interval, running_sums
from ..cuts.light_cuts import collect_cuts, limited_cuts
from ..points.bsdf_proxies import MaterialProxy
from ..points.surfaces import CutLambertianSurface, Receiver
from ..transport.evaluation import Transport, evaluate_pairs
from .contributions import LayerSums
from .gather_vertices import LitVertices, PackedVertices, joined
from .pixel_rays import PixelRays
from .spatial_cells import FACINGS, device_facing


@dataclass
class Receivers:
    """Clusters in the form of gather points for :mod:`vpl.cuts.light_cuts`: boxes with cones of normals, evaluated."""

    receiver: Receiver

    @classmethod
    def of(cls, center: mi.Point3f, extent: mi.Vector3f, axis: mi.Vector3f, cosine: mi.Float) -> Receivers:
        """From boxes and cones of normals: axes, cosines of half-angles."""
        count = dr.width(cosine)
        white, no = mi.Color3f(*(dr.opaque(mi.Float, 1.0, count) for _ in range(3))), mi.Bool(False)
        proxy = MaterialProxy(white, None, None, None, no, no, False, False)
        return cls(Receiver(center, axis, proxy, extent, cosine, by_expected_error=True))

    @property
    def count(self) -> int:
        return self.receiver.count

    def select(self, index) -> Receivers:
        """The clusters at ``index``, evaluated."""
        return Receivers(self.receiver.select(index))


class PixelClusters:
    """Clusters of lit vertices (at least one) by pixel and facing; each later vertex is a separate cluster.

    ``first``, ``size``: range of the vertices of each cluster; ``pixel`` of each cluster; ``vertices`` in the order of
    the clusters; ``camera_rays`` of the pixels.
    """

    def __init__(self, lit: LitVertices, camera_rays: PixelRays):
        vertices, together = lit.vertices, lit.count - lit.alone
        pixel = camera_rays.places(lit.rays).pixel
        first, size, order = _by_pixel_and_facing(vertices.normal, pixel, together, camera_rays.pixels)
        if lit.alone:
            last = dr.arange(mi.UInt32, lit.alone) + dr.opaque(mi.UInt32, together)
            first, size = joined(first, last), joined(size, dr.opaque(mi.UInt32, 1, lit.alone))
            order = joined(order, last)
        self.first, self.size = first, size
        self.vertices = PackedVertices(vertices, lit.rays, order)
        self.pixel = dr.gather(mi.UInt32, pixel, dr.gather(mi.UInt32, order, self.first))
        dr.eval(self.first, self.size, self.pixel)
        self.receivers = Receivers.of(*_bounds(self.vertices, self.first, self.size))
        self.cumulative = running_sums(self.vertices.level)

    @property
    def weight(self):
        """Sum of the weights of each cluster, double precision."""
        first = dr.gather(type(self.cumulative), self.cumulative, self.first)
        return dr.gather(type(self.cumulative), self.cumulative, self.first + self.size) - first

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
        one, ray = self.vertices.at(row)
        interaction = dr.zeros(mi.Interaction3f, dr.width(row))
        interaction.p, interaction.n = one.position, one.flat
        surface = CutLambertianSurface(interaction, one.depth, one.normal, mi.Color3f(1))
        return ray, surface, one.weight * (mi.Float(whole) / channel_mean(dr.abs(one.weight)))


def _by_pixel_and_facing(normal: mi.Normal3f, pixel: mi.UInt32, count: int, pixels: int):
    """Groups of the first ``count`` vertices, whose ``pixel`` ascends, by pixel and facing: (first and size of each
    group, the vertices in the order of the groups), evaluated."""
    if count == 0:
        return mi.UInt32(), mi.UInt32(), mi.UInt32()
    facing, vertex = device_facing(normal), dr.arange(mi.UInt32, count)
    dr.eval(pixel, facing)
    of_pixel, of_key = dr.zeros(mi.UInt32, pixels), dr.zeros(mi.UInt32, pixels * FACINGS)
    own, toward = dr.gather(mi.UInt32, pixel, vertex), dr.gather(mi.UInt32, facing, vertex)
    add_at(of_pixel, dr.opaque(mi.UInt32, 1, count), own)
    add_at(of_key, dr.opaque(mi.UInt32, 1, count), own * FACINGS + toward)
    dr.eval(of_pixel, of_key)
    begin, first = (dr.prefix_reduce(dr.ReduceOp.Add, number) for number in (of_pixel, of_key))
    order = _vertices_by_key(facing, begin, of_pixel, first, dr.zeros(mi.UInt32, count))
    used = dr.compress(of_key > 0)
    first, size = (dr.gather(mi.UInt32, x, used) for x in (first, of_key))
    dr.eval(first, size)
    return first, size, order


@recorded_once
@dr.syntax
def _vertices_by_key(facing, begin, number, first, order):
    """Write the vertices of each pixel and facing to ``order``, from ``first`` on.  A pixel has ``number`` vertices,
    from ``begin`` on."""
    key = dr.arange(mi.UInt32, dr.width(first))
    pixel, wanted, place, k = key // FACINGS, key % FACINGS, mi.UInt32(first), dr.zeros(mi.UInt32, dr.width(first))
    start, count = dr.gather(mi.UInt32, begin, pixel), dr.gather(mi.UInt32, number, pixel)
    while dr.hint(k < count, exclude=[facing, start, count, wanted, order]):
        found = dr.gather(mi.UInt32, facing, start + k) == wanted
        dr.scatter(order, start + k, place, found)
        place += dr.select(found, mi.UInt32(1), 0)
        k += 1
    dr.eval(place, order)
    return order


@recorded_once
@dr.syntax
def _bounds(vertices: PackedVertices, first, size):
    """Box and cone of normals of each range of vertices: (centre, half of the extent, axis, cosine), evaluated."""
    low, high = mi.Point3f(dr.inf), mi.Point3f(-dr.inf)
    axis, k = mi.Vector3f(0), dr.zeros(mi.UInt32, dr.width(first))
    while dr.hint(k < size, exclude=[vertices, first, size]):
        point, normal = vertices.place(first + k)
        low, high = dr.minimum(low, point), dr.maximum(high, point)
        axis += mi.Vector3f(normal)
        k += 1
    axis /= dr.maximum(dr.norm(axis), 1e-20)
    cosine, k = mi.Float(1), dr.zeros(mi.UInt32, dr.width(first))
    while dr.hint(k < size, exclude=[vertices, first, size, axis]):
        cosine = dr.minimum(cosine, dr.dot(axis, vertices.place(first + k)[1]))
        k += 1
    # Rounded down by 16 units in the last place, so the cone holds every normal
    box = 0.5 * (low + high), 0.5 * (high - low), axis, dr.maximum(cosine - 2e-6, -1)
    dr.eval(box)
    return box


def light_clusters(
    transport: Transport, clusters: PixelClusters, allowed, max_cut: int, seed: int, result, sums: LayerSums | None,
) -> int:  # fmt: skip
    """Add the light of virtual lights at the clusters to ``result``, per camera ray; returns the number of shadow rays.

    ``allowed``, for each cluster in double precision: largest expected error of a pair, as a contribution to the sum
    over the samples of the pixel; ``sums`` by layer.  A light of a node is drawn in proportion to intensity, so the
    drawn lights of a group have the expectation of the lights of the group.
    """
    # A cluster without weight may have any error
    threshold = mi.Float(allowed / dr.maximum(clusters.weight, np.finfo(np.float64).tiny))
    dr.eval(threshold)
    threshold, sizes = limited_cuts(transport.lights, clusters.receivers, threshold, max_cut)
    rays, numbers = 0, [PairNumbers(derived_seed(seed, k), clusters.size) for k in range(len(transport.lights.groups))]
    for chunk in collect_cuts(transport.lights, clusters.receivers, threshold, sizes):
        cluster, own = dr.gather(mi.UInt32, chunk.points, chunk.rows), numbers[chunk.number]
        of_light = own.random(cluster, chunk.group.first_light(chunk.nodes))
        of_vertex = own.systematic(cluster, chunk.place)
        ray, surface, weight = clusters.draw(cluster, of_vertex)
        light, scale = chunk.group.draw(chunk.nodes, of_light)
        value, traced = evaluate_pairs(transport, chunk.group, surface, light, scale)
        value = mi.UnpolarizedSpectrum(value) * weight * dr.opaque(mi.Float, chunk.group.sign)
        value = dr.select(chunk.written & dr.all(dr.isfinite(value)), value, 0)
        add_at(result, value, ray)
        if sums is not None:
            sums.add(value, ray, surface.depth + light.depth + 1, light.group)
        dr.eval(result, traced)
        rays += int(dr.count(traced)[0])
    return rays
