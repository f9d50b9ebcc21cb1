"""Gather vertices: the vertices of camera paths where irradiance from virtual lights is added, and the choice of lit
vertices.

A path has a *first* gather vertex and may have *later* ones.  Only some vertices are lit: in a pixel with n samples, k
first vertices, and a number of later vertices in proportion to weight.  :class:`LitVertices` divides the weights by the
lit fractions, so the sum over lit vertices has the expectation of the sum over all vertices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, rgb_to_spectrum, select_record, spectrum_to_rgb, upload
from ..core.loops import recorded_once
from ..core.sampling import HASH_ROUNDS, derived_seed, independent_sampler, precise_sample
from .pixel_rays import PixelRays, RayNumbers

# Values of a packed vertex: a cache line of 64 bytes
_RECORD = 16


@dataclass
class GatherVertices:
    """Vertices of paths, one per lane.

    ``position``: world units; ``normal``: axis of the lobe (:class:`vpl.transport.minorant.Lobe`); ``flat``: geometric
    normal on the visible side; ``weight``: contribution to the camera ray per irradiance from virtual lights, an
    unpolarized spectrum, may be negative, 0 for no vertex; ``depth``: edges from the camera, 0 for no vertex.
    """

    position: mi.Point3f
    normal: mi.Normal3f
    flat: mi.Normal3f
    weight: mi.UnpolarizedSpectrum
    depth: mi.UInt32

    @classmethod
    def none(cls, count: int) -> GatherVertices:
        """Lanes without vertices."""
        weight = dr.zeros(mi.UnpolarizedSpectrum, count)
        return cls(mi.Point3f(0), mi.Normal3f(0), mi.Normal3f(0), weight, mi.UInt32(0))

    def select(self, index: mi.UInt32, factor: mi.Float | None = None) -> GatherVertices:
        """The vertices at ``index``, with weights multiplied by the ``factor`` of each (default: 1), evaluated."""
        factor = dr.opaque(mi.Float, 1.0, len(index)) if factor is None else factor
        # Every selection uses the same kernel
        dr.eval(index, factor)
        picked = GatherVertices(*(dr.gather(type(x), x, index) for x in vars(self).values()))
        if len(index):
            picked.weight *= factor
        dr.eval(picked)
        return picked

    def and_then(self, more: GatherVertices) -> GatherVertices:
        """These vertices followed by ``more``, evaluated."""
        both = GatherVertices(*(joined(x, y) for x, y in zip(vars(self).values(), vars(more).values(), strict=True)))
        dr.eval(both)
        return both


def joined(first, second):
    """Concatenate the lanes of two arrays; the caller evaluates the result.

    ``dr.concat`` puts the number of lanes into the kernel: Dr.Jit would compile a kernel for every number of lanes.
    """
    if dr.depth_v(first) > 1:
        return type(first)(*(joined(x, y) for x, y in zip(first, second, strict=True)))
    before, after = dr.width(first), dr.width(second)
    both = dr.zeros(type(first), before + after)
    for part, count, start in ((first, before, 0), (second, after, before)):
        if count:
            dr.scatter(both, part, dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start))
    return both


@dataclass
class SecondVertices:
    """Second vertices of paths, one per lane: the vertex after the first scattering or gathering vertex.

    ``position``: world units; ``normal``: geometric normal on the side of arrival; ``weight``: contribution per
    irradiance with w = 1, 0 where virtual lights carry nothing; ``throughput`` of the path up to the vertex;
    ``before``: radiance found by the path before the vertex.  The last three are means over channels.
    """

    position: mi.Point3f
    normal: mi.Normal3f
    weight: mi.Float
    throughput: mi.Float
    before: mi.Float

    @classmethod
    def none(cls) -> SecondVertices:
        """Lanes without vertices."""
        return cls(mi.Point3f(0), mi.Normal3f(0), mi.Float(0), mi.Float(0), mi.Float(0))


@dataclass
class Gathered:
    """Gather vertices of paths up to now, a record per lane.

    ``first``; ``second``; ``later``: a later gather vertex, drawn by weight; ``later_level``: sum of the weights of the
    later vertices, mean over channels.
    """

    first: GatherVertices
    second: SecondVertices
    later: GatherVertices
    later_level: mi.Float

    @classmethod
    def none(cls, count: int) -> Gathered:
        """Lanes that have met nothing."""
        return cls(GatherVertices.none(count), SecondVertices.none(), GatherVertices.none(count), mi.Float(0))

    def add(self, vertex: GatherVertices, is_first: mi.Bool, sample: mi.Float) -> None:
        """Record a vertex; ``sample``: a uniform number for the choice of the later vertex."""
        self.first = select_record(is_first, vertex, self.first)
        level = dr.select(is_first, 0, channel_mean(dr.abs(vertex.weight)))
        self.later_level += level
        self.later = select_record(sample * self.later_level < level, vertex, self.later)

    def finish(self) -> None:
        """Divide the weight of the drawn later vertex by the probability of the draw."""
        level = self.later_level
        self.later.weight *= dr.select(level > 0, level / channel_mean(dr.abs(self.later.weight)), 0)


class PackedVertices:
    """Gather vertices with the camera ``ray`` of each, in an ``order``, as packed records: the values of a vertex lie
    in one line of the cache.

    ``level``: weight of each vertex, the mean of the absolute values over channels.
    """

    def __init__(self, vertices: GatherVertices, ray: mi.UInt32, order: mi.UInt32):
        row, count = dr.arange(mi.UInt32, dr.width(order)), dr.width(order)
        one = GatherVertices(*(dr.gather(type(x), x, order) for x in vars(vertices).values()))
        self.level = channel_mean(dr.abs(one.weight))
        depth, ray = (dr.reinterpret_array(mi.Float, x) for x in (one.depth, dr.gather(mi.UInt32, ray, order)))
        weight = spectrum_to_rgb(one.weight)
        parts = [(one.position, ray), (one.flat, depth), (one.normal, mi.Float(0)), (weight, mi.Float(0))]
        self._records = dr.zeros(mi.Float, count * _RECORD)
        for number, (vector, value) in enumerate(parts):
            dr.scatter(self._records, mi.Vector4f(*vector, value), row * len(parts) + number)
        dr.eval(self._records, self.level)

    def place(self, row) -> tuple[mi.Point3f, mi.Normal3f]:
        """(Position, axis of the lobe) of vertices."""
        return mi.Point3f(self._part(row, 0).xyz), mi.Normal3f(self._part(row, 2).xyz)

    def at(self, row) -> tuple[GatherVertices, mi.UInt32]:
        """(Vertices, their camera rays)."""
        first, second, third, fourth = (self._part(row, number) for number in range(4))
        ray, depth = (dr.reinterpret_array(mi.UInt32, x.w) for x in (first, second))
        vectors = mi.Point3f(first.xyz), mi.Normal3f(third.xyz), mi.Normal3f(second.xyz)
        weight = mi.unpolarized_spectrum(rgb_to_spectrum(mi.Color3f(fourth.xyz)))
        return GatherVertices(*vectors, weight, depth), ray

    def _part(self, row, number: int) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, self._records, row * (_RECORD // 4) + number)


@dataclass
class LitVertices:
    """Gather vertices that virtual lights light.

    ``vertices``: first vertices by ascending ray, then later vertices; weights divided by the lit fraction; ``rays``:
    the camera ray of each vertex, UInt32; ``alone``: number of later vertices; each later vertex is a cluster.
    """

    vertices: GatherVertices
    rays: mi.UInt32
    alone: int

    @classmethod
    def of(
        cls, first: GatherVertices, later: GatherVertices, rays: PixelRays, most: int, seed: int, before: int = 0
    ) -> LitVertices:  # fmt: skip
        """Choose first vertices of every pixel with the camera ``rays``, and later vertices by weight: at most ``most``
        first vertices of a pixel with the mean number of rays, and as large a fraction of those of the others;
        ``before``: number of pixels of the image before these."""
        kept = rays.lit(most)
        places = rays.places(dr.arange(mi.UInt32, rays.count))
        of_level = (np.array(values) for values in (rays.sizes, kept))
        number, lighted = (dr.gather(mi.UInt32, upload(mi.UInt32, x), places.level) for x in of_level)
        # The lanes that fill a packet hold zeros, by which processors do not divide
        number = dr.maximum(number, 1)
        of_image = replace(places, pixel=places.pixel + dr.opaque(mi.UInt32, before))
        lit = _are_lit(of_image, number, lighted, dr.opaque(mi.UInt32, rays.cells), derived_seed(seed, 1))
        chosen = dr.compress(lit & (dr.max(dr.abs(first.weight)) > 0))
        later_rays, factor = drawn_later(first, later, rays, most, derived_seed(seed, 0))
        # A lit vertex represents the first vertices of its pixel
        stands_for = dr.gather(mi.Float, mi.Float(number) / mi.Float(lighted), chosen)
        picked = first.select(chosen, stands_for).and_then(later.select(later_rays, factor))
        return cls(picked, joined(chosen, later_rays), len(later_rays))

    @property
    def count(self) -> int:
        return len(self.rays)


def _are_lit(places: RayNumbers, number: mi.UInt32, lighted: mi.UInt32, cells: mi.UInt32, seed: int) -> mi.Bool:
    """Mask of the rays whose first vertices are lit: systematic sampling of ``lighted`` of the ``number`` rays of each
    pixel, from a random start.

    In the order of the sampling, the rays of a cell of the film follow each other, first those of one half
    (:func:`vpl.split.pixel_rays.half_of`), then those of the other; the second half comes first in two of four cells,
    the second and the third.  Cells and halves thus have about equal numbers of lit vertices, and no ray is preferred.
    """
    cell, turn = places.in_cells(cells)
    each, is_second = number // cells, (turn & 1) == 1
    comes_later = is_second ^ (((cell ^ (cell >> 1)) & 1) == 1)
    of_first = (each + 1) // 2
    before = dr.select(comes_later, dr.select(is_second, of_first, each - of_first), 0)
    order = cell * each + before + turn // 2
    start = dr.mul_hi(mi.sample_tea_32(places.pixel, dr.opaque(mi.UInt32, seed), HASH_ROUNDS)[0], number)
    walked = mi.UInt64(order) * mi.UInt64(lighted) + mi.UInt64(start)
    return walked % mi.UInt64(number) >= mi.UInt64(number - lighted)


def drawn_later(
    first: GatherVertices, later: GatherVertices, rays: PixelRays, most: int, seed: int
) -> tuple[mi.UInt32, mi.Float]:
    """Draw later vertices of each pixel in proportion to their weight.

    The expected number is the number of lit first vertices, see :class:`LitVertices`, times the fraction of later
    vertices in the total weight of the pixel.  Returns (camera rays, ascending; factors of the weights: the inverse of
    the expected number of draws of each vertex).  Systematic sampling along the ``rays`` of each pixel, from a random
    start.
    """
    levels = [channel_mean(dr.abs(x.weight)) for x in (first, later)]
    levels = [dr.select(dr.isfinite(level), level, 0) for level in levels]
    start = precise_sample(independent_sampler(seed, rays.pixels))
    dr.eval(levels, start)
    pixels = rays.device_first, rays.by_level(rays.sizes), rays.by_level(rays.lit(most)), start
    # The same kernel counts and records the draws
    number = _draw_systematically(pixels, levels, dr.zeros(mi.UInt32, rays.pixels), False, _Drawn.none(1))
    drawn = _Drawn.none(int(dr.sum(number)[0]))
    if dr.width(drawn.ray):
        _draw_systematically(pixels, levels, dr.prefix_reduce(dr.ReduceOp.Add, number), True, drawn)
    return drawn.ray, drawn.factor


@dataclass
class _Drawn:
    """Output arrays of :func:`_draw_systematically`: the ``ray`` and the ``factor`` of the weight for each draw."""

    ray: mi.UInt32
    factor: mi.Float

    @classmethod
    def none(cls, count: int) -> _Drawn:
        """Arrays of ``count`` entries, not written yet."""
        return cls(dr.zeros(mi.UInt32, count), dr.zeros(mi.Float, count))


@recorded_once
@dr.syntax
def _draw_systematically(pixels, levels, place, find: bool, drawn: _Drawn):
    """Number of draws of the later vertices of each of the ``pixels`` (first ray, rays, lit vertices, random start).

    ``levels``: weights of first and of later vertices.  With ``find``, writes the draws to ``drawn``, for each pixel
    from the index ``place`` on.
    """
    begin, rays, lit, start = pixels
    of_first, of_later = levels
    precise, find = dr.float64_array_t(mi.Float), dr.opaque(mi.Bool, find)
    dr.make_opaque(place, drawn)
    total, k = dr.zeros(precise, dr.width(begin)), dr.zeros(mi.UInt32, dr.width(begin))
    while dr.hint(k < rays, exclude=[begin, rays, of_first, of_later]):
        total += dr.gather(mi.Float, of_first, begin + k)
        total += dr.gather(mi.Float, of_later, begin + k)
        k += 1
    step, sum_of_later = total / precise(lit), dr.zeros(precise, dr.width(begin))
    number, k = (dr.zeros(mi.UInt32, dr.width(begin)) for _ in range(2))
    while dr.hint(k < rays, exclude=[begin, rays, of_later, start, step, place, find, drawn]):
        level = dr.gather(mi.Float, of_later, begin + k)
        sum_of_later += level
        draws = dr.select(step > 0, mi.UInt32(dr.floor(sum_of_later / step + start)), 0)
        while dr.hint(number < draws, exclude=[begin, k, level, step, place, find, drawn]):
            dr.scatter(drawn, _Drawn(begin + k, mi.Float(step / level)), place + number, find)
            number += 1
        k += 1
    dr.eval(number, drawn)
    return number
