"""Cells of an environment along latitude and longitude (z up, in world space), with the mean radiance of each.

Bright cells at edges are divided into finer ones: the sun is hardly larger than a cell, and directions drawn evenly in
a cell that it fills by half would miss it half of the time.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, finite_or_zero, upload
from ..core.morton import interleave
from ..core.parameters import parameters_of
from ..core.sampling import independent_sampler

_CONSTANT = "ConstantBackgroundEmitter"
_EVALUATIONS = 2  # least number of evaluations along each axis of a cell
# Evaluations along each axis of an edge cell; least contrast of its neighbourhood.  The sun may be a single texel
_EDGE_EVALUATIONS, _EDGE_CONTRAST = 16, 2.0
_PART_EVALUATIONS = 4  # of a part of a divided cell
_OWN_SAMPLES = 1 << 12  # directions that an environment samples: suns are among the brightest
# Least brightness of an edge in an image, relative to the mean radiance: darker edges are many, and hold little light
_BRIGHT = 10.0
# Parts of a divided cell along each axis; least share in all light of an edge cell that is divided with its neighbours;
# most of these edge cells
_PARTS, _DIVIDED_SHARE, _MOST_DIVIDED = 16, 1e-3, 64
# Rows at each pole without divided cells, times this number: the square of the number of all rows. Cosines in single
# precision cannot tell the parts apart there
_POLAR = 2**17
# Least weight of a part in a divided cell, over the mean radiance of the cell: evaluations of a part may all miss the
# sun in it. Samples there have at most the inverse of this number times the weight of an even sample of the cell
_LEAST_WEIGHT = 0.1
# Columns of the table: for emitters without an image, and the most
_DEFAULT_WIDTH, LARGEST_WIDTH = 1024, 2048


class EnvironmentCells:
    """A table of ``width`` × ``height`` cells, at most ``most_columns`` wide.

    ``radiance`` (height, width): mean of every cell, float64.  The other arrays (n,) have an entry for every cell that
    is not divided, and for every part of a divided cell.  float64: ``light``: radiance times ``solid_angle``;
    ``weight`` for samples, about the same.  Integers: ``parent``: the cell, row by row; ``curve``: place along a Morton
    curve; ``number``: below ``count``, for tables with an entry for each number: the parts of divided cells follow all
    cells, and the numbers of divided cells are not used.  ``places``: directions of all these.
    """

    def __init__(self, environment, most_columns: int = LARGEST_WIDTH):
        self.width = width = min(_table_width(environment), most_columns)
        self.height = width // 2
        self.radiance, edges = _read(environment, width)
        divided = self._bright(edges)
        self.count = self.radiance.size + len(divided) * _PARTS**2
        part, whole = np.arange(_PARTS**2), np.delete(np.arange(self.radiance.size), divided)
        corner = divided[:, None] * _PARTS
        row, column = corner // (width * _PARTS) * _PARTS + part // _PARTS, corner % (width * _PARTS) + part % _PARTS
        fine = (row * (width * _PARTS) + column).ravel()
        self.number = np.append(whole, self.radiance.size + np.arange(len(fine)))
        self.parent = np.append(whole, np.repeat(divided, _PARTS**2))
        row, column = np.append(whole // width * _PARTS, row), np.append(whole % width * _PARTS, column)
        size = np.append(np.full(len(whole), _PARTS), np.ones(len(fine), int))
        step = np.pi / (self.height * _PARTS)
        self.solid_angle = (np.cos(row * step) - np.cos((row + size) * step)) * size * step
        across = max(_PART_EVALUATIONS, _across(environment, width * _PARTS))
        of_parts = _read_cells(environment, fine, width * _PARTS, across)
        mean = np.append(self.radiance.ravel()[whole], of_parts)
        self.light = mean * self.solid_angle
        least = np.zeros(self.radiance.size)
        least[divided] = _LEAST_WEIGHT * of_parts.reshape(-1, _PARTS**2).mean(1)
        self.weight = np.maximum(mean, least[self.parent]) * self.solid_angle
        # The third axis is not used
        codes = [interleave(np.outer(np.arange(width * _PARTS), axis)) for axis in ((0, 1, 0), (1, 0, 0))]
        self.curve = codes[0][row] | codes[1][column]
        self.places = CellPlaces(width, self.height, divided)

    def _bright(self, edges: np.ndarray) -> np.ndarray:
        """The cells that are divided, ascending: the brightest among ``edges``, and their neighbours, in which all
        evaluations may have missed a part of the sun."""
        light = self.radiance * np.sin((np.arange(self.height) + 0.5) * np.pi / self.height)[:, None]
        of_edges = light.ravel()[edges]
        chosen = np.argsort(-of_edges, kind="stable")[:_MOST_DIVIDED]
        chosen = edges[chosen[of_edges[chosen] > _DIVIDED_SHARE * light.sum()]]
        step = np.arange(-1, 2)
        row, column = (chosen[:, None, None] // self.width + step[:, None], chosen[:, None, None] % self.width + step)
        row, column = (x.ravel() for x in np.broadcast_arrays(row, column % self.width))
        polar = -(-(self.height**2) // _POLAR)
        inside = (row >= polar) & (row < self.height - polar)
        return np.unique(row[inside] * self.width + column[inside])


class CellPlaces:
    """Directions of the cells of a table of ``width`` × ``height`` cells, some of them ``divided``, and the reverse.

    Tables without divided cells have smaller kernels.
    """

    def __init__(self, width: int, height: int, divided: np.ndarray):
        self._columns, self._rows = (dr.opaque(mi.UInt32, size) for size in (width, height))
        self._divided = None
        if len(divided):
            first = np.zeros(width * height, np.uint32)
            first[divided] = width * height + np.arange(len(divided)) * _PARTS**2
            self._divided, self._first_part = upload(mi.UInt32, divided), upload(mi.UInt32, first)

    def direction(self, number, sample, active):
        """A direction in each cell or part, by two uniform numbers: evenly by solid angle."""
        return _direction(*self._corner(number, active), dr.pi / mi.Float(self._rows), sample)

    def _corner(self, number, active):
        """(Row, column, size) of cells and parts, in units of cells."""
        if self._divided is None:
            return mi.Float(number // self._columns), mi.Float(number % self._columns), 1.0
        cells = self._rows * self._columns
        is_part, part = number >= cells, number - cells
        cell = dr.gather(mi.UInt32, self._divided, part // _PARTS**2, active & is_part)
        cell, size = dr.select(is_part, cell, number), dr.select(is_part, mi.Float(1 / _PARTS), 1)
        row, column = (dr.select(is_part, mi.Float(x % _PARTS) * size, 0) for x in (part // _PARTS, part))
        return mi.Float(cell // self._columns) + row, mi.Float(cell % self._columns) + column, size

    def number_of(self, direction, active):
        """Number of the cell or part in which a direction lies."""
        polar = dr.safe_acos(direction.z) * mi.Float(self._rows) / dr.pi
        azimuth = dr.atan2(direction.y, direction.x)
        azimuth = dr.select(azimuth < 0, azimuth + dr.two_pi, azimuth) * mi.Float(self._columns) / dr.two_pi
        row = dr.minimum(mi.UInt32(polar), self._rows - 1)
        column = dr.minimum(mi.UInt32(azimuth), self._columns - 1)
        cell = row * self._columns + column
        if self._divided is None:
            return cell
        first = dr.gather(mi.UInt32, self._first_part, cell, active)
        row, column = (
            dr.minimum(mi.UInt32((x - mi.Float(of_cell)) * _PARTS), _PARTS - 1)
            for x, of_cell in ((polar, row), (azimuth, column))
        )
        return dr.select(first > 0, first + row * _PARTS + column, cell)


def radiance_from(environment, direction, active=True):
    """Radiance that arrives from a direction; 0 where it is not finite."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    si.wi = -direction
    return finite_or_zero(mi.unpolarized_spectrum(environment.eval(si, active)))


