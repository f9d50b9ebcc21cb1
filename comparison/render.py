"""`manylights.render`: an image that ends by itself, when it has the samples, the seconds or the error asked for."""

import time as clock
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from integrators.knobs import doubt_percentage
from vpl.core.exclusive import exclusive

from .convergence import ErrorGoal
from .denoising import Denoiser
from .interruption import Interruption
from .pass_sizes import PassSizes
from .rendering import Progressive, total_statistics


@dataclass
class Took:
    """Cost of an image.

    `spp`: samples per pixel; `passes`: how many, each with a seed of its own; `seconds`: wall-clock time of the call,
    with compilation and denoising; `error`: the relative standard error that 95% of the pixels do not exceed, as
    estimated (see convergence.py), of the image before it was denoised, None if there were fewer than two passes;
    `statistics`: the integrator's counters, added up over passes; `ended_by`: "spp", "time" or "error", whichever was
    reached, "interruption" (Ctrl-C, or the integrator's `cancel`) or "progress"; None while it goes on; `channels`:
    names of the image's channels; `denoise_seconds`: those of `seconds` that denoising took; `raw`: the image before it
    was denoised (`mi.TensorXf`), None if it was not.
    """

    spp: int
    passes: int
    seconds: float
    error: float | None
    statistics: dict = field(repr=False)
    ended_by: str | None
    channels: list
    denoise_seconds: float = 0.0
    raw: object = field(default=None, repr=False)


def render(
    scene, integrator=None, sensor=0, *, error=None, time=None, spp=None, seed=0, denoise=False, progress=None,
    pass_spp=None,
):  # fmt: skip
    """Render a scene in passes of about two seconds; return the image, a `mi.TensorXf` of shape (height, width,
    channels) as of `mi.render`, and what it took (`Took`).

    `integrator`: a `mi.Integrator` or the name of one, by default the scene's; `sensor`: its index. The render ends as
    soon as one of these is reached, of which any may be given: `error`, the relative standard error that 95% of the
    pixels are to be below; `time`, in seconds, compilation included; `spp`, samples per pixel (if none is given, the
    scene's). There is always one pass. `seed`: of the first pass; the others have hashes of it. `denoise`: return the
    denoised image, see denoising.py. `progress`: called after each pass with what it took so far and the image so far;
    if it returns False, the render ends. `pass_spp`: samples per pixel of a pass, instead of two seconds.

    After Ctrl-C, or `cancel()` of the integrator, the image of the finished passes is returned. Where there are none,
    KeyboardInterrupt is raised, or RuntimeError after `cancel()`; and KeyboardInterrupt by a second Ctrl-C.

    Raises ValueError for values that are not positive, for a sensor that does not exist, and for a scene without an
    integrator if none is given; ModuleNotFoundError for `denoise` without the package that it needs; RuntimeError where
    another thread renders with the same sensor.
    """
    _check(error=error, time=time, spp=spp, pass_spp=pass_spp)
    doubt_percentage("error", error or 0)
    if not 0 <= sensor < len(scene.sensors()):
        raise ValueError(f"sensor must be from 0 to {len(scene.sensors()) - 1}, got {sensor!r}")
    if error is None and time is None and spp is None:
        spp = scene.sensors()[sensor].sampler().sample_count()
    begin = clock.perf_counter()
    denoiser = Denoiser(scene, sensor, seed) if denoise else None
    running = _Render(Progressive(scene, seed, sensor, _integrator(scene, integrator)), begin, progress)
    reserved = denoiser.filter_seconds if denoiser else 0.0
    sizes = PassSizes(running.progressive.pixels, spp, time and time - reserved, pass_spp, many=error is not None)
    with exclusive(sensor=scene.sensors()[sensor]), Interruption() as interruption:
        running.run(sizes, error and ErrorGoal(error), interruption)
    if not running.progressive.passes:
        raise KeyboardInterrupt if interruption.asked else RuntimeError("cancelled before the first pass was finished")
    return running.result(denoiser)


def _check(**values):
    for name, value in values.items():
        if value is None:
            continue
        whole = name.endswith("spp")
        if not isinstance(value, int if whole else int | float) or not 0 < value < float("inf"):
            raise ValueError(f"{name} must be a positive {'whole ' if whole else ''}number, got {value!r}")


def _integrator(scene, integrator):
    """Return the integrator of that name, or the one given, or the scene's."""
    if isinstance(integrator, str):
        import integrators  # noqa: F401 (registers plugins; needs a variant)

        return mi.load_dict({"type": integrator})
    integrator = integrator or scene.integrator()
    if integrator is None:
        raise ValueError("the scene has no integrator; give one")
    return integrator


class _Render:
    """A render that began at a time (of `perf_counter`): its passes, and what ended it."""

    def __init__(self, progressive, begin, progress):
        self.progressive, self._begin, self._progress = progressive, begin, progress
        self._error, self._ended_by = None, None

    def run(self, sizes, goal, interruption):
        """Render passes until something ends it."""

        def interrupted():
            return interruption.asked or self.progressive.integrator.should_stop()

        while self._ended_by is None:
            size = sizes.next(self.progressive.passes, clock.perf_counter() - self._begin)
            if isinstance(size, str):
                self._ended_by = size
                return
            try:
                # Mitsuba, too, hears Ctrl-C, and stops: then the pass may be unfinished.
                one = self.progressive.render(size, accept=lambda: not interrupted())
            except KeyboardInterrupt:
                one = None
            if one is not None:
                self._look(goal)
            if one is None or interrupted():
                self._ended_by = "interruption"

    def _look(self, goal):
        """See whether the last pass was enough, and tell how far it is."""
        if goal and goal.is_due(self.progressive):
            self._error = self.progressive.estimate.relative()
            if goal.is_reached(self._error):
                self._ended_by = "error"
        if self._progress and self._progress(self._took(), self._image()) is False:
            self._ended_by = self._ended_by or "progress"

    def result(self, denoiser):
        """Return the image and what it took."""
        if self._ended_by != "error":
            self._error = self.progressive.estimate.relative()
        image, took = self._image(), self._took()
        if denoiser:
            image, took.raw = denoiser.denoise(image, took.channels), image
            took.denoise_seconds = denoiser.seconds
            took.seconds = clock.perf_counter() - self._begin
        return image, took

    def _image(self):
        return mi.TensorXf(np.float32(self.progressive.image))

    def _took(self):
        one = self.progressive
        seconds = clock.perf_counter() - self._begin
        statistics = total_statistics(one.passes)
        return Took(one.spp, len(one.passes), seconds, self._error, statistics, self._ended_by, one.channels)
