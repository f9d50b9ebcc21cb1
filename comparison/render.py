"""`manylights.render`: renders in passes until a limit of samples, seconds or error is reached."""

from __future__ import annotations

import os
import time as clock
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import mitsuba as mi
import numpy as np

from integrators.knobs import doubt_percentage
from vpl.core.exclusive import exclusive
from vpl.core.stages import listening

from .batch import ALL
from .checkpoint import Checkpoint
from .counters import TotalStatistics
from .denoising import Denoiser, for_denoising, quality_of
from .ending import Ending, checked
from .features import channels_of, check_layers, hides_emitters, layers_of
from .fine_film import usual_parts
from .interruption import Interruption, is_interruption
from .rendering import Progressive
from .scene_files import SceneFile
from .single_pass import check_film
from .timed_sizes import sizes_of

LIMITS = ("spp", "time")  # end a render regardless of its error
DENOISING = "denoise"  # stage after the last pass


@dataclass
class Took:
    """Cost of an image.

    `spp`: samples per pixel; `passes`: number of passes, each with its own seed; `seconds`: wall-clock time of the
    call, including compilation and denoising; `error`: estimated relative standard error that 95% of the pixels do not
    exceed (see convergence.py), before denoising, an upper estimate in renders by `manylights` without the limit
    `error`, whose passes are stratified together, None for fewer than two passes and where pixels have different
    numbers of samples; `statistics`: counters of the integrator, summed over passes; `ended_by`: the limit that was
    reached ("spp", "time" or "error"), "interruption" (Ctrl-C, or `cancel` of the integrator) or "progress", None
    during the render; `channels`: names of the channels; `denoise_seconds`: the part of `seconds` for denoising;
    `denoiser`: metadata, quality of the denoiser and samples of albedo and normal; `raw`: the image before denoising
    (`mi.TensorXf`), None without denoising; `layer_spp`: samples per pixel of the requested layers, None without.

    During a render: `stage`: current stage, a key of `statistics["seconds"]` or `DENOISING`, None between passes;
    `seconds_left`: expected seconds until the end, None if unknown.
    """

    spp: int
    passes: int
    seconds: float
    error: float | None
    statistics: dict[str, Any] = field(repr=False)
    ended_by: str | None
    channels: list[str]
    denoise_seconds: float = 0.0
    denoiser: dict[str, Any] = field(default_factory=dict, repr=False)
    raw: mi.TensorXf | None = field(default=None, repr=False)
    layer_spp: int | None = None
    stage: str | None = None
    seconds_left: float | None = None


