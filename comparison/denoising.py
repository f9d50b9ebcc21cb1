"""Denoising by Open Image Denoise on the CPU, guided by albedo and shading normal.

Requires the package `mitsuba-oidn` (`pip install 'manylights[denoise]'`). Albedo and normal belong to the first surface
that is neither mirror nor glass. They have as many samples as the image, but at least 16 and at most 64 per pixel; if
time is limited, 16 and up to 64 more in a twenty-fifth of the limit. A separate filter removes the remaining noise
("prefiltering"), so that the denoiser can treat them as noise-free.

The denoiser mistakes noise correlated between pixels for detail: a wide reconstruction filter of the film gives worse
results than a box filter.
"""

import math
import time
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.garbage import garbage_kept
from vpl.core.sampling import derived_seed, independent_sampler

from .images import colour
from .scene_files import known_parameters

# Fewest and most samples per pixel: squares, to which some of Mitsuba's samplers round
FEATURE_SPP = 16, 64  # 64 instead of 16: denoised error 2 to 10% less in four scenes (decisions.md)
FEATURE_WAVEFRONT = 1 << 22  # most samples of an image rendered at once, some 400 MB, or the fewest per pixel
FEATURE_SHARE = 0.04  # of a time limit; the samples of a path take about 25 times as long
FEATURE_SEED = 0xFEA7  # combined with the seed of the image, to avoid correlated noise
QUALITIES = ("high", "balanced", "fast")  # of Open Image Denoise: networks of three sizes
DEEPEST = 16  # interactions with mirrors, panes and masks
FEATURES = ("albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y", "normal.Z")


def import_oidn():
    """Import `mitsuba_oidn`; raises a ModuleNotFoundError that states the command to install it."""
    try:
        import mitsuba_oidn
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "denoising needs the package 'mitsuba_oidn'; pip install 'manylights[denoise]' brings it"
        ) from None
    return mitsuba_oidn


def quality_of(denoise):
    """Return the quality that the value of a parameter `denoise` names, the best one for True. Raises ValueError for a
    string that is not one of `QUALITIES`."""
    if not isinstance(denoise, str):
        return QUALITIES[0]
    if denoise not in QUALITIES:
        raise ValueError(f"denoise must be True, False or one of {', '.join(QUALITIES)}, got {denoise!r}")
    return denoise


class Denoiser:
    """Denoises images of a scene by one of its sensors (an index).

    `spp`, `time_limit`: samples per pixel and seconds of the image, None if unlimited; they limit the samples of albedo
    and normal. `feature_spp`: samples per pixel of albedo and normal. `seconds`: time spent so far, including albedo
    and normal, which the constructor renders. `filter_seconds`: estimated time of a call of `denoise`. `quality`: one
    of `QUALITIES`.
    """

    def __init__(self, scene, sensor=0, seed=0, spp=None, time_limit=None, quality=QUALITIES[0]):
        self._oidn, begin = import_oidn(), time.perf_counter()
        self.quality, self._network = quality, getattr(self._oidn.Quality, quality.capitalize())
        self._device = self._oidn.Device(self._oidn.DeviceType.CPU)
        features, self.feature_spp = _features(scene, scene.sensors()[sensor], seed, spp, time_limit)
        filtering = time.perf_counter()
        self._features = {name: self._filtered({name: plane}) for name, plane in features.items()}
        end = time.perf_counter()
        self.seconds, self.filter_seconds = end - begin, end - filtering

    @property
    def description(self):
        """Return metadata for denoised images."""
        return {"denoise_quality": self.quality, "denoise_feature_spp": self.feature_spp}

    def denoise(self, image, channels):
        """Denoise the colour of an image (height, width, channels). Keeps its other channels, and treats non-finite
        pixels as black."""
        begin = time.perf_counter()
        names = ("R", "G", "B") if "R" in channels else ("Y",)
        planes = np.array(image, np.float32)
        rgb = np.nan_to_num(colour(planes, channels), nan=0.0, posinf=0.0, neginf=0.0)
        filtered = self._filtered({"color": rgb, **self._features}, hdr=True, clean_aux=True)
        where = [list(channels).index(name) for name in names]
        planes[..., where] = filtered if len(where) == 3 else filtered.mean(axis=-1, keepdims=True)
        self.seconds += time.perf_counter() - begin
        return type(image)(planes) if isinstance(image, mi.TensorXf) else planes

    def _filtered(self, inputs, **settings):
        """Filter the first image of `inputs` (name -> (height, width, 3) float32), guided by the remaining ones."""
        arrays = {name: np.ascontiguousarray(plane, np.float32) for name, plane in inputs.items()}
        output = np.empty_like(next(iter(arrays.values())))
        network = self._device.new_filter("RT")
        for name, plane in (*arrays.items(), ("output", output)):
            network.set_image(name, plane)
        for name, value in ({"quality": self._network} | settings).items():
            setattr(network, name, value)
        network.execute()
        return output