def _direction(row, column, size, step, sample):
    """A direction in each cell with a corner and a ``size`` in units of ``step``, radians: evenly by solid angle."""
    cosine = dr.lerp(dr.cos(row * step), dr.cos((row + size) * step), sample.x)
    sine, azimuth = dr.safe_sqrt(1 - dr.square(cosine)), (column + sample.y * size) * step
    return mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), cosine)


def _table_width(environment) -> int:
    """Columns of the table: the width of the image rounded up to a power of two, between 64 and LARGEST_WIDTH."""
    if environment.class_name() == _CONSTANT:
        return 64
    columns = _image_width(environment) or _DEFAULT_WIDTH
    return int(np.clip(2 ** np.ceil(np.log2(columns)), 64, LARGEST_WIDTH))


def _image_width(environment) -> int:
    """Columns of the image of an environment, 0 without an image."""
    parameters = parameters_of(environment)
    # Mitsuba repeats the first column at the end
    return max(1, parameters["data"].shape[1] - 1) if "data" in parameters else 0


def _across(environment, width: int) -> int:
    """Evaluations along each axis of a cell in a table of ``width`` columns."""
    return max(_EVALUATIONS, -(-_image_width(environment) // width))


def _read(environment, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean radiance of every cell, (width / 2, width) float64, and the edge cells; non-finite radiance counts as
    black."""
    height, across = width // 2, _across(environment, width)
    radiance = _read_cells(environment, np.arange(width * height), width, across).reshape(height, width)
    brightest = radiance
    if not (_image_width(environment) or environment.class_name() == _CONSTANT):
        cell, found = _seen_by_samples(environment, width)
        brightest = radiance.copy()
        np.maximum.at(brightest.reshape(-1), cell, found)
    edges = np.flatnonzero(_at_edges(brightest, _BRIGHT * radiance.mean() if _image_width(environment) else 0.0))
    radiance.reshape(-1)[edges] = _read_cells(environment, edges, width, max(_EDGE_EVALUATIONS, 2 * across))
    return radiance, edges


def _seen_by_samples(environment, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(Cells, radiance) of directions that the environment samples: evaluations of the cells may miss a sun.  Of a sun
    below a tenth of a degree, those of an edge may."""
    ds, _ = environment.sample_direction(
        dr.zeros(mi.Interaction3f, _OWN_SAMPLES), independent_sampler(1, _OWN_SAMPLES).next_2d()
    )
    cell = CellPlaces(width, width // 2, np.zeros(0, int)).number_of(ds.d, True)
    radiance = dr.select(dr.all(dr.isfinite(ds.d)), channel_mean(radiance_from(environment, ds.d)), 0)
    dr.eval(cell, radiance)
    return download(cell), download(radiance)


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
        total += channel_mean(radiance_from(environment, _direction(row, column, 1, step, jitter)))
        k += 1
    return total
