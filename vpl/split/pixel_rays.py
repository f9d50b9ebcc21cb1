"""Numbers of camera rays of pixels, which may differ between pixels.

The rays of a pixel are side by side, and the pixels follow each other in rows.  Numbers are the mean of the image times
a power of two, so that all pixels with a number share a lattice, see :mod:`vpl.split.lattice`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.sampling import HASH_ROUNDS

# Numbers of rays over the mean number: from a quarter to four times. With more levels up and down the denoised error is
# the same within 1% (kitchen, staircase2)
_LEVELS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
# Of the mean number: the least number of rays is an integer
MULTIPLE = 4


@dataclass(frozen=True)
class RayNumbers:
    """Places of camera rays in pixels, UInt32.

    ``pixel``; ``number`` in the pixel; ``level``: index of the pixel's number of rays in :attr:`PixelRays.sizes`.
    """

    pixel: mi.UInt32
    number: mi.UInt32
    level: mi.UInt32

    @classmethod
    def of_lanes(cls, lane: mi.UInt32, samples: int) -> RayNumbers:
        """Of the rays ``lane``, of which ``samples`` consecutive ones belong to a pixel."""
        each = dr.opaque(mi.UInt32, samples)
        return cls(lane // each, lane % each, lane * dr.opaque(mi.UInt32, 0))

    def in_cells(self, cells: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Number of the cell of each ray in its pixel, and number of the ray in the cell; ``cells`` of the film in a
        pixel.

        Successive rays of a pixel belong to different cells, in an order that is random for each pixel and each round.
        With a regular order, virtual lights of few samples are gathered in a regular pattern, which a denoiser keeps.
        """
        turn = self.number // cells
        return (self.number + turn_of_cells(self.pixel, turn)) % cells, turn


def half_of(number: mi.UInt32, cells: mi.UInt32) -> mi.UInt32:
    """Half of the samples, 0 or 1, of the rays with a ``number`` in their pixel: every second round of rays over the
    ``cells`` of the film in the pixel."""
    return number // cells & 1


def turn_of_cells(pixel: mi.UInt32, turn: mi.UInt32) -> mi.UInt32:
    """Random numbers by which the order of a pixel's cells is rotated, for every round of its rays over the cells."""
    return mi.sample_tea_32(pixel, turn, HASH_ROUNDS)[0] >> 8


@dataclass(frozen=True)
class Continued:
    """Rays of earlier passes whose lattices the rays of a pass continue: ``earlier``, their number in the mean over the
    pixels, which is in proportion to the numbers of this pass; ``seed`` of the lattices of all these passes."""

    earlier: int
    seed: int


