"""The base class of the integrators that use virtual point lights; the methods differ in one hook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from vpl.core.arrays import download
from vpl.core.sampling import derived_seed
from vpl.direct.adaptive import DirectOptions, light_directly
from vpl.direct.emitter_sampling import ExtendedEmitters, direct_light
from vpl.direct.sources import Sources
from vpl.lights.light_set import LightOptions, LightSet, prepare_lights
from vpl.points.bsdf_proxies import probe_materials
from vpl.points.camera_paths import PixelGrid, SceneTraits
from vpl.points.surfaces import Batch, make_batches
from vpl.transport.evaluation import mean_radiance

from . import properties
from .gathering import GatheringIntegrator, Start, whole_sum

AOVS = ("shadow_rays", "upper_bounds", "cut_size")
REGIONS = 300  # of an environment [IAS section 4.3.1]


@dataclass
class Shading:
    """What a method is asked to shade: one batch of gather points.

    ``direct``: radiance per point that is known already (direct light of extended emitters); ``mean``: an estimate of
    the mean radiance over all gather points of the render and over channels; ``share``: the fraction of them that is in
    this batch; ``ray``: UInt32, the camera ray of each point; ``weight``: what its radiance counts in that ray;
    ``grid``: how camera rays lie in the image; ``stopped``: whether to give up early.
    """

    scene: object
    traits: SceneTraits
    lights: LightSet
    batch: Batch
    direct: object
    mean: float
    share: float
    seed: int
    ray: object
    weight: object
    grid: PixelGrid
    stopped: Callable[[], bool]


@dataclass
class Shaded:
    """What a method answers: radiance due to the lights, and counters, per point of the batch.

    ``shadow_rays``, ``upper_bounds``, ``cut_size``: UInt32, or Float where several points share one; ``seconds``: time
    by stage; ``phase_one``: radiance that a first phase assumed, where the method has one; ``dropped``: values left out
    because they were not finite; ``counts``: numbers for the statistics, which are added up over batches.
    """

    radiance: object
    shadow_rays: object
    upper_bounds: object
    cut_size: object
    seconds: dict = field(default_factory=dict)
    phase_one: object = None
    dropped: int = 0
    counts: dict = field(default_factory=dict)


@dataclass
class Prepared(Start):
    """A render before its method has worked.

    ``direct``: radiance per gather point; ``counts``: for statistics.
    """

    direct: object = None
    jobs: list[Shading] = field(default_factory=list)
    counts: dict = field(default_factory=dict)


class ManyLightIntegrator(GatheringIntegrator):
    """Base class: reads the common properties, makes lights and gather points, and asks ``shade`` for the rest."""

    needs_trees = True
    offered_aovs = AOVS

    def __init__(self, props):
        super().__init__(props, -1)
        self.vpl_count = properties.integer(props, "vpl_count", 200_000, 1)
        self.direct_count = properties.integer(props, "direct_count", 4096, 1)
        self.clamping = properties.number(props, "clamping", 0.01, 0)
        self.direct = properties.choice(props, "direct", "nee", ("nee", "adaptive", "vpl", "none"))
        self.emitter_samples = properties.integer(props, "emitter_samples", 16, 1)
        self.direct_error = properties.number(props, "direct_error", 0.05, 1e-4)
        self.lobe_limit = properties.number(props, "lobe_limit", 1.0, 0)

    def shade(self, job: Shading) -> Shaded:
        """Light of ``job.lights`` at the points of ``job.batch``: the one thing that a method defines."""
        raise NotImplementedError

    def light_options(self) -> LightOptions:
        """The part of the properties that decides which lights are made."""
        return LightOptions(
            self.vpl_count, self.direct_count, self.clamping, self.direct, self.max_depth, self.rr_depth,
            self.lobe_limit, self.needs_trees,
        )  # fmt: skip

    def prepare(self, scene, sampler, ray, active=True) -> Prepared:
        """Everything before the method's own work: camera paths, lights, direct light, batches of gather points."""
        return self._prepare(scene, sampler, self.begin(scene, sampler, ray, active))

    def _prepare(self, scene, sampler, start: Start) -> Prepared:
        points, emitters, clock = start.paths.points, start.emitters, start.clock
        prepared = Prepared(**vars(start), direct=dr.zeros(mi.UnpolarizedSpectrum, points.count))
        if start.dark or self.max_depth < 2:
            return prepared
        lights = prepare_lights(scene, emitters, self.light_options(), start.seed)
        clock.split(lights.seconds)
        grid = self.pixel_grid(scene, sampler)
        if self.direct in ("nee", "adaptive"):
            light = self._nee if self.direct == "nee" else self._adaptive
            direct, rays = light(scene, start, grid)
            prepared.direct += direct
            prepared.counts["emitter_rays"] = rays
            clock.lap("direct")
        prepared.counts |= {
            "lights": lights.counts,
            "light_paths": lights.paths,
            "dropped": lights.dropped + emitters.dropped,
        }
        if lights.groups:
            prepared.jobs = self._jobs(scene, start.traits, lights, prepared, start.seed, grid)
        return prepared

    def _nee(self, scene, start: Start, grid):
        """Direct light of extended emitters by a fixed number of samples: (radiance, rays)."""
        return direct_light(
            scene, ExtendedEmitters(scene, start.emitters), start.traits, start.paths.points, self.max_depth,
            self.emitter_samples, grid.samples, derived_seed(start.seed, 30),
        )  # fmt: skip

    def _adaptive(self, scene, start: Start, grid):
        """Direct light of extended emitters by adaptive sampling: (radiance, rays)."""
        # Points, spots and directional emitters are virtual lights already
        sources = Sources(scene, start.emitters.extended_only(), REGIONS)
        options = DirectOptions(error=self.direct_error)
        found = light_directly(
            scene, start.traits, sources, start.paths.points, grid, self.max_depth, options,
            derived_seed(start.seed, 30), self.should_stop,
        )  # fmt: skip
        return found.radiance, whole_sum(found.shadow_rays)

    def light(self, scene, sampler, start: Start):
        """Prepare, ask the method, and put its batches together."""
        prepared = self._prepare(scene, sampler, start)
        radiance, totals = prepared.direct, {}
        for job in prepared.jobs:
            if self.should_stop():
                break
            part = self.shade(job)
            dr.scatter_add(radiance, part.radiance, job.batch.index)
            for name in self.offered_aovs:
                values = getattr(part, name)
                total = totals.setdefault(name, dr.zeros(type(values), start.paths.points.count))
                dr.scatter(total, values, job.batch.index)
            start.clock.split(part.seconds)
            for name, number in (part.counts | {"dropped": part.dropped}).items():
                prepared.counts[name] = prepared.counts.get(name, 0) + number
        names = {"shadow_rays": "shadow_rays", "upper_bounds": "bound_computations", "cut_size": "cut_size"}
        found = {label: whole_sum(totals.get(name)) for name, label in names.items()}
        return radiance, totals, found | {"lights": {}, "light_paths": 0, "emitter_rays": 0} | prepared.counts

    def _jobs(self, scene, traits, lights: LightSet, prepared: Prepared, seed: int, grid: PixelGrid) -> list[Shading]:
        """One job per batch of gather points, each knowing the mean radiance over all of them."""
        points, jobs, mean = prepared.paths.points, [], 0.0
        batches = make_batches(points, probe_materials(points, traits))
        prepared.clock.lap("probe")
        for number, batch in enumerate(batches):
            direct = dr.gather(type(prepared.direct), prepared.direct, batch.index)
            stream = derived_seed(seed, 31, number)
            ray = dr.gather(mi.UInt32, points.ray, batch.index)
            weight = dr.gather(type(points.weight), points.weight, batch.index)
            share = batch.count / points.count
            jobs.append(
                Shading(scene, traits, lights, batch, direct, 0.0, share, stream, ray, weight, grid, self.should_stop)
            )
            if self.needs_trees:
                level = mean_radiance(scene, traits, lights, batch, derived_seed(seed, 32, number))
                mean += (level + float(download(direct).mean(dtype="float64"))) * share
        for job in jobs:
            job.mean = mean
        prepared.clock.lap("pilot")
        return jobs

    def describe(self) -> dict:
        """Properties and their values, for ``to_string`` and file metadata."""
        names = ["vpl_count", "direct_count", "clamping", "direct", "emitter_samples", "direct_error", "lobe_limit"]
        return super().describe() | {name: getattr(self, name) for name in names}
