"""The image of Mitsuba's ``path``, sooner: virtual lights carry what they can, and the rest is traced."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import channel_mean, download
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.lights.light_set import LightSet, ScatteredGroup
from vpl.lights.perturbed import Perturbed
from vpl.points.camera_paths import SceneTraits
from vpl.split.balance import Balance
from vpl.split.decision import Decision
from vpl.split.gather_vertices import LitVertices
from vpl.split.kept_lights import KeptLights, TreedLights
from vpl.split.next_event import emitters_of
from vpl.split.paths import Limits, Rules
from vpl.split.pilot import Arrivals
from vpl.split.pixel_clusters import PixelClusters, light_clusters
from vpl.split.site_choice import learning_rays
from vpl.split.surface_lights import surface_lights
from vpl.split.view import View
from vpl.split.view_lights import ViewLights, spaced_lights
from vpl.split.worth import Worth
from vpl.transport.evaluation import Transport

from .gathering import Clock, GatheringIntegrator, add_statistics
from .knobs import Boolean
from .manual import manual_page

# Camera rays that are followed at a time, about: half of them, but so many at least and at most. Memory that is new to
# a process takes long to fill, which is felt in small images, and kernels are recorded anew each time
_WAVEFRONT = 1 << 18, 1 << 20
# Pixels darker than this share of the image's mean are lit as precisely as if they had it
_DARK_FLOOR = 0.1
# Nodes of the cut of a cluster, at most
_MAX_CUT = 1000
# Surfaces as virtual lights see them: all of them block, for what passes one is traced
_OPAQUE = SceneTraits(False, False, True, False, False, (), (), None)


@manual_page
class ManyLightsIntegrator(GatheringIntegrator):
    r"""
    .. _integrator-manylights:

    Many lights (:monosp:`manylights`)
    ----------------------------------

    .. pluginparameters::

     {knobs}

    The image of ``path``, with less noise in the same time: the mean over seeds is the same for the same ``max_depth``,
    nothing is clamped and nothing left out.

    **How.** Radiance that the camera's first surface x1 receives by way of a second one, x2, is split in two,

    .. math:: f_1 f_2 = w F_1 F_2 + (f_1 f_2 - w F_1 F_2), \qquad w = 1 / (1 + c^2 \cos\theta_1 \cos\theta_2 / d^2).

    F is the *floor* of a BSDF, its Lambertian part. The first term is left to virtual lights on the surfaces where
    camera paths arrive, each with the irradiance that one path finds there. They are clustered in a light tree; those
    gather vertices of a pixel that face the same way share one light cut, as in Multidimensional Lightcuts, with a
    representative drawn anew for every pair. The second term is traced as by ``path``; most of its paths end at x2,
    where little is left of them. w keeps lights from being bright spots in corners; c is a multiple of the distance
    between lights. See :mod:`vpl.split`.

    **Many emitters.** Where there are 64 or more, all of them with a constant radiance, what a surface receives from
    emitters directly is split as well, if that pays: point and spot emitters are virtual lights themselves, with w = 1,
    and area emitters have points that are. A cut of a hundred lights stands for all, where ``path`` draws one emitter.
    Light of environments, directional emitters, and meshes whose vertices have other normals than their surface is
    traced.

    **Chooses by itself.** A pilot of some ten thousand paths tells where lights are wanted, how many, at how many of a
    pixel's samples, and whether they pay: where they would take little of the noise away, or the image has few samples,
    there are none, and what is left is ``path`` with well spread samples. What was chosen is in ``statistics``, in the
    log (level Info) and in files that the command writes. The same seed chooses the same.

    **Kept lights.** With ``keep_lights`` the frames of a camera that moves, or several sensors, share their lights and
    the tree over them, each seed its own, as far as these are two million. Every frame still has the mean of ``path``,
    and a pilot of its own; lights that stand for emitters are made anew. It costs quality: lights are aimed at what the
    first camera saw, so that what others see has fewer of them and more noise, and the noise of lights is the same in
    all frames: it stands still where it would flicker, and does not average out over them. Whether the scene is still
    the same is asked before each pass: of every object but sensors and the integrator, all that Mitsuba prints of it
    and the values of all parameters are compared (by hashes, 10 to 40 ms in most scenes); where anything differs,
    lights are made anew. To change what Mitsuba neither prints nor lists as a parameter, such as how a texture is
    filtered, takes a scene that is loaded anew: give it an integrator of its own.

    - Values of single pixels may be negative while samples are few: what is traced is a difference.
    - Samplers: where a sample lies in its pixel, on the lens and in time is left to the sensor's sampler; what emitters
      and directions it chooses at surfaces that scatter is spread by the plugin. With ``multijitter`` instead of
      ``independent``, Mitsuba's default, there is 2% (bistro_interior), 8% (kitchen) or 23% (cornell) less variance.
    - Masks: the image is that of ``prb``. ``path`` (Mitsuba 3.9.1) shows black for samples that have passed nothing but
      masks when their paths end, and so is too dark where nothing is behind a mask; with ``hide_emitters`` it hides an
      environment behind a mask by that, which is seen through it here. Alpha is that of ``path``.
    - Surfaces only: a scene with a participating medium is refused.
    - ``*_rgb`` and ``*_mono`` variants only. Not differentiable.
    - Materials and emitters: all that ``path`` renders. Light that metals and surfaces with bump or normal maps send
      on is traced, and so is what passes a mask or thin glass between x1 and x2.

    .. tabs::
        .. code-tab:: xml

            <integrator type="manylights">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            import manylights
            "integrator": {"type": "manylights", "max_depth": 8}
    """

    knobs = (
        Boolean(
            "virtual_lights", True,
            "Whether virtual lights may carry indirect light, and that of many emitters, where they pay. Without them "
            "all of it is traced.",
        ),
        Boolean(
            "keep_lights", False,
            "Whether the virtual lights of a seed are kept for the next image of it, by the same integrator, as long "
            "as the scene stays as it is but for its sensors.",
        ),
    )  # fmt: skip

    renders_in_parts = True

    def __init__(self, props):
        super().__init__(props)
        self._kept = KeptLights()

    def _sample(self, scene, sampler, ray, active):
        clock = Clock(Stage.SCENE)
        radiance, valid = self._trace(self._view(scene, sampler, ray, active), clock)
        return mi.Spectrum(radiance), valid, []

    def _view(self, scene, sampler, ray, active) -> View:
        number = dr.detach(sampler.next_1d())
        seed = int(dr.reinterpret_array(mi.UInt32, number)[0])
        # Of some sensors all rays are the same one
        grid, count = self.pixel_grid(scene, sampler), max(dr.width(ray), dr.width(number))
        wide = dr.zeros(mi.Float, count)
        ray.o, ray.d, ray.time = ray.o + wide, ray.d + wide, ray.time + wide
        active = mi.Bool(active) & dr.full(mi.Bool, True, count)
        dr.make_opaque(ray, active)
        emission = emitters_of(scene, learning_rays(count))
        alike = dr.opaque(mi.Float, 1.0, -(-count // grid.samples))
        size = grid.width, grid.samples
        rules = Rules(self.max_depth, self.rr_depth, self.hide_emitters)
        return View(scene, emission, Perturbed(scene), rules, ray, active, *size, seed, alike, Worth.unknown())

    def _trace(self, view: View, clock: Clock):
        """(Radiance of each camera ray, whether it is opaque in the film's alpha)."""
        clock.begin(Stage.PILOT)
        self.statistics = {}
        decision = Decision.of(view, self.virtual_lights)
        chosen, worth = decision.balance, decision.judge(view)
        if worth is not None:
            self.statistics["worth"] = worth
        mi.Log(mi.LogLevel.Info, f"manylights: {chosen}")
        lights = self._lights(view, decision.pilot.arrivals, chosen, clock)
        limits = view.limits(lights)
        expected = decision.expected_light(lights) if lights.all else None
        radiance, valid = dr.zeros(mi.UnpolarizedSpectrum, view.count), dr.zeros(mi.Bool, view.count)
        # Whole pixels, in parts of about the same size
        parts = max(round(view.count / np.clip(view.count / 2, *_WAVEFRONT)), 1)
        most = -(-view.pixels // parts) * view.samples
        for first in range(0, view.count, most):
            if self.should_stop():
                break
            lane = dr.arange(mi.UInt32, min(most, view.count - first)) + dr.opaque(mi.UInt32, first)
            dr.eval(lane)
            part, opaque = self._part(view, lane, first, limits, lights, chosen, expected, clock)
            dr.scatter(radiance, part, lane)
            dr.scatter(valid, opaque, lane)
            dr.eval(radiance, valid)
        clock.stop()
        if view.scene.environment() is not None and not self.hide_emitters:
            valid |= view.active
        finite = dr.all(dr.isfinite(radiance))
        dropped = int(dr.count(~finite)[0])
        if dropped:
            mi.Log(mi.LogLevel.Warn, f"{dropped} sample(s) with values that are not finite were dropped.")
        self.statistics |= {"balance": chosen.reason, "dropped": dropped, "seconds": clock.seconds}
        return dr.select(finite & (self.max_depth > 0), radiance, 0), valid & (self.max_depth > 0)

    def _part(self, view: View, lane, first: int, limits: Limits, lights: ViewLights, chosen: Balance, expected, clock):
        """(Radiance of the camera rays ``lane``, of whole pixels and from ``first`` on, whether each is opaque in the
        film's alpha)."""
        clock.begin(Stage.TRACED)
        found, *vertices, _ = view.follow(lane, limits, 4, first)
        radiance, valid = found.radiance, found.valid
        if not lights.all:
            return radiance, valid
        clock.begin(Stage.CLUSTERS)
        seed = derived_seed(view.seed, 5, first)
        points = LitVertices.of(*vertices, view.samples, chosen.vertices, derived_seed(seed, 0))
        # Memory for the cuts
        del found, vertices, _
        nearby = expected[first // view.samples :][: -(-len(lane) // view.samples)]
        return radiance + self._gather(view, lights, chosen, points, radiance, nearby, seed, clock), valid

    def _lights(self, view: View, arrivals: Arrivals, chosen: Balance, clock: Clock) -> ViewLights:
        """Virtual lights and their trees."""
        surfaces = self._surface_lights(view, arrivals, chosen, clock) if chosen.light_paths else None
        if not chosen.emitters:
            return ViewLights(surfaces)
        clock.begin(Stage.TREE)
        lights = view.emission.lights
        emitters = view.emitter_lights(lights.groups(lights.points(view.count), derived_seed(view.seed, 7)))
        self.statistics["lights"] = self.statistics.get("lights", {}) | {"emitters": emitters.count}
        return ViewLights(surfaces, emitters)

    def _surface_lights(self, view: View, arrivals: Arrivals, chosen: Balance, clock: Clock) -> LightSet | None:
        """Virtual lights on surfaces; None where there are none."""
        clock.begin(Stage.LIGHTS)
        # None is followed where they are kept
        self.statistics["light_paths"] = 0
        make = partial(self._made_lights, view, arrivals, chosen, clock)
        made = self._kept.find(view.scene, (view.seed, self.max_depth), make) if self.keep_lights else make()
        self.statistics["lights"] = {"surface": made.surface.lights.count}
        if made.group is None:
            return None
        return spaced_lights([made.group], made.surface.spacing(arrivals), self.max_depth)

    def _made_lights(self, view: View, arrivals: Arrivals, chosen: Balance, clock: Clock) -> TreedLights:
        """Virtual lights where the pilot's paths arrived, and their tree."""
        # The path from a light is shorter by the two edges between camera and light, and no camera path, whose worth
        # would be known
        rules = replace(view.rules, max_depth=self.max_depth - 2, rr_depth=1)
        limits = replace(view, rules=rules, worth=Worth.unknown()).limits(ViewLights())
        seed = derived_seed(view.seed, 2)
        made = surface_lights(view.scene, view.emission, arrivals, chosen.light_paths, limits, seed)
        self.statistics["light_paths"] = chosen.light_paths
        if made.lights.count == 0:
            return TreedLights(made, None)
        clock.begin(Stage.TREE)
        return TreedLights(made, ScatteredGroup.of(made.lights, derived_seed(view.seed, 3)))

    def _gather(self, view, lights, chosen, points: LitVertices, found, expected, seed, clock):
        """Light of virtual lights at the ``points`` of some pixels, per camera ray.

        ``expected``: light that lights should bring to each pixel, by which errors are judged together with what its
        paths ``found``.
        """
        samples, count = view.samples, dr.width(found)
        lit = dr.zeros(mi.UnpolarizedSpectrum, count)
        dr.eval(lit)
        if points.count == 0:
            return lit
        clusters = PixelClusters(points, samples)
        clock.begin(Stage.CUTS)
        traced = np.nan_to_num(download(channel_mean(found)), posinf=0, neginf=0)
        level = np.maximum(traced, 0).reshape(-1, samples).mean(1) + expected
        level = np.maximum(level, _DARK_FLOOR * level.mean())
        # What a pair may add to what the vertices of a pixel bring together
        allowed = chosen.error * points.kept * level[clusters.pixel]
        shadow_rays = 0
        for number, carrying in enumerate(lights.all):
            transport, stream = Transport(view.scene, _OPAQUE, carrying), derived_seed(seed, 1, number)
            shadow_rays += light_clusters(transport, clusters, allowed, _MAX_CUT, stream, lit)
        clock.stop()
        more = {"shadow_rays": shadow_rays, "gather_points": points.count, "clusters": clusters.count}
        add_statistics(self.statistics, more | {"later": points.alone})
        # Every step-th sample stands for all
        return lit * dr.opaque(mi.Float, samples / points.kept)


mi.register_integrator("manylights", ManyLightsIntegrator)
