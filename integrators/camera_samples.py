"""Stratified camera samples instead of Mitsuba's ``independent`` sampler: places in the pixel and on the lens, times.

Mitsuba's ``render`` takes all numbers of a camera ray from the sampler of the sensor, which Python cannot exchange.
:func:`stratified` therefore lends a sensor that has the film and the rays of the scene's sensor, and its own sampler.

Mitsuba's sensor ``batch`` calls its sensors through Dr.Jit's registry of all sensors, whichever scene they belong to.
A sensor that another thread frees meanwhile would end the process, so lent sensors are kept and lent again.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.sampling import derived_seed
from vpl.split.film_cells import FilmCells
from vpl.split.lattice import Lattice
from vpl.split.pixel_rays import MULTIPLE, Continued, PixelRays, RayNumbers

# Mitsuba's default. A scene that names another sampler keeps it
_REPLACED = "IndependentSampler"
# A batch of sensors calls its sensors through the registry, and would call a lent sensor, too
_KEPT = "BatchSensor"


class LatticeSampler(mi.Sampler):
    """Camera samples from rank-1 lattices over the samples of a pixel; see :mod:`vpl.split.lattice`.

    Each call of ``next_1d`` or ``next_2d`` takes a lattice in an independent random order.  The numbers are for camera
    rays and not for symbolic loops.  ``pixels``: of the film, borders included; ``cells``: the :class:`FilmCells` of a
    render in one pass, if rays are not in the order of the film or continue lattices, else None.
    """

    def __init__(self):
        super().__init__(mi.Properties("lattice"))
        self.pixels, self._seed, self._pass = 1, 0, 0
        self.end()

    @property
    def pass_seed(self) -> int:
        """Seed of a pass of a render; independent of the number of samples."""
        return derived_seed(self._seed, self._pass)

    def seed(self, seed, wavefront_size=0xFFFFFFFF):
        """Begin the first pass of a render; lanes are sorted by pixel."""
        super().seed(seed, wavefront_size)
        self._seed, self._pass = int(mi.UInt32(seed)[0]), 0
        self._begin()

    def advance(self):
        """Begin the next pass of a render with ``samples_per_pass``."""
        # Without Mitsuba's method: called from Python, it would call this method a second time
        self._pass += 1
        self._begin()

    def end(self):
        """Forget the last render, and free its memory."""
        self.cells = self._lattice = self._in_cells = self._offset = None

    def next_1d(self, active=True):
        """A uniform number for each lane."""
        return self._next()[0]

    def next_2d(self, active=True):
        """A point of the unit square for each lane."""
        # Mitsuba takes the place in the pixel first, and assumes its own order
        if self._in_cells and self._calls == 0:
            return self._next(self._in_cells)[1] + self._offset
        return self._next()[1]

    def _begin(self):
        lanes = self.wavefront_size()
        each, lane, self._calls = lanes // self.pixels, dr.arange(mi.UInt32, lanes), 0
        seed, earlier, cells, rays = self._seed, None, 1, self.cells and self.cells.rays
        if rays and rays.continued:
            seed, earlier = rays.continued.seed, rays.earlier
        if rays and not self.cells.is_plain:
            places, sizes = rays.places(lane), rays.sizes
            in_cells = self.cells.places(lane)
            cells = rays.cells
            self._in_cells = Lattice(in_cells, self.cells.sizes, seed, self.cells.earlier)
            here = self.cells.position(lane // dr.opaque(mi.UInt32, each))
            self._offset = self.cells.position(in_cells.pixel) - here
        else:
            places, sizes = RayNumbers.of_lanes(lane, each), (self.sample_count(),)
            # The passes of a render share the lattice of a pixel
            places = replace(places, number=places.number + dr.opaque(mi.UInt32, self._pass * each))
        self._lattice = Lattice(places, sizes, seed, earlier, cells)

    def _next(self, lattice: Lattice | None = None):
        self._calls += 1
        return (lattice or self._lattice).at(dr.opaque(mi.UInt32, self._calls))


class StratifiedSensor(mi.Sensor):
    """A sensor with the film and the rays of another sensor, and a :class:`LatticeSampler`, see :meth:`becomes`."""

    # Mitsuba may call a sensor before and after it is lent
    _sensor = None

    def __init__(self):
        properties = mi.Properties("stratified")
        # The pixel format of mono variants, which warn of others
        idle = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance"}
        properties["film"] = self._idle = mi.load_dict(idle)
        properties["sampler"] = LatticeSampler()
        # Times from 0 to 1 stand for the shutter of the other sensor
        properties["shutter_open"], properties["shutter_close"] = 0.0, 1.0
        super().__init__(properties)

    def becomes(self, sensor, spp: int, cells: FilmCells | None = None) -> None:
        """Stand for ``sensor`` with ``spp`` samples of a pixel of the film, and the rays of ``cells`` if there are any;
        None: for no sensor."""
        self._sensor, self.m_film, sampler = sensor, sensor.film() if sensor else self._idle, self.sampler()
        sampler.end()
        if sensor is None:
            return
        self.m_needs_sample_3 = sensor.needs_aperture_sample()
        sampler.set_sample_count(spp)
        sampler.pixels, sampler.cells = int(np.prod(film_size(sensor.film()))), cells

    def to_string(self):
        """The other sensor."""
        return f"StratifiedSensor[{self._sensor}]"

    def sample_ray(self, time, *numbers):
        """Rays of the other sensor."""
        if self._sensor is None:
            return dr.zeros(mi.Ray3f), mi.Spectrum(0)
        return self._sensor.sample_ray(self._time(time), *numbers)

    def sample_ray_differential(self, time, *numbers):
        """Rays of the other sensor, with differentials."""
        if self._sensor is None:
            return dr.zeros(mi.RayDifferential3f), mi.Spectrum(0)
        return self._sensor.sample_ray_differential(self._time(time), *numbers)

    def _time(self, time):
        return self._sensor.shutter_open() + time * self._sensor.shutter_open_time()


_IDLE: list[StratifiedSensor] = []


def is_replaced(sensor) -> bool:
    """Whether :func:`stratified` replaces the samples of a sensor."""
    is_usual = sensor.sampler().class_name() == _REPLACED and sensor.class_name() != _KEPT
    # Integrators refuse sensors within a participating medium
    return is_usual and sensor.get_medium() is None


def film_size(film) -> np.ndarray:
    """Width and height of the pixels that a film samples, (2,) int64, borders included."""
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    return np.array(film.crop_size(), np.int64) + border


def may_differ(sensor, spp: int, parts: int = 1) -> bool:
    """Whether the pixels of an image may have different numbers of samples, ``spp`` in the mean.

    ``parts``: the image has a film of ``parts``² pixels for each pixel, with a box filter, instead of the film of the
    ``sensor``.
    """
    return has_free_order(sensor, parts > 1) and spp % (MULTIPLE * parts**2) == 0


def has_free_order(sensor, has_box: bool = False) -> bool:
    """Whether rays may have another order than the film, and pixels different numbers of rays.

    Only with a box filter, which has no weights: Mitsuba divides the sum of weighted samples by the sum of weights, so
    pixels with many samples would count more than their neighbours.  ``has_box``: the film will have a box filter.
    """
    film = sensor.film()
    return is_replaced(sensor) and (has_box or (film.rfilter().is_box_filter() and not film.sample_border()))


def cells_of(
    film, spp: int, parts: int, density: np.ndarray | None = None, continued: Continued | None = None
) -> FilmCells | None:  # fmt: skip
    """Cells of a ``film`` with ``parts``² pixels for each pixel of the image and ``spp`` samples for each pixel of the
    film; None if rays have the order of the film and lattices of their own.

    ``density`` (height, width): samples of the image's pixels over their mean, about; None: equal numbers;
    ``continued``: earlier rays with these numbers.  Raises ValueError for a density of another shape.
    """
    if parts == 1 and density is None and continued is None:
        return None
    width, height = (film_size(film) // parts).tolist()
    samples = spp * parts**2
    if density is None:
        rays = replace(PixelRays.uniform(width * height, samples), cells=parts**2, continued=continued)
        return FilmCells(rays, width)
    if density.shape != (height, width):
        raise ValueError(f"density must have the shape of the image, {(height, width)}, got {density.shape}")
    return FilmCells(replace(PixelRays.by_density(density, samples, continued), cells=parts**2), width)


@contextmanager
def stratified(
    sensor, spp: int, density: np.ndarray | None = None, parts: int = 1, continued: Continued | None = None
):  # fmt: skip
    """Within the block, a sensor for ``sensor`` with stratified samples if its sampler is ``independent``.

    Yields ``sensor`` itself with another sampler, for a batch of sensors, and within a participating medium.  ``spp``:
    samples of a pixel of the film; 0: as many as the sampler has; ``density``, ``parts``, ``continued``: see
    :func:`cells_of`, for films with a box filter.
    """
    if not is_replaced(sensor):
        yield sensor
        return
    sampler = sensor.sampler()
    try:
        # A single operation, because threads render at the same time
        lent = _IDLE.pop()
    except IndexError:
        lent = StratifiedSensor()
    try:
        spp = spp or sampler.sample_count()
        lent.becomes(sensor, spp, cells_of(sensor.film(), spp, parts, density, continued))
        yield lent
    finally:
        lent.becomes(None, 0)
        _IDLE.append(lent)
