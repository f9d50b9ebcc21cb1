"""Vertices of camera paths at which virtual lights are gathered, and which of them are."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, upload


@dataclass
class GatherVertices:
    """Vertices of paths, one per lane.

    ``position``, ``normal`` (shading normal, on the side that is seen), ``flat`` (geometric normal), ``depth``: edges
    from the camera, 0 where there is no vertex; ``weight``: what irradiance that virtual lights send there contributes
    to the camera ray, unpolarized spectrum, may be negative; 0 where none is gathered.
    """

    position: object
    normal: object
    flat: object
    weight: object
    depth: object

    @classmethod
    def none(cls, count: int) -> GatherVertices:
        """No vertices."""
        weight = dr.zeros(mi.UnpolarizedSpectrum, count)
        return cls(mi.Point3f(0), mi.Normal3f(0), mi.Normal3f(0), weight, mi.UInt32(0))

    def select(self, index, *factors) -> GatherVertices:
        """Those picked by an index array, with their weights times some factors, evaluated."""
        picked = GatherVertices(*(dr.gather(type(x), x, index) for x in vars(self).values()))
        for factor in factors if len(index) else ():
            picked.weight *= factor
        dr.eval(picked)
        return picked

    def and_then(self, more: GatherVertices) -> GatherVertices:
        """These, and others after them, evaluated."""
        both = GatherVertices(*(joined(x, y) for x, y in zip(vars(self).values(), vars(more).values(), strict=True)))
        dr.eval(both)
        return both


def joined(first, second):
    """The lanes of one array and then those of another; to be evaluated by the caller.

    ``dr.concat`` holds the number of lanes in its kernel, which is then compiled anew for every one.
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
class Arrival:
    """Second vertices of paths: after the first that scatters, or the first where lights are gathered; one per lane.

    ``position``; ``normal`` of the side that was met; ``weight``: what irradiance there would contribute if virtual
    lights carried all of it (w = 1), 0 where they carry none; ``throughput`` of the path, and ``before``: the radiance
    that it had found before; means over channels.
    """

    position: object
    normal: object
    weight: object
    throughput: object
    before: object

    @classmethod
    def none(cls) -> Arrival:
        """No arrivals."""
        return cls(mi.Point3f(0), mi.Normal3f(0), mi.Float(0), mi.Float(0), mi.Float(0))


@dataclass
class LitVertices:
    """Gather ``vertices`` that are lit, with the camera ray of each (``rays``, UInt32); ``alone``: so many, the last
    ones, are of those after the first ones of their paths; ``kept``: samples of a pixel whose first one is lit."""

    vertices: GatherVertices
    rays: object
    alone: int
    kept: int

    @classmethod
    def of(cls, first: GatherVertices, later: GatherVertices, samples: int, most: int, seed: int) -> LitVertices:
        """At most ``most`` first vertices of every pixel, and as many later ones as their light is worth."""
        kept, number = min(most, samples), dr.opaque(mi.UInt32, samples)
        sample = dr.arange(mi.UInt32, dr.width(first.weight)) % number
        # Evenly among the samples of a pixel
        lit = mi.UInt64(sample) * dr.opaque(mi.UInt64, kept) % mi.UInt64(number) >= dr.opaque(mi.UInt64, samples - kept)
        rays = dr.compress(lit & (dr.max(dr.abs(first.weight)) > 0))
        later_rays, factor = drawn_later(first, later, samples, kept, seed)
        # As many as there would be among the first vertices that are lit
        share = dr.opaque(mi.Float, kept / samples)
        picked = first.select(rays).and_then(later.select(later_rays, factor, share))
        return cls(picked, joined(rays, later_rays), len(later_rays), kept)

    @property
    def count(self) -> int:
        return len(self.rays)


def drawn_later(first: GatherVertices, later: GatherVertices, samples: int, most: int, seed: int):
    """Some of the ``later`` vertices of each pixel, drawn so that each has the weight that ``most`` vertices of the
    pixel would have on average if all of its light was theirs: (camera rays, ascending, factors of their weights).

    Systematic sampling along each pixel, from a random start.  ``samples``: camera rays of a pixel, side by side.
    """
    levels = [channel_mean(dr.abs(x.weight)) for x in (first, later)]
    dr.eval(levels)
    of_first, of_later = (np.nan_to_num(download(x).astype(np.float64), posinf=0) for x in levels)
    pixels = np.arange(0, len(of_first), samples)
    sums = np.add.reduceat(of_later, pixels)
    step = (sums + np.add.reduceat(of_first, pixels)) / most
    start = np.random.default_rng(seed).random(len(pixels))
    number = np.floor(sums / np.where(sums > 0, step, 1) + start).astype(np.int64)
    pixel = np.repeat(np.arange(len(pixels)), number)
    rank = np.arange(len(pixel)) - np.repeat(np.cumsum(number) - number, number)
    cumulative = np.cumsum(of_later)
    target = (cumulative[pixels] - of_later[pixels])[pixel] + (rank + 1 - start[pixel]) * step[pixel]
    ray = np.minimum(np.searchsorted(cumulative, target, side="left"), len(of_later) - 1)
    # Rounding must not lead to a neighbouring pixel or to a vertex without weight
    kept = (of_later[ray] > 0) & (ray // samples == pixel)
    ray, factor = ray[kept], step[pixel[kept]] / of_later[ray[kept]]
    return upload(mi.UInt32, ray), upload(mi.Float, factor)
