"""A single pass of a render: its image, cost and seed, and what the passes of a render share."""

import time
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.compilation import compilation_measured
from vpl.core.exclusive import exclusive
from vpl.core.garbage import garbage_kept
from vpl.core.stages import Stage
from vpl.split.film_cells import HALF

from .fine_film import fine_film
from .images import check_colour, colour, planes_of

MAXIMUM_PASS_SAMPLES = 2**21  # pixel samples of a pass: bounds memory, and the time to the first image
MORE_IN_PARTS = 4  # factor of the above for a pass that is rendered in parts
# The same for a pass that is a single kernel, where no image is waited for. Such a pass stores no paths: 2^21, 2^23,
# 2^24 and 2^26 samples of `path` with the sampler multijitter, cornell, 512 wide, take 0.00, 0.02, 0.02 and 0.02 GiB
# more than 2^18, and 0.7, 2.9, 4.0 and 21 s on two cores. 2^24 are enough to stratify large images, in seconds
MORE_IN_ONE_KERNEL = 8
# Stages of `manylights` with times that grow with the samples, by the parts of a predicted cost: paths, lights, cuts
PER_SAMPLE = (Stage.TRACED,), (Stage.LIGHTS, Stage.TREE), (Stage.CLUSTERS, Stage.CUTS)
LEAST_SECONDS = 1e-6  # below the time of any pass, so that no cost is 0


def pass_seed(seed, index):
    """Return the seed of pass `index` of a render: `seed` for pass 0, so that a single pass is equal to
    `mi.render(scene, seed=seed)`, and a 32-bit hash of `seed` and `index` for later passes."""
    if index == 0:
        return seed
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def pass_sizes(spp, size):
    """Split `spp` samples per pixel into passes of `size` (a list of ints)."""
    full, rest = divmod(spp, size)
    return [size] * full + ([rest] if rest else [])


