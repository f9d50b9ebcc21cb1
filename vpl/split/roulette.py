"""Russian roulette: survival probabilities of paths, chosen by the pilot.

Three rules end paths.  The throughput of a surviving path is divided by the survival probability, so no rule biases the
image.

1. **Residual.**  Where virtual lights carry most of the throughput, the residual is small: a path survives with the
   residual fraction (:func:`residual_survival`).
2. **Expected contribution.**  A path survives with the probability m E.  E is the expected contribution relative to the
   brightness of the pixel.  The multiple m has the least variance × cost (:func:`best_multiple`).  [Vorba and Křivánek
   2016, "Adjoint-driven Russian roulette"; Rath et al. 2022, "EARS: efficiency-aware Russian roulette", eq. 14: the
   best probability is proportional to the root of variance over cost.]
3. **Throughput.**  The rule of Mitsuba's ``path`` from ``rr_depth`` on (:mod:`vpl.core.path_limits`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, upload
from .cost_model import CostModel
from .spatial_cells import SpatialCells

# Least probability of rule 1: the minorant and w describe the residual of a single direction only roughly
_LEAST_RESIDUAL = 0.02
# Candidate multiples, powers of two at half steps, from 1/8 to 32: below 1/8, every path would end early
_MULTIPLES = 2.0 ** np.arange(-3, 5.5, 0.5)


@dataclass
class OutgoingRadiance:
    """Radiance that surfaces send back to paths, learned from a pilot without regard to direction.

    ``cells``; ``radiance``: root mean square of each cell, mean over channels; ``known``: whether anything was learned;
    ``least_survival``: see :class:`vpl.split.cost_model.CostModel`.  The arrays are opaque: Dr.Jit compiles a single
    kernel.
    """

    cells: SpatialCells
    radiance: mi.Float
    known: mi.Bool
    least_survival: mi.Float

    @classmethod
    def unknown(cls) -> OutgoingRadiance:
        """Nothing is known: rule 2 ends no path."""
        return cls(
            SpatialCells.none(), upload(mi.Float, np.ones(2)), dr.opaque(mi.Bool, False), dr.opaque(mi.Float, 1.0)
        )

    @classmethod
    def learned(
        cls, position: np.ndarray, normal: np.ndarray, radiance: np.ndarray, model: CostModel
    ) -> tuple[OutgoingRadiance, np.ndarray]:
        """Learn from vertices (n, 3) with ``radiance`` (n,) sent back.

        Returns also the root mean square (n,) predicted for each vertex by the remaining vertices of the cell: a
        prediction including the vertex would be too good.
        """
        cells, cell = SpatialCells.around(position, normal, model.roulette_cells)
        size = int(cell.max()) + 1
        squared, number = np.bincount(cell, radiance**2, size), np.bincount(cell, minlength=size)
        prior = model.roulette_prior * np.mean(radiance**2)
        others = np.maximum(squared[cell] - radiance**2, 0) + prior
        predicted = np.sqrt(others / (number[cell] - 1 + model.roulette_prior))
        rms = np.sqrt((squared + prior) / (number + model.roulette_prior))
        least = dr.opaque(mi.Float, model.least_survival)
        return cls(cells, upload(mi.Float, rms), dr.opaque(mi.Bool, True), least), predicted

    def survival(self, position, normal, throughput, importance, residual):
        """Survival probability at vertices by rule 2; by rule 1, ``residual``, where nothing is known.

        ``throughput`` of the arriving path; ``importance``: m over the brightness of the pixel; ``residual``: fraction
        of the throughput left to trace.
        """
        radiance = dr.gather(mi.Float, self.radiance, self.cells.at(position, normal))
        expected = residual * channel_mean(dr.abs(throughput)) * radiance * importance
        return dr.select(self.known, dr.clip(expected, self.least_survival, 1), residual)


def residual_survival(residual, full, applies):
    """Probability by rule 1: the ratio of the spectra ``residual`` and ``full``; 1 where the rule does not apply."""
    left = dr.max(dr.abs(residual)) / dr.max(dr.abs(full))
    return dr.select(applies & dr.isfinite(left), dr.clip(left, _LEAST_RESIDUAL, 1), 1)


def best_multiple(
    expected: np.ndarray, brought: np.ndarray, edges: np.ndarray, paths: int, variance: float, model: CostModel
) -> float:
    """The multiple m of rule 2 with the least variance × cost at second vertices; where none pays, the least multiple
    that hardly raises the variance, which still ends the paths that bring next to nothing; infinite without one.

    ``expected`` (n,): expected contributions with m = 1 of the paths with a second vertex; ``brought`` (n,): actual
    contributions, both relative to the image; ``edges`` (n,): edges beyond the second vertex; ``paths``: total number
    of paths; ``variance``: relative variance of a path without rule 2.

    The largest increases of the variance are left out, as the largest errors are left out of ``variance``.  Otherwise a
    single path decides where pilots are small.  Of fewer than 1000 paths, none is left out.
    """
    best, least = np.inf, model.roulette_gain * variance * (model.first_edges + edges.sum() / paths)
    harmless = np.inf
    kept = max(len(brought) - model.left_out(paths), 0)
    for multiple in _MULTIPLES:
        survival = np.clip(multiple * expected, model.least_survival, 1)
        rises = brought**2 * (1 / survival - 1)
        if kept < len(rises):
            rises = np.partition(rises, kept)[:kept]
        of_multiple = variance + np.sum(rises) / paths
        product = of_multiple * (model.first_edges + np.sum(edges * survival) / paths)
        if product < least:
            best, least = multiple, product
        if 0 < of_multiple <= (1 + model.roulette_rise) * variance:
            harmless = min(harmless, multiple)
    return float(best if np.isfinite(best) else harmless)
