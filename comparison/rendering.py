"""Progressive rendering: passes of different seeds and their average."""

import time
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from .convergence import ErrorEstimate
from .images import colour

MAXIMUM_PASS_SAMPLES = 2**21  # pixel samples of one pass: it bounds memory, and the wait for the first image
MORE_IN_PARTS = 4  # times as many has a pass that is rendered in parts


def pass_seed(seed, index):
    """Return the seed of pass `index` of a render with seed `seed`: the seed itself for pass 0, so that a render of one
    pass is `mi.render(scene, seed=seed)`, and otherwise a hash of both (32 bits)."""
    if index == 0:
        return seed
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def pass_sizes(spp, size):
    """Split `spp` samples per pixel into passes of `size` (a list of ints)."""
    full, rest = divmod(spp, size)
    return [size] * full + ([rest] if rest else [])


def largest_pass(pixels, in_parts=False):
    """Return how many samples per pixel, at least one, make up to `MAXIMUM_PASS_SAMPLES` samples in all pixels, or
    `MORE_IN_PARTS` times as many."""
    return max(1, (MORE_IN_PARTS if in_parts else 1) * MAXIMUM_PASS_SAMPLES // pixels)


@dataclass
class Pass:
    """One finished pass: its seed, samples per pixel, wall-clock seconds, and what the integrator counted."""

    seed: int
    spp: int
    seconds: float
    statistics: dict = field(default_factory=dict)


@dataclass
class PassImage:
    """Image of one pass: `planes`, (height, width, channels) float32, the average of its samples; the names of its
    `channels`; and the `Pass` itself, `taken`."""

    planes: np.ndarray
    channels: list
    taken: Pass


def render_pass(scene, sensor, integrator, spp, seed):
    """Render a pass of `spp` samples per pixel (samplers with strata round them up) and return it, a `PassImage`.
    `sensor` is its index."""
    sensor = scene.sensors()[sensor]
    # Asked before the render: some integrators, such as `prb`, sample with a clone
    with _sample_count(sensor.sampler(), spp) as spp:
        begin = time.perf_counter()
        image = mi.render(scene, sensor=sensor, integrator=integrator, seed=seed, spp=spp)
        dr.eval(image)
        dr.sync_thread()
        seconds = time.perf_counter() - begin
    # Not the image that `mi.render` returned: it lacks channels of nested integrators, and names.
    bitmap = sensor.film().bitmap()
    channels = [entry.name for entry in bitmap.struct_()]
    planes = np.array(bitmap, np.float32).reshape(bitmap.size()[1], bitmap.size()[0], -1)
    statistics = dict(getattr(integrator, "statistics", None) or {})
    return PassImage(planes, channels, Pass(seed, spp, seconds, statistics))


class Passes:
    """The running average of passes with a common seed, weighted by their samples per pixel.

    It depends on the passes and their order alone. `channels` are the names of the image's channels ("R", "G", "B", and
    those of AOVs), known after the first pass; `passes` is the list of them (`Pass`), `estimate` their `ErrorEstimate`.
    """

    def __init__(self, seed):
        self.seed = seed
        self.restart()

    def restart(self):
        """Forget all passes."""
        self.passes, self.channels, self.sum, self.estimate = [], [], 0.0, ErrorEstimate()

    def add(self, image):
        """Add a `PassImage`, and return its `Pass`."""
        # In double precision, as a long sum of floats would drift.
        planes, one = image.planes.astype(np.float64), image.taken
        self.channels = image.channels
        self.sum = self.sum + one.spp * planes
        self.estimate.add(_shown(planes, self.channels), one.spp)
        self.passes.append(one)
        return one

    @property
    def spp(self):
        """Samples per pixel of all passes."""
        return sum(one.spp for one in self.passes)

    @property
    def seconds(self):
        """Wall-clock seconds of all passes, each by itself."""
        return sum(one.seconds for one in self.passes)

    @property
    def image(self):
        """The average, (height, width, channels) float64."""
        return self.sum / self.spp


class Progressive(Passes):
    """The running average of passes of one scene that this process renders. `integrator` is the scene's unless another
    one is given."""

    def __init__(self, scene, seed, sensor=0, integrator=None):
        super().__init__(seed)
        self._scene, self._sensor = scene, sensor
        self.integrator = integrator or scene.integrator()

    def render(self, spp, seed=None, accept=lambda: True):
        """Render one more pass of `spp` samples per pixel and return it (a `Pass`).

        Its seed is `pass_seed(seed of the render, number of the pass)` unless `seed` is given. A pass that raises
        leaves the average as it was, and so does one that `accept` refuses when it is finished (None is returned).
        """
        seed = pass_seed(self.seed, len(self.passes)) if seed is None else seed
        image = render_pass(self._scene, self._sensor, self.integrator, spp, seed)
        return self.add(image) if accept() else None

    def should_stop(self):
        """Was the integrator's `cancel` called?"""
        return self.integrator.should_stop()

    def is_late(self):
        """Was there no time for a pass? It is not for this one to know."""
        return False

    @property
    def in_parts(self):
        """Is a pass rendered in parts, between which it can be stopped, and with little memory for each sample?"""
        return getattr(self.integrator, "renders_in_parts", False)

    @property
    def largest_pass(self):
        """Most samples per pixel of a pass."""
        return largest_pass(self.pixels, self.in_parts)

    @property
    def pixels(self):
        """Number of pixels of the image."""
        return int(np.prod(self._scene.sensors()[self._sensor].film().crop_size()))


@contextmanager
def _sample_count(sampler, spp):
    """Set the samples per pixel of a sampler for the time of the block, which is given what it rounds them up to."""
    own = sampler.sample_count()
    sampler.set_sample_count(spp)
    try:
        yield sampler.sample_count()
    finally:
        sampler.set_sample_count(own)


def _shown(planes, channels):
    """Return the colour of an image, or all of it where its film has other channels."""
    try:
        return colour(planes, channels)
    except ValueError:
        return planes


def total_statistics(passes):
    """Add up the integrators' counters over passes: see `TotalStatistics`."""
    return TotalStatistics().of(passes)


class TotalStatistics:
    """The integrators' counters, added up over passes as these come.

    Numbers are summed, nested dicts (such as "seconds") likewise. What describes a pass, as text (such as "balance")
    and "lights" do, is that of the pass with the most samples, the last of these if there are several.
    """

    def __init__(self):
        self._total, self._count, self._most = {}, 0, 0

    def of(self, passes):
        """Return the total of a list of passes, {} if they counted nothing. It begins with those of the last call."""
        for one in passes[self._count :]:
            _add(self._total, one.statistics, describe=one.spp >= self._most)
            self._most = max(self._most, one.spp)
        self._count = len(passes)
        return deepcopy(self._total)


def _add(total, statistics, describe):
    for key, value in statistics.items():
        if isinstance(value, dict) and key != "lights":
            _add(total.setdefault(key, {}), value, describe)
        elif isinstance(value, int | float | np.number) and not isinstance(value, bool):
            total[key] = total.get(key, 0) + (value.item() if isinstance(value, np.number) else value)
        elif describe or key not in total:
            total[key] = value
