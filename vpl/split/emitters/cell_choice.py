"""Probabilities of sources of light by spatial cell, learned from the light of each that a pilot's vertices receive."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import download, upload, upload_vectors
from ...core.sampling import RowChoice, derived_seed, independent_sampler
from ..spatial_cells import SpatialCells
from .arriving_power import RAYS, Looks, arriving_power
from .irradiance import Places

# Rays to learn by, as a fraction of the camera rays: learning may take a few percent of a render
_LEARNING_SHARE = 0.25
# The same for later passes of a render, several of which use what was learned
_LATER_SHARE = 0.5
# Bounds of memory: largest number of rays, some 20 bytes each; number of rays at a time, some 100 bytes each
_MOST_RAYS, _RAYS_AT_A_TIME = 1 << 21, 1 << 20


def learning_rays(paths: int, is_later: bool = False) -> int:
    """Number of rays to learn by, for a number of camera rays; ``is_later``: of a later pass of a render."""
    return min(int((_LATER_SHARE if is_later else _LEARNING_SHARE) * paths), _MOST_RAYS)


@dataclass(frozen=True)
class _VerticesOfCells:
    """Vertices sorted by cell: ``position``, ``normal``; ``size``, ``first`` (cells,): their number, and the first."""

    position: mi.Point3f
    normal: mi.Point3f
    size: mi.UInt32
    first: mi.UInt32

    @classmethod
    def of(cls, position: np.ndarray, normal: np.ndarray, cell: np.ndarray) -> _VerticesOfCells:
        """Vertices (n, 3) in the cells ``cell`` (n,), from 1 on."""
        order, size = np.argsort(cell, kind="stable"), np.bincount(cell)[1:]
        position, normal = (upload_vectors(mi.Point3f, x[order]) for x in (position, normal))
        return cls(position, normal, upload(mi.UInt32, size), upload(mi.UInt32, np.cumsum(size) - size))

    @property
    def cells(self) -> int:
        """Number of cells."""
        return dr.width(self.size)

    def drawn(self, row: mi.UInt32, sampler) -> Places:
        """A random vertex of each of the cells ``row``, from 0 on."""
        number = mi.UInt32(sampler.next_1d() * mi.Float(dr.gather(mi.UInt32, self.size, row)))
        vertex = dr.gather(mi.UInt32, self.first, row) + number
        return Places.of_facing(*(dr.gather(mi.Point3f, x, vertex) for x in (self.position, self.normal)))


class CellChoice:
    """Probabilities of sources by spatial cell; before :meth:`learn`, the same everywhere.

    ``usual`` (n,) float64: probabilities where nothing is known, with sum 1; ``share``: fraction of the samples drawn
    by ``usual`` in every cell; ``ignored``: indices of sources without learning.  ``has_learned``: whether cells have
    probabilities of their own.
    """

    def __init__(self, usual: np.ndarray, share: float, ignored: np.ndarray):
        self.count, self._stride = len(usual), dr.opaque(mi.UInt32, len(usual) + 1)
        self._usual, self._share = usual, share
        self._learnable = upload(mi.UInt32, np.isin(np.arange(len(usual)), ignored, invert=True)) > 0
        dr.eval(self._learnable)
        # See `each_source`
        self._learns = dr.opaque(mi.Bool, False)
        self.forget()

    def _use(self, probability: np.ndarray) -> None:
        """Use probabilities (cells, sources) float64; rows sum to 1."""
        self._rows = RowChoice(probability.ravel(), np.full(len(probability), self.count))

    @property
    def pmf(self) -> np.ndarray:
        """Probabilities (cells + 1, sources) of drawing each source; row 0 where nothing is known."""
        return self._rows.pmf.reshape(-1, self.count)

    # ---------------------- Learning ----------------------

    def forget(self) -> None:
        """Return to the usual probabilities everywhere."""
        self._cells, self.has_learned = SpatialCells.none(), False
        # Twice, because Dr.Jit compiles different kernels for arrays of a single entry
        self._use(np.stack([self._usual, self._usual]))

    def learn(self, position: np.ndarray, normal: np.ndarray, rays: int, seed: int, look: Callable) -> bool:
        """Learn from vertices (n, 3) with at most about ``rays`` rays; returns whether anything was learned.

        ``look(places, cell, seed)``: irradiance at places, with a single sample each, as
        :func:`vpl.split.emitters.irradiance.irradiance_from_emitters` returns it.
        """
        each = RAYS * self.count
        most = rays // each
        if most < 1 or len(position) == 0:
            return False
        self._cells, cell = SpatialCells.around(position, normal, most)
        vertices = _VerticesOfCells.of(position, normal, cell)
        most = max(_RAYS_AT_A_TIME // each, 1)
        looks = Looks.none(vertices.cells * self.count)
        with self.each_source():
            for first in range(0, vertices.cells, most):
                cells = min(most, vertices.cells - first)
                found = self._look(vertices, first, cells, derived_seed(seed, first), look)
                looks.write(first * self.count, found.irradiance, found.unoccluded, self._learnable)
        power = arriving_power(looks, self.count, self._cells.neighbours())
        self._use(self._shares(download(power).reshape(-1, self.count)))
        self.has_learned = True
        return True

    @contextmanager
    def each_source(self) -> Iterator[None]:
        """Within the block, every source has a cell, and the cell draws only the source."""
        self._learns = dr.opaque(mi.Bool, True)
        try:
            yield
        finally:
            self._learns = dr.opaque(mi.Bool, False)

    def _look(self, vertices: _VerticesOfCells, first: int, cells: int, seed: int, look: Callable):
        """Result of ``look`` for :data:`RAYS` rays to each source, in ``cells`` cells from ``first`` on."""
        each = RAYS * self.count
        lane = dr.arange(mi.UInt32, cells * each)
        row = lane // dr.opaque(mi.UInt32, each) + dr.opaque(mi.UInt32, first)
        source = lane // RAYS % dr.opaque(mi.UInt32, self.count)
        places = vertices.drawn(row, independent_sampler(derived_seed(seed, 0), len(lane)))
        dr.eval(places, source)
        return look(places, source, derived_seed(seed, 1))

    def _shares(self, power: np.ndarray) -> np.ndarray:
        """Probabilities (cells + 1, sources) in proportion to ``power`` (cells, sources); row 0: for unknown cells."""
        total = power.sum(1, keepdims=True)
        learned = np.where(total > 0, power / np.maximum(total, np.finfo(np.float64).tiny), self._usual)
        return np.concatenate([self._usual[None], (1 - self._share) * learned + self._share * self._usual])

    # ---------------------- Sampling ----------------------

    def cell(self, position, facing):
        """See :meth:`vpl.split.emitters.base.EmitterSampler.cell`."""
        return self._cells.at(position, facing)

    def draw(self, cell, number, active):
        """Draw a source for each cell by a uniform number: (source, its probability, a new uniform number)."""
        known = active & ~self._learns
        row = self._rows.draw(cell, number, known)
        source = dr.select(self._learns, cell, row - self._row(cell))
        probability = dr.select(self._learns, 1, self._rows.probability(row, known))
        return source, probability, dr.select(self._learns, number, self._rows.rest(row, number, known))

    def probability(self, cell, source, active):
        """Probability of a source in each cell."""
        known = self._rows.probability(self._row(cell) + source, active & ~self._learns)
        return dr.select(self._learns, dr.select(active & (cell == source), mi.Float(1), 0), known)

    def _row(self, cell):
        """Start of a cell's row in the table of probabilities."""
        return cell * self._stride
