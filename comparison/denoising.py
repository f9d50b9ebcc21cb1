"""Denoising by Open Image Denoise on the CPU, guided by albedo and shading normal.

Requires the package `mitsuba-oidn` (`pip install 'manylights[denoise]'`). Albedo and normal come from features.py. The
denoiser treats them as noise-free: with 16 samples or more, that leaves less error than filters that remove their noise
first ("prefiltering"), each of which takes as long as the denoiser itself (docs/decisions.md).

Images are denoised at twice their resolution (fine_film.py) where time and memory allow. The denoiser mistakes noise
correlated between pixels for detail, so the wide reconstruction filter of a film follows afterwards.
"""

import math
import time
from functools import cached_property

import mitsuba as mi
import numpy as np

from .features import features_of
from .fine_film import merged
from .images import colour
from .scene_files import known_parameters

GUIDES = ("albedo", "normal")  # features that the denoiser uses
QUALITIES = ("high", "balanced", "fast")  # of Open Image Denoise: networks of three sizes
# Error of images denoised by each of them, at the usual and at twice the resolution, over that by "high" at the usual
# resolution (decisions.md)
ERRORS = {
    1: dict(zip(QUALITIES, (1.0, 1.12, 1.26), strict=True)),
    2: dict(zip(QUALITIES, (0.76, 0.83, 0.92), strict=True)),
}
# Time of each network for a pixel, over that of a sample of `path`: kitchen and living_room
SAMPLES = dict(zip(QUALITIES, (3.2, 1.4, 0.75), strict=True))
# Denoised errors fall by this factor where samples double: mean of the scenes with references, of 1.15 to 1.6
FALL = 1.37
POWER = -math.log2(FALL)  # of the samples, to which denoised errors are proportional
# Fraction of the remaining time below which the best network is not compared: all of it would lower the error by 10%
NEGLIGIBLE = 0.2
# Largest fraction of a limit of time for the fastest network at twice the resolution. From a half, less error would
# remain in the usual resolution; a first pass, of four samples, takes 1.3 times as long as the network
FINE_SHARE = 1 / 3
# Width of the tile whose denoising is timed, pixels; least fraction of the seconds of the image that it takes, within
# limits in seconds; smaller tiles are doubled. On two cores a tile of 64 takes 0.013 s, and a pixel of it 1.05 to 1.2
# times as long as one of an image of 256 to 1920. A third of these measurements are up to twice as long as the others
TILE, TILE_SHARE, TILE_SECONDS = 64, 0.01, (0.005, 0.05)


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
    """Return the quality that the value of a parameter `denoise` names, None for True. Raises ValueError for a string
    that is not one of `QUALITIES`."""
    if not isinstance(denoise, str):
        return None
    if denoise not in QUALITIES:
        raise ValueError(f"denoise must be True, False or one of {', '.join(QUALITIES)}, got {denoise!r}")
    return denoise


