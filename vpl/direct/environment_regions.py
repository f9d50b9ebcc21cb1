"""An environment cut into regions that are sampled like lights [IAS section 4.3; Agarwal et al. 2003].

The environment is evaluated once into a table of cells along latitude and longitude (z up, in world space).  Regions
are sets of cells.  A cell is drawn from its region in proportion to its light, and a direction uniformly in the cell.
Directions of a region thus have nearly equal weights: [IAS] calls this preintegrated and jittered sampling.  A sample
evaluates the radiance of its direction, not the mean of its cell: the table causes no bias.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, finite_or_zero, upload
from ..core.morton import interleave, morton_order
from ..core.parameters import fingerprint, parameters_of
from ..core.sampling import RowChoice, independent_sampler
from .environment_strata import cones, stratify

_CONSTANT = "ConstantBackgroundEmitter"
_EVALUATIONS = 2  # least number of evaluations along each axis of a cell
# Evaluations along each axis of an edge cell; least contrast of its neighbourhood.  The sun may be a single texel
_EDGE_EVALUATIONS, _EDGE_CONTRAST = 16, 2.0
# Least brightness of an edge in an image, relative to the mean radiance: darker edges are many, and hold little light
_BRIGHT = 10.0
_STRATA_WIDTH = 256  # columns of the grid of the strata
# Columns of the table: for emitters without an image, and the most
_DEFAULT_WIDTH, _LARGEST_WIDTH = 1024, 2048
# Fraction of a region's samples drawn uniformly by solid angle, because the table rests on few evaluations
_EVEN_SHARE = 0.02


# Key and regions of the previous call, in one tuple: threads never combine the key and the regions of different calls
_previous: tuple[tuple, EnvironmentRegions] | None = None


def regions_of(environment, count: int, most_columns: int = _LARGEST_WIDTH) -> EnvironmentRegions:
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

    def __init__(self, environment, count: int, most_columns: int = _LARGEST_WIDTH):
        self.environment = environment
        width = min(_table_width(environment), most_columns)
        radiance = _read(environment, width)
        height = len(radiance)
        edges = np.cos(np.linspace(0, np.pi, height + 1))
        solid_angle = ((edges[:-1] - edges[1:]) * 2 * np.pi / width)[:, None] * np.ones(width)
        light = radiance * solid_angle
        block = max(1, width // _STRATA_WIDTH)
        sums = [a.reshape(height // block, block, width // block, block).sum((1, 3)) for a in (light, solid_angle)]
        coarse = stratify(sums[0] / sums[1], count)
        axis, cosine = cones(coarse)
        # Neighbours have successive numbers, so that well spread numbers draw regions and cells spread over the sky
        order = morton_order(axis)
        self.axis, self.cone_cos, self.count = axis[order], cosine[order], len(order)
        coarse = np.argsort(order)[coarse]
        labels = np.repeat(np.repeat(coarse, block, 0), block, 1).ravel()
        self.irradiance = np.bincount(labels, light.ravel(), self.count)
        self._tabulate(labels, light.ravel(), solid_angle.ravel(), width, height)

    def _tabulate(self, labels, light, solid_angle, width, height):
        """Store the cells region by region, with their cumulative probabilities and densities within the region."""
        angle = np.bincount(labels, solid_angle, self.count)
        total = self.irradiance[labels]
        share = np.where(total > 0, light / np.where(total > 0, total, 1), 0)
        share = (1 - _EVEN_SHARE) * share + _EVEN_SHARE * solid_angle / angle[labels]
        share[total == 0] = (solid_angle / angle[labels])[total == 0]
        # Codes along a Morton curve, whose third axis is not used
        rows, columns = (
            interleave(np.outer(np.arange(n), axis)) for n, axis in ((height, (0, 1, 0)), (width, (1, 0, 0)))
        )
        order = np.lexsort(((rows[:, None] | columns).ravel(), labels))
        self._choice = RowChoice(share[order], np.bincount(labels, minlength=self.count))
        share[order] = self._choice.pmf
        cells = np.zeros(self._choice.place[-1] + 1, np.int64)
        cells[self._choice.place] = order
        self._cells = upload(mi.UInt32, cells)
        density = (share / solid_angle).astype(np.float32).view(np.uint32)
        # Interleaved: one memory access fetches both values
        self._found = upload(mi.UInt32, np.stack([labels.astype(np.uint32), density], 1).ravel())
        self._width, self._height = (dr.opaque(mi.UInt32, size) for size in (width, height))

    def sample(self, region, member, sample, active):
        """Sample a direction of each region: (direction, radiance over density, density per solid angle).

        ``member``: uniform number that draws the cell; ``sample``: two uniform numbers for the direction in the cell.
        """
        cell = dr.gather(mi.UInt32, self._cells, self._choice.draw(region, member, active), active)
        row, column = cell // self._width, cell % self._width
        step = dr.pi / mi.Float(self._height)
        top, bottom = dr.cos(mi.Float(row) * step), dr.cos(mi.Float(row + 1) * step)
        cosine = dr.lerp(top, bottom, sample.x)
        azimuth = dr.two_pi * (mi.Float(column) + sample.y) / mi.Float(self._width)
        sine = dr.safe_sqrt(1 - dr.square(cosine))
        direction = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), cosine)
        density = self._of_cell(cell, active)[1]
        radiance = self.radiance(direction, active)
        return direction, finite_or_zero(radiance / density) & active, density

    def radiance(self, direction, active):
        """Incident radiance from a direction."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        si.wi = -direction
        return finite_or_zero(mi.unpolarized_spectrum(self.environment.eval(si, active)))

    def find(self, direction, active):
        """(Region, density of :meth:`sample`) of a direction."""
        polar = dr.safe_acos(direction.z) * mi.Float(self._height) / dr.pi
        azimuth = dr.atan2(direction.y, direction.x)
        azimuth = dr.select(azimuth < 0, azimuth + dr.two_pi, azimuth) * mi.Float(self._width) / dr.two_pi
        row = dr.minimum(mi.UInt32(polar), self._height - 1)
        column = dr.minimum(mi.UInt32(azimuth), self._width - 1)
        cell = row * self._width + column
        return self._of_cell(cell, active)

    def _of_cell(self, cell, active):
        """(Region, density of :meth:`sample`) of cells."""
        region, density = dr.gather(mi.Vector2u, self._found, cell, active)
        return region, dr.reinterpret_array(mi.Float, density)