def render(
    scene: mi.Scene | str | os.PathLike[str],
    integrator: mi.Integrator | str | None = None,
    sensor: int | str = 0,
    *,
    error: float | None = None,
    time: float | None = None,
    spp: int | None = None,
    seed: int = 0,
    denoise: bool | str = False,
    progress: Callable[[Took, mi.TensorXf | None], bool | None] | None = None,
    pass_spp: int | None = None,
    checkpoint: Checkpoint | None = None,
    layers: Sequence[str] = (),
) -> tuple[mi.TensorXf, Took]:
    """Render a scene in passes; return the image, a `mi.TensorXf` of shape (height, width, channels) as of `mi.render`,
    and the cost (`Took`). Without a limit of `time` the sizes of passes do not depend on the speed of the machine
    (pass_sizes.py). With one, passes take two to five seconds, or five times their start if that is longer; with
    `manylights` about ten, the last one up to twenty.

    `scene`: a `mi.Scene`, or the path of a scene file. `integrator`: a `mi.Integrator` or the name of a plugin, by
    default the scene's. `sensor`: an index, or "all" for a list of (image, cost) over all sensors. The first limit that
    is reached ends the render: `error`, the relative standard error that 95% of the pixels do not exceed; `time`, in
    seconds, compilation included; `spp`, samples per pixel. The default is the scene's samples per pixel. There
    is at least one pass. The log has a warning if `spp` or `time` ends a render above its `error`. `seed`: of the first
    pass; later passes have hashes of `seed` and their index. `denoise`: return the denoised image (denoising.py), by
    the network "high", "balanced" or "fast", or, if True, by the one that suits the `time` or the samples, and, where
    time and memory allow, at twice the resolution, with a multiple of four samples; an integrator given by name is then
    created with its property `denoised`, if it has one. An image of many samples is the mean of mirrored copies that
    are denoised, and gets back detail that the denoiser removes (detail.py). `manylights` with this property gives more
    samples to pixels where the denoiser leaves noise (sample_density.py), unless there is an `error`.
    `progress`: called after each pass with the cost and the image so far, and before denoising with None for the image;
    integrators of this project also call it so at the start of each stage of a pass. If it returns False, no other pass
    begins; an exception ends the render at once. `pass_spp`: samples per pixel of a pass. `checkpoint`: a
    `checkpoint.Checkpoint` of the same render with one sensor, whose samples and seconds count; it is removed at the
    end of a render that reaches a limit. `layers`: names of features.py, "albedo", "normal", "depth", for channels such
    as "albedo.R".

    Ctrl-C, or `cancel()` of the integrator, returns the image of the finished passes. Without a finished pass Ctrl-C
    raises KeyboardInterrupt and `cancel()` RuntimeError. A second Ctrl-C raises KeyboardInterrupt.

    Raises ValueError for limits that are not positive, for another `denoise` or other `layers`, for `denoise` with a
    film without colour, for a sensor that does not exist, for a scene without an integrator, for a participating medium
    that the integrator does not support, and for channels in `layers` that the integrator has; FileNotFoundError for a
    missing scene file; ModuleNotFoundError if the package for `denoise` is missing; RuntimeError if another thread
    renders with the same sensor, or if no variant is set.
    """
    quality, _ = quality_of(denoise), channels_of(layers)
    scene = _scene(scene)
    integrator = _integrator(scene, integrator, denoise)
    check_layers(layers, integrator)
    if sensor == ALL:
        if checkpoint:
            raise ValueError(f"checkpoint must be None where sensor is '{ALL}': it is of one image")
        return _render_all(
            scene, integrator, error=error, time=time, spp=spp, seed=seed, denoise=denoise, progress=progress,
            pass_spp=pass_spp, layers=layers,
        )  # fmt: skip
    error, time, spp, pass_spp = checked(error=error, time=time, spp=spp, pass_spp=pass_spp)
    doubt_percentage("error", error or 0)
    if not 0 <= sensor < len(scene.sensors()):
        raise ValueError(f"sensor must be from 0 to {len(scene.sensors()) - 1}, got {sensor!r}")
    if error is None and time is None and spp is None:
        spp = scene.sensors()[sensor].sampler().sample_count()
    begin = clock.perf_counter()
    if denoise:
        check_film(scene.sensors()[sensor], integrator, "denoise")
    # Passes of a checkpoint have the usual resolution, as the choice depends on times
    parts = 1 if checkpoint or not denoise else usual_parts(scene.sensors()[sensor], integrator, spp)
    of_image = {"seed": seed, "spp": spp, "time_limit": time, "hide_emitters": hides_emitters(integrator)}
    denoiser = Denoiser(scene, sensor, quality=quality, parts=parts, **of_image) if denoise else None
    planes = layers_of(layers, scene, sensor, denoiser, **of_image)
    # Without a limit of time for a checkpoint, which may go on with another one or on other machines
    limits = {} if checkpoint else {"seconds": time, "spp": spp}
    progressive = _progressive(scene, seed, sensor, integrator, denoiser, error, **limits)
    # An image that ends by its error needs independent passes, and a checkpoint may go on with them on other machines
    progressive.shares_lattices = not (denoiser or error or checkpoint)
    reserved = denoiser.expected_seconds if denoiser else 0.0
    sizes = sizes_of(progressive, spp, time and time - reserved, pass_spp, error is not None)
    ending = Ending(spp, time and time - reserved, error, reserved)
    if checkpoint:
        begin -= checkpoint.restore(progressive)
    with exclusive(sensor=scene.sensors()[sensor]):
        return render_passes(progressive, sizes, ending, begin, progress, denoiser, checkpoint, planes)


