"""Stratified camera samples instead of Mitsuba's ``independent`` sampler: places in the pixel and on the lens, times.

Mitsuba's ``render`` takes all numbers of a camera ray from the sampler of the sensor, which Python cannot exchange.
:func:`stratified` therefore lends a sensor that has the film and the rays of the scene's sensor, and its own sampler.

Mitsuba's sensor ``batch`` calls its sensors through Dr.Jit's registry of all sensors, whichever scene they belong to.
A sensor that another thread frees meanwhile would end the process, so lent sensors are kept and lent again.
"""

from __future__ import annotations

from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.sampling import derived_seed
from vpl.split.lattice import Lattice

# Mitsuba's default. A scene that names another sampler keeps it
_REPLACED = "IndependentSampler"
# A batch of sensors calls its sensors through the registry, and would call a lent sensor, too
_KEPT = "BatchSensor"


class LatticeSampler(mi.Sampler):
    """Camera samples from rank-1 lattices over the samples of a pixel; see :mod:`vpl.split.lattice`.

    Each call of ``next_1d`` or ``next_2d`` takes a lattice in an independent random order.  The numbers are for camera
    rays and not for symbolic loops.  ``pixels``: of the film, borders included.
    """

    def __init__(self):
        super().__init__(mi.Properties("lattice"))
        self.pixels, self._seed, self._pass = 1, 0, 0

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

    def next_1d(self, active=True):
        """A uniform number for each lane."""
        return self._next()[0]

    def next_2d(self, active=True):
        """A point of the unit square for each lane."""
        return self._next()[1]

    def _begin(self):
        lanes = self.wavefront_size()
        each = lanes // self.pixels
        lane, wide = dr.arange(mi.UInt32, lanes), dr.opaque(mi.UInt32, each)
        # The passes of a render share the lattice of a pixel
        number = lane % wide + dr.opaque(mi.UInt32, self._pass * each)
        self._lattice, self._calls = Lattice(lane // wide, number, self.sample_count(), self._seed), 0

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

    def becomes(self, sensor, spp: int) -> None:
        """Stand for ``sensor`` with ``spp`` samples of a pixel; None: for no sensor."""
        self._sensor, self.m_film = sensor, sensor.film() if sensor else self._idle
        if sensor is None:
            return
        film = sensor.film()
        size = np.array(film.crop_size(), np.int64) + (2 * film.rfilter().border_size() if film.sample_border() else 0)
        self.m_needs_sample_3 = sensor.needs_aperture_sample()
        self.sampler().set_sample_count(spp)
        self.sampler().pixels = int(np.prod(size))

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


@contextmanager
def stratified(sensor, spp: int):
    """Within the block, a sensor for ``sensor`` with stratified samples if its sampler is ``independent``.

    Yields ``sensor`` itself with another sampler, for a batch of sensors, and within a participating medium, which
    integrators refuse.  ``spp``: samples of a pixel; 0: as many as the sampler has.
    """
    sampler = sensor.sampler()
    if sampler.class_name() != _REPLACED or sensor.class_name() == _KEPT or sensor.get_medium() is not None:
        yield sensor
        return
    try:
        # A single operation, because threads render at the same time
        lent = _IDLE.pop()
    except IndexError:
        lent = StratifiedSensor()
    try:
        lent.becomes(sensor, spp or sampler.sample_count())
        yield lent
    finally:
        lent.becomes(None, 0)
        _IDLE.append(lent)
