"""Light of each source that arrives in each spatial cell, from a few rays of the cell and of its neighbours.

A *pair* is a cell and a source.  Arrays of pairs go cell by cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import add_at, channel_mean, upload
from ...core.loops import recorded_once

# Rays from a cell to each source
RAYS = 2
# Weight of the neighbours of a cell and of the prior visibility, as equivalent numbers of rays; the first is a maximum
_NEIGHBOURS, _PRIOR = 4.0, 1.0


@dataclass
class Looks:
    """Results of rays from cells to sources.

    For each pair: ``possible``: squared unoccluded irradiance, mean over the rays, double precision; ``found``: the
    same with 0 for rays that were blocked; ``rays``, ``hits``: numbers of rays with unoccluded light, and of those that
    found it, UInt32.
    """

    possible: mi.Float64
    found: mi.Float64
    rays: mi.UInt32
    hits: mi.UInt32

    @classmethod
    def none(cls, pairs: int) -> Looks:
        """Entries of ``pairs`` pairs, not written yet."""
        precise = dr.float64_array_t(mi.Float)
        return cls(*(dr.zeros(kind, pairs) for kind in (precise, precise, mi.UInt32, mi.UInt32)))

    def write(self, first: int, reached, unoccluded, learnable: mi.Bool) -> None:
        """Write the pairs from ``first`` on.

        Irradiance by each ray, :data:`RAYS` for each pair: ``reached``, a spectrum; ``unoccluded``, mean over channels;
        ``learnable``: whether each source is learned; others count as black.
        """
        pairs = dr.width(unoccluded) // RAYS
        lane, precise = dr.arange(mi.UInt32, pairs), dr.float64_array_t(mi.Float)
        arrives, unoccluded = channel_mean(reached) > 0, dr.select(dr.isfinite(unoccluded), unoccluded, 0)
        dr.eval(arrives, unoccluded)
        pair = lane + dr.opaque(mi.UInt32, first)
        counts = dr.gather(mi.Bool, learnable, pair % dr.opaque(mi.UInt32, dr.width(learnable)))
        of_pairs = Looks(precise(0), precise(0), mi.UInt32(0), mi.UInt32(0))
        for ray in range(RAYS):
            light = dr.gather(mi.Float, unoccluded, lane * RAYS + ray)
            light = dr.square(precise(dr.select(counts, light, 0)))
            hits = (light > 0) & dr.gather(mi.Bool, arrives, lane * RAYS + ray)
            of_pairs.possible += light / RAYS
            of_pairs.found += dr.select(hits, light, 0) / RAYS
            of_pairs.rays += dr.select(light > 0, mi.UInt32(1), 0)
            of_pairs.hits += dr.select(hits, mi.UInt32(1), 0)
        dr.scatter(self, of_pairs, pair)
        dr.eval(self)


def arriving_power(looks: Looks, sources: int, neighbours: np.ndarray) -> mi.Float64:
    """Root mean square of the arriving irradiance for each pair, double precision.

    The mean of the cell's own rays, of those of its neighbours, and of a prior, each with a weight.  ``sources``: their
    number; ``neighbours`` (cells, 26): numbers of the cells around each cell, from 1 on; 0 for none.
    """
    precise = dr.float64_array_t(mi.Float)
    lane, stride = dr.arange(mi.UInt32, dr.width(looks.rays)), dr.opaque(mi.UInt32, sources)
    cell, source = lane // stride, lane % stride
    # Prior visibility of a source in a cell: how often the cell sees sources, times how often cells see the source
    of_cell = _seen(*(dr.block_sum(x, sources) for x in (looks.hits, looks.rays)))
    of_source = _seen(*(_sums(x, source, sources) for x in (looks.hits, looks.rays)))
    of_all = _seen(*(dr.sum(x) for x in (looks.hits, looks.rays)))
    dr.make_opaque(of_cell, of_source, of_all)
    visible = dr.gather(precise, of_cell, cell) * dr.gather(precise, of_source, source)
    visible = dr.minimum(visible / dr.maximum(of_all, 1e-9), 1)
    # The mean of roots, because a neighbour may be next to an emitter that is far from this cell. Single precision
    # holds an irradiance, but not its square
    power, prior = mi.Float(dr.sqrt(looks.found)), _PRIOR * dr.sqrt(visible * looks.possible)
    dr.eval(power, prior)
    around, most = upload(mi.UInt32, neighbours), dr.opaque(mi.UInt32, neighbours.shape[1])
    total = prior + RAYS * _around(power, around, most, cell, source, stride)
    rays = upload(precise, RAYS * np.count_nonzero(neighbours, 1) + _PRIOR)
    rays = dr.gather(precise, rays, cell)
    expected, rays = total / rays, dr.minimum(rays, _NEIGHBOURS)
    power = dr.sqrt((RAYS * looks.found + rays * dr.square(expected)) / (RAYS + rays))
    dr.eval(power)
    return power


@recorded_once
@dr.syntax
def _around(power, around, most, cell, source, stride):
    """Sum of the ``power`` of the ``most`` neighbours ``around`` each pair's ``cell``, for the same ``source``.

    A loop, because an unrolled sum takes ten times as long to compile.
    """
    total, number = dr.zeros(mi.Float, dr.width(cell)), dr.zeros(mi.UInt32, dr.width(cell))
    while dr.hint(number < most, exclude=[power, around, most, cell, source, stride]):
        near = dr.gather(mi.UInt32, around, cell * most + number)
        total += dr.gather(mi.Float, power, (near - 1) * stride + source, near > 0)
        number += 1
    return total


def _seen(hits: mi.UInt32, rays: mi.UInt32) -> mi.Float64:
    """Fraction of the rays with unoccluded light that found the light."""
    precise = dr.float64_array_t(mi.Float)
    return precise(hits) / precise(dr.maximum(rays, 1))


def _sums(values: mi.UInt32, source: mi.UInt32, sources: int) -> mi.UInt32:
    """Sum over cells for each source."""
    total = dr.zeros(mi.UInt32, sources)
    add_at(total, values, source)
    return total
