"""The image of Mitsuba's ``path`` with less variance: virtual lights carry diffuse light, paths trace the rest."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from vpl.core.clock import Clock
from vpl.core.stages import Stage
from vpl.lights.perturbed import Perturbed
from vpl.split.cost_model import CostModel
from vpl.split.emitters import emitter_sampler
from vpl.split.emitters.learned import learning_rays
from vpl.split.estimator import estimate
from vpl.split.roulette import OutgoingRadiance
from vpl.split.surface_lights import KeptLights
from vpl.split.view import PathRules, View

from .gathering import GatheringIntegrator
from .knobs import Boolean
from .manual import manual_page


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

    def __init__(self, props, cost_model: CostModel | None = None):
        super().__init__(props)
        self.cost_model, self._kept = cost_model or CostModel(), KeptLights()

    def _sample(self, scene, sampler, ray, active):
        clock = Clock(Stage.SCENE)
        view = self._view(scene, sampler, ray, active)
        kept = self._kept if self.keep_lights else None
        found = estimate(view, self.virtual_lights, kept, self.should_stop, clock)
        self.statistics = found.statistics
        return mi.Spectrum(found.radiance), found.valid, []

    def _view(self, scene, sampler, ray, active) -> View:
        number = dr.detach(sampler.next_1d())
        seed = int(dr.reinterpret_array(mi.UInt32, number)[0])
        grid, count = self.pixel_grid(scene, sampler), max(dr.width(ray), dr.width(number))
        # Some sensors give a single ray for all samples
        wide = dr.zeros(mi.Float, count)
        ray.o, ray.d, ray.time = ray.o + wide, ray.d + wide, ray.time + wide
        active = mi.Bool(active) & dr.full(mi.Bool, True, count)
        dr.make_opaque(ray, active)
        alike = dr.opaque(mi.Float, 1.0, -(-count // grid.samples))
        return View(
            scene, emitter_sampler(scene, learning_rays(count)), Perturbed(scene),
            PathRules(self.max_depth, self.rr_depth, self.hide_emitters), ray, active, grid.width, grid.samples, seed,
            alike, OutgoingRadiance.unknown(), self.cost_model,
        )  # fmt: skip


mi.register_integrator("manylights", ManyLightsIntegrator)