def largest_pass(pixels, in_parts=False, in_one_kernel=False):
    """Return the maximum samples per pixel of a pass, at least 1: up to `MAXIMUM_PASS_SAMPLES` samples over all pixels,
    or `MORE_IN_PARTS` or `MORE_IN_ONE_KERNEL` times as many for a pass in parts or in one kernel."""
    more = MORE_IN_PARTS if in_parts else MORE_IN_ONE_KERNEL if in_one_kernel else 1
    return max(1, more * MAXIMUM_PASS_SAMPLES // pixels)


@dataclass
class Pass:
    """A finished pass: seed, samples per pixel, wall-clock seconds, counters of the integrator, and the seconds of
    compilation, None if they were not measured."""

    seed: int
    spp: int
    seconds: float
    statistics: dict = field(default_factory=dict)
    compile_seconds: float | None = None

    @property
    def weight(self):
        """Weight in the average of passes: the precision that the integrator expects of the pass before rendering it,
        or else the samples per pixel. Passes of `manylights` without virtual lights are noisier than the others."""
        return self.statistics.get("precision", self.spp)

    @property
    def has_lights(self):
        """Whether `manylights` used virtual lights."""
        return Stage.CUTS in self.statistics.get("seconds", {})

    @property
    def growth(self):
        """Expected seconds of a sample of passes of other sizes, a list of (ratio of the sizes, seconds over those in
        this pass) by size; None if the integrator does not predict costs.

        The seconds of each part of the cost grow with the predicted cost. Where this pass has no virtual lights, the
        seconds of its paths tell those of lights and cuts.
        """
        costs = self.statistics.get("costs")
        if not costs:
            return None
        own, measured = dict(costs)[1], self._seconds_by_part
        each = [seconds / cost if cost else measured[0] / own[0] for seconds, cost in zip(measured, own, strict=True)]
        whole = max(sum(measured), LEAST_SECONDS)
        return [(ratio, float(np.dot(other, each)) / whole) for ratio, other in costs]

    @property
    def _seconds_by_part(self):
        """Seconds of the parts of `PER_SAMPLE`."""
        stages = self.statistics.get("seconds", {})
        return [sum(stages.get(stage, 0.0) for stage in part) for part in PER_SAMPLE]

    @property
    def repeated_seconds(self):
        """Seconds without compilation, and without the work that later passes share: preparing emitters, the pilot, and
        measurements by the pilot's paths; at least `LEAST_SECONDS`."""
        shared, stages = [], self.statistics.get("seconds", {})
        if self.statistics.get("pilots", 0):
            shared = [Stage.SCENE, Stage.PILOT]
        elif self.statistics.get("measured", 0):
            shared = [Stage.PILOT]
        not_repeated = (self.compile_seconds or 0.0) + sum(stages.get(stage, 0.0) for stage in shared)
        return max(self.seconds - not_repeated, LEAST_SECONDS)

    @property
    def start_seconds(self):
        """The `repeated_seconds` that hardly grow with the samples; None if the integrator does not report them."""
        stages = self.statistics.get("seconds", {})
        if Stage.TRACED not in stages:
            return None
        return max(self.repeated_seconds - sum(self._seconds_by_part), 0.0)


@dataclass
class PassImage:
    """Image of a pass. `planes`: average of the samples, (height, width, channels) float32; `channels`: names; `taken`:
    the `Pass`; `half`: colour of every second sample, None if not requested."""

    planes: np.ndarray
    channels: list
    taken: Pass
    half: np.ndarray | None = None


def render_pass(
    scene, sensor, integrator, spp, seed, first=None, shared=None, density=None, half=False, parts=1,
    continued=None, measures=None,
):  # fmt: skip
    """Render a pass of `spp` samples per pixel, which stratified samplers round up; return a `PassImage`.

    `sensor`: an index. `first`: (samples per pixel, seed) of the first pass of the render, by default this pass; the
    start that passes of `manylights` share depends on it. `shared`: the `SharedStart` of the render. `density`, `half`,
    `continued`: samples of each pixel over `spp`, whether to return an image of every second sample, and earlier
    samples; see `PassRenderer.pass_of`. `parts`: the image is that of a fine film (fine_film.py), whose pixels have
    equal numbers of samples, so that `spp` is rounded up. `measures`: whether to measure compilation, which takes time;
    by default in a first pass.
    """
    sensor, begin = scene.sensors()[sensor], time.perf_counter()
    shared = shared or SharedStart()
    with fine_film(sensor, parts):
        samples = {"density": density, "half": half, "continued": continued}
        sharing = _sharing(scene, sensor, integrator, (spp, seed), first or (spp, seed), shared, parts, samples)
        measures = first is None if measures is None else measures
        with compilation_measured() if measures else nullcontext() as compilation, sharing:
            spp = _render(scene, sensor, integrator, spp, seed, parts)
        seconds = time.perf_counter() - begin
        # The film, as the image of `mi.render` lacks names, and channels of nested integrators
        planes, channels = planes_of(sensor.film().bitmap())
    statistics = dict(getattr(integrator, "statistics", None) or {})
    taken = Pass(seed, spp, seconds, statistics, compilation and compilation.seconds)
    if not half:
        return PassImage(planes, channels, taken)
    rest = [index for index, name in enumerate(channels) if not name.startswith(HALF)]
    of_half = colour(planes, channels, f"{HALF}.")
    return PassImage(planes[..., rest], [channels[index] for index in rest], taken, of_half)


def check_film(sensor, integrator, purpose):
    """Raise ValueError before a render if images by an integrator for a `mi.Sensor` have no colour, which the `purpose`
    needs. May empty the film. Raises RuntimeError if another thread uses the sensor."""
    film = sensor.film()
    if film.class_name() == "HDRFilm":
        # Each of its pixel formats has colour. To develop an image for the names takes memory and time
        return
    with exclusive(sensor=sensor):
        film.prepare(integrator.aov_names())
        _, channels = planes_of(film.bitmap())
    check_colour(channels, purpose)


def _render(scene, sensor, integrator, spp, seed, parts):
    """Render to the film of a sensor; return the samples per pixel, as the sampler rounds them."""
    # Set before the render, as integrators such as `prb` clone the sampler
    with sample_count(sensor.sampler(), -(-spp // parts**2)) as of_film, garbage_kept():
        dr.eval(mi.render(scene, sensor=sensor, integrator=integrator, seed=seed, spp=of_film))
        dr.sync_thread()
        return of_film * parts**2


@dataclass
class SharedStart:
    """What the passes of a render share: `start`, an object of the integrator, None before the first pass. The scene
    must not change while it is used. `rays`, `learning`: least numbers of camera rays for which the start is made, and
    for which emitters are learned; 0 without a limit of time, with a checkpoint, and on a cluster."""

    start: object = None
    rays: int = 0
    learning: int = 0


@contextmanager
def _sharing(scene, sensor, integrator, this, first, shared, parts, samples):
    """Let the pass `this`, (samples per pixel, seed), use the start of the pass `first`, if the integrator shares it.
    `samples`: arguments of `PassRenderer.pass_of` on the samples of the pass.

    Makes the start if the first pass was rendered elsewhere, so that an image is the same on any number of workers.
    """
    if not hasattr(integrator, "pass_of"):
        yield
        return
    with integrator.pass_of(shared, this == first, parts=parts, **samples) as is_missing:
        if is_missing:
            with integrator.only_start():
                _render(scene, sensor, integrator, *first, parts)
        yield


@contextmanager
def sample_count(sampler, spp):
    """Set the samples per pixel of a sampler within the block; yield the number after rounding by the sampler."""
    own = sampler.sample_count()
    sampler.set_sample_count(spp)
    try:
        yield sampler.sample_count()
    finally:
        sampler.set_sample_count(own)
