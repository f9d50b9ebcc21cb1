"""Iterative adaptive sampling of direct light: shadow rays go where light was found to arrive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import drjit as dr
import mitsuba as mi

from vpl.core.arrays import download
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.direct.adaptive import FIELDS, DirectOptions, light_directly
from vpl.direct.sources import Sources
from vpl.points.camera_paths import PixelGrid

from . import properties
from .bands import fits_one_band, random_rays, render_in_bands
from .gathering import CameraPass, GatheringIntegrator, add_statistics, whole_sum
from .manual import direct_manual_page

_LEVEL_RAYS = 4096


@dataclass
class Band:
    """What a band of rows knows of the image: how its pixels lie, the mean radiance, and its share of the time."""

    grid: PixelGrid
    level: float
    time: float


@direct_manual_page
class AdaptiveDirectIntegrator(GatheringIntegrator):
    r"""
    .. _integrator-adaptivedirect:

    Iterative adaptive direct light (:monosp:`adaptivedirect`)
    ----------------------------------------------------------

    .. pluginparameters::

     * - lights
       - |string|
       - ``clusters``: clusters of emitters are sampled adaptively. ``all``: every emitter gets one shadow ray at every
         point, again and again until the noise of those with an extent is low enough. ``auto``: for every group of
         points the cheaper of both. (Default: ``auto``)

     * - cluster_angle
       - |float|
       - Largest solid angle of a cluster as seen from a point, in steradians. (Default: 0.02)

     * - faint_share
       - |float|
       - Clusters that would send less than this share of the light at a group of points, if nothing was between, may
         fill up to 0.3 steradians. 0: none may, as in the paper. (Default: 0.005)

     * - max_passes
       - |int|
       - Most passes over a pixel. (Default: 15)

     * - samples_per_cluster
       - |float|
       - Emitter samples of a pixel in a pass, for each of its clusters. (Default: 1.5)

     * - min_samples
       - |int|
       - Fewest emitter samples of a pixel in a pass. (Default: 50)

     * - pass_limit
       - |int|
       - Most emitter samples of a pixel in a pass, at least ``min_samples``. (Default: 400)

     * - guide
       - |string|
       - How clusters are chosen. ``evaluated``: by what they would send if nothing was between, corrected by what
         samples found. ``sampled``: by samples alone, the first pass by none, as in the paper.
         (Default: ``evaluated``)

     * - combine
       - |string|
       - How passes are averaged. ``fixed``: by weights that do not depend on what they found, without bias.
         ``inverse_variance``: by their estimated variances (equation 8 of the paper), which favours passes that missed
         something. (Default: ``fixed``)

     * - shade_regions
       - |bool|
       - With several camera rays a pixel: shade one point for all that meet the same surface close to each other, as
         in the paper, instead of any of their points. (Default: no)

     {common parameters}

    Donikian et al. 2006, "Accurate direct illumination using iterative adaptive sampling" [IAS]. In passes, every pixel
    samples clusters of emitters; what the samples of the pixel and of the 8 x 8 pixels around it found decides which
    clusters the next pass samples, until the estimated error is below ``error``. It is for many emitters of which each
    point sees a few: occlusion is learned instead of paid for again and again.

    {what is estimated}

    **Departures from the paper.** Probabilities start from the clusters' unoccluded contribution instead of uniform
    ones (``guide``), and statistics hold what samples found in relation to it; passes are combined without bias
    (``combine``); each half of a pixel's samples decides whether the other half goes on, so that no pixel ends because
    it happened to look converged; dark pixels are held to a fraction of the image's mean (``dark_floor``); emitter
    samples are combined with BSDF samples for glossy surfaces and near emitters (``bsdf_share``); variances come from
    neighbouring strata; a sample takes the point of any camera ray of its pixel, which costs no more than the points of
    regions and is less noisy (``shade_regions``). Cuts, groups, regions and clusters differ in detail: see
    :mod:`vpl.direct.cluster_cuts`, :mod:`vpl.direct.sites`, :mod:`vpl.direct.pixel_regions` and
    :mod:`vpl.direct.emitter_clusters`. A black pixel is given up after three passes and 250 samples without light, as
    in the paper.

    .. tabs::
        .. code-tab:: xml

            <integrator type="adaptivedirect">
                <float name="error" value="0.02"/>
            </integrator>

        .. code-tab:: python

            import integrators
            "integrator": {"type": "adaptivedirect", "error": 0.02}
    """

    offered_aovs = FIELDS
    along_curve = False  # the pixels' points stay together
    own_properties = (
        "lights", "cluster_angle", "faint_share", "max_passes", "samples_per_cluster", "min_samples", "pass_limit",
        "guide", "combine", "shade_regions",
    )  # fmt: skip

    def __init__(self, props):
        super().__init__(props, 2)
        self._in_base, self._band = False, None
        self.error = properties.number(props, "error", 0.03, 1e-4)
        self.dark_floor = properties.number(props, "dark_floor", 0.1, 0)
        self.max_samples = properties.integer(props, "max_samples", 20_000, 1, 100_000)
        self.bsdf_share = properties.number(props, "bsdf_share", 0.125, 0)
        self.regions = properties.integer(props, "regions", 300, 1)
        self.time = properties.number(props, "time", 0.0, 0)
        self._read_method(props)

    def _read_method(self, props) -> None:
        """The properties of this method alone."""
        self.lights = properties.choice(props, "lights", "auto", ("auto", "clusters", "all"))
        self.cluster_angle = properties.number(props, "cluster_angle", 0.02, 0)
        self.faint_share = properties.number(props, "faint_share", 0.005, 0)
        self.max_passes = properties.integer(props, "max_passes", 15, 1)
        self.samples_per_cluster = properties.number(props, "samples_per_cluster", 1.5, 0)
        self.min_samples = properties.integer(props, "min_samples", 50, 1)
        self.pass_limit = properties.integer(props, "pass_limit", 400, self.min_samples)
        self.shade_regions = properties.boolean(props, "shade_regions", False)
        self.guide = properties.choice(props, "guide", "evaluated", ("evaluated", "sampled"))
        self.combine = properties.choice(props, "combine", "fixed", ("fixed", "inverse_variance"))

    def options(self) -> DirectOptions:
        """The properties as the renderer's core takes them."""
        evaluated = self.guide == "evaluated"
        return DirectOptions(
            error=self.error, dark_floor=self.dark_floor, lights=self.lights, solid_angle=self.cluster_angle,
            faint_share=self.faint_share, max_passes=self.max_passes, max_samples=self.max_samples,
            samples_per_cluster=self.samples_per_cluster, least_samples=self.min_samples, most_samples=self.pass_limit,
            bsdf_share=self.bsdf_share, evaluated=evaluated, prior=1.0 if evaluated else 0.0,
            inverse_variance=self.combine == "inverse_variance", shade_regions=self.shade_regions, time=self.time,
        )  # fmt: skip

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Render as Mitsuba does, but large images in bands of rows; see :mod:`integrators.bands`."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        samples = spp or sensor.sampler().sample_count()
        # The base class calls this method again
        if self._in_base or self.samples_per_pass < samples or fits_one_band(sensor.film(), samples):
            self._in_base = True
            try:
                return super().render(scene, sensor, seed, spp, develop, evaluate)
            finally:
                self._in_base = False
        with dr.suspend_grad():
            self._render_bands(scene, sensor, int(mi.UInt32(seed)[0]), samples)
        return sensor.film().develop() if develop else mi.TensorXf()

    def _render_bands(self, scene, sensor, seed: int, samples: int) -> None:
        """One level of brightness and one budget of time for all bands."""
        level, start, totals = self._find_level(scene, sensor, derived_seed(seed, 1)), perf_counter(), {}

        def trace(sampler, ray, grid, share):
            left = max(self.time - (perf_counter() - start), 1e-3) * share if self.time > 0 else 0.0
            self._band = Band(grid, level, left)
            try:
                return self.sample(scene, sampler, ray)
            finally:
                self._band = None
                add_statistics(totals, self.statistics)

        render_in_bands(self, scene, sensor, derived_seed(seed, 2), samples, trace)
        self.statistics = totals

    def _find_level(self, scene, sensor, seed: int) -> float:
        """Mean radiance of direct light over the film, from one pass at few points."""
        camera = self.begin(scene, *random_rays(sensor, seed, _LEVEL_RAYS))
        if camera.dark or self.max_depth < 2:
            return 0.0
        quick = replace(self.options(), max_passes=1, lights="clusters")
        found = light_directly(
            scene, camera.traits, Sources(scene, camera.emitters, self.regions), camera.paths.points, PixelGrid(8, 1),
            self.max_depth, quick, derived_seed(seed, 1), level=0.0,
        )  # fmt: skip
        return float(download(found.radiance).sum(dtype="float64")) / (3 * _LEVEL_RAYS)

    def pixel_grid(self, scene, sampler):
        """How the camera rays of this pass or band lie in the image."""
        return self._band.grid if self._band else super().pixel_grid(scene, sampler)

    def light(self, scene, sampler, camera: CameraPass):
        """Direct light of all emitters; see :func:`vpl.direct.adaptive.light_directly`."""
        points = camera.paths.points
        if camera.dark or self.max_depth < 2:
            return mi.UnpolarizedSpectrum(0), {}, {"shadow_rays": 0}
        sources = Sources(scene, camera.emitters, self.regions)
        camera.clock.lap(Stage.SOURCES)
        options, level = self.options(), None
        if self._band:
            options, level = replace(options, time=self._band.time), self._band.level
        found = light_directly(
            scene, camera.traits, sources, points, self.pixel_grid(scene, sampler), self.max_depth, options,
            derived_seed(camera.seed, 30), self.should_stop, level,
        )  # fmt: skip
        camera.clock.lap(Stage.DIRECT)
        counts = {"sources": sources.count, "shadow_rays": whole_sum(found.shadow_rays)}
        counts |= {"passes": whole_sum(found.passes), "clusters": found.clusters}
        return found.radiance, vars(found), counts | {"dropped": camera.emitters.dropped}

    def describe(self):
        """All properties and their values."""
        names = ["error", "dark_floor", "max_samples", "bsdf_share", "regions", "time", *self.own_properties]
        return super().describe() | {name: getattr(self, name) for name in names}


mi.register_integrator("adaptivedirect", AdaptiveDirectIntegrator)
