"""Passes of an image, rendered by the workers of a pool and summed in the order of their seeds.

The image depends only on the passes, not on the workers or the order of arrival. The samples of a pass are fixed in
advance, by the size of the image and the requested samples, as the time of a pass differs between workers.
"""

import math
import time
from collections import Counter

from ..rendering import Passes
from ..single_pass import pass_seed
from . import worker
from .pool import TASKS_PER_WORKER, Task

PASS_SAMPLES = 2**20  # maximum pixel samples of a pass, unless one per pixel is more
LEAST_PASSES = 16  # of an image with a limit of samples per pixel
LEAST_SPP = 4  # Mitsuba compiles different kernels for passes below this
WAITING_BYTES = 2**31  # maximum memory of passes that wait for an earlier pass
WAIT_SECONDS = 0.1  # between checks for Ctrl-C


def samples_of_a_pass(pixels, spp=None):
    """Return the samples per pixel of a pass: a power of two, with at most `PASS_SAMPLES` pixel samples. An image of
    `spp` samples per pixel, if given, has at least 16 passes, unless these have fewer than 4 samples."""
    most = max(1, PASS_SAMPLES // pixels)
    if spp:
        most = min(most, max(LEAST_SPP, spp // LEAST_PASSES))
    return 1 << (most.bit_length() - 1)


class DistributedPasses(Passes):
    """Running average of passes on the workers of a `Pool`, with the interface of `rendering.Progressive`.

    `bundle`: the scene (`SceneBundle`); `pixels`, `sampler` (`mi.Sampler`): of the sensor of index `sensor`;
    `pass_spp`: samples per pixel of all passes except the last; `spp`: of the image, or None. `deadline`: time of
    `perf_counter` that ends the wait for passes, except for the first one. `workers`: number of passes by address of a
    worker.
    """

    def __init__(self, pool, bundle, seed, sensor, pixels, sampler, pass_spp, spp=None):
        super().__init__(seed)
        self.pixels, self.workers, self.deadline = pixels, Counter(), math.inf
        self._pool, self._bundle, self._sensor = pool, bundle, sensor
        sampler.set_sample_count(pass_spp)
        self._pass_spp, self._rounded, self._spp = pass_spp, sampler.sample_count(), spp
        self._finished, self._failure, self._seconds, self._late = {}, None, 0.0, False

    def start(self):
        """Let workers begin with the pass after the finished ones."""
        self._base, self._first = self.spp, len(self.passes)
        self._next = self._first
        self._pool.sources.append(self)

    def close(self):
        """Drop all passes that are not finished."""
        self._pool.forget(self)
        self._finished.clear()

    def render(self, spp, accept=lambda: True, is_probe=False, is_last=False):
        """Wait for the next pass, of `spp` samples per pixel, add it and return the `Pass`; None if `accept` returns
        False, or after the deadline. Raises ClusterError if a pass failed. `is_probe`: False, as the passes of workers
        have equal numbers of samples in all pixels; `is_last`: not used, as they share no lattices."""
        index = len(self.passes)
        while index not in self._finished:
            if self._failure:
                raise self._failure
            nothing_comes = index == self._next and self._is_too_late(0)
            self._late = bool(self.passes) and (nothing_comes or time.perf_counter() > self.deadline)
            if self._late or not accept():
                return None
            self._pool.wait(WAIT_SECONDS)
        return self.add(self._finished.pop(index))

    def is_late(self):
        """Return whether the deadline refused a pass."""
        return self._late

    def should_stop(self):
        """Return False: `cancel` of a worker's integrator cannot be called."""
        return False

    # --- For the pool ---

    def next_task(self, queued):
        """Return the next pass for a worker with `queued` tasks, None if there is none for it."""
        size = self._size(self._next)
        ahead = self._next - len(self.passes)
        if not size or ahead >= self._most_ahead() or (self._next and self._is_too_late(queued)):
            return None
        sources = self._pool.sources
        if self is not sources[0] and sum(one.waiting_bytes for one in sources) >= WAITING_BYTES:
            return None  # earlier images wait for a pass
        first = (self.passes[0].spp, self.passes[0].seed) if self.passes else (self._size(0), pass_seed(self.seed, 0))
        arguments = (self._bundle, self._sensor, size, pass_seed(self.seed, self._next), first)
        task = Task(self, self._next, worker.render_pass, arguments)
        self._next += 1
        return task

    @property
    def waiting_bytes(self):
        """Memory of passes that have arrived and are not added yet."""
        return self._pass_bytes * len(self._finished)

    @property
    def _pass_bytes(self):
        """Memory of the image of a pass; before the first pass is added, with three channels."""
        return 4 * self.pixels * (len(self.channels) or 3)

    def done(self, index, image, address):
        """Take a finished pass."""
        self._finished[index], self._seconds = image, image.taken.seconds
        self.workers[address] += 1

    def failed(self, index, error):
        """Take the error of a failed pass."""
        self._failure = error

    def _size(self, index):
        if self._spp is None:
            return self._pass_spp
        return max(0, min(self._pass_spp, self._spp - self._base - (index - self._first) * self._rounded))

    def _most_ahead(self):
        """Return the maximum number of passes on workers or waiting, which bounds memory."""
        workers = max(1, len(self._pool.workers))
        return max(TASKS_PER_WORKER * workers, min(8 * workers, WAITING_BYTES // self._pass_bytes))

    def _is_too_late(self, queued):
        """Return whether a worker with `queued` tasks would finish another pass after the deadline."""
        return time.perf_counter() + (queued + 1) * self._seconds > self.deadline
