"""The image of Mitsuba's ``path`` with less variance: virtual lights carry diffuse light, paths trace the rest."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext

import drjit as dr
import mitsuba as mi

from vpl.core.arrays import NO_LIMIT
from vpl.core.clock import Clock
from vpl.core.exclusive import exclusive
from vpl.core.garbage import garbage_kept
from vpl.core.sampling import derived_seed
from vpl.core.stages import Stage
from vpl.lights.emitter_groups import OTHER, EmitterGroups
from vpl.split.contributions import LENGTHS, Layers
from vpl.split.cost_model import CostModel
from vpl.split.emitters import emitter_sampler
from vpl.split.emitters.cell_choice import learning_rays
from vpl.split.estimator import estimate
from vpl.split.film_cells import HALF, FilmCells
from vpl.split.pixel_rays import PixelRays, half_of
from vpl.split.roulette import OutgoingRadiance
from vpl.split.start import Start, make_start
from vpl.split.surface_lights import KeptLights
from vpl.split.view import PathRules, Stream, View
from vpl.transport.minorant import Minorants

from .camera_samples import LatticeSampler, stratified
from .knobs import Boolean, Groups, Words
from .longer_renders import PassRenderer
from .manual import manual_page

# Least samples of a pixel by which the pilot and its learning are sized where passes share them: a usual pass
_SHARED_SAMPLES = 16
# Ratios of the sizes of later passes of a render, of which a pass predicts the cost
_OTHER_SIZES = 0.25, 0.5, 1, 1.5, 2, 4, 8, 16
# Names of channels and layers of images, which are no names of groups of emitters
_RESERVED = (*LENGTHS, OTHER, "albedo", "normal", "depth", *"RGBAXYZ")


@manual_page
class ManyLightsIntegrator(PassRenderer):
    r"""
    .. _integrator-manylights:

    Many lights (:monosp:`manylights`)
    ----------------------------------

    .. pluginparameters::

     {knobs}

    The image of ``path`` with less variance in the same time.  The mean over seeds equals that of ``path`` for the same
    ``max_depth``: nothing is clamped or left out.

    **Method.** Let x1 be the first surface that a camera path meets, x2 the next one, and f the BSDFs.  The radiance
    that x1 receives from x2 is split in two parts,

    .. math:: f_1 f_2 = w F_1 F_2 + (f_1 f_2 - w F_1 F_2), \qquad w = 1 / (1 + c^2 \cos\theta_1 \cos\theta_2 / d^2).

    F is the *minorant* of a BSDF, its Lambertian part.  Virtual lights carry the first part.  They lie on the surfaces
    where camera paths arrive, each with the irradiance that one path finds there, and a light tree clusters them.  The
    gather vertices of a pixel that face the same way share one light cut, as in Multidimensional Lightcuts, but refined
    by expected errors instead of bounds, with a light drawn for each pair.  Paths trace the second part as ``path``
    does; most of them end at x2, where little is left.  w prevents bright spots in corners; c is a multiple of the
    distance between lights, at x2.  See :mod:`vpl.split`.

    **Many emitters.** In scenes of 64 emitters or more, each with a constant radiance, the direct light of x1 is split
    as well, if that pays.  Point and spot emitters are virtual lights themselves, with w = 1; area emitters get virtual
    lights on random points.  One cut of a hundred lights then stands for all emitters, where ``path`` draws one
    emitter.  Environments, directional emitters, and meshes with vertex normals other than their geometric normals are
    traced.

    **Direct light.** Where small emitters, penumbras or the choice among emitters make the noise, a pixel takes up to
    16 emitter samples at the first surface that scatters, by the difference of two samples of the pilot.
    ``statistics`` holds the mean, ``emitter_samples``.  Denoised images of fewer than 64 expected samples take one.

    **Decisions.** A pilot of a 36th of the camera rays (a 16th in raw images), less in long renders, decides whether
    virtual lights pay, their number and places, and how many samples of a pixel they light.  Without lights,
    ``manylights`` is ``path`` with stratified and more emitter samples.  The decision is in ``statistics``, in the log
    (level Info) and in the files of the command.  It depends on the seed and the limit of time, not on the clock.  The
    passes of ``manylights.render`` and of the command share the pilot of the first pass; each draws its own lights.

    **Gradients.** ``mi.render(scene, params, integrator=...)`` has gradients in ``*_ad_*`` variants.  The image is that
    of ``manylights``, and its derivatives are those of ``prb`` with the same ``max_depth``, ``rr_depth`` and
    ``hide_emitters``.  Image and derivatives have the means of ``prb`` and different seeds, so the gradient of a
    squared error has the mean that ``prb`` gives.  Derivatives have the limits of ``prb``: they leave out moving edges
    of shapes and shadows, and the positions of point emitters.  Derivatives also have the cost and the noise of
    ``prb``: virtual lights reduce the noise of the image alone.  Pixels share the errors of virtual lights.  A
    parameter that acts on many pixels, such as the colour of a wall, can therefore have a noisier gradient than with an
    image by ``prb``; ``virtual_lights`` false avoids this.  A wrapper ``aov`` passes derivatives on; ``moment`` raises
    an error.

    **Kept lights.** With ``keep_lights``, the frames of a moving camera or several sensors share the virtual lights of
    a seed and their tree, up to two million lights.  Each frame keeps the mean of ``path`` and has a pilot of its own;
    lights that stand for emitters are made for each frame.  The price is quality.  The lights lie where the first
    camera looked, so other cameras have fewer lights and more variance.  All frames share the error of the lights,
    which neither flickers nor averages out.  Before each pass, the plugin compares hashes of all that Mitsuba prints of
    the scene's objects and of all parameters, without sensors and integrator (10 to 40 ms in most scenes), and makes
    new lights if anything differs.  A change that Mitsuba neither prints nor lists as a parameter, such as the filter
    of a texture, needs a new scene and a new integrator.

    **Layers.** ``layers`` and ``light_groups`` add channels to the image, such as ``direct.R`` and ``lamps.R``.
    Every contribution has one length and one emitter, so the three layers by length sum to the image up to rounding,
    and so do the layers of all groups.  Each layer has the mean of ``path`` for this light alone.  Masks, glass and
    mirrors count as edges: a lamp behind glass is indirect light.  A virtual light belongs to the group of the
    emitter that its path found, and a light cut draws lights of any group, so a group has more noise than an image of
    its emitters alone.  In scenes of 64 emitters or more, groups change the random numbers of an image.  Layers take
    up to an eighth more time, and a layer takes 12 bytes of memory per sample of a pass, 4 in ``*_mono`` variants;
    layers by length take the memory of three.  The sensor must give rays the weight 1, as ``perspective`` and
    ``thinlens`` do.  Layers are refused below a wrapper, such as ``aov`` or ``moment``.  Denoising leaves layers as
    they are, and images with layers have no derivatives.

    - Single pixels may be negative while samples are few, because the traced part is a difference.
    - Caustics: the pilot compares relative variances without the largest 0.1% of the errors.  For a glass ball under a
      small lamp it chooses virtual lights, which reduce that variance but leave a larger plain variance than ``path``.
    - Samplers: the plugin stratifies the choice of emitters and directions.  In place of ``independent``, Mitsuba's
      default, the plugin also stratifies the samples in a pixel, on the lens and in time.  Other samplers, the sensor
      ``batch`` and wrappers, such as ``aov`` and ``moment``, keep the samples of the sensor's sampler.
    - Numbers of samples: with ``denoised``, the passes of ``manylights.render`` from the third on give a pixel from a
      quarter to four times the mean number of samples.  The differences of two halves of the second pass, denoised and
      not, show where noise remains.  Passes depend on earlier passes only and have a common weight for all pixels, so
      the mean of the image is unchanged.  These passes take successive points of common lattices.  Renders of less than
      some 60 samples have no such second pass and equal numbers.  The sensor needs the samples of this plugin, and a
      film in the resolution of the image a box filter.  Images that end by ``error``, passes of a given size, images by
      several workers and images above half a million pixels (a million in their own resolution) have equal numbers.
    - Fine films: where an image is denoised at twice its resolution, the rays of a pixel share two fifths of the light
      of virtual lights, in proportion to the light that they reflect.  The sum over the pixel is the same, and this
      light is slightly blurred inside the pixel.  With another filter than a box, this changes pixels at edges a
      little.  With ``layers`` or ``light_groups``, rays share no light.
    - Light through masks and thin glass: shadow rays to area emitters and environments pass these surfaces, as far as
      ``max_depth`` allows, and multiple importance sampling combines them with the paths that find the same light.
      Where such light is rare, shadow rays take up to a tenth more time for little.
    - Panes and lamps in glass: shadow rays pass smooth ``dielectric`` (``glass`` in ``statistics``), or up to five
      eighths of the paths at a surface go to balls around glass and mirrors (``relays``), where such light makes a
      tenth of the noise and pilots show that they remove it.  Paths do not go to glass in shape groups and
      ``principled`` glass.  Shadow rays pass no glass on CUDA.  Light of points and directions is found as in ``path``.
    - Masks: the image is that of ``prb``.  ``path`` (Mitsuba 3.9.1) shows black for samples whose path ends after it
      passed only masks, so it is too dark where nothing is behind a mask.  With ``hide_emitters``, ``path`` hides an
      environment behind a mask, which ``manylights`` shows.  Alpha is that of ``path``.
    - Surfaces only: the plugin refuses a scene with a participating medium.
    - ``*_rgb`` and ``*_mono`` variants only.  No recording by ``dr.freeze``.
    - Materials and emitters: all that ``path`` renders.  Paths alone trace the light of metals, of bump and normal maps
      within blends and masks or beyond 45 degrees, and light that passes a mask or thin glass between x1 and x2.

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
            "Whether virtual lights may carry indirect light and the light of many emitters, where they pay. Otherwise "
            "paths trace all light.",
        ),
        Boolean(
            "keep_lights", False,
            "Whether the integrator keeps the virtual lights of a seed for its next image with that seed, while only "
            "the sensors of the scene change.",
        ),
        Boolean(
            "denoised", False,
            "Whether the image will be denoised. Denoisers keep noise that neighbouring pixels share, so there are "
            "more virtual lights, up to twice as many, and c is larger. Denoisers also leave errors at edges, which "
            "virtual lights do not reduce, so only lights that remove much of the variance are used. "
            "``manylights.render`` gives more samples to pixels where the denoiser leaves noise. The raw image has the "
            "same mean, and 1.2 to 1.7 times the variance × time in rooms, up to three times where raw images alone "
            "have virtual lights.",
        ),
        Boolean(
            "stratified", True,
            "Whether the plugin stratifies the samples in a pixel, on the lens and in time if the sensor's sampler is "
            "``independent``, Mitsuba's default. Other samplers, and the sensor ``batch``, keep their samples.",
        ),
        Words(
            "layers", "",
            "Parts of the image as additional channels: {allowed}, the light of paths with one, two, and more edges, "
            "as ``max_depth`` counts them.",
            words=LENGTHS,
        ),
        Groups(
            "light_groups", "",
            "Groups of emitters whose light becomes additional channels, such as ``lamps=lamp*,bulb; sky=env``: names "
            "and patterns. An emitter belongs to the first group of which a pattern is equal to its id, the id of its "
            "shape, or its class, such as ``SunskyEmitter``; ``*`` and ``?`` stand for any characters. The remaining "
            f"emitters are the group ``{OTHER}``.",
            reserved=_RESERVED,
        ),
    )  # fmt: skip

    renders_in_parts = True

    def __init__(self, props, cost_model: CostModel | None = None):
        super().__init__(props)
        if self.keep_lights and self.light_groups:
            raise ValueError(
                f'{props.plugin_name()}: properties "keep_lights" and "light_groups" exclude each other: kept lights '
                "do not follow changes of ids"
            )
        self.cost_model, self._kept = cost_model or CostModel(), KeptLights()

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the image, by ``prb``: a tensor of the shape of the image, see :meth:`_adjoint` for errors.

        ``params``: parameters with derivatives; ``sensor``: a sensor or its index; ``spp``: 0 for that of the sampler.
        """
        with self._adjoint(scene, sensor) as (prb, sensor):
            derivative = prb.render_forward(scene, params, sensor, seed, spp)
        return derivative if self.max_depth > 0 else dr.zeros(mi.TensorXf, derivative.shape)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add the derivatives of parameters for those of the image, ``grad_in``, by ``prb``; otherwise as
        :meth:`render_forward`."""
        with self._adjoint(scene, sensor) as (prb, sensor):
            # prb shows emitters to paths of length 0
            if self.max_depth > 0:
                prb.render_backward(scene, params, grad_in, sensor, seed, spp)

    @contextmanager
    def _adjoint(self, scene, sensor):
        """The integrator ``prb`` with the same paths, and the sensor, which both are reserved for this thread.

        Raises RuntimeError in a variant without derivatives and while another thread renders with the same sensor,
        ValueError for a scene that is not supported and for layers.
        """
        if "_ad_" not in mi.variant():
            raise RuntimeError(
                f'manylights: the variant "{mi.variant()}" has no derivatives: set one that has, such as llvm_ad_rgb'
            )
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        if self._layer_names:
            raise ValueError('manylights: images with "layers" or "light_groups" have no derivatives; leave these out')
        with exclusive(sensor=sensor, integrator=self), garbage_kept():
            self.check_scene(scene)
            # prb counts with 32 bits
            depth = self.max_depth if self.max_depth <= NO_LIMIT else -1
            paths = {"max_depth": depth, "rr_depth": self.rr_depth, "hide_emitters": self.hide_emitters}
            yield mi.load_dict({"type": "prb", **paths}), sensor

    def aov_names(self):
        """Names of the channels of layers."""
        channels = "Y" if mi.is_monochromatic else "RGB"
        layers = [*self._layer_names, *([HALF] if self._pass.half else [])]
        return [f"{layer}.{channel}" for layer in layers for channel in channels]

    @property
    def _layer_names(self) -> list[str]:
        """Names of the requested layers."""
        return [*self.layers, *self.light_groups, *([OTHER] if self.light_groups else [])]

    def _render(self, scene, sensor, seed, spp, develop, evaluate):
        if self._layer_names:
            _require_unit_weight(sensor)
        density, continued, parts = self._pass.density, self._pass.continued, self.parts_of(sensor)
        with stratified(sensor, spp, density, parts, continued) if self.stratified else nullcontext(sensor) as chosen:
            return super()._render(scene, chosen, seed, spp, develop, evaluate)

    def _sample(self, scene, sampler, ray, active):
        if self._layer_names and self._sensor is None:
            raise ValueError(
                "manylights: layers are not rendered below a wrapper such as aov or moment, which names channels in "
                "another order (Mitsuba 3.9.1)"
            )
        clock, shared = Clock(Stage.SCENE), self._pass.shared
        known = shared.start if shared else None
        if shared and known is None and not self._pass.makes_start:
            raise RuntimeError("the start of the first pass is missing: render the first pass before later ones")
        cells = self._cells(scene, sampler, dr.width(ray))
        view = self._view(scene, sampler, ray, active, cells, known)
        clock.begin(Stage.PILOT)
        start = known or make_start(view, self.virtual_lights)
        if shared:
            shared.start = start
        if not self._pass.makes_image:
            none = [dr.zeros(mi.Float, view.count) for _ in self.aov_names()]
            return dr.zeros(mi.Spectrum, view.count), dr.zeros(mi.Bool, view.count), none
        kept = self._kept if self.keep_lights else None
        before = start.measured
        found = estimate(view, start, kept, self.stopped, clock)
        # Later passes share the pilot and its measurements
        self.statistics = found.statistics | {"pilots": int(known is None), "measured": start.measured - before}
        # Mitsuba's passes of `samples_per_pass` have the same size in larger renders
        if shared and self.samples_per_pass == NO_LIMIT:
            sizes = sorted({max(round(times * view.samples), 1) for times in _OTHER_SIZES})
            self.statistics["costs"] = [(size / view.samples, found.decision.costs(size)) for size in sizes]
        channels = [channel for name in self._layer_names for channel in found.layers[name]]
        if self._pass.half:
            number = cells.rays.places(dr.arange(mi.UInt32, view.count)).number
            half = half_of(number, dr.opaque(mi.UInt32, cells.rays.cells))
            channels += list(dr.select(half == 1, 2 * found.radiance, 0))
        if cells.is_plain:
            return mi.Spectrum(found.radiance), found.valid, channels
        channels = [cells.evenly(channel) for channel in channels]
        valid = cells.evenly_masked(found.valid, derived_seed(view.seed, Stream.ALPHA))
        return mi.Spectrum(cells.evenly(found.radiance)), valid, channels

    def _cells(self, scene, sampler, count: int) -> FilmCells:
        """The cells of the film for ``count`` camera rays."""
        if isinstance(sampler, LatticeSampler) and sampler.cells:
            return sampler.cells
        grid = self.pixel_grid(scene, sampler)
        return FilmCells(PixelRays.uniform(-(-count // grid.samples), grid.samples), grid.width)

    def _view(self, scene, sampler, ray, active, cells: FilmCells, known: Start | None) -> View:
        number = dr.detach(sampler.next_1d())
        bits = dr.reinterpret_array(mi.UInt32, number)
        # Renders with different numbers of samples share kept lights
        seed = sampler.pass_seed if isinstance(sampler, LatticeSampler) else int(bits[0])
        count, pixels = dr.width(ray), cells.rays.pixels
        dr.make_opaque(ray, active)
        learning = planned = count
        if shared := self._pass.shared:
            # A shared start serves larger passes, too
            usual = max(count, _SHARED_SAMPLES * pixels)
            learning = max(usual, shared.learning)
            # For many pixels and little time, 16 samples of each would be more than the render has
            planned = max(count, shared.rays, min(usual, self.cost_model.root_from))
        groups = EmitterGroups(scene, self.light_groups) if self.light_groups and not known else None
        emitters = known.emitters if known else emitter_sampler(scene, learning_rays(learning), groups)
        return View(
            scene, emitters, Minorants(emitters.traits.materials),
            PathRules(self.max_depth, self.rr_depth, self.hide_emitters), ray, active, cells.width, cells.rays, seed,
            dr.opaque(mi.Float, 1.0, pixels), dr.opaque(mi.UInt32, 1, pixels), OutgoingRadiance.unknown(), learning,
            planned, self.cost_model if self.denoised else self.cost_model.without_denoiser(),
            Layers(bool(self.layers), emitters.groups),
        )  # fmt: skip


def _require_unit_weight(sensor) -> None:
    """Raise ValueError for a sensor whose rays have a weight, by which Mitsuba multiplies the image and no layer."""
    _, weight = sensor.sample_ray_differential(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    if not dr.allclose(mi.unpolarized_spectrum(weight), 1):
        raise ValueError(
            f'manylights: properties "layers" and "light_groups" need a sensor whose rays have the weight 1, such as '
            f"perspective or thinlens, got {sensor.class_name()}"
        )


mi.register_integrator("manylights", ManyLightsIntegrator)
