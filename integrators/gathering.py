"""The base class of all integrators: camera rays in, radiance out; what lights the gather points is left open."""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import add_at, download, usable
from vpl.core.exclusive import exclusive
from vpl.core.shared_code import share_code
from vpl.core.stages import Stage, tell
from vpl.lights.emitters import Emitters, read_emitters
from vpl.points.camera_paths import CameraPaths, PixelGrid, SceneTraits, follow_camera_rays, refuse_media, scene_traits

from . import VARIANTS
from .knobs import PATH_KNOBS, Integer, read_knobs, show_knobs

# Of Mitsuba, whose own constructor does not show what it has read
_SAMPLES_PER_PASS = Integer("samples_per_pass", 2**32 - 1, "Most samples of a pixel in a pass.", minimum=1)


class Clock:
    """Seconds by stage, of which the first begins at once.  A stage ends when the next one begins or the clock is
    stopped, and the device has finished; who listens (:func:`vpl.core.stages.listening`) is told of each."""

    def __init__(self, stage: Stage):
        self.seconds: dict[str, float] = {}
        self._stage: Stage | None = None
        self.begin(stage)

    def begin(self, stage: Stage) -> None:
        """End the current stage and begin another one."""
        self.stop()
        tell(stage)
        self._stage, self._start = stage, perf_counter()

    def stop(self) -> None:
        """End the current stage."""
        if self._stage is not None:
            dr.sync_thread()
            self.add({self._stage: perf_counter() - self._start})
            self._stage = None

    def add(self, seconds: dict[str, float]) -> None:
        """Add the times of stages that were taken elsewhere."""
        for stage, spent in seconds.items():
            # By plain text, as statistics are printed
            self.seconds[str(stage)] = self.seconds.get(stage, 0.0) + spent


def whole_sum(values) -> int:
    """Sum of a counter over all points (None: nothing was counted); shares of a count add up to whole numbers."""
    return 0 if values is None else round(float(download(values).sum(dtype="float64")))


def add_statistics(totals: dict, more: dict) -> None:
    """Add counters to counters of the same name, and dictionaries of them."""
    for name, value in more.items():
        if isinstance(value, dict):
            add_statistics(totals.setdefault(name, {}), value)
        else:
            totals[name] = totals.get(name, 0) + value