def _table_width(environment) -> int:
    """Columns of the table: the width of the image rounded up to a power of two, between 64 and _LARGEST_WIDTH."""
    if environment.class_name() == _CONSTANT:
        return 64
    columns = _image_width(environment) or _DEFAULT_WIDTH
    return int(np.clip(2 ** np.ceil(np.log2(columns)), 64, _LARGEST_WIDTH))


def _image_width(environment) -> int:
    """Columns of the image of an environment, 0 without an image."""
    parameters = parameters_of(environment)
    # Mitsuba repeats the first column at the end
    return max(1, parameters["data"].shape[1] - 1) if "data" in parameters else 0


def _read(environment, width: int) -> np.ndarray:
    """Mean radiance of every cell, (width / 2, width) float64; non-finite radiance counts as black."""
    height = width // 2
    image_width = _image_width(environment)
    across = max(_EVALUATIONS, -(-image_width // width))
    radiance = _read_cells(environment, np.arange(width * height), width, across).reshape(height, width)
    edges = np.flatnonzero(_at_edges(radiance, _BRIGHT * radiance.mean() if image_width else 0.0))
    radiance.reshape(-1)[edges] = _read_cells(environment, edges, width, max(_EDGE_EVALUATIONS, 2 * across))
    return radiance


def _at_edges(radiance: np.ndarray, least: float) -> np.ndarray:
    """Mask of edge cells, (height, width) bool.

    The brightest cell of the 3 × 3 neighbourhood is above ``least`` and _EDGE_CONTRAST times the darkest cell.
    """
    padded = np.pad(np.pad(radiance, ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap")
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    brightest = around.max((2, 3))
    return (brightest > _EDGE_CONTRAST * around.min((2, 3))) & (brightest > least)


def _read_cells(environment, cells: np.ndarray, width: int, across: int) -> np.ndarray:
    """Mean radiance of some cells, from ``across`` × ``across`` evaluations in each."""
    if len(cells) == 0:
        return np.zeros(0)
    row, column = upload(mi.Float, cells // width), upload(mi.Float, cells % width)
    steps = dr.opaque(mi.Float, 2 * np.pi / width), dr.opaque(mi.UInt32, across)
    total = _sum_of_evaluations(environment, row, column, *steps, independent_sampler(0, len(cells)))
    return download(total).astype(np.float64) / across**2


@dr.syntax
def _sum_of_evaluations(environment, row, column, step, across, sampler):
    """Radiance of each cell, summed over one jittered direction in each of ``across`` × ``across`` equal parts."""
    total, k = dr.zeros(mi.Float, dr.width(row)), mi.UInt32(0)
    while dr.hint(k < across * across, exclude=[environment, row, column, step, across]):
        jitter = (mi.Point2f(mi.Float(k % across), mi.Float(k // across)) + sampler.next_2d()) / mi.Float(across)
        sine, cosine = dr.sincos((row + jitter.x) * step)
        around_sine, around_cosine = dr.sincos((column + jitter.y) * step)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(row))
        si.wi = -mi.Vector3f(sine * around_cosine, sine * around_sine, cosine)
        total += channel_mean(finite_or_zero(mi.unpolarized_spectrum(environment.eval(si))))
        k += 1
    return total
