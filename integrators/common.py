"""The base class of the integrators that use virtual point lights; the methods differ in one hook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from vpl.core.arrays import add_at, download
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.direct.adaptive import DirectOptions, light_directly
from vpl.direct.emitter_sampling import ExtendedEmitters, direct_light
from vpl.direct.sources import Sources
from vpl.lights.light_set import LightOptions, LightSet, prepare_lights
from vpl.points.bsdf_proxies import probe_materials
from vpl.points.camera_paths import PixelGrid
from vpl.points.surfaces import Batch, make_batches
from vpl.transport.evaluation import Transport, mean_radiance

from .gathering import CameraPass, GatheringIntegrator, whole_sum
from .knobs import Choice, Fraction, Integer, Number, Words

# Gather points by which is judged where the camera looks
_PLACES = 1024
AOVS = ("shadow_rays", "upper_bounds", "cut_size")
AOVS_TEXT = "Comma-separated channels to return, per camera ray and from the same pass: {allowed}."
# Of the methods that compare bounds with the radiance around them
DARK_FLOOR = Number(
    "dark_floor", 0.5,
    "What is darker than this fraction of the image's mean is refined as if it had it; 0 holds the bound everywhere, "
    "at several times the cost in dark corners.",
    minimum=0,
)  # fmt: skip


@dataclass
class ShadeJob:
    """Job of one ``shade`` call: a batch of gather points, and what is known of them.

    ``transport``: the scene and its lights; ``batch``: the points; ``direct``: radiance per point that is known
    already (direct light of extended emitters); ``mean``: an estimate of the mean radiance over all gather points of
    the render and over channels; ``share``: the fraction of them that is in this batch; ``ray``: UInt32, the camera ray
    of each point; ``weight``: what its radiance counts in that ray; ``grid``: how camera rays lie in the image;
    ``stopped``: whether to give up early.
    """

    transport: Transport
    batch: Batch
    direct: object
    mean: float
    share: float
    seed: int
    ray: object
    weight: object
    grid: PixelGrid
    stopped: Callable[[], bool]

    @property
    def lights(self) -> LightSet:
        return self.transport.lights


@dataclass
class ShadeResult:
    """Result of one ``shade`` call: radiance due to the lights, and counters, per point of the batch.

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
class Prepared(CameraPass):
    """A render before its method has worked.

    ``direct``: radiance per gather point; ``counts``: for statistics.
    """

    direct: object = None
    jobs: list[ShadeJob] = field(default_factory=list)
    counts: dict = field(default_factory=dict)


