"""Cells of a film: the pixels of an image, or parts of them if the film is finer than the image.

A denoiser leaves less error at twice the resolution (:mod:`comparison.fine_film`).  Lights, cuts and numbers of rays
are those of the pixels of the image, and the cells divide the rays of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isqrt

import drjit as dr
import mitsuba as mi

from ..core.loops import recorded_once
from .pixel_rays import PixelRays, RayNumbers, turn_of_cells

# Name of the channels of an image with the mean of every second ray of a cell
HALF = "every second"


@dataclass(frozen=True)
class FilmCells:
    """Cells of the film that the camera rays of pixels belong to.

    ``rays`` of the pixels, each of which has a multiple of its number of cells; ``width`` of the image in pixels.  The
    cells of the film follow each other in rows.
    """

    rays: PixelRays
    width: int

    @property
    def parts(self) -> int:
        """Cells along each side of a pixel."""
        return isqrt(self.rays.cells)

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.rays.pixels * self.rays.cells

    @property
    def sizes(self) -> tuple[int, ...]:
        """The different numbers of rays of a cell, ascending."""
        return tuple(size // self.rays.cells for size in self.rays.sizes)

    @property
    def earlier(self) -> tuple[int, ...] | None:
        """Number of earlier rays of a cell for each of ``sizes``; None for lattices of their own."""
        return self.rays.earlier and tuple(number // self.rays.cells for number in self.rays.earlier)

    @property
    def mean(self) -> int:
        """Mean number of rays of a cell."""
        return self.rays.mean // self.rays.cells

    @property
    def is_plain(self) -> bool:
        """Whether the rays of a cell are side by side, and as many as those of other cells."""
        return self.parts == 1 and not self.rays.differ

    def places(self, lane: mi.UInt32) -> RayNumbers:
        """Places of the rays ``lane`` (UInt32) in cells: ``pixel`` is the cell."""
        places = self.rays.places(lane)
        if self.parts == 1:
            return places
        parts, cells = (dr.opaque(mi.UInt32, number) for number in (self.parts, self.rays.cells))
        part, number = places.in_cells(cells)
        width = dr.opaque(mi.UInt32, self.width)
        row = places.pixel // width * parts + part // parts
        column = places.pixel % width * parts + part % parts
        return RayNumbers(row * (width * parts) + column, number, places.level)

    def position(self, cell: mi.UInt32) -> mi.Point2f:
        """Position of a cell in the film, in cells."""
        width = dr.opaque(mi.UInt32, self.width * self.parts)
        return mi.Point2f(cell % width, cell // width)

    def evenly(self, values):
        """The ``values`` of the rays for cells with the mean number of rays, side by side: those of the rays in another
        order, or, where pixels have different numbers, the means of the cells.

        Mitsuba adds up samples with a box filter as if pixels had equal numbers of rays.
        """
        if not self.rays.differ:
            return dr.gather(type(values), values, self._ray)
        means = (self._means(channel) for channel in (values if dr.depth_v(values) > 1 else [values]))
        return type(values)(*(dr.gather(mi.Float, mean, self._even_places.pixel) for mean in means))

    def evenly_masked(self, mask: mi.Bool, seed: int) -> mi.Bool:
        """As :meth:`evenly`, for a ``mask``: a multiple of 1 / mean number for each cell, with the mean fraction."""
        if not self.rays.differ:
            return dr.gather(mi.Bool, mask, self._ray)
        fraction = self.evenly(dr.select(mask, mi.Float(1), mi.Float(0)))
        places = self._even_places
        # A random number for each cell, so that rounding has no preference
        rounding = mi.sample_tea_float32(places.pixel, dr.opaque(mi.UInt32, seed))
        return rounding < fraction * self.mean - mi.Float(places.number)

    @property
    def _even_places(self) -> RayNumbers:
        """Places of the rays in the cells if all cells had the mean number, side by side."""
        return RayNumbers.of_lanes(dr.arange(mi.UInt32, self.rays.count), self.mean)

    @cached_property
    def _ray(self) -> mi.UInt32:
        """The ray at each of the even places, for equal numbers of rays: the inverse of :meth:`places`, evaluated."""
        pixel, part = self._pixel_and_part(self._even_places.pixel)
        cells = dr.opaque(mi.UInt32, self.rays.cells)
        ray = pixel * dr.opaque(mi.UInt32, self.rays.mean) + _number(pixel, part, self._even_places.number, cells)
        dr.eval(ray)
        return ray

    def _pixel_and_part(self, cell: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """The pixel of each cell, and the number of the cell in the pixel."""
        parts, width = (dr.opaque(mi.UInt32, x) for x in (self.parts, self.width))
        row, column = cell // (width * parts), cell % (width * parts)
        return row // parts * width + column // parts, row % parts * parts + column % parts

    def _means(self, values: mi.Float) -> mi.Float:
        """Mean over the rays of each cell, evaluated."""
        pixel, part = self._pixel_and_part(dr.arange(mi.UInt32, self.count))
        rays, cells = dr.gather(mi.UInt32, self.rays.by_level(self.sizes), pixel), dr.opaque(mi.UInt32, self.rays.cells)
        first = dr.gather(mi.UInt32, self.rays.device_first, pixel)
        dr.eval(values, pixel, part, rays, first)
        return _sums(values, pixel, part, rays, first, cells) / mi.Float(rays)


@recorded_once
@dr.syntax
def _sums(values, pixel, part, rays, first, cells):
    """Sum of the values of each cell's rays, in step: independent of the number of threads."""
    total, k = dr.zeros(mi.Float, dr.width(pixel)), dr.zeros(mi.UInt32, dr.width(pixel))
    while dr.hint(k < rays, exclude=[values, pixel, part, rays, first, cells]):
        total += dr.gather(mi.Float, values, first + _number(pixel, part, k, cells))
        k += 1
    dr.eval(total)
    return total


def _number(pixel: mi.UInt32, part: mi.UInt32, turn: mi.UInt32, cells: mi.UInt32) -> mi.UInt32:
    """Number in the pixel of the ray that a cell, ``part`` of ``cells``, gets in round ``turn``."""
    return turn * cells + (part + cells - turn_of_cells(pixel, turn) % cells) % cells
