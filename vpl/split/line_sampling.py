"""Random lines near the arrivals of camera paths, with a known density on surfaces.

A box of an octree over the arrivals (:mod:`vpl.split.arrival_octree`) is drawn, and then a line from the uniform
distribution of lines through the box: from a uniform point on the surface of the box, inwards by the cosine.  By the
formulas of Cauchy and Crofton, a line through a convex body of surface area S is expected to hit each side of a surface
of area A inside the body A / S times, for any shape and orientation of the surface.  Ray tracing alone thus draws
points on any kind of shape with a known density, and few points far from the arrivals.

Camera paths usually arrive at a single side of a surface.  With M the mean normal of the arrivals in a box, a line is
reversed with probability |M| if it runs along M.  A fraction (1 + cos(n, M)) / 2 of the lines through a side with
normal n runs against M, so the density on the side is A / S (1 + n·M).

Lines and densities are computed by kernels, because NumPy uses a single core.  Boxes have double precision: some are
smaller than the rounding of positions far from the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload, upload_vectors
from ..core.sampling import find_interval, independent_sampler, precise_sample
from .arrival_octree import SCENE_SHARE, ArrivalOctree
from .line_density import LineDensity


@dataclass
class Lines:
    """Line segments inside boxes, world units, evaluated.

    ``origin``, ``direction``, ``length``; ``low``, ``size``: the box of each, in double precision.
    """

    origin: mi.Point3f
    direction: mi.Vector3f
    length: mi.Float
    low: mi.Vector3d
    size: mi.Vector3d

    @property
    def count(self) -> int:
        return dr.width(self.length)

    def hold(self, line: mi.UInt32, position: mi.Point3f) -> mi.Bool:
        """Whether points lie in the boxes of the lines with the numbers ``line``, boundary included."""
        low, size = (dr.gather(type(x), x, line) for x in (self.low, self.size))
        return _inside(position, low, size)


class LineSampler:
    """Draws lines through the boxes of an octree, with a known ``density``; ``scene_size``: extent of the scene, world
    units."""

    def __init__(self, octree: ArrivalOctree):
        parts = octree.leaves, octree.parents
        self.scene_size = octree.scene_size
        low = [*(part.low for part in parts), octree.scene_low[None]]
        size = [*(part.size for part in parts), np.full((1, 3), octree.scene_size)]
        turn = [*(part.turn for part in parts), np.zeros((1, 3))]
        self._low, self._size, self._turn = (upload_vectors(mi.Vector3d, np.concatenate(x)) for x in (low, size, turn))
        chance = np.concatenate([*(part.chance for part in parts), [SCENE_SHARE]])
        self._cumulative = upload(mi.Float64, np.concatenate([[0.0], np.cumsum(chance)]))
        self._last = len(chance)
        self.density = LineDensity.of(octree)

    def draw(self, count: int, seed: int) -> Lines:
        """Draw ``count`` random lines, stratified over the boxes."""
        sampler = independent_sampler(seed, count)
        lane = dr.arange(mi.UInt32, count)
        sample = (mi.Float64(lane) + sampler.next_1d()) / dr.opaque(mi.Float64, float(count))
        row = find_interval(
            self._cumulative, dr.zeros(mi.UInt32, count), dr.opaque(mi.UInt32, self._last, count), sample
        )
        low, size, turn = (dr.gather(type(x), x, row) for x in (self._low, self._size, self._turn))
        place, direction, length = _chords(size, sampler)
        # A reversed line begins where it ended
        back = (sampler.next_1d() < dr.norm(turn)) & (dr.dot(direction, turn) > 0)
        place = dr.select(back, place + direction * length, place)
        direction = dr.select(back, -direction, direction)
        lines = Lines(mi.Point3f(low + place), mi.Vector3f(direction), mi.Float(length), low, size)
        dr.eval(lines)
        return lines


def _inside(position, low, size) -> mi.Bool:
    """Whether points lie in boxes, boundary included."""
    beyond = type(low)(position) - low
    return dr.all((beyond >= 0) & (beyond <= size))


def _chords(size, sampler):
    """Draw a line through each box of a ``size``: (entry relative to the lower corner, direction, length)."""
    number, vector = type(size.x), type(size)
    x, y, z = size
    sample = precise_sample(sampler) * (y * z + z * x + x * y)
    axis = dr.select(sample < y * z, mi.UInt32(0), dr.select(sample < y * z + z * x, mi.UInt32(1), 2))
    far = sampler.next_1d() < 0.5
    place = vector(*(precise_sample(sampler) * side for side in size))
    place = vector(*(dr.select(axis == k, dr.select(far, size[k], 0), place[k]) for k in range(3)))
    radius2, angle = precise_sample(sampler), dr.two_pi * precise_sample(sampler)
    inwards, radius = dr.sqrt(1 - radius2) * dr.select(far, number(-1), 1), dr.sqrt(radius2)
    components = inwards, radius * dr.cos(angle), radius * dr.sin(angle)
    direction = vector(*(
        dr.select(axis == k, components[0], dr.select(axis == (k + 2) % 3, components[1], components[2]))
        for k in range(3)
    ))  # fmt: skip
    # A line that runs along a side never leaves through it
    ahead = dr.select(direction > 0, size - place, -place) / direction
    distance = dr.min(dr.select(direction == 0, dr.inf, ahead))
    return place, direction, dr.maximum(distance, 0)
