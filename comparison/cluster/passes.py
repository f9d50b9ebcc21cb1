"""The passes of an image, rendered by the workers of a pool and added up here in the order of their seeds.

So the image depends on the passes alone, not on who rendered them, nor on which came first. How many samples a pass has
is fixed beforehand, by the image and the samples that are asked for: what passes take differs from worker to worker.
"""

import math
import time
from collections import Counter

from ..rendering import Passes, pass_seed
from . import worker
from .pool import TASKS_PER_WORKER, Task

PASS_SAMPLES = 2**20  # pixel samples of a pass, at most, unless a single one per pixel is more
LEAST_PASSES = 16  # of an image with given samples per pixel
LEAST_SPP = 4  # Mitsuba compiles other kernels for passes of fewer
WAITING_BYTES = 2**31  # of passes that wait for one before them, of one image or of all
WAIT_SECONDS = 0.1  # from one look for Ctrl-C to the next


def samples_of_a_pass(pixels, spp=None):
    """Return the samples per pixel of a pass: a power of two, of up to `PASS_SAMPLES` pixel samples, and such that an
    image of `spp` samples per pixel, if given, has at least 16 passes if each of them can have 4."""
    most = max(1, PASS_SAMPLES // pixels)
    if spp:
        most = min(most, max(LEAST_SPP, spp // LEAST_PASSES))
    return 1 << (most.bit_length() - 1)


class DistributedPasses(Passes):
    """The running average of passes that the workers of a `Pool` render, in the place of a `rendering.Progressive`.

    `bundle` is the scene (`SceneBundle`); `pixels` and `sampler` (a `mi.Sampler`) are those of the sensor with the
    index `sensor`; `pass_spp` is the size of all passes but the last of `spp` samples per pixel, which may be None.
    `deadline` (of `perf_counter`) is when no pass is waited for any more, except for the first. `workers` counts the
    passes of each worker, by address.
    """

    def __init__(self, pool, bundle, seed, sensor, pixels, sampler, pass_spp, spp=None):
        super().__init__(seed)
        self.pixels, self.workers, self.deadline = pixels, Counter(), math.inf
        self._pool, self._bundle, self._sensor = pool, bundle, sensor
        sampler.set_sample_count(pass_spp)
        self._pass_spp, self._rounded, self._spp = pass_spp, sampler.sample_count(), spp
        self._finished, self._failure, self._seconds, self._late = {}, None, 0.0, False

    def start(self):
        """Let workers begin, with the pass after those that there are."""
        self._base, self._first = self.spp, len(self.passes)
        self._next = self._first
        self._pool.sources.append(self)

    def close(self):
        """No more passes are needed."""
        self._pool.forget(self)
        self._finished.clear()

    def render(self, spp, accept=lambda: True):
        """Return the next pass (a `Pass`), which has `spp` samples per pixel, when it is there and added; None if
        `accept` refuses to wait, or if there was no time. Raises ClusterError if a pass failed."""
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
        """Was there no time for a pass?"""
        return self._late

    def should_stop(self):
        """Was the integrator's `cancel` called? Nobody can, here."""
        return False

    # --- For the pool ---

    def next_task(self, queued):
        """Return the next pass for a worker that has so many tasks already, None if it is not to have one."""
        size = self._size(self._next)
        ahead = self._next - len(self.passes)
        if not size or ahead >= self._most_ahead() or (self._next and self._is_too_late(queued)):
            return None
        sources = self._pool.sources
        if self is not sources[0] and sum(one.waiting_bytes for one in sources) >= WAITING_BYTES:
            return None  # images before this one wait for a pass
        arguments = (self._bundle, self._sensor, size, pass_seed(self.seed, self._next))
        task = Task(self, self._next, worker.render_pass, arguments)
        self._next += 1
        return task

    @property
    def waiting_bytes(self):
        """Of passes that are here and not added yet, of three channels."""
        return 12 * self.pixels * len(self._finished)

    def done(self, index, image, address):
        """A pass is there."""
        self._finished[index], self._seconds = image, image.taken.seconds
        self.workers[address] += 1

    def failed(self, index, error):
        """A pass could not be rendered."""
        self._failure = error

    def _size(self, index):
        if self._spp is None:
            return self._pass_spp
        return max(0, min(self._pass_spp, self._spp - self._base - (index - self._first) * self._rounded))

    def _most_ahead(self):
        """How many passes may be with workers, or wait here for one before them: memory is bounded."""
        workers = max(1, len(self._pool.workers))
        return max(TASKS_PER_WORKER * workers, min(8 * workers, WAITING_BYTES // (12 * self.pixels)))

    def _is_too_late(self, queued):
        """Would a pass be finished after the deadline, by a worker that has so many before it?"""
        return time.perf_counter() + (queued + 1) * self._seconds > self.deadline
