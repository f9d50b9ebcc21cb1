"""Base class of all integrators: radiance of camera rays, with the lighting of gather points left to subclasses."""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import NO_LIMIT, add_at, download, usable
from vpl.core.clock import Clock
from vpl.core.exclusive import exclusive
from vpl.core.garbage import garbage_kept
from vpl.core.shared_code import share_code
from vpl.core.stages import Stage
from vpl.lights.emission import bounding_sphere
from vpl.lights.emitters import Emitters, read_emitters
from vpl.points.camera_paths import CameraPaths, PixelGrid, SceneTraits, follow_camera_rays, refuse_media, scene_traits

from . import VARIANTS
from .camera_samples import film_size
from .knobs import PATH_KNOBS, Integer, read_knobs, show_knobs

# A property of Mitsuba's integrators, whose value Mitsuba does not expose
_SAMPLES_PER_PASS = Integer("samples_per_pass", NO_LIMIT, "Most samples of a pixel in a pass.", minimum=1)


def whole_sum(values) -> int:
    """Sum of a counter over all points, rounded, as points may hold fractions of a count; 0 for None."""
    return 0 if values is None else round(float(download(values).sum(dtype="float64")))


def add_statistics(totals: dict, more: dict) -> None:
    """Add the counters in ``more`` to those in ``totals`` by name, recursively for dictionaries."""
    for name, value in more.items():
        if isinstance(value, dict):
            add_statistics(totals.setdefault(name, {}), value)
        else:
            totals[name] = totals.get(name, 0) + value


