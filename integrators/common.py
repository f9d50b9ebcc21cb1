"""Base class of the integrators with virtual point lights; each method overrides ``shade``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from vpl.core.arrays import add_at, download
from vpl.core.path_limits import PathLimits
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

# Gather points that determine the visible part of the scene
_PLACES = 1024
AOVS = ("shadow_rays", "upper_bounds", "cut_size")
AOVS_TEXT = "Comma-separated channels to return, per camera ray and from the same pass: {allowed}."
# For methods that compare error bounds with a radiance estimate
DARK_FLOOR = Number(
    "dark_floor", 0.5,
    "Smallest radiance in the error threshold, as a fraction of the image's mean: darker points are refined as if they "
    "had this radiance. 0 applies the relative bound everywhere, at several times the cost in dark corners.",
    minimum=0,
)  # fmt: skip


@dataclass
class ShadeJob:
    """Input of one ``shade`` call.

    ``transport``: the scene and its lights; ``batch``: gather points; ``direct``: known radiance per point (direct
    light of emitters with an extent); ``mean``: estimated mean radiance over the render's gather points and over
    channels; ``share``: fraction of the gather points in this batch; ``ray``: camera ray of each point; ``weight``:
    throughput of each point to the camera; ``grid``: layout of camera rays in the image; ``stopped``: whether to stop
    early.
    """

    transport: Transport
    batch: Batch
    direct: mi.UnpolarizedSpectrum
    mean: float
    share: float
    seed: int
    ray: mi.UInt32
    weight: mi.UnpolarizedSpectrum
    grid: PixelGrid
    stopped: Callable[[], bool]

    @property
    def lights(self) -> LightSet:
        return self.transport.lights


@dataclass
class ShadeResult:
    """Result of one ``shade`` call: radiance due to the lights, and counters, per point of the batch.

    ``shadow_rays``, ``upper_bounds``, ``cut_size``: UInt32, or Float if a count is divided between points; ``seconds``:
    time by stage; ``phase_one``: radiance estimate of the first phase, for methods with two phases; ``dropped``: number
    of omitted non-finite values; ``counts``: statistics, summed over batches.
    """

    radiance: mi.UnpolarizedSpectrum
    shadow_rays: mi.UInt32 | mi.Float
    upper_bounds: mi.UInt32 | mi.Float | None
    cut_size: mi.UInt32 | mi.Float
    seconds: dict[str, float] = field(default_factory=dict)
    phase_one: mi.Float | None = None
    dropped: int = 0
    counts: dict[str, int] = field(default_factory=dict)


@dataclass
class Prepared(CameraPass):
    """Input of a method for one pass.

    ``direct``: known radiance per gather point; ``jobs``: one per batch; ``counts``: statistics.
    """

    direct: mi.UnpolarizedSpectrum | None = None
    jobs: list[ShadeJob] = field(default_factory=list)
    counts: dict = field(default_factory=dict)


class ManyLightIntegrator(GatheringIntegrator):
    """Base class: generates lights and gather points, and calls ``shade`` for their radiance."""

    needs_trees = True
    offered_aovs = AOVS
    knobs = (
        Integer("vpl_count", 200_000, "Approximate number of virtual point lights.", minimum=1),
        Choice(
            "direct", "nee",
            "Method for direct light. ``nee``: next-event estimation with multiple importance sampling for area "
            "emitters and environments. ``adaptive``: iterative adaptive sampling for area emitters and environments, "
            "see ``adaptivedirect``. ``vpl``: virtual lights on area emitters and environments, as in the papers. "
            "``none``: no direct light. Except with ``none``, point, spot and directional emitters are virtual lights, "
            "exact and never clamped.",
            words=("nee", "adaptive", "vpl", "none"),
        ),
        Integer(
            "emitter_samples", 16,
            "Pairs of an emitter and a BSDF sample per gather point with ``direct=\"nee\"``. Their cost is small "
            "compared to virtual lights, and their variance is often the largest part of an image's.",
            minimum=1,
        ),
        Fraction(
            "direct_error", 0.05,
            "Relative standard error of the direct light with ``direct=\"adaptive\"``.",
            minimum=1e-4,
        ),
        Integer(
            "direct_count", 4096,
            "Number of virtual lights on area emitters, and again for the environment, with ``direct=\"vpl\"``.",
            minimum=1,
        ),
        Number(
            "clamping", 2.0,
            "Smallest distance to a virtual light on a surface, as a multiple of the typical distance between these "
            "lights in the visible part of the scene. The contribution of nearer lights is clamped, which prevents "
            "bright spots and darkens corners; more lights reduce the loss. 0: no clamping.",
            minimum=0,
        ),
        Number(
            "lobe_limit", 1.0,
            "Largest density, per steradian, of a glossy lobe that stores virtual lights like a diffuse lobe (density "
            "at most 1/pi). 0: only diffuse lobes store lights.",
            minimum=0,
        ),
        Words("aovs", "", AOVS_TEXT, words=offered_aovs),
    )  # fmt: skip

    def shade(self, job: ShadeJob) -> ShadeResult:
        """Radiance due to ``job.lights`` at the points of ``job.batch``, by the method of the derived class."""
        raise NotImplementedError

    def light_options(self) -> LightOptions:
        """Properties that determine the lights."""
        return LightOptions(
            self.vpl_count, self.direct_count, self.clamping, self.direct, self.max_depth, self.rr_depth,
            self.lobe_limit, self.needs_trees,
        )  # fmt: skip

    def prepare(self, scene, sampler, ray, active=True) -> Prepared:
        """Camera paths, lights, direct light and batches of gather points: the input of ``shade``."""
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
        """Direct light of emitters with an extent, by a fixed number of samples: (radiance, shadow rays)."""
        return direct_light(
            scene, ExtendedEmitters(scene, camera.emitters), camera.traits, camera.paths.points,
            PathLimits.of(self.max_depth, self.rr_depth), self.emitter_samples, grid.samples,
            derived_seed(camera.seed, 30),
        )  # fmt: skip

    def _adaptive(self, scene, camera: CameraPass, grid):
        """Direct light of emitters with an extent, by adaptive sampling: (radiance, shadow rays)."""
        # Point, spot and directional emitters are virtual lights already
        sources = Sources(scene, camera.emitters.extended_only())
        options = DirectOptions(error=self.direct_error, rr_depth=self.rr_depth)
        found = light_directly(
            scene, camera.traits, sources, camera.paths.points, grid, self.max_depth, options,
            derived_seed(camera.seed, 30), self.stopped,
        )  # fmt: skip
        return found.radiance, whole_sum(found.shadow_rays)

    def light(self, scene, sampler, camera: CameraPass):
        """Sum ``shade`` over the batches: (radiance, channels, statistics)."""
        prepared = self._prepare(scene, sampler, camera)
        radiance, totals = prepared.direct, {}
        for job in prepared.jobs:
            if self.stopped():
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
        """One job per batch of gather points, with the estimated mean radiance over the batches."""
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
            jobs.append(ShadeJob(transport, batch, direct, 0.0, share, stream, ray, weight, grid, self.stopped))
            if self.needs_trees:
                level = mean_radiance(transport, batch, derived_seed(seed, 32, number))
                mean += (level + float(download(direct).mean(dtype="float64"))) * share
        for job in jobs:
            job.mean = mean
        prepared.clock.stop()
        return jobs
