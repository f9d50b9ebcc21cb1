"""Albedo, normal and depth of the first surfaces that are neither mirror nor glass.

They guide the denoiser, and are layers of images on request. They have about twice the samples of the image, but at
least 16 and at most 128 per pixel; if time is limited, 16 and up to 128 more in 6% of the limit.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.garbage import garbage_kept
from vpl.core.loops import recorded_once
from vpl.core.materials import Materials
from vpl.core.sampling import derived_seed, independent_sampler
from vpl.core.shapes import SceneShapes

from .fine_film import fine_film
from .images import planes_of
from .single_pass import sample_count

# Fewest and most samples per pixel. 144 instead of 16: denoised error 4, 6 and 10% less in images of 4, 16 and 64
# samples, both without a filter (decisions.md)
FEATURE_SPP = 16, 128
# Samples per pixel of a render: squares, to which some of Mitsuba's samplers round, and powers of two, which share a
# kernel that compiles for 0.5 s in kitchen
AT_ONCE = 64, 16, 4, 1
# Most samples of an image rendered at once with the first number and with the others, some 100 bytes each
FEATURE_WAVEFRONTS = 1 << 22, 1 << 25
# A sample of a path takes 20 to 25 times as long. Features and image gain equally by more time if the features have
# about twice the samples of the image (decisions.md), which take a tenth of its time with the first ones
PER_SAMPLE = 2
FEATURE_SHARE = 0.06  # of a time limit, for the samples after the first ones
FEATURE_SEED = 0xFEA7  # combined with the seed of the image, to avoid correlated noise
DEEPEST = 16  # interactions with mirrors, panes and masks
# Channels of each feature; the names are those of Cycles' layers
FEATURES = {"albedo": ("R", "G", "B"), "normal": ("X", "Y", "Z"), "depth": ("Z",)}
# Least and largest value of each; a filter with negative weights goes beyond those of samples
RANGES = {"albedo": (0, 1), "normal": (-1, 1), "depth": (0, np.finfo(np.float32).max)}


def channels_of(names):
    """Return the names of the channels of features, in order. Raises ValueError for a name that is not in `FEATURES`,
    for a repeated name, and for a string in place of a sequence of names."""
    if isinstance(names, str) or not set(names) <= set(FEATURES) or len(set(names)) < len(names):
        raise ValueError(
            f"layers must be a list of distinct names out of {', '.join(FEATURES)}, got {names!r} (layers of light are "
            "properties of the integrator manylights)"
        )
    return [f"{name}.{channel}" for name in names for channel in FEATURES[name]]


@dataclass
class Layers:
    """Features that an image has as additional channels: `planes` (height, width, channels) float32, names of the
    `channels`, and samples per pixel `spp`."""

    planes: np.ndarray
    channels: list
    spp: int

    @classmethod
    def of(cls, names: Sequence[str], features: dict, spp: int):
        """Layers by the `names` of features, a dict as of `auxiliary_features` with `spp` samples per pixel."""
        return cls(np.concatenate([features[name] for name in names], axis=-1), channels_of(names), spp)

    def added_to(self, image):
        """Return an image (height, width, channels) with these channels after its own."""
        return np.concatenate((image, self.planes), axis=-1)


def check_layers(layers, integrator):
    """Raise ValueError for `layers` that are not names of features, and for those that the integrator has."""
    if own := set(channels_of(layers)) & set(integrator.aov_names()):
        raise ValueError(f"layers must not name channels of the integrator, got {', '.join(sorted(own))}")


def layers_of(names, scene, sensor, denoiser, **of_image):
    """Return the `Layers` with some `names` for a sensor (an index), None for no names: those of the denoiser if there
    is one. `of_image`: see `features_of`."""
    if not names:
        return None
    if denoiser:
        return Layers.of(names, denoiser.merged_features, denoiser.feature_spp)
    return Layers.of(names, *features_of(scene, scene.sensors()[sensor], **of_image))


def hides_emitters(integrator):
    """Return whether an integrator hides emitters from the camera. Mitsuba does not tell this of the integrator inside
    a wrapper such as `moment`, nor of one that traces light from the emitters."""
    return getattr(integrator, "hide_emitters", False)


def features_of(scene, sensor, seed=0, spp=None, time_limit=None, parts=1, hide_emitters=False):
    """Return (the features of an image, a dict as of `auxiliary_features`; samples per pixel). `sensor`: a `mi.Sensor`;
    `seed`, `spp`, `time_limit`: of the image, None if unlimited; `parts`, `hide_emitters`: see `auxiliary_features`."""
    fewest, most = FEATURE_SPP
    wanted = most if spp is None else min(max(PER_SAMPLE * spp, fewest), most)
    if time_limit is None:
        return auxiliary_features(scene, sensor, wanted, seed, parts, hide_emitters)
    # The first samples tell the time of the others; compilation counts, because people wait for it
    begin = time.perf_counter()
    first = auxiliary_features(scene, sensor, fewest, seed, parts, hide_emitters)
    spent = time.perf_counter() - begin
    possible = min(FEATURE_SHARE * time_limit / spent * fewest, most if spp is None else wanted - fewest)
    if possible < fewest:
        return first
    more = auxiliary_features(scene, sensor, int(possible), derived_seed(seed, 1), parts, hide_emitters)
    return _mean_of([first, more])


def _mean_of(renders):
    """Return the mean of (images by name, samples) by samples, and the sum of the samples."""
    mean, whole = {}, 0
    for one, samples in renders:
        whole += samples
        share = np.float32(samples / whole)
        # A single render is not copied
        mean = {name: mean[name] + share * (plane - mean[name]) if mean else plane for name, plane in one.items()}
    return mean, whole


def auxiliary_features(scene, sensor, spp, seed, parts=1, hide_emitters=False):
    """Render "albedo", "normal" and "depth", a dict of (height, width, channels) float32, of the first surfaces that
    are neither mirror nor glass, with the film's filter and about `spp` samples per pixel; `sensor` is a `mi.Sensor`.
    Samples rendered at once are stratified if the sensor's sampler is `independent`. `parts`: in the resolution of a
    fine film (fine_film.py), with its filter. `hide_emitters`: of the integrator, as in Mitsuba's `prb`. Return the
    dict and the samples per pixel: `spp` rounded down to a multiple of 16, at least 16.

    Albedo, 0 to 1: directional albedo, estimated by one BSDF sample, times the throughput of mirrors and glass before
    the surface, plus emission. Normal: shading normal in world space, turned towards the viewer. Depth: length of the
    path from the near clipping distance of the camera, world units, as in Mitsuba's `aov`. All are 0 in empty
    directions.
    """
    sizes = _sizes(max(spp, FEATURE_SPP[0]), int(np.prod(sensor.film().crop_size())))
    # One after the other: large images take much memory
    with fine_film(sensor, parts):
        return _mean_of(
            (_rendered(scene, sensor, each // parts**2, (seed, part), hide_emitters), each)
            for part, each in enumerate(sizes)
        )


def _sizes(spp, pixels):
    """Return the numbers of samples per pixel that are rendered at once, of `AT_ONCE`: together `spp` rounded down to a
    multiple of 16. Images of a fine film have few enough `pixels` for 16."""
    (large, *others), (most_of_large, most) = AT_ONCE, FEATURE_WAVEFRONTS
    several = spp // large if large * pixels <= most_of_large else 0
    small = next(size for size in others if size * pixels <= most or size == others[-1])
    rest = spp - several * large
    return [large] * several + [small] * ((rest - rest % others[0]) // small)


def _rendered(scene, sensor, spp, key, hide_emitters):
    """Render the features of `auxiliary_features` at once, with `spp` samples per pixel of the sensor's film; `key`:
    integers that make the seed."""
    seed = int(np.random.SeedSequence((FEATURE_SEED, *key)).generate_state(1)[0])
    # The module belongs to the variant
    from integrators.camera_samples import stratified

    # The scene's own sensor, unless its sampler is `independent`, keeps its samples
    with stratified(sensor, spp) as wrapper, sample_count(wrapper.sampler(), spp), garbage_kept():
        integrator = _feature_integrator(mi.variant(), hide_emitters)
        mi.render(scene, sensor=wrapper, integrator=integrator, spp=spp, seed=seed)
        planes, names = planes_of(sensor.film().bitmap())
    return {name: _within(planes, names.index(channels_of([name])[0]), name) for name in FEATURES}


def _within(planes, first, name):
    """Return the feature of this name, whose channels begin with the `first` of `planes`, with finite values."""
    # Slices, as a list of indices takes three times as long
    found = np.clip(planes[..., first : first + len(FEATURES[name])], *RANGES[name])
    found[np.isnan(found)] = 0
    return found


@cache
def _feature_integrator(variant, hide_emitters):
    """Return an integrator that renders a black image with the features as AOVs. Mitsuba's base class depends on the
    variant; `variant`, the current one, is part of the cache key."""

    class FeatureIntegrator(mi.SamplingIntegrator):
        def aov_names(self):
            return channels_of(list(FEATURES))

        def sample(self, scene, sampler, ray, medium=None, active=True):
            # Stratified numbers are for camera rays alone
            number = sampler.next_1d()
            own = independent_sampler(int(dr.reinterpret_array(mi.UInt32, number)[0]), dr.width(number))
            materials = Materials.of(SceneShapes.of(scene))
            hides = dr.opaque(mi.Bool, self.hide_emitters)
            first = _first_rough_surface(scene, materials, own, mi.Ray3f(ray), mi.Bool(active), hides)
            albedo, normal, depth, valid = first
            finite = dr.all(dr.isfinite(albedo)) & dr.all(dr.isfinite(normal)) & dr.isfinite(depth)
            albedo, normal = dr.select(finite, dr.minimum(albedo, 1), 0), dr.select(finite, normal, 0)
            return mi.Spectrum(0), valid, [*albedo, *normal, dr.select(finite, depth, 0)]

    properties = mi.Properties()
    properties["hide_emitters"] = hide_emitters
    return FeatureIntegrator(properties)


@recorded_once
@dr.syntax
def _first_rough_surface(scene, materials: Materials, sampler, ray, active, hides):
    """Trace camera rays through mirrors, glass and masks; return albedo, normal, depth, and the mask of hits. `hides`:
    whether emitters are hidden from the camera."""
    throughput, bounces = mi.Color3f(1), mi.UInt32(0)
    albedo, normal, valid = mi.Color3f(0), mi.Normal3f(0), mi.Bool(False)
    depth, length = mi.Float(0), mi.Float(0)
    while dr.hint(active, exclude=[scene, materials, hides]):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=bounces == 0, active=active)
        hit = active & si.is_valid()
        length += dr.select(hit, si.t, 0)
        emitter = si.emitter(scene)
        hidden = hides & (bounces == 0) & (emitter != None)  # noqa: E711
        albedo += throughput * _three(emitter.eval(si, active & ~hidden))
        bsdf = si.bsdf(ray)
        numbers = sampler.next_1d(hit), sampler.next_2d(hit)
        sample, weight = materials.sample(bsdf, si, *numbers, hit)
        throughput = dr.select(hidden, throughput, throughput * _three(weight))
        # A surface with a delta and a smooth lobe, such as plastic, counts by its smooth lobe
        smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        passed = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        onward = hit & (passed | (mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & ~smooth))
        onward |= hit & hidden
        ends = hit & ~onward
        albedo[ends] += throughput
        normal[ends] = mi.Normal3f(dr.mulsign(si.sh_frame.n, si.wi.z))
        depth[ends] = length
        valid |= hit & ~hidden
        ray = si.spawn_ray(dr.select(hidden, ray.d, si.to_world(sample.wo)))
        bounces += dr.select(hidden, 0, 1)
        active = onward & (bounces < DEEPEST)
    return albedo, normal, depth, valid


def _three(value):
    """Convert a spectrum to three channels; without RGB, the mean over the wavelengths."""
    value = mi.unpolarized_spectrum(value)
    return mi.Color3f(value) if mi.is_rgb else mi.Color3f(dr.mean(value))
