"""The base class of all many-light integrators: camera rays in, radiance out; the methods differ in one hook."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.arrays import download
from vpl.direct import ExtendedEmitters, direct_light
from vpl.evaluation import mean_radiance
from vpl.gather import CameraPaths, SceneTraits, follow_camera_rays, refuse_media, scene_traits
from vpl.light_set import LightOptions, LightSet, prepare_lights
from vpl.lights import read_emitters
from vpl.proxies import probe_materials
from vpl.sampling import derived_seed
from vpl.surfaces import Batch, make_batches

from . import properties

AOVS = ("shadow_rays", "upper_bounds", "cut_size")


@dataclass
class Shading:
    """What a method is asked to shade: one batch of gather points.

    ``direct``: radiance per point that is known already (direct light of extended emitters); ``mean``: an estimate of
    the mean radiance over all gather points of the render and over channels; ``ray``: UInt32, the camera ray of each
    point; ``samples``: camera rays of a pixel, which follow each other; ``stopped``: whether to give up early.
    """

    scene: object
    traits: SceneTraits
    lights: LightSet
    batch: Batch
    direct: object
    mean: float
    seed: int
    ray: object
    samples: int
    stopped: Callable[[], bool]


@dataclass
class Shaded:
    """What a method answers: radiance due to the lights, and counters, per point of the batch.

    ``shadow_rays``, ``upper_bounds``, ``cut_size``: UInt32, or Float where several points share one; ``seconds``: time
    by stage; ``phase_one``: radiance that a first phase assumed, where the method has one.
    """

    radiance: object
    shadow_rays: object
    upper_bounds: object
    cut_size: object
    seconds: dict = field(default_factory=dict)
    phase_one: object = None


class Clock:
    """Seconds by stage; a stage ends when the device has finished."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._start = perf_counter()

    def lap(self, stage: str) -> None:
        """End the current stage and name it."""
        dr.sync_thread()
        now = perf_counter()
        self.split({stage: now - self._start})

    def split(self, seconds: dict[str, float]) -> None:
        """Add the times of stages that were taken elsewhere; the current stage begins now."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
        self._start = perf_counter()


@dataclass
class Prepared:
    """A render before its method has worked.

    ``valid``: camera rays that are opaque in the film's alpha, where an environment counts, as in ``path``; ``direct``:
    radiance per gather point; ``counts``: for statistics.
    """

    paths: CameraPaths
    valid: object
    direct: object
    jobs: list[Shading]
    counts: dict
    clock: Clock


def _whole_sum(values) -> int:
    """Sum of a counter over all points (None: nothing was counted); shares of a count add up to whole numbers."""
    return 0 if values is None else round(float(download(values).sum(dtype="float64")))


class ManyLightIntegrator(mi.SamplingIntegrator):
    """Base class: reads the common properties, makes lights and gather points, and asks ``shade`` for the rest.

    Lights belong to one call of ``sample``: a scene that was edited in between is never lit by the lights of the old
    one, and each pass of a render with several passes gets new ones.  The seed of the lights is drawn from the sampler,
    so that wrappers such as ``moment`` and ``aov``, which only call ``sample``, work like ``mi.render``.
    """

    needs_trees = True
    offered_aovs = AOVS

    def __init__(self, props):
        super().__init__(props)
        self.max_depth = properties.depth(props)
        self.rr_depth = properties.integer(props, "rr_depth", 5, 1)
        self.vpl_count = properties.integer(props, "vpl_count", 200_000, 1)
        self.direct_count = properties.integer(props, "direct_count", 4096, 1)
        self.clamping = properties.number(props, "clamping", 0.01, 0)
        self.direct = properties.choice(props, "direct", "nee", ("nee", "vpl", "none"))
        self.emitter_samples = properties.integer(props, "emitter_samples", 4, 1)
        self.lobe_limit = properties.number(props, "lobe_limit", 1.0, 0)
        self.aovs = properties.words(props, "aovs", self.offered_aovs)
        # Read by the base class too, which does not show it
        self.samples_per_pass = properties.integer(props, "samples_per_pass", 2**32 - 1, 1)
        self.statistics: dict = {}

    def shade(self, job: Shading) -> Shaded:
        """Light of ``job.lights`` at the points of ``job.batch``: the one thing that a method defines."""
        raise NotImplementedError

    def aov_names(self):
        """Channels that ``sample`` returns besides the radiance."""
        return list(self.aovs)

    def light_options(self) -> LightOptions:
        """The part of the properties that decides which lights are made."""
        return LightOptions(
            self.vpl_count, self.direct_count, self.clamping, self.direct, self.max_depth, self.rr_depth,
            self.lobe_limit, self.needs_trees,
        )  # fmt: skip

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along camera rays; see ``mi.SamplingIntegrator.sample`` for this interface."""
        if medium is not None:
            raise ValueError(
                "the camera is inside a participating medium; many-light integrators support surfaces only"
            )
        refuse_media(scene)
        with dr.suspend_grad():
            prepared = self.prepare(scene, sampler, mi.Ray3f(ray), active)
            radiance, counters = self._assemble(prepared, [self.shade(job) for job in prepared.jobs])
        finite = dr.all(dr.isfinite(radiance)) & (self.max_depth > 0)
        return dr.select(finite, mi.Spectrum(radiance), 0), prepared.valid, counters

    def prepare(self, scene, sampler, ray, active=True) -> Prepared:
        """Everything before the method's own work: camera paths, lights, direct light, batches of gather points."""
        clock = Clock()
        seed = int(dr.reinterpret_array(mi.UInt32, dr.detach(sampler.next_1d()))[0])
        emitters, traits = read_emitters(scene), scene_traits(scene)
        if emitters.count == 0:
            mi.Log(mi.LogLevel.Warn, "The scene has no emitters: the image will be black.")
        clock.lap("scene")
        skip = self.skip_area_emitters if self.hide_emitters else None
        paths = follow_camera_rays(
            scene, emitters, traits, sampler, seed, ray, active, self.max_depth, self.rr_depth, skip
        )
        clock.lap("gather")
        sky = emitters.environment is not None and not self.hide_emitters
        prepared = Prepared(
            paths, paths.valid | (active & sky), dr.zeros(mi.UnpolarizedSpectrum, paths.points.count), [], {}, clock
        )
        if paths.points.count == 0 or emitters.count == 0 or self.max_depth < 2:
            return prepared

        lights = prepare_lights(scene, emitters, self.light_options(), seed)
        clock.split(lights.seconds)
        if self.direct == "nee":
            extended, samples = ExtendedEmitters(scene, emitters), self.emitter_samples
            direct, rays = direct_light(
                scene, extended, traits, paths.points, self.max_depth, samples, derived_seed(seed, 30)
            )
            prepared.direct += direct
            prepared.counts["emitter_rays"] = rays
            clock.lap("direct")
        prepared.counts |= {
            "lights": lights.counts,
            "light_paths": lights.paths,
            "dropped": lights.dropped + emitters.dropped,
        }
        if lights.groups:
            prepared.jobs = self._jobs(scene, traits, lights, prepared, seed, self._samples_of_a_pixel(scene, sampler))
        return prepared

    def _jobs(self, scene, traits, lights: LightSet, prepared: Prepared, seed: int, samples: int) -> list[Shading]:
        """One job per batch of gather points, each knowing the mean radiance over all of them."""
        points, jobs, mean = prepared.paths.points, [], 0.0
        batches = make_batches(points, probe_materials(points, traits))
        prepared.clock.lap("probe")
        for number, batch in enumerate(batches):
            direct = dr.gather(type(prepared.direct), prepared.direct, batch.index)
            stream = derived_seed(seed, 31, number)
            ray = dr.gather(mi.UInt32, points.ray, batch.index)
            jobs.append(Shading(scene, traits, lights, batch, direct, 0.0, stream, ray, samples, self.should_stop))
            if self.needs_trees:
                level = mean_radiance(scene, traits, lights, batch, derived_seed(seed, 32, number))
                mean += (level + float(download(direct).mean(dtype="float64"))) * batch.count / points.count
        for job in jobs:
            job.mean = mean
        prepared.clock.lap("pilot")
        return jobs

    def _samples_of_a_pixel(self, scene, sampler) -> int:
        """Camera rays of a pixel in this pass, which Mitsuba puts next to each other; 1 where that cannot be known.

        A wrapper may render in passes of its own: then no sensor has as many pixels as there would have to be.
        """
        samples = min(sampler.sample_count(), self.samples_per_pass)
        for sensor in scene.sensors():
            film = sensor.film()
            border = 2 * film.rfilter().border_size() if film.sample_border() else 0
            if sampler.wavefront_size() == samples * int(np.prod(np.array(film.crop_size(), np.int64) + border)):
                return samples
        return 1

    def _assemble(self, prepared: Prepared, shaded: list[Shaded]):
        """Put the batches together: (radiance, requested counters) per camera ray; fills ``statistics``."""
        points, clock = prepared.paths.points, prepared.clock
        radiance = prepared.direct
        totals = {}
        for job, part in zip(prepared.jobs, shaded, strict=True):
            dr.scatter_add(radiance, part.radiance, job.batch.index)
            for name in self.offered_aovs:
                values = getattr(part, name)
                total = totals.setdefault(name, dr.zeros(type(values), points.count))
                dr.scatter(total, values, job.batch.index)
            clock.split(part.seconds)
        image, bad_samples = mi.UnpolarizedSpectrum(prepared.paths.emission), 0
        counters = [dr.zeros(mi.Float, dr.width(prepared.paths.valid)) for _ in self.aovs]
        if points.count:
            lit = points.weight * radiance
            bad = ~dr.all(dr.isfinite(lit))
            dr.scatter_add(image, dr.select(bad, 0, lit), points.ray)
            for name, counter in zip(self.aovs, counters, strict=True):
                if name in totals:
                    dr.scatter(counter, mi.Float(totals[name]), points.ray)
            bad_samples = int(dr.count(bad)[0])
        dr.eval(image, counters)
        self._count(prepared, totals, bad_samples)
        return image, counters

    def _count(self, prepared: Prepared, totals: dict, bad_samples: int) -> None:
        """Fill ``statistics``: totals over the last call of ``sample``."""
        if bad_samples:
            mi.Log(mi.LogLevel.Warn, f"{bad_samples} sample(s) with values that are not finite were dropped.")
        names = {"shadow_rays": "shadow_rays", "upper_bounds": "bound_computations", "cut_size": "cut_size"}
        self.statistics = {
            "gather_points": prepared.paths.points.count,
            **{label: _whole_sum(totals.get(name)) for name, label in names.items()},
            **({"lights": {}, "light_paths": 0, "emitter_rays": 0, "dropped": 0} | prepared.counts),
            "seconds": prepared.clock.seconds,
        }
        self.statistics["dropped"] += bad_samples

    def describe(self) -> dict:
        """Properties and their values, for ``to_string`` and file metadata."""
        names = ["max_depth", "rr_depth", "vpl_count", "direct_count", "clamping", "direct", "emitter_samples"]
        values = {name: getattr(self, name) for name in [*names, "lobe_limit", "hide_emitters"]}
        values["max_depth"] = -1 if math.isinf(self.max_depth) else self.max_depth
        return values

    def to_string(self):
        """One line a property, as Mitsuba's plugins print themselves."""
        lines = ",\n".join(f"  {name} = {value}" for name, value in self.describe().items())
        return f"{type(self).__name__}[\n{lines}\n]"

    def render_forward(self, *args, **kwargs):
        """Not supported: cuts are discontinuous choices."""
        raise NotImplementedError(f"{type(self).__name__} cannot be differentiated: use Mitsuba's prb integrators.")

    def render_backward(self, *args, **kwargs):
        """Not supported: cuts are discontinuous choices."""
        raise NotImplementedError(f"{type(self).__name__} cannot be differentiated: use Mitsuba's prb integrators.")
