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
from vpl.split.lattice import Lattice
from vpl.split.pixel_rays import MULTIPLE, PixelRays, RayNumbers

# Mitsuba's default. A scene that names another sampler keeps it
_REPLACED = "IndependentSampler"
# A batch of sensors calls its sensors through the registry, and would call a lent sensor, too
_KEPT = "BatchSensor"


class LatticeSampler(mi.Sampler):
    """Camera samples from rank-1 lattices over the samples of a pixel; see :mod:`vpl.split.lattice`.

    Each call of ``next_1d`` or ``next_2d`` takes a lattice in an independent random order.  The numbers are for camera
    rays and not for symbolic loops.  ``pixels``: of the film, borders included; ``width`` of the film; ``rays``: the
    :class:`PixelRays` of a render in one pass, None for equal numbers of rays.
    """

    def __init__(self):
        super().__init__(mi.Properties("lattice"))
        self.pixels, self.width, self._seed, self._pass = 1, 1, 0, 0
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
        self.rays = self._lattice = self._offset = None

    def next_1d(self, active=True):
        """A uniform number for each lane."""
        return self._next()[0]

    def next_2d(self, active=True):
        """A point of the unit square for each lane."""
        point = self._next()[1]
        # Mitsuba takes the place in the pixel first, and assumes equal numbers of rays
        return point + self._offset if self.rays and self._calls == 1 else point

    def _begin(self):
        lanes = self.wavefront_size()
        each, lane, self._calls = lanes // self.pixels, dr.arange(mi.UInt32, lanes), 0
        if self.rays:
            places, sizes = self.rays.places(lane), self.rays.sizes
            here, there = (self._position(pixel) for pixel in (lane // dr.opaque(mi.UInt32, each), places.pixel))
            self._offset = there - here
        else:
            places, sizes = RayNumbers.of_lanes(lane, each), (self.sample_count(),)
            # The passes of a render share the lattice of a pixel
            places = replace(places, number=places.number + dr.opaque(mi.UInt32, self._pass * each))
        self._lattice = Lattice(places, sizes, self._seed)

    def _position(self, pixel):
        """Position of a pixel in the film."""
        width = dr.opaque(mi.UInt32, self.width)
        return mi.Point2f(pixel % width, pixel // width)

    def _next(self):
        self._calls += 1
        return self._lattice.at(dr.opaque(mi.UInt32, self._calls))


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

    def becomes(self, sensor, spp: int, density: np.ndarray | None = None) -> None:
        """Stand for ``sensor`` with ``spp`` samples of a pixel, which differ in proportion to a ``density`` (height,
        width) if there is one; None: for no sensor."""
        self._sensor, self.m_film, sampler = sensor, sensor.film() if sensor else self._idle, self.sampler()
        sampler.end()
        if sensor is None:
            return
        film = sensor.film()
        size = np.array(film.crop_size(), np.int64) + (2 * film.rfilter().border_size() if film.sample_border() else 0)
        self.m_needs_sample_3 = sensor.needs_aperture_sample()
        sampler.set_sample_count(spp)
        sampler.pixels, sampler.width = int(np.prod(size)), int(size[0])
        if density is None:
            return
        shape = tuple(size[::-1].tolist())
        if density.shape != shape:
            raise ValueError(f"density must have the shape of the film, {shape}, got {density.shape}")
        sampler.rays = PixelRays.by_density(density, spp)

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


def may_differ(sensor, spp: int) -> bool:
    """Whether pixels may have different numbers of samples, ``spp`` in the mean.

    Only with a box filter, which has no weights: Mitsuba divides the sum of weighted samples by the sum of weights, so
    pixels with many samples would count more than their neighbours.
    """
    film = sensor.film()
    return is_replaced(sensor) and film.rfilter().is_box_filter() and not film.sample_border() and spp % MULTIPLE == 0


@contextmanager
def stratified(sensor, spp: int, density: np.ndarray | None = None):
    """Within the block, a sensor for ``sensor`` with stratified samples if its sampler is ``independent``.

    Yields ``sensor`` itself with another sampler, for a batch of sensors, and within a participating medium.  ``spp``:
    samples of a pixel; 0: as many as the sampler has; ``density`` (height, width): the samples of a pixel over their
    mean, about, where :func:`may_differ`; None: equal numbers.
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
        lent.becomes(sensor, spp or sampler.sample_count(), density)
        yield lent
    finally:
        lent.becomes(None, 0)
        _IDLE.append(lent)