class Denoiser:
    """Denoises images of a scene by one of its sensors (an index).

    `spp`, `time_limit`: samples per pixel and seconds of the image, None if unlimited; they limit the samples of the
    `features`, a dict as of `auxiliary_features`. `feature_spp`: samples per pixel of the features. `seconds`: time
    spent so far, of which `start_seconds` in the constructor, which renders the features. `expected_seconds`: estimated
    time of a call of `denoise_fine`. `parts`: of the film of the images, see fine_film.py; becomes 1 if the network
    `quality`, or else the fastest one, would take more than a third of the `time_limit`. `quality`: one of `QUALITIES`;
    by default the one that leaves the least error, as the time that it saves is for samples. With `parts` of 1 and no
    time limit it is the best one.
    """

    def __init__(self, scene, sensor=0, seed=0, spp=None, time_limit=None, quality=None, parts=1):
        self._oidn, begin = import_oidn(), time.perf_counter()
        self._networks = {name: getattr(self._oidn.Quality, name.capitalize()) for name in QUALITIES}
        self._device = self._oidn.Device(self._oidn.DeviceType.CPU)
        one = scene.sensors()[sensor]
        self._filter, self._size = one.film().rfilter(), np.array(one.film().crop_size(), np.int64)
        self.parts, self._known = parts, {}  # (parts, quality) -> expected seconds
        if parts > 1 and time_limit is not None:
            # The time of a network is that of its tiles at the resolution of `parts`
            is_quick = self._expected(quality or QUALITIES[-1]) <= FINE_SHARE * time_limit
            self.parts = parts if is_quick else 1
        self.features, self.feature_spp = features_of(scene, one, seed, spp, time_limit, self.parts)
        self.quality = quality or self._usual_quality(spp, time_limit)
        self.expected_seconds = self._expected(self.quality)
        if time_limit is not None and not quality:
            self._choose(time_limit - (time.perf_counter() - begin))
        self.seconds = self.start_seconds = time.perf_counter() - begin

    @property
    def description(self):
        """Return metadata for denoised images."""
        return {
            "denoise_quality": self.quality, "denoise_feature_spp": self.feature_spp, "denoise_resolution": self.parts,
        }  # fmt: skip

    def denoise(self, image, channels, quality=None):
        """Denoise the colour of an image (height, width, channels) in the resolution of its sensor's film. Keeps its
        other channels, and treats non-finite pixels as black. `quality`: one of `QUALITIES`, by default that of the
        denoiser."""
        return self._denoised(image, channels, quality, self.merged_features)

    def denoise_fine(self, image, channels):
        """Denoise the colour of an image in the resolution of the fine film, as `denoise`; return the image in the
        resolution of the sensor's film."""
        return merged(self._denoised(image, channels, None, self.features), self.parts, self._filter)

    @cached_property
    def merged_features(self):
        """Features in the resolution of the sensor's film, a dict as of `auxiliary_features`."""
        return {name: merged(plane, self.parts, self._filter) for name, plane in self.features.items()}

    def _denoised(self, image, channels, quality, features):
        begin = time.perf_counter()
        names = ("R", "G", "B") if "R" in channels else ("Y",)
        planes = np.array(image, np.float32)
        rgb = np.nan_to_num(colour(planes, channels), nan=0.0, posinf=0.0, neginf=0.0)
        network = self._networks[quality or self.quality]
        filtered = self._filtered({"color": rgb, **{name: features[name] for name in GUIDES}}, network)
        where = [list(channels).index(name) for name in names]
        planes[..., where] = filtered if len(where) == 3 else filtered.mean(axis=-1, keepdims=True)
        self.seconds += time.perf_counter() - begin
        return type(image)(planes) if isinstance(image, mi.TensorXf) else planes

    def _usual_quality(self, spp, time_limit):
        """Return the quality that leaves the least error for `spp` samples and the time of the denoiser."""
        if self.parts == 1 or spp is None or time_limit is not None:
            return QUALITIES[0]
        taken = {name: self.parts**2 * SAMPLES[name] for name in QUALITIES}
        # The image with other samples that would take as long as with a network without cost
        errors = {name: ERRORS[self.parts][name] * (spp + taken[name]) ** -POWER for name in QUALITIES}
        return min(errors, key=errors.get)

    def _choose(self, left):
        """Choose the quality that leaves the least error `left` seconds before the limit."""
        if self.expected_seconds < NEGLIGIBLE * left:
            return
        others = {name: self._expected(name) for name in QUALITIES if name != self.quality}
        seconds, known = {self.quality: self.expected_seconds} | others, ERRORS[self.parts]
        errors = {name: known[name] * (left - spent) ** POWER for name, spent in seconds.items() if spent < left}
        self.quality = min(errors, key=errors.get, default=QUALITIES[-1])
        self.expected_seconds = seconds[self.quality]

    def _expected(self, quality):
        """Return the seconds that denoising an image is expected to take."""
        if (self.parts, quality) not in self._known:
            self._known[self.parts, quality] = self._expected_by_tiles(quality)
        return self._known[self.parts, quality]

    def _expected_by_tiles(self, quality):
        """Return the seconds that denoising an image is expected to take, by the time of a tile of it."""
        columns, rows = self.parts * self._size

        def tile(width):
            return {name: np.full((min(width, rows), min(width, columns), 3), 0.5) for name in ("color", *GUIDES)}

        # The first call loads the weights of the network
        self._seconds_of(tile(TILE), quality)
        width, whole = TILE, int(rows * columns)
        while True:
            inputs = tile(width)
            seconds, size = self._seconds_of(inputs, quality), int(np.prod(inputs["color"].shape[:2]))
            if size == whole or seconds >= np.clip(TILE_SHARE * seconds * whole / size, *TILE_SECONDS):
                # A large image multiplies the error of a single measurement
                return min(seconds, self._seconds_of(inputs, quality)) * whole / size
            width *= 2

    def _seconds_of(self, inputs, quality):
        """Return the seconds that denoising takes."""
        begin = time.perf_counter()
        self._filtered(inputs, self._networks[quality])
        return time.perf_counter() - begin

    def _filtered(self, inputs, quality):
        """Filter "color" of `inputs` (name -> (height, width, 3) float32), guided by "albedo" and "normal"."""
        arrays = {name: np.ascontiguousarray(plane, np.float32) for name, plane in inputs.items()}
        output = np.empty_like(arrays["color"])
        network = self._device.new_filter("RT")
        for name, plane in (*arrays.items(), ("output", output)):
            network.set_image(name, plane)
        network.quality, network.hdr, network.clean_aux = quality, True, True
        network.execute()
        return output


def for_denoising(integrator, parameters):
    """Return the parameters of an integrator whose images will be denoised: with `denoised`, if the integrator has this
    property and it is not given."""
    usual = {"denoised": True}
    return usual | parameters if known_parameters(integrator, usual) else parameters