@dataclass(frozen=True)
class PixelRays:
    """Camera rays of pixels.

    ``mean`` number of rays; ``sizes``: the different numbers, ascending; ``level`` (pixels,) uint32: index of the
    number of rays of each pixel in ``sizes``; ``continued``: earlier rays, None for lattices of their own; ``cells`` of
    the film in a pixel.
    """

    mean: int
    sizes: tuple[int, ...]
    level: np.ndarray
    continued: Continued | None = None
    cells: int = 1

    @classmethod
    def uniform(cls, pixels: int, samples: int) -> PixelRays:
        """``samples`` rays for each of ``pixels`` pixels."""
        return cls(samples, (samples,), np.zeros(pixels, np.uint32))

    @classmethod
    def by_density(cls, density: np.ndarray, samples: int, continued: Continued | None = None) -> PixelRays:
        """Rays about in proportion to a positive ``density`` (pixels,), ``samples`` in the mean; ``continued``: earlier
        rays by this density.

        Raises ValueError for ``samples`` that are not a positive multiple of :data:`MULTIPLE`.
        """
        if samples < MULTIPLE or samples % MULTIPLE:
            raise ValueError(f"samples must be a positive multiple of {MULTIPLE}, got {samples}")
        level = _levels(np.log2(np.asarray(density, np.float64).reshape(-1)))
        # Without the levels that no pixel has: large numbers take long to tabulate
        used, level = np.unique(level, return_inverse=True)
        sizes = tuple(int(size) for size in _LEVELS[used] * samples)
        return cls(samples, sizes, level.astype(np.uint32), continued)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return len(self.level)

    @property
    def earlier(self) -> tuple[int, ...] | None:
        """Number of earlier rays for each of ``sizes``; None for lattices of their own."""
        return self.continued and tuple(size * self.continued.earlier // self.mean for size in self.sizes)

    @property
    def count(self) -> int:
        """Number of rays."""
        return int(self.first[-1])

    @property
    def differ(self) -> bool:
        """Whether pixels have different numbers of rays."""
        return len(self.sizes) > 1

    @cached_property
    def numbers(self) -> np.ndarray:
        """Number of rays of each pixel, (pixels,) int64."""
        return np.array(self.sizes, np.int64)[self.level]

    @cached_property
    def first(self) -> np.ndarray:
        """First ray of each pixel, and the number of all rays, (pixels + 1,) int64."""
        return np.concatenate([[0], np.cumsum(self.numbers)])

    def pixel_of(self, ray: np.ndarray) -> np.ndarray:
        """Pixels of the rays ``ray`` (n,), integers."""
        return self._pixels[ray] if self.differ else ray // self.mean

    def lit(self, most: int) -> list[int]:
        """Numbers of lit vertices of pixels, for each of ``sizes``: at most ``most`` with the mean number of rays, the
        same fraction of larger and smaller numbers, and at least one."""
        kept = min(most, self.mean)
        return [max(round(size * kept / self.mean), 1) for size in self.sizes]

    def by_level(self, values: Sequence[int]) -> mi.UInt32:
        """The value of each pixel: ``values[i]`` for pixels with ``sizes[i]`` rays."""
        return upload(mi.UInt32, np.array(values)[self.level])

    @property
    def device_first(self) -> mi.UInt32:
        """First ray of each pixel."""
        return self._device_rows[0]

    def part(self, first: int, last: int) -> PixelRays:
        """The pixels from ``first`` up to, and without, ``last``."""
        return PixelRays(self.mean, self.sizes, self.level[first:last], self.continued, self.cells)

    def parts(self, rays: int) -> list[tuple[int, int]]:
        """Ranges (first, last + 1) of pixels that together have about ``rays`` rays each, at least one pixel."""
        ends = np.searchsorted(self.first, np.arange(0, self.count, rays)[1:])
        edges = np.unique([0, *ends, self.pixels])
        return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))

    def places(self, lane: mi.UInt32) -> RayNumbers:
        """Places of the rays ``lane`` (UInt32)."""
        if not self.differ:
            return RayNumbers.of_lanes(lane, self.mean)
        pixel = dr.gather(mi.UInt32, self._device_pixels, lane)
        first, level = (dr.gather(mi.UInt32, row, pixel) for row in self._device_rows)
        return RayNumbers(pixel, lane - first, level)

    @cached_property
    def _pixels(self) -> np.ndarray:
        """Pixel of each ray, (count,) uint32."""
        return np.repeat(np.arange(self.pixels, dtype=np.uint32), self.numbers)

    @cached_property
    def _device_pixels(self) -> mi.UInt32:
        return upload(mi.UInt32, self._pixels)

    @cached_property
    def _device_rows(self) -> tuple[mi.UInt32, mi.UInt32]:
        return upload(mi.UInt32, self.first[:-1]), upload(mi.UInt32, self.level)


def _levels(wanted: np.ndarray) -> np.ndarray:
    """Index in ``_LEVELS`` of each pixel, for ``wanted`` (n,), the logarithm to base 2 of the number of rays up to a
    common constant.  The mean of the numbers is 1 exactly."""
    lowest, top = int(np.log2(_LEVELS[0])), len(_LEVELS) - 1
    wanted = wanted - np.mean(wanted)

    def rounded(values, constant):
        return np.clip(np.round(values + constant) - lowest, 0, top).astype(np.int64)

    # In units of the least number of rays
    whole = len(wanted) * MULTIPLE
    reach = float(np.ptp(wanted)) + top
    low, high = -reach, reach
    # Numbers that are rounded already have few values
    values, counts = np.unique(wanted, return_counts=True)
    # The remainder makes up for the rest
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.sum(counts << rounded(values, middle)) > whole else (middle, high)
    level = rounded(wanted, low)
    left, lacking = whole - int(np.sum(1 << level)), wanted + low - lowest - level
    # The next level of a pixel costs as much as its level. A remainder is a multiple of the least level below the top,
    # so that it can always be spent
    while left:
        able = np.flatnonzero((level < top) & (1 << level <= left))
        order = able[np.argsort(-lacking[able], kind="stable")]
        taken = order[np.cumsum(1 << level[order]) <= left]
        left -= int(np.sum(1 << level[taken]))
        lacking[taken] -= 1
        level[taken] += 1
    return level
