"""Base class of the integrators of direct light; derived classes choose the options of :mod:`vpl.direct.adaptive`."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from time import perf_counter

import drjit as dr
import mitsuba as mi

from vpl.core.arrays import download
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.direct.adaptive import FIELDS, DirectOptions, light_directly
from vpl.direct.sources import Sources
from vpl.points.camera_paths import PixelGrid

from .bands import fits_one_band, random_rays, render_in_bands
from .gathering import CameraPass, GatheringIntegrator, add_statistics, for_all_samples, whole_sum
from .knobs import Depth, Fraction, Integer, Number, Words, knobs_of

# Camera rays that estimate the mean radiance of the surfaces that an image rendered in bands shows
_LEVEL_RAYS = 4096


@dataclass
class Band:
    """Band of rows: pixel layout, the mean radiance of the surfaces that are seen (``level``), and the band's ``time``
    in seconds."""

    grid: PixelGrid
    level: float
    time: float


class DirectLightIntegrator(GatheringIntegrator):
    """Base class: lights gather points by :func:`vpl.direct.adaptive.light_directly`, large images in bands."""

    along_curve = False  # the points of a pixel remain consecutive
    knobs = (
        Fraction(
            "error", DirectOptions.error,
            "Target standard error of each pixel, as a fraction of its radiance: 0.03 is 3%.",
            minimum=1e-4,
        ),
        Number(
            "dark_floor", DirectOptions.dark_floor,
            "Smallest radiance in the error threshold, as a fraction of the mean over the surfaces that are seen: "
            "darker pixels reach about the absolute error of a pixel with this radiance.",
            minimum=0,
        ),
        Integer(
            "max_samples", DirectOptions.max_samples,
            "Largest number of emitter samples of a pixel; each half of the estimate has at least four.",
            minimum=1, maximum=100_000,
        ),
        Number(
            "bsdf_share", DirectOptions.bsdf_share,
            "BSDF samples per emitter sample, on glossy surfaces and near emitters. 0: none, which increases the "
            "variance there and loses emitters behind glass.",
            minimum=0,
        ),
        Number(
            "time", DirectOptions.time,
            "Time limit in seconds, after which rendering stops at any error; 0 is no limit.",
            minimum=0,
        ),
        Depth(
            "max_depth", 2,
            "Longest path from camera to emitter, in edges, as counted by Mitsuba's ``path``: 1 shows emitters only, 2 "
            "adds direct light at directly visible surfaces. Larger values follow mirrors, glass and masks, and add "
            "direct light at the surface behind. -1 is no limit.",
        ),
        Words(
            "aovs", "",
            "Comma-separated channels to return, per camera ray: {allowed}. ``noise`` is the estimated relative "
            "standard error, ``visible`` the fraction of samples with light.",
            words=FIELDS,
        ),
    )  # fmt: skip

    def __init__(self, props):
        super().__init__(props)
        self._in_base, self._band, self._is_clearing = False, None, False

    def options(self) -> DirectOptions:
        """Options of :func:`vpl.direct.adaptive.light_directly`, from the knobs of the same names."""
        known = {field.name for field in fields(DirectOptions)}
        names = [knob.name for knob in knobs_of(type(self)) if knob.name in known]
        return DirectOptions(**{name: getattr(self, name) for name in names})

    def _render(self, scene, sensor, seed, spp, develop, evaluate):
        """Render large images in bands of rows (:mod:`integrators.bands`), and small images by Mitsuba's ``render``."""
        if spp:
            # Some samplers round the number up
            sensor.sampler().set_sample_count(spp)
        samples = sensor.sampler().sample_count()
        # Mitsuba's `render` calls this method recursively
        if self._in_base or self.samples_per_pass < samples or fits_one_band(sensor.film(), samples):
            self._in_base = True
            try:
                return super()._render(scene, sensor, seed, spp, develop, evaluate)
            finally:
                self._in_base = False
        self._clear_stop(scene)
        with dr.suspend_grad():
            self._render_bands(scene, sensor, int(mi.UInt32(seed)[0]), samples)
        return sensor.film().develop() if develop else mi.TensorXf()

    def _clear_stop(self, scene) -> None:
        """Begin the time of ``timeout``, and forget that an earlier render was cancelled.  Only Mitsuba's ``render``
        does that: here for a black image of one pixel."""
        # The pixel format of mono variants, which warn of others
        film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
        self._is_clearing = True
        try:
            super()._render(scene, mi.load_dict({"type": "perspective", "film": film}), 0, 1, False, False)
        finally:
            self._is_clearing = False

    def _sample(self, scene, sampler, ray, active):
        if self._is_clearing:
            return mi.Spectrum(0), mi.Bool(False), [mi.Float(0)] * len(self.aovs)
        return super()._sample(scene, sampler, ray, active)

    def _render_bands(self, scene, sensor, seed: int, samples: int) -> None:
        """Render the bands with a common mean radiance and a common time limit."""
        level, start, totals = self._find_level(scene, sensor, derived_seed(seed, 1)), perf_counter(), {}

        def trace(sampler, ray, grid, fraction):
            left = max(self.time - (perf_counter() - start), 1e-3) * fraction if self.time > 0 else 0.0
            self._band = Band(grid, level, left)
            try:
                return self.sample(scene, sampler, ray)
            finally:
                self._band = None
                add_statistics(totals, self.statistics)

        render_in_bands(self, scene, sensor, derived_seed(seed, 2), samples, trace)
        self.statistics = totals

    def _find_level(self, scene, sensor, seed: int) -> float:
        """Mean radiance of direct light over the gather points, from one pass with _LEVEL_RAYS camera rays."""
        sampler, ray = random_rays(sensor, seed, _LEVEL_RAYS)
        camera = self.begin(scene, sampler, *for_all_samples(sampler, ray, True))
        if camera.dark or self.max_depth < 2:
            return 0.0
        quick = replace(self.options(), max_passes=1, lights="clusters")
        found = light_directly(
            scene, camera.traits, Sources(scene, camera.emitters), camera.paths.points, PixelGrid(8, 1),
            self.max_depth, quick, derived_seed(seed, 1), level=0.0,
        )  # fmt: skip
        return float(download(found.radiance).mean(dtype="float64"))

    def pixel_grid(self, scene, sampler):
        """Layout of the camera rays of this pass or band in the image."""
        return self._band.grid if self._band else super().pixel_grid(scene, sampler)

    def light(self, scene, sampler, camera: CameraPass):
        """Direct light of every emitter by :func:`vpl.direct.adaptive.light_directly`."""
        points = camera.paths.points
        if camera.dark or self.max_depth < 2:
            return mi.UnpolarizedSpectrum(0), {}, {"shadow_rays": 0}
        camera.clock.begin(Stage.SOURCES)
        sources = Sources(scene, camera.emitters)
        camera.clock.begin(Stage.DIRECT)
        options, level = self.options(), None
        if self._band:
            options, level = replace(options, time=self._band.time), self._band.level
        found = light_directly(
            scene, camera.traits, sources, points, self.pixel_grid(scene, sampler), self.max_depth, options,
            derived_seed(camera.seed, 30), self.stopped, level,
        )  # fmt: skip
        camera.clock.stop()
        counts = {"sources": sources.count, "shadow_rays": whole_sum(found.shadow_rays)}
        counts |= {"passes": whole_sum(found.passes), "clusters": found.clusters}
        return found.radiance, vars(found), counts | {"dropped": camera.emitters.dropped}