def _hear_interruptions() -> None:
    """Give Ctrl-C back to Python, before Mitsuba's own ``render`` takes it for its time.

    It calls the ``render`` that is overridden here once more, which calls it once more.  Without this, that second call
    would find the handler of the first and leave it behind: the next Ctrl-C would call an integrator that is gone.
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)


@dataclass
class CameraPass:
    """Result of following the camera rays of one pass, with which every render begins.

    ``seed``: drawn from the sampler; ``emitters``, ``traits``: of the scene; ``paths``: of the camera rays;
    ``valid``: rays that are opaque in the film's alpha, where an environment counts, as in ``path``.
    """

    seed: int
    emitters: Emitters
    traits: SceneTraits
    paths: CameraPaths
    valid: object
    clock: Clock

    @property
    def dark(self) -> bool:
        """Whether there is nothing to light, or nothing to light it with."""
        return self.paths.points.count == 0 or self.emitters.count == 0


class GatheringIntegrator(mi.SamplingIntegrator):
    """Base class: follows camera rays to gather points, asks ``light`` for their radiance, and sums up.

    Lights belong to one call of ``sample``, unless ``manylights`` is told to keep them: a scene that was edited in
    between is never lit by the lights of the old one, and each pass of a render with several passes gets new ones.
    Seeds are drawn from the sampler, so that wrappers such as ``moment`` and ``aov``, which only call ``sample``, work
    like ``mi.render``.
    """

    aovs: tuple[str, ...] = ()  # channels that are asked for, where derived classes have a knob of that name
    along_curve = True  # whether gather points are sorted by their place
    # Whether images are rendered in parts, stop in between, and take little memory for more samples (50 bytes each)
    renders_in_parts = False
    knobs = PATH_KNOBS

    def __init__(self, props):
        if mi.variant() not in VARIANTS:
            available = ", ".join(variant for variant in VARIANTS if variant in mi.variants())
            raise RuntimeError(
                f'the integrator "{props.plugin_name()}" does not support the variant "{mi.variant()}": choose one of '
                f"{available}, or an integrator of Mitsuba, such as path"
            )
        super().__init__(props)
        read_knobs(self, props)
        self.samples_per_pass = _SAMPLES_PER_PASS.read(self, props)
        self.statistics: dict = {}
        # Whose rays `sample` gets, while this integrator and no wrapper renders
        self._sensor = None

    def light(self, scene, sampler, camera: CameraPass):
        """Light the gather points of ``camera.paths``: (radiance, {channel: values}, {name: statistic}).

        All per gather point; a channel that nobody offers is not shown.
        """
        raise NotImplementedError

    def check_scene(self, scene):
        """Raise ValueError for a scene with a participating medium."""
        refuse_media(scene)

    def aov_names(self):
        """Channels that ``sample`` returns besides the radiance."""
        return list(self.aovs)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Render as Mitsuba does; a RuntimeError where another thread uses the sensor, its film and its sampler."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        _hear_interruptions()
        with exclusive(sensor=sensor, integrator=self):
            outer, self._sensor = self._sensor, sensor
            try:
                return self._render(scene, sensor, seed, spp, develop, evaluate)
            finally:
                self._sensor = outer

    def _render(self, *arguments):
        """What ``render`` does with its arguments."""
        return super().render(*arguments)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along camera rays; see ``mi.SamplingIntegrator.sample`` for this interface."""
        with exclusive(sampler=sampler, integrator=self), dr.suspend_grad():
            try:
                if medium is not None:
                    raise ValueError(
                        "the camera is inside a participating medium; many-light integrators support surfaces only"
                    )
                if dr.flag(dr.JitFlag.FreezingScope):
                    raise RuntimeError(
                        f"{type(self).__name__} cannot be recorded by dr.freeze, as it reads results of kernels while "
                        "it renders: call mi.render outside of frozen functions"
                    )
                self.check_scene(scene)
                share_code(scene)
                return self._sample(scene, sampler, mi.Ray3f(ray), active)
            except Exception as error:
                # Out of `mi.render` comes another one, which only says that something went wrong
                mi.Log(mi.LogLevel.Warn, f"{type(self).__name__}: {error}")
                raise

    def _sample(self, scene, sampler, ray, active):
        """What ``sample`` returns."""
        camera = self.begin(scene, sampler, ray, active)
        radiance, channels, found = self.light(scene, sampler, camera)
        image, counters = self._assemble(camera, radiance, channels, found)
        finite = dr.all(usable(image)) & (self.max_depth > 0)
        return dr.select(finite, mi.Spectrum(image), 0), camera.valid, counters

    def begin(self, scene, sampler, ray, active=True) -> CameraPass:
        """Emitters and camera paths."""
        clock = Clock(Stage.SCENE)
        seed = int(dr.reinterpret_array(mi.UInt32, dr.detach(sampler.next_1d()))[0])
        emitters, traits = read_emitters(scene), scene_traits(scene)
        if emitters.count == 0:
            mi.Log(mi.LogLevel.Warn, "The scene has no emitters: the image will be black.")
        clock.begin(Stage.GATHER)
        skip = self.skip_area_emitters if self.hide_emitters else None
        paths = follow_camera_rays(
            scene, emitters, traits, sampler, seed, ray, active, self.max_depth, self.rr_depth, skip, self.along_curve
        )
        clock.stop()
        sky = emitters.environment is not None and not self.hide_emitters
        return CameraPass(seed, emitters, traits, paths, paths.valid | (active & sky), clock)

    def pixel_grid(self, scene, sampler) -> PixelGrid:
        """Layout of the camera rays of this pass in the image.

        Mitsuba puts the rays of a pixel next to each other. Whose they are is not known below a wrapper, which may
        render in passes of its own, too: where no sensor of the scene has as many pixels as there would have to be,
        every ray counts as a pixel, eight to a row.
        """
        samples = min(sampler.sample_count(), self.samples_per_pass)
        for sensor in [self._sensor] if self._sensor else scene.sensors():
            film = sensor.film()
            border = 2 * film.rfilter().border_size() if film.sample_border() else 0
            size = np.array(film.crop_size(), np.int64) + border
            if sampler.wavefront_size() == samples * int(np.prod(size)):
                return PixelGrid(int(size[0]), samples)
        return PixelGrid(8, 1, known=samples == 1)

    def _assemble(self, camera: CameraPass, radiance, channels: dict, found: dict):
        """Bring what gather points found to their camera rays: (radiance, requested channels); fills ``statistics``."""
        points = camera.paths.points
        image, bad_samples = mi.UnpolarizedSpectrum(camera.paths.emission), 0
        counters = [dr.zeros(mi.Float, dr.width(camera.paths.valid)) for _ in self.aovs]
        if points.count:
            lit = points.weight * radiance
            bad = ~dr.all(usable(lit))
            add_at(image, dr.select(bad, 0, lit), points.ray)
            for name, counter in zip(self.aovs, counters, strict=True):
                if name in channels:
                    dr.scatter(counter, mi.Float(channels[name]), points.ray)
            bad_samples = int(dr.count(bad)[0])
        dr.eval(image, counters)
        if bad_samples:
            mi.Log(mi.LogLevel.Warn, f"{bad_samples} sample(s) with values that are not finite were dropped.")
        self.statistics = {"gather_points": points.count, **found, "seconds": camera.clock.seconds}
        self.statistics["dropped"] = self.statistics.get("dropped", camera.emitters.dropped) + bad_samples
        return image, counters

    def to_string(self):
        """All properties and their values."""
        return show_knobs(self)

    def render_forward(self, *args, **kwargs):
        """Not supported: what is sampled is chosen by what was seen, which is not continuous."""
        raise NotImplementedError(f"{type(self).__name__} cannot be differentiated: use Mitsuba's prb integrators.")

    def render_backward(self, *args, **kwargs):
        """Not supported: what is sampled is chosen by what was seen, which is not continuous."""
        raise NotImplementedError(f"{type(self).__name__} cannot be differentiated: use Mitsuba's prb integrators.")