def _progressive(scene, seed, sensor, integrator, denoiser, error, **limits):
    """Return the `Progressive` for an image, which a `denoiser` will denoise unless it is None."""
    if denoiser is None:
        return Progressive(scene, seed, sensor, integrator, **limits)
    # The error is that of the raw image, which equal numbers of samples suit best
    chooses = None if error else denoiser.denoise
    progressive = Progressive(scene, seed, sensor, integrator, chooses, denoiser.parts, **limits)
    progressive.keeps_halves = denoiser.restores
    return progressive


def _render_all(scene, integrator, **limits):
    """Return a list of the results of `render` for each sensor, up to the first that was ended early."""
    found = []
    for sensor in range(len(scene.sensors())):
        found.append(render(scene, integrator, sensor, **limits))
        if found[-1][1].ended_by in ("interruption", "progress"):
            break
    return found


def render_passes(progressive, sizes, ending, begin, progress=None, denoiser=None, checkpoint=None, layers=None):
    """Render passes until the end of the render; return the image and the cost, as `render` does.

    `progressive`: renders and adds passes (`rendering.Progressive` or `cluster.passes.DistributedPasses`), and may have
    passes of the checkpoint; `sizes`: the `PassSizes`; `ending`: the limits (`Ending`); `begin`: start of the render by
    `perf_counter`, less the seconds of the checkpoint; `layers`: the `Layers` of the image, or None.
    """
    running = _Render(progressive, ending, begin, progress, checkpoint, layers)
    with Interruption() as interruption:
        running.run(sizes, interruption, stays=denoiser is not None)
    if not progressive.passes:
        raise KeyboardInterrupt if interruption.asked else RuntimeError("cancelled before the first pass was finished")
    image, took = running.result(denoiser)
    if checkpoint and took.ended_by in (*LIMITS, "error"):
        checkpoint.finish()
    return image, took


def _scene(scene):
    """Return a `mi.Scene`, which is loaded if `scene` is the path of a scene file."""
    if mi.variant() is None:
        raise RuntimeError('no variant is set: call mi.set_variant("llvm_ad_rgb"), or with another variant, first')
    if isinstance(scene, mi.Scene):
        return scene
    if not isinstance(scene, str | os.PathLike):
        raise TypeError(f"scene must be a mi.Scene or the path of a scene file, got {scene!r}")
    if not os.path.isfile(scene):
        raise FileNotFoundError(f"no scene file '{os.fspath(scene)}'")
    return SceneFile(scene).load()


def _integrator(scene, integrator, denoise):
    """Return the given integrator, the plugin of the given name, or by default the scene's integrator. Raises
    ValueError if there is none, and for a scene that the integrator does not support. `denoise`: whether the image will
    be denoised."""
    if isinstance(integrator, str):
        import integrators  # noqa: F401 (registers plugins; needs a variant)

        integrator = mi.load_dict({"type": integrator} | (for_denoising(integrator, {}) if denoise else {}))
    integrator = integrator or scene.integrator()
    if integrator is None:
        raise ValueError("the scene has no integrator; give one")
    if hasattr(integrator, "check_scene"):
        integrator.check_scene(scene)
    return integrator