def _features(scene, sensor, seed, spp, time_limit):
    """Return (albedo and normal, samples per pixel), see `Denoiser` for the limits."""
    fewest, most = FEATURE_SPP
    wanted = most if spp is None else min(max(spp, fewest), most)
    if time_limit is None:
        return auxiliary_features(scene, sensor, math.isqrt(wanted) ** 2, seed)
    # The first samples tell the time of the others; compilation counts, because people wait for it
    begin = time.perf_counter()
    first = auxiliary_features(scene, sensor, fewest, seed)
    spent = time.perf_counter() - begin
    # Mitsuba's stratified samplers round to squares
    possible = min(FEATURE_SHARE * time_limit / spent * fewest, most if spp is None else wanted - fewest)
    if possible < fewest:
        return first
    more = auxiliary_features(scene, sensor, math.isqrt(int(possible)) ** 2, derived_seed(seed, 1))
    return _mean_of([first, more])


def _mean_of(renders):
    """Return the mean of (images by name, samples) by samples, and the sum of the samples."""
    whole = sum(samples for _, samples in renders)
    return {name: sum(samples / whole * one[name] for one, samples in renders) for name in renders[0][0]}, whole


def auxiliary_features(scene, sensor, spp, seed):
    """Render "albedo" and "normal", a dict of (height, width, 3) float32, of the first surfaces that are neither mirror
    nor glass, with the film's filter and at least `spp` samples per pixel; `sensor` is a `mi.Sensor`. The samples are
    stratified if the sensor's sampler is `independent`. Return the dict and the samples per pixel, which are more only
    in large images.

    Albedo, 0 to 1: directional albedo, estimated by one BSDF sample, times the throughput of mirrors and glass before
    the surface, plus emission. Normal: shading normal in world space, turned towards the viewer. Both are 0 in empty
    directions.
    """
    fewest, pixels = FEATURE_SPP[0], int(np.prod(sensor.film().crop_size()))
    each, parts = (spp, 1) if spp * pixels <= FEATURE_WAVEFRONT else (fewest, math.ceil(spp / fewest))
    return _mean_of([(_rendered(scene, sensor, each, (seed, part)), each) for part in range(parts)])


def _rendered(scene, sensor, spp, key):
    """Render the features of `auxiliary_features` at once; `key`: integers that make the seed."""
    seed = int(np.random.SeedSequence((FEATURE_SEED, *key)).generate_state(1)[0])
    # The module belongs to the variant
    from integrators.camera_samples import stratified

    with stratified(sensor, spp) as wrapper, garbage_kept():
        mi.render(scene, sensor=wrapper, integrator=_feature_integrator(mi.variant()), spp=spp, seed=seed)
    bitmap = sensor.film().bitmap()
    names = [entry.name for entry in bitmap.struct_()]
    planes = np.array(bitmap, np.float32).reshape(bitmap.size()[1], bitmap.size()[0], -1)
    features = np.nan_to_num(planes[..., [names.index(name) for name in FEATURES]])
    return {"albedo": np.clip(features[..., :3], 0, 1), "normal": np.clip(features[..., 3:], -1, 1)}


@cache
def _feature_integrator(variant):
    """Return an integrator that renders a black image with albedo and normal as AOVs. Mitsuba's base class depends on
    the variant; `variant`, the current one, is the cache key."""

    class FeatureIntegrator(mi.SamplingIntegrator):
        def aov_names(self):
            return list(FEATURES)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            # Stratified numbers are for camera rays alone
            number = sampler.next_1d()
            own = independent_sampler(int(dr.reinterpret_array(mi.UInt32, number)[0]), dr.width(number))
            albedo, normal, valid = _first_rough_surface(scene, own, mi.Ray3f(ray), mi.Bool(active))
            finite = dr.all(dr.isfinite(albedo)) & dr.all(dr.isfinite(normal))
            albedo, normal = dr.select(finite, dr.minimum(albedo, 1), 0), dr.select(finite, normal, 0)
            return mi.Spectrum(0), valid, [*albedo, *normal]

    return FeatureIntegrator(mi.Properties())


@dr.syntax
def _first_rough_surface(scene, sampler, ray, active):
    """Trace camera rays through mirrors, glass and masks; return albedo, normal, and the mask of hits."""
    throughput, depth = mi.Color3f(1), mi.UInt32(0)
    albedo, normal, valid = mi.Color3f(0), mi.Normal3f(0), mi.Bool(False)
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
        hit = active & si.is_valid()
        albedo += throughput * _three(si.emitter(scene).eval(si, active))
        bsdf = si.bsdf(ray)
        sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(hit), sampler.next_2d(hit), hit)
        throughput *= _three(weight)
        # A surface with a delta and a smooth lobe, such as plastic, counts by its smooth lobe
        smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        passed = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        onward = hit & (passed | (mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & ~smooth))
        ends = hit & ~onward
        albedo[ends] += throughput
        normal[ends] = mi.Normal3f(dr.mulsign(si.sh_frame.n, si.wi.z))
        valid |= hit
        ray = si.spawn_ray(si.to_world(sample.wo))
        depth += 1
        active = onward & (depth < DEEPEST)
    return albedo, normal, valid


def _three(value):
    """Convert a spectrum to three channels; without RGB, the mean over the wavelengths."""
    value = mi.unpolarized_spectrum(value)
    return mi.Color3f(value) if mi.is_rgb else mi.Color3f(dr.mean(value))


def for_denoising(integrator, parameters):
    """Return the parameters of an integrator whose images will be denoised: with `denoised`, if the integrator has this
    property and it is not given."""
    usual = {"denoised": True}
    return usual | parameters if known_parameters(integrator, usual) else parameters
