"""Stratified camera samples instead of Mitsuba's ``independent`` sampler: places in the pixel and on the lens, times.

Mitsuba's ``render`` takes all numbers of a camera ray from the sampler of the sensor, which Python cannot exchange.
:func:`stratified` therefore wraps the sensor: the wrapper has the film and the rays of the sensor, and a sampler of its
own.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.split.lattice import Lattice

# Mitsuba's default, chosen by nobody who knows its noise
_REPLACED = "IndependentSampler"
# Mitsuba calls the sensors of a batch through its registry of all sensors, where the wrapper must not be
_UNWRAPPED = "BatchSensor"


class LatticeSampler(mi.Sampler):
    """Camera samples from rank-1 lattices over the samples of a pixel; see :mod:`vpl.split.lattice`.

    Each call of ``next_1d`` or ``next_2d`` takes a lattice in an independent random order.  The sampler serves one
    render and no symbolic loop.
    """

    def __init__(self, samples: int, pixels: int):
        """``samples`` of each of the ``pixels`` of a film, borders included."""
        properties = mi.Properties("lattice")
        properties["sample_count"] = samples
        super().__init__(properties)
        self._pixels, self._seed, self._pass = pixels, 0, 0

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
        lanes, samples = self.wavefront_size(), self.sample_count()
        each = dr.opaque(mi.UInt32, lanes // self._pixels)
        lane = dr.arange(mi.UInt32, lanes)
        # The passes of a render share the lattice of a pixel
        number = lane // each * dr.opaque(mi.UInt32, samples) + self._pass * each + lane % each
        self._lattice, self._calls = Lattice(number, samples, self._seed), 0

    def _next(self):
        self._calls += 1
        return self._lattice.at(dr.opaque(mi.UInt32, self._calls))


class StratifiedSensor(mi.Sensor):
    """A sensor with the film, the rays and the shutter of ``sensor``, and a :class:`LatticeSampler`."""

    def __init__(self, sensor, samples: int):
        film = sensor.film()
        size = np.array(film.crop_size(), np.int64) + (2 * film.rfilter().border_size() if film.sample_border() else 0)
        properties = mi.Properties("stratified")
        properties["film"] = film
        properties["sampler"] = LatticeSampler(samples, int(np.prod(size)))
        begin = float(dr.detach(mi.Float(sensor.shutter_open()))[0])
        properties["shutter_open"] = begin
        properties["shutter_close"] = begin + float(sensor.shutter_open_time())
        super().__init__(properties)
        self.m_needs_sample_3 = sensor.needs_aperture_sample()
        if sensor.get_medium() is not None:
            self.set_medium(sensor.get_medium())
        self._sensor = sensor

    def to_string(self):
        """The wrapped sensor."""
        return f"StratifiedSensor[{self._sensor}]"

    def sample_ray(self, *numbers):
        """Rays of the wrapped sensor."""
        return self._sensor.sample_ray(*numbers)

    def sample_ray_differential(self, *numbers):
        """Rays of the wrapped sensor, with differentials."""
        return self._sensor.sample_ray_differential(*numbers)


def stratified(sensor, spp: int):
    """``sensor``, with stratified samples if its sampler is ``independent`` and it is no batch of sensors.

    ``spp``: samples of a pixel; 0: as many as the sampler has.
    """
    sampler = sensor.sampler()
    if sampler.class_name() != _REPLACED or sensor.class_name() == _UNWRAPPED:
        return sensor
    return StratifiedSensor(sensor, spp or sampler.sample_count())