class _Render:
    """A render that began at the time `begin` (of `perf_counter`): passes, and the reason for the end."""

    def __init__(self, progressive, ending, begin, progress, checkpoint, layers):
        self.progressive, self._ending, self._begin, self._progress = progressive, ending, begin, progress
        self._checkpoint, self._layers = checkpoint, layers
        self._error, self._ended_by, self._statistics = None, None, TotalStatistics()
        self._raised = None
        if ending.goal and ending.goal.resume(progressive.passes):
            # The checkpoint may be of a render that reached its error, and whose image was lost
            self._judge()

    def run(self, sizes, interruption, stays):
        """Render passes until the end. Leave a checkpoint with all of them unless the render is complete, or if it
        `stays`, for a denoiser, which may fail. Otherwise the image follows at once, and the file is removed."""
        complete = False
        try:
            self._run(sizes, interruption)
            complete = self._ended_by in (*LIMITS, "error")
        finally:
            if self._checkpoint and (stays or not complete):
                self._checkpoint.leave()

    def _run(self, sizes, interruption):

        def interrupted():
            return interruption.asked or self.progressive.should_stop()

        self._ending.mark(self.progressive.spp, self._elapsed())
        while self._ended_by is None:
            size = sizes.next(self.progressive.passes, self._elapsed())
            if isinstance(size, str):
                self._ended_by = size
                return
            one = self._pass(size, interrupted, is_probe=sizes.is_probe, is_last=sizes.is_last)
            if one is not None:
                self._look()
            if one is None or interrupted():
                self._ended_by = "time" if self.progressive.is_late() else "interruption"

    def _pass(self, size, interrupted, **kind):
        """Render a pass and return it, None after an interruption."""
        try:
            with listening(self._listener()) if self._progress else nullcontext():
                # Ctrl-C also stops Mitsuba, so that the pass may be unfinished
                return self.progressive.render(size, accept=lambda: not interrupted(), **kind)
        except BaseException as error:
            # Mitsuba and Dr.Jit replace exceptions that they pass on
            if self._raised is not None:
                raise self._raised from None
            if not is_interruption(error):
                raise

    def _listener(self):
        """Return the listener for the stages of the next pass."""
        before = self._took()

        def begins(stage):
            elapsed = self._elapsed()
            left = self._ending.seconds_left(elapsed)
            try:
                self._tell(replace(before, seconds=elapsed, stage=str(stage), seconds_left=left), None)
            except BaseException as error:
                self._raised = error
                raise _Refused from error

        return begins

    def _tell(self, took, image):
        """Call `progress`, which may end the render."""
        if self._progress(took, image) is False:
            self._ended_by = self._ended_by or "progress"

    def _look(self):
        """Estimate the error after a pass if an estimate is due, and call `progress`."""
        spp, goal = self.progressive.spp, self._ending.goal
        self._ending.mark(spp, self._elapsed())
        if self._checkpoint:
            self._checkpoint.keep(self._elapsed())
        if goal and goal.is_due(self.progressive):
            self._judge()
        if self._progress:
            self._tell(self._took(), self._image())

    def _judge(self):
        """Estimate the error, which may end the render."""
        self._error = self.progressive.error()
        self._ending.look(self._error, self.progressive.spp)
        if self._ending.goal.is_reached(self._error):
            self._ended_by = "error"

    def result(self, denoiser):
        """Return the image and the cost; warn if the error was not reached."""
        if self._ended_by != "error":
            self._error = self.progressive.error()
        if self._ended_by in LIMITS and self._ending.goal:
            self._ending.goal.warn_if_missed(self._error, self._ended_by)
        image, took = self._image(), self._took()
        if denoiser:
            if self._progress:
                self._progress(replace(took, stage=DENOISING), None)
            took.raw, image = image, self._complete(denoiser.denoise_passes(self.progressive))
            took.denoise_seconds, took.denoiser = denoiser.seconds, denoiser.description
            took.seconds = self._elapsed()
        return image, took

    def _elapsed(self):
        return clock.perf_counter() - self._begin

    def _image(self):
        return self._complete(np.float32(self.progressive.image))

    def _complete(self, image):
        """Return an image (height, width, channels) with the layers, as a tensor."""
        return mi.TensorXf(self._layers.added_to(image) if self._layers else image)

    def _took(self):
        one, seconds = self.progressive, self._elapsed()
        statistics, layers = self._statistics.of(one.passes), self._layers
        return Took(
            one.spp, len(one.passes), seconds, self._error, statistics, self._ended_by,
            one.channels + (layers.channels if layers else []), layer_spp=layers.spp if layers else None,
            seconds_left=None if self._ended_by else self._ending.seconds_left(seconds),
        )  # fmt: skip


class _Refused(BaseException):
    """Replaces the exception of a callback on the way through code that would log an `Exception`."""