def _hear_interruptions() -> None:
    """Restore Python's handler of Ctrl-C before Mitsuba's ``render`` installs its own.

    Mitsuba's ``render`` calls the Python override, which calls Mitsuba's ``render`` a second time.  The second call
    would take the handler of the first for Python's and leave it installed: the next Ctrl-C would then call an
    integrator that no longer exists.
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)


def for_all_samples(sampler, ray, active):
    """(Camera rays, mask) with a lane for each sample: some sensors, such as ``radiancemeter``, give a single ray."""
    count = dr.width(ray) if dr.width(ray.o, ray.d) > 1 else sampler.wavefront_size()
    ray, wide = mi.Ray3f(ray), dr.zeros(mi.Float, max(count, 1))
    ray.o, ray.d, ray.time, ray.maxt = ray.o + wide, ray.d + wide, ray.time + wide, ray.maxt + wide
    return ray, mi.Bool(active) & dr.full(mi.Bool, True, len(wide))


@dataclass
class CameraPass:
    """Camera rays of a pass, followed to their gather points: the first step of a render.

    ``seed``: drawn from the sampler; ``emitters``, ``traits``: of the scene; ``paths``: of the camera rays;
    ``valid``: whether a ray is opaque in the film's alpha, where an environment counts, as in ``path``.
    """

    seed: int
    emitters: Emitters
    traits: SceneTraits
    paths: CameraPaths
    valid: mi.Bool
    clock: Clock

    @property
    def dark(self) -> bool:
        """Whether the pass has no gather points, or the scene no emitters."""
        return self.paths.points.count == 0 or self.emitters.count == 0


class GatheringIntegrator(mi.SamplingIntegrator):
    """Base class: follows camera rays to gather points, and sums the radiance that ``light`` returns for them.

    Each call of ``sample`` makes new virtual lights, except with ``keep_lights`` of ``manylights``: an edited scene
    never has the lights of its earlier state, and every pass of a render has its own lights.  Seeds are drawn from the
    sampler, for the benefit of wrappers that only call ``sample`` (``moment``, ``aov``).
    """

    aovs: tuple[str, ...] = ()  # requested channels, for subclasses with a property of that name
    along_curve = True  # whether gather points are sorted along a space-filling curve
    # Whether a pass is rendered in parts: it can stop between them, and needs little memory (50 bytes a sample)
    renders_in_parts = False
    # Whether images that will be denoised may have a film that is finer than the image. Most methods share work between
    # the samples of a pixel
    suits_fine_film = False
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
        # The sensor of the rays in `sample`; None below a wrapper
        self._sensor = None

    def light(self, scene, sampler, camera: CameraPass):
        """Radiance of the gather points of ``camera.paths``: (radiance, {channel: values}, {name: statistic}).

        Radiance and channels have a value per gather point.  Channels that were not requested are ignored.
        """
        raise NotImplementedError

    def check_scene(self, scene):
        """Raise ValueError for a scene with a participating medium, or of infinite size, which rays miss on CUDA."""
        refuse_media(scene)
        bounding_sphere(scene)

    def stopped(self) -> bool:
        """Whether this render was cancelled, or has taken the time of ``timeout``.

        Never below a wrapper: Mitsuba asks the wrapper, and this integrator keeps the answer of its last own render.
        """
        return self._sensor is not None and self.should_stop()

    def _refuse_recording(self):
        """Raise RuntimeError while ``dr.freeze`` records."""
        if dr.flag(dr.JitFlag.FreezingScope):
            raise RuntimeError(
                f"{type(self).__name__} cannot be recorded by dr.freeze, as it reads results of kernels while it "
                "renders: call mi.render outside of frozen functions"
            )

    def aov_names(self):
        """Names of the channels that ``sample`` returns in addition to the radiance."""
        return list(self.aovs)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Render as Mitsuba does.  Raises RuntimeError while another thread renders with the same sensor."""
        # Before anything else: an error within Mitsuba's render can abort a process that records
        self._refuse_recording()
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        _hear_interruptions()
        with exclusive(sensor=sensor, integrator=self), garbage_kept():
            outer, self._sensor = self._sensor, sensor
            own = sensor.sampler().sample_count()
            try:
                return self._render(scene, sensor, seed, spp, develop, evaluate)
            finally:
                self._sensor = outer
                # Mitsuba leaves spp there; a later call without spp, as of gradients, means that of the scene
                sensor.sampler().set_sample_count(own)

    def _render(self, *arguments):
        """Render, with exclusive use of the sensor and the integrator."""
        return super().render(*arguments)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along camera rays; the interface is that of ``mi.SamplingIntegrator.sample``."""
        with exclusive(sampler=sampler, integrator=self), dr.suspend_grad():
            try:
                if medium is not None:
                    raise ValueError(
                        "the camera is inside a participating medium; many-light integrators support surfaces only"
                    )
                # Wrappers such as `moment` do not call `render`
                self._refuse_recording()
                self.check_scene(scene)
                share_code(scene)
                return self._sample(scene, sampler, *for_all_samples(sampler, ray, active))
            except Exception as error:
                # Logged, as `mi.render` raises a general error with this error as the cause
                mi.Log(mi.LogLevel.Warn, f"{type(self).__name__}: {error}")
                raise

    def _sample(self, scene, sampler, ray, active):
        """Result of ``sample``, with exclusive use of the sampler and the integrator."""
        camera = self.begin(scene, sampler, ray, active)
        radiance, channels, found = self.light(scene, sampler, camera)
        image, counters = self._assemble(camera, radiance, channels, found)
        shown = mi.Bool(self.max_depth > 0)
        return dr.select(dr.all(usable(image)) & shown, mi.Spectrum(image), 0), camera.valid & shown, counters

    def begin(self, scene, sampler, ray, active=True) -> CameraPass:
        """Read the emitters, and follow the camera rays."""
        clock = Clock(Stage.SCENE)
        seed = int(dr.reinterpret_array(mi.UInt32, dr.detach(sampler.next_1d()))[0])
        emitters, traits = read_emitters(scene), scene_traits(scene)
        if emitters.count == 0:
            mi.Log(mi.LogLevel.Warn, "The scene has no emitters: the image will be black.")
        clock.begin(Stage.GATHER)
        paths = follow_camera_rays(
            emitters, traits, sampler, seed, ray, active, self.max_depth, self.rr_depth, self.hide_emitters,
            self.along_curve,
        )  # fmt: skip
        clock.stop()
        sky = emitters.environment is not None and not self.hide_emitters
        return CameraPass(seed, emitters, traits, paths, paths.valid | (active & sky), clock)

    def pixel_grid(self, scene, sampler) -> PixelGrid:
        """Layout of the camera rays of this pass in the image.

        Mitsuba stores the rays of a pixel in sequence.  Below a wrapper, which may also render in passes, the sensor is
        unknown.  If no sensor of the scene fits the number of rays, every ray counts as a pixel, in rows of eight.
        """
        samples = min(sampler.sample_count(), self.samples_per_pass)
        for sensor in [self._sensor] if self._sensor else scene.sensors():
            size = film_size(sensor.film())
            if sampler.wavefront_size() == samples * int(np.prod(size)):
                return PixelGrid(int(size[0]), samples)
        return PixelGrid(8, 1, known=samples == 1)

    def _assemble(self, camera: CameraPass, radiance, channels: dict, found: dict):
        """Sum values of gather points to camera rays: (radiance, requested channels).  Sets ``statistics``."""
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
        """Not supported: the choice of samples depends on earlier results, discontinuously."""
        self._refuse_gradients()

    def render_backward(self, *args, **kwargs):
        """Not supported: the choice of samples depends on earlier results, discontinuously."""
        self._refuse_gradients()

    def _refuse_gradients(self):
        raise NotImplementedError(
            f"{type(self).__name__} cannot be differentiated: use manylights, whose gradients are those of prb, or one "
            "of Mitsuba's prb integrators"
        )