class ManyLightIntegrator(GatheringIntegrator):
    """Base class: makes lights and gather points, and asks ``shade`` for the rest."""

    needs_trees = True
    offered_aovs = AOVS
    knobs = (
        Integer("vpl_count", 200_000, "How many virtual point lights to aim for.", minimum=1),
        Choice(
            "direct", "nee",
            "Light that comes straight from emitters. ``nee``: area emitters and environments by emitter and BSDF "
            "sampling with multiple importance sampling. ``vpl``: they become virtual lights, as in the papers. "
            "``none``: left out. ``adaptive``: area emitters and environments by iterative adaptive sampling, as in "
            "``adaptivedirect``. Point, spot and directional emitters are virtual lights already, exact and never "
            "clamped, in all of these but ``none``.",
            words=("nee", "adaptive", "vpl", "none"),
        ),
        Integer(
            "emitter_samples", 16,
            "Pairs of an emitter and a BSDF sample per gather point with ``direct=\"nee\"``. More of them cost little "
            "beside virtual lights, and their noise is often most of what is left.",
            minimum=1,
        ),
        Fraction(
            "direct_error", 0.05,
            "Standard error of the direct light, relative to it, with ``direct=\"adaptive\"``.",
            minimum=1e-4,
        ),
        Integer(
            "direct_count", 4096,
            "Virtual lights on area emitters, and as many for the environment, with ``direct=\"vpl\"``.",
            minimum=1,
        ),
        Number(
            "clamping", 2.0,
            "Smallest distance to a virtual light that stands for a surface, as a multiple of the typical distance "
            "between such lights where the camera looks; light from nearer is dimmed instead of becoming a bright "
            "spot. With more lights, less is cut off. 0 turns it off.",
            minimum=0,
        ),
        Number(
            "lobe_limit", 1.0,
            "A glossy lobe stores virtual lights where its density is at most this, per steradian, as though it were "
            "diffuse (which has at most 1/pi); 0 stores the light of diffuse lobes only.",
            minimum=0,
        ),
        Words("aovs", "", AOVS_TEXT, words=offered_aovs),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
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

    def _prepare(self, scene, sampler, camera: CameraPass) -> Prepared:
        points, emitters, clock = camera.paths.points, camera.emitters, camera.clock
        prepared = Prepared(**vars(camera), direct=dr.zeros(mi.UnpolarizedSpectrum, points.count))
        if camera.dark or self.max_depth < 2:
            return prepared
        lights = prepare_lights(scene, emitters, self.light_options(), points.places(_PLACES), camera.seed)
        clock.add(lights.seconds)
        grid = self.pixel_grid(scene, sampler)
        if self.direct in ("nee", "adaptive"):
            clock.begin(Stage.DIRECT)
            light = self._nee if self.direct == "nee" else self._adaptive
            direct, rays = light(scene, camera, grid)
            prepared.direct += direct
            prepared.counts["emitter_rays"] = rays
            clock.stop()
        prepared.counts |= {
            "lights": lights.counts,
            "light_paths": lights.paths,
            "dropped": lights.dropped + emitters.dropped,
        }
        if lights.groups:
            prepared.jobs = self._jobs(Transport(scene, camera.traits, lights), prepared, camera.seed, grid)
        return prepared

    def _nee(self, scene, camera: CameraPass, grid):
        """Direct light of extended emitters by a fixed number of samples: (radiance, rays)."""
        return direct_light(
            scene, ExtendedEmitters(scene, camera.emitters), camera.traits, camera.paths.points, self.max_depth,
            self.emitter_samples, grid.samples, derived_seed(camera.seed, 30),
        )  # fmt: skip

    def _adaptive(self, scene, camera: CameraPass, grid):
        """Direct light of extended emitters by adaptive sampling: (radiance, rays)."""
        # Point, spot and directional emitters are virtual lights already
        sources = Sources(scene, camera.emitters.extended_only())
        options = DirectOptions(error=self.direct_error)
        found = light_directly(
            scene, camera.traits, sources, camera.paths.points, grid, self.max_depth, options,
            derived_seed(camera.seed, 30), self.should_stop,
        )  # fmt: skip
        return found.radiance, whole_sum(found.shadow_rays)

    def light(self, scene, sampler, camera: CameraPass):
        """Prepare, ask the method, and put its batches together."""
        prepared = self._prepare(scene, sampler, camera)
        radiance, totals = prepared.direct, {}
        for job in prepared.jobs:
            if self.should_stop():
                break
            part = self.shade(job)
            add_at(radiance, part.radiance, job.batch.index)
            for name in self.offered_aovs:
                values = getattr(part, name)
                total = totals.setdefault(name, dr.zeros(type(values), camera.paths.points.count))
                dr.scatter(total, values, job.batch.index)
            camera.clock.add(part.seconds)
            for name, number in (part.counts | {"dropped": part.dropped}).items():
                prepared.counts[name] = prepared.counts.get(name, 0) + number
        names = {"shadow_rays": "shadow_rays", "upper_bounds": "bound_computations", "cut_size": "cut_size"}
        found = {label: whole_sum(totals.get(name)) for name, label in names.items()}
        return radiance, totals, found | {"lights": {}, "light_paths": 0, "emitter_rays": 0} | prepared.counts

    def _jobs(self, transport: Transport, prepared: Prepared, seed: int, grid: PixelGrid) -> list[ShadeJob]:
        """One job per batch of gather points, each knowing the mean radiance over all of them."""
        points, jobs, mean = prepared.paths.points, [], 0.0
        prepared.clock.begin(Stage.PROBE)
        batches = make_batches(points, probe_materials(points, transport.traits))
        prepared.clock.begin(Stage.PILOT)
        for number, batch in enumerate(batches):
            direct = dr.gather(type(prepared.direct), prepared.direct, batch.index)
            stream = derived_seed(seed, 31, number)
            ray = dr.gather(mi.UInt32, points.ray, batch.index)
            weight = dr.gather(type(points.weight), points.weight, batch.index)
            share = batch.count / points.count
            jobs.append(ShadeJob(transport, batch, direct, 0.0, share, stream, ray, weight, grid, self.should_stop))
            if self.needs_trees:
                level = mean_radiance(transport, batch, derived_seed(seed, 32, number))
                mean += (level + float(download(direct).mean(dtype="float64"))) * share
        for job in jobs:
            job.mean = mean
        prepared.clock.stop()
        return jobs
