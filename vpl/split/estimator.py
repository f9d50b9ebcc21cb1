"""Estimator of ``manylights``: start (:mod:`vpl.split.start`) → plan → lights → image.

Each step takes the results of earlier steps and returns a new result.  The same seed makes the same decisions.

The passes of a render may share a :class:`Start`.  Each pass still draws new lights and paths and has a plan for the
size of the pass.  The start is independent of the random numbers of later passes, so every pass is unbiased.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import LARGEST_VALUE, channel_mean, download, upload
from ..core.clock import Clock
from ..core.sampling import derived_seed
from ..core.stages import Stage
from ..transport.evaluation import Transport
from .camera_rays import trace_camera_rays
from .contributions import LayerSums
from .gather_vertices import LitVertices
from .line_hits import has_large_curves
from .path_state import PathSettings
from .path_tracer import Traced
from .pilot import error_scale
from .pixel_clusters import PixelClusters, light_clusters
from .pixel_rays import PixelRays
from .plan import LEAST_VARIANCE, Decision, Plan, choose, without_lights
from .roulette import best_multiple
from .spread_light import spread
from .start import Start, evidence_of
from .surface_lights import KeptLights, surface_lights
from .view import Stream, View, ViewLights

# Smallest and largest number of camera rays per part; the target is half of the image. Filling new memory of a process
# is slow, which matters for small images. Dr.Jit records the kernels anew for each part, 15 to 100 ms by the number of
# materials, as long as some 50 000 rays take
_WAVEFRONT = 1 << 19, 1 << 20


@dataclass(frozen=True)
class Part:
    """Pixels that are traced at once: a range ``pixels`` (first, last + 1), their ``first`` ray and ``rays``."""

    pixels: tuple[int, int]
    first: int
    rays: PixelRays


@dataclass(frozen=True)
class Estimate:
    """``radiance`` of each camera ray; ``valid``: whether the ray is opaque in the film's alpha; ``layers``: radiance
    by name of the layer; ``decision``; ``statistics``."""

    radiance: mi.UnpolarizedSpectrum
    valid: mi.Bool
    layers: dict[str, mi.UnpolarizedSpectrum]
    decision: Decision
    statistics: dict


def estimate(view: View, start: Start, kept: KeptLights | None, stopped: Callable[[], bool], clock: Clock) -> Estimate:
    """Estimate the radiance of a view's camera rays.

    ``kept``: lights of earlier images, or None; ``stopped``: whether to end early.
    """
    view = replace(view, emitters=start.emitters_for(view.count), relays=start.relays)
    decision = decide(view, start)
    view, samples = with_emitter_samples(view, decision)
    view, roulette = with_roulette(view, decision)
    mi.Log(mi.LogLevel.Info, f"manylights: {decision.plan}")
    lights, of_lights = make_lights(view, decision, kept, clock)
    radiance, valid, layers, of_image = render_image(view, lights, decision, stopped, clock)
    precision = {"precision": decision.precision(view.samples)}
    # Text, because passes add up numbers
    relays = {"relays": str(start.relays.count)} if start.relays else {}
    glass = {"glass": "passed"} if start.emitters.refracts else {}
    statistics = {"plan": decision.plan.reason} | precision | glass | relays | samples | roulette | of_lights | of_image
    return Estimate(radiance, valid, layers, decision, statistics | {"seconds": clock.seconds})


# ---------------------- Plan ----------------------


def decide(view: View, start: Start) -> Decision:
    """Compare the kinds of virtual lights for a view of a certain size."""
    evidence = evidence_of(view, start)
    plan = without_lights(start.refusal, evidence) if start.refusal else choose(evidence, start.options)
    return Decision(start.pilot, evidence, plan, start.options, start.effects)


def with_emitter_samples(view: View, decision: Decision) -> tuple[View, dict]:
    """(View with numbers of emitter samples; their mean, as a statistic)."""
    numbers = decision.effect.numbers(decision.emitter_samples.multiple)
    return replace(view, direct_samples=upload(mi.UInt32, numbers)), {"emitter_samples": f"{np.mean(numbers):.3g}"}


def with_roulette(view: View, decision: Decision) -> tuple[View, dict]:
    """(View with Russian roulette by expected contribution, if roulette pays; the multiple, as a statistic)."""
    pilot, onward, model = decision.pilot, decision.pilot.onward, view.model
    if len(onward.path) == 0:
        return view, {}
    outgoing, predicted = pilot.outgoing
    of_paths, of_pixels = pilot.unseen
    relative = onward.throughput / error_scale(of_paths, model)[onward.path]
    whole = decision.evidence.whole
    paths = len(pilot.radiance)
    multiple = best_multiple(relative * predicted, relative * onward.sent, onward.edges, paths, whole, model)
    if not np.isfinite(multiple):
        return view, {}
    # The less variance remains, the more a contribution matters
    multiple *= (whole / max(decision.variance, LEAST_VARIANCE)) ** 0.5
    # Beside light that is seen directly, the other light may be 0
    importance = upload(mi.Float, np.minimum(multiple / error_scale(of_pixels, model), LARGEST_VALUE))
    return replace(view, outgoing=outgoing, importance=importance), {"roulette": f"{multiple:.3g}"}


# ---------------------- Lights ----------------------


def make_lights(view: View, decision: Decision, kept: KeptLights | None, clock: Clock) -> tuple[ViewLights, dict]:
    """(Virtual lights with trees, statistics) of a plan."""
    lights, statistics = _surface_lights(view, decision, kept, clock)
    if not decision.plan.emitters:
        return lights, statistics
    clock.begin(Stage.TREE)
    sources, c, seed = view.emitters.lights, view.emitters_c, derived_seed(view.seed, Stream.EMITTER_LIGHTS)
    emitters = view.light_set(sources.groups(sources.points(view.count, view.model), c, seed))
    counts = statistics.get("lights", {}) | {"emitters": emitters.count}
    return replace(lights, emitters=emitters, emitters_c=c), statistics | {"lights": counts}


def _surface_lights(view: View, decision: Decision, kept: KeptLights | None, clock: Clock) -> tuple[ViewLights, dict]:
    """(Virtual lights on surfaces, statistics)."""
    wanted, pilot = decision.plan.light_paths, decision.pilot
    if not wanted:
        return ViewLights(), {}
    clock.begin(Stage.LIGHTS)
    drawn = []

    def make():
        drawn.append(wanted)
        return surface_lights(view, pilot.line_sampler, wanted, lambda: clock.begin(Stage.TREE))

    made = kept.find(view.scene, (view.seed, view.rules.max_depth, view.model), make) if kept else make()
    statistics = {"light_paths": sum(drawn), "lights": {"surface": made.lights.count}}
    if not made.groups:
        return ViewLights(), statistics
    return ViewLights(view.light_set(made.groups), c=made.c), statistics


# ---------------------- Image ----------------------


def render_image(view: View, lights: ViewLights, decision: Decision, stopped: Callable[[], bool], clock: Clock):
    """(Radiance, valid, layers, statistics) of the camera rays, traced in parts of whole pixels of about equal size."""
    is_plain = not lights.all and decision.evidence.plain_alone
    view, settings = _for_paths(view, lights, is_plain)
    gatherer = Gatherer.of(view, lights, decision) if lights.all else None
    radiance, valid = dr.zeros(mi.UnpolarizedSpectrum, view.count), dr.zeros(mi.Bool, view.count)
    sums = view.layers.sums(view.count)
    parts = max(round(view.count / np.clip(view.count / 2, *_WAVEFRONT)), 1)
    statistics: dict[str, int] = {}
    for pixels in view.rays.parts(-(-view.pixels // parts) * view.samples):
        if stopped():
            break
        part = Part(pixels, int(view.rays.first[pixels[0]]), view.rays.part(*pixels))
        lane = dr.arange(mi.UInt32, part.rays.count) + dr.opaque(mi.UInt32, part.first)
        dr.eval(lane)
        sums_of_part = sums.part(part.first) if sums else None
        traced, points = _traced_part(view, lane, part, settings, lights, decision.plan, sums_of_part, clock)
        found, opaque = traced.radiance, traced.valid
        # Not with layers, which would not sum to the light of a cell
        shares = points is not None and part.rays.cells > 1 and sums is None
        weight = traced.gathered.first.weight if shares else None
        # Frees the memory of unlit gather vertices
        del traced
        if points is not None:
            light, counts = gatherer.light(points, weight, found, part, sums_of_part, clock)
            del weight
            found += light
            for name, number in counts.items():
                statistics[name] = statistics.get(name, 0) + number
        dr.scatter(radiance, found, lane)
        dr.scatter(valid, opaque, lane)
        dr.eval(radiance, valid)
    clock.stop()
    if view.scene.environment() is not None and not view.rules.hide_emitters:
        valid |= view.active
    finite = dr.all(dr.isfinite(radiance))
    dropped = int(dr.count(~finite)[0])
    if dropped:
        mi.Log(mi.LogLevel.Warn, f"{dropped} sample(s) with values that are not finite were dropped.")
    shown = view.rules.max_depth > 0
    kept = finite & shown
    layers = {name: sums.of(name, kept) for name in view.layers.names}
    return dr.select(kept, radiance, 0), valid & shown, layers, statistics | {"dropped": dropped, "plain": is_plain}


def _for_paths(view: View, lights: ViewLights, is_plain: bool) -> tuple[View, PathSettings]:
    """(View, settings of paths); ``is_plain``: whether the paths are plain."""
    settings = view.settings(lights)
    if not is_plain:
        return view, settings
    several = int(dr.max(view.direct_samples)[0]) > 1
    return replace(view, emitters=view.emitters.simplest()), replace(settings, plain=True, several=several)


def _traced_part(
    view: View, lane: mi.UInt32, part: Part, settings: PathSettings, lights: ViewLights, plan: Plan,
    sums: LayerSums | None, clock: Clock,
) -> tuple[Traced, LitVertices | None]:  # fmt: skip
    """(Traced part of the camera rays ``lane`` of a part of the image; gather vertices that are lit)."""
    # The time of the first part alone does not grow with the number of samples
    clock.begin(Stage.TRACED if part.first else Stage.RECORDED)
    traced = trace_camera_rays(view, lane, settings, Stream.IMAGE, part.first, sums=sums, goes_on=True)
    clock.hand_over(Stage.TRACED)
    if not lights.all:
        return traced, None
    clock.begin(Stage.CLUSTERS)
    seed = derived_seed(derived_seed(view.seed, Stream.GATHER, part.first), 0)
    gathered = traced.gathered
    lit = LitVertices.of(gathered.first, gathered.later, part.rays, plan.vertices, seed, part.pixels[0])
    return traced, lit


@dataclass(frozen=True)
class Gatherer:
    """Virtual lights at gather vertices, with an error of cuts relative to the brightness of each pixel.

    ``transports``: one for each set of lights; ``expected``: expected radiance of the lights in each pixel, (pixels,);
    ``darkest``: least brightness that errors are relative to.
    """

    view: View
    plan: Plan
    transports: list[Transport]
    expected: np.ndarray
    darkest: float

    @classmethod
    def of(cls, view: View, lights: ViewLights, decision: Decision) -> Gatherer:
        """For the lights of a plan."""
        # Every surface blocks the light of virtual lights: light that passes a surface is traced
        traits = replace(view.emitters.traits, null=False, nearest_hits=has_large_curves(view.scene))
        transports = [Transport(view.scene, traits, carrying) for carrying in lights.all]
        darkest = view.model.dark_pixel * max(float(np.mean(decision.pilot.radiance)), 0.0)
        return cls(view, decision.plan, transports, decision.expected_light(lights), darkest)

    def light(
        self, points: LitVertices, weight, found, part: Part, sums: LayerSums | None, clock: Clock
    ) -> tuple[mi.UnpolarizedSpectrum, dict]:
        """(Light at the ``points``, per camera ray; counters) for a part of the image.

        The brightness of a pixel is the radiance ``found`` by paths plus the expected light of virtual lights.
        ``weight`` of the first gather vertices, if the rays of a pixel share light; ``sums`` by layer of this part.
        """
        view, rays = self.view, part.rays
        lit = dr.zeros(mi.UnpolarizedSpectrum, rays.count)
        dr.eval(lit)
        if points.count == 0:
            return lit, {}
        clusters = PixelClusters(points, rays)
        clock.begin(Stage.CUTS)
        radiance = np.nan_to_num(download(channel_mean(found)), posinf=0, neginf=0)
        traced = np.add.reduceat(radiance, rays.first[:-1]) / rays.numbers
        brightness = np.maximum(traced, 0) + self.expected[slice(*part.pixels)]
        # Of the sum over the samples of a pixel
        allowed = self._errors(rays) * rays.numbers * np.maximum(brightness, self.darkest)
        precise = dr.float64_array_t(mi.Float)
        allowed = dr.gather(precise, upload(precise, allowed), clusters.pixel)
        shadow_rays, seed = 0, derived_seed(view.seed, Stream.GATHER, part.first)
        for number, transport in enumerate(self.transports):
            stream = derived_seed(seed, 1, number)
            shadow_rays += light_clusters(transport, clusters, allowed, view.model.largest_cut, stream, lit, sums)
        if weight is not None:
            lit = spread(lit, weight, rays, view.model.spread)
        clock.stop()
        counts = {"shadow_rays": shadow_rays, "gather_points": points.count, "clusters": clusters.count}
        return lit, counts | {"later": points.alone}

    def _errors(self, rays: PixelRays) -> np.ndarray:
        """Largest error of a pair over the radiance of its pixel, (pixels,): with as many shadow rays for each ray."""
        model = self.view.model
        finer = (rays.numbers / rays.mean) ** -model.error_slope
        return np.clip(self.plan.error * finer, model.finest_error, model.coarsest_error)
