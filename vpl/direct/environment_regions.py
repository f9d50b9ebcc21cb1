"""An environment cut into regions that are sampled like lights [IAS section 4.3; Agarwal et al. 2003].

The environment is evaluated once into a table of cells (:mod:`vpl.direct.environment_cells`).  Regions are sets of
cells.  A cell is drawn from its region about in proportion to its light, and a direction uniformly in the cell.
Directions of a region thus have nearly equal weights: [IAS] calls this preintegrated and jittered sampling.  A sample
evaluates the radiance of its direction, not the mean of its cell: the table causes no bias.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero, upload
from ..core.morton import morton_order
from ..core.parameters import fingerprint
from ..core.sampling import RowChoice
from .environment_cells import LARGEST_WIDTH, EnvironmentCells, radiance_from
from .environment_strata import cones, stratify

_STRATA_WIDTH = 256  # columns of the grid of the strata
# Fraction of a region's samples drawn uniformly by solid angle, because the table rests on few evaluations
_EVEN_SHARE = 0.02


# Key and regions of the previous call, in one tuple: threads never combine the key and the regions of different calls
_previous: tuple[tuple, EnvironmentRegions] | None = None


def regions_of(environment, count: int, most_columns: int = LARGEST_WIDTH) -> EnvironmentRegions:
    """Regions of an environment; those of the previous call if the environment and the arguments are unchanged."""
    global _previous
    key = count, most_columns, fingerprint([environment])
    found = _previous
    # Regions evaluate their environment.  An equal environment of another scene does not match: it may be edited later
    if found is None or found[0] != key or found[1].environment is not environment:
        found = key, EnvironmentRegions(environment, count, most_columns)
        _previous = found
    return found[1]


def forget_regions() -> None:
    """Forget the regions of the previous call, so that the time of a render includes them."""
    global _previous
    _previous = None


class EnvironmentRegions:
    """``count`` regions of an environment, all arrays float64.

    ``axis`` (count, 3), ``cone_cos`` (count,): cones around the directions of each region; ``irradiance`` (count,):
    radiance (mean over channels) integrated over solid angle.  ``most_columns``: largest width of the table.
    """

    def __init__(self, environment, count: int, most_columns: int = LARGEST_WIDTH):
        self.environment = environment
        cells = EnvironmentCells(environment, most_columns)
        self._places = cells.places
        block = max(1, cells.width // _STRATA_WIDTH)
        sums = [
            np.bincount(cells.parent, values, cells.radiance.size)
            .reshape(cells.height // block, block, cells.width // block, block)
            .sum((1, 3))
            for values in (cells.light, cells.solid_angle)
        ]
        coarse = stratify(sums[0] / sums[1], count)
        axis, cosine = cones(coarse)
        # Neighbours have successive numbers, so that well spread numbers draw regions and cells spread over the sky
        order = morton_order(axis)
        self.axis, self.cone_cos, self.count = axis[order], cosine[order], len(order)
        coarse = np.argsort(order)[coarse]
        labels = np.repeat(np.repeat(coarse, block, 0), block, 1).ravel()[cells.parent]
        self.irradiance = np.bincount(labels, cells.light, self.count)
        self._tabulate(cells, labels)

    def _tabulate(self, cells: EnvironmentCells, labels: np.ndarray):
        """Store the cells region by region, with their cumulative probabilities and densities within the region."""
        angle = np.bincount(labels, cells.solid_angle, self.count)
        total = np.bincount(labels, cells.weight, self.count)[labels]
        share = np.where(total > 0, cells.weight / np.where(total > 0, total, 1), 0)
        share = (1 - _EVEN_SHARE) * share + _EVEN_SHARE * cells.solid_angle / angle[labels]
        share[total == 0] = (cells.solid_angle / angle[labels])[total == 0]
        order = np.lexsort((cells.curve, labels))
        self._choice = RowChoice(share[order], np.bincount(labels, minlength=self.count))
        share[order] = self._choice.pmf
        drawn = np.zeros(self._choice.place[-1] + 1, np.int64)
        drawn[self._choice.place] = cells.number[order]
        self._drawn = upload(mi.UInt32, drawn)
        # Interleaved: one memory access fetches both values
        found = np.zeros((cells.count, 2), np.uint32)
        found[cells.number, 0] = labels
        found[cells.number, 1] = (share / cells.solid_angle).astype(np.float32).view(np.uint32)
        self._found = upload(mi.UInt32, found.ravel())

    def sample(self, region, member, sample, active):
        """Sample a direction of each region: (direction, radiance over density, density per solid angle).

        ``member``: uniform number that draws the cell; ``sample``: two uniform numbers for the direction in the cell.
        """
        cell = dr.gather(mi.UInt32, self._drawn, self._choice.draw(region, member, active), active)
        direction = self._places.direction(cell, sample, active)
        density = self._of_cell(cell, active)[1]
        radiance = self.radiance(direction, active)
        return direction, finite_or_zero(radiance / density) & active, density

    def radiance(self, direction, active):
        """Incident radiance from a direction."""
        return radiance_from(self.environment, direction, active)

    def find(self, direction, active):
        """(Region, density of :meth:`sample`) of a direction."""
        return self._of_cell(self._places.number_of(direction, active), active)

    def _of_cell(self, cell, active):
        """(Region, density of :meth:`sample`) of cells."""
        region, density = dr.gather(mi.Vector2u, self._found, cell, active)
        return region, dr.reinterpret_array(mi.Float, density)
