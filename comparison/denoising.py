"""Denoising by Open Image Denoise on the CPU, guided by albedo and shading normal.

Requires the package `mitsuba-oidn` (`pip install 'manylights[denoise]'`). Albedo and normal come from features.py. The
denoiser treats them as noise-free: with 16 samples or more, that leaves less error than filters that remove their noise
first ("prefiltering"), each of which takes as long as the denoiser itself (docs/decisions.md).

Images are denoised at twice their resolution (fine_film.py) where time and memory allow. The denoiser mistakes noise
correlated between pixels for detail, so the wide reconstruction filter of a film follows afterwards.

Where time allows, mirrored copies of an image are denoised as well: their mean has less error of the network. Images of
many samples get back detail that the denoiser removed (detail.py).
"""

import math
import time
from functools import cached_property

import mitsuba as mi
import numpy as np

from . import detail
from .features import features_of
from .fine_film import merged
from .images import colour, colour_indices, with_colour
from .scene_files import known_parameters

GUIDES = ("albedo", "normal")  # features that the denoiser uses
QUALITIES = ("high", "balanced", "fast")  # of Open Image Denoise: networks of three sizes
# Error of images denoised by each of them, at the usual and at twice the resolution, over that by "high" at the usual
# resolution (decisions.md)
ERRORS = {
    1: dict(zip(QUALITIES, (1.0, 1.12, 1.26), strict=True)),
    2: dict(zip(QUALITIES, (0.76, 0.83, 0.92), strict=True)),
}
# Error of the mean of some denoised copies, each mirrored along other axes, over that of one copy: 60 s, four scenes
COPIES = {1: 1.0, 2: 0.95, 4: 0.934}
# Axes along which a copy is mirrored
MIRRORED = (), (0, 1), (1,), (0,)
# Networks and numbers of copies that are compared: copies by a small network leave more error in the same time than one
# by a larger one
WAYS = (*((name, 1) for name in QUALITIES), *((QUALITIES[0], copies) for copies in COPIES if copies > 1))
# Time of each network for a pixel, over that of a sample of `path`: kitchen and living_room
SAMPLES = dict(zip(QUALITIES, (3.2, 1.4, 0.75), strict=True))
# Denoised errors fall by this factor where samples double: mean of the scenes with references, of 1.15 to 1.6
FALL = 1.37
POWER = -math.log2(FALL)  # of the samples, to which denoised errors are proportional
# Fraction of the remaining time below which the best network is not compared with others: all of it would lower the
# error by 10%
NEGLIGIBLE = 0.2
# Largest fraction of a limit of time for the fastest network at twice the resolution. From a half, less error would
# remain in the usual resolution; a first pass, of four samples, takes 1.3 times as long as the network
FINE_SHARE = 1 / 3
# Largest fraction of a limit of time for the halves of an image with detail. They take as long as six samples of `path`
# at twice the resolution, and images of some 500 samples or more gain
DETAIL_SHARE = 0.01
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
    time to denoise passes. `parts`: of the film of the images, see fine_film.py; becomes 1 if the network
    `quality`, or else the fastest one, would take more than a third of the `time_limit`. `quality`: one of `QUALITIES`;
    by default the one that leaves the least error, as the time that it saves is for samples. With `parts` of 1 and no
    time limit it is the best one. `copies`: number of denoised copies, 1 by networks other than the best one.
    `hide_emitters`: of the integrator. `restores`: whether the limits allow detail (detail.py); `has_detail`: whether
    the last image of `denoise_passes` has it. `like`: another `Denoiser` of such images, whose decisions this one
    takes: `parts`, `quality`, `copies` and `restores`. It measures what that one measured, so that it takes as long.
    The argument `parts` then does not count.
    """

    def __init__(
        self, scene, sensor=0, seed=0, spp=None, time_limit=None, quality=None, parts=1, hide_emitters=False, like=None,
    ):  # fmt: skip
        self._oidn, begin = import_oidn(), time.perf_counter()
        self._networks = {name: getattr(self._oidn.Quality, name.capitalize()) for name in QUALITIES}
        self._device = self._oidn.Device(self._oidn.DeviceType.CPU)
        one = scene.sensors()[sensor]
        self._filter, self._size = one.film().rfilter(), np.array(one.film().crop_size(), np.int64)
        self.parts = self._asked_parts = parts = like._asked_parts if like else parts
        self._known = {}  # (parts, quality) -> expected seconds
        if parts > 1 and time_limit is not None:
            # The time of a network is that of its tiles at the resolution of `parts`
            is_quick = self._expected(quality or QUALITIES[-1]) <= FINE_SHARE * time_limit
            self.parts = parts if is_quick else 1
        if like:
            self.parts = like.parts
        self.features, self.feature_spp = features_of(scene, one, seed, spp, time_limit, self.parts, hide_emitters)
        ways = [way for way in WAYS if quality in (None, way[0])]
        self.quality, self.copies = self._usual_way(ways, spp, time_limit)
        if time_limit is not None:
            self._choose(ways, time_limit - (time.perf_counter() - begin))
        self._reserve(spp, time_limit)
        if like:
            self.quality, self.copies, self.restores = like.quality, like.copies, like.restores
            self.expected_seconds = like.expected_seconds
        self.seconds = self.start_seconds = time.perf_counter() - begin

    @property
    def description(self):
        """Return metadata for denoised images."""
        return {
            "denoise_quality": self.quality, "denoise_copies": self.copies, "denoise_feature_spp": self.feature_spp,
            "denoise_resolution": self.parts, "denoise_detail": self.has_detail,
        }  # fmt: skip

    def denoise(self, image, channels, quality=None):
        """Denoise the colour of an image (height, width, channels) in the resolution of its sensor's film. Keeps its
        other channels, and treats non-finite pixels as black. `quality`: one of `QUALITIES`, for a single copy; by
        default the quality and the copies of the denoiser."""
        return self._denoised(image, channels, quality, self.merged_features)

    def denoise_fine(self, image, channels, quality=None):
        """Denoise the colour of an image in the resolution of the fine film, as `denoise`; return the image in the
        resolution of the sensor's film."""
        return merged(self._denoised(image, channels, quality, self.features), self.parts, self._filter)

    def denoise_passes(self, passes):
        """Denoise the colour of the image of `rendering.Passes`, as `denoise_fine`, with detail if they suit."""
        image = self.denoise_fine(np.float32(passes.fine_image), passes.channels)
        self.has_detail = self.restores and detail.suits(passes)
        if self.has_detail:
            begin, before, where = time.perf_counter(), self.seconds, colour_indices(passes.channels)
            names = [passes.channels[index] for index in where]
            fine = [np.float32(half[..., where]) for half in passes.fine_halves]
            denoised = [self.denoise_fine(half, names, detail.QUALITY) for half in fine]
            halves = [passes.merged(half) for half in fine]
            raw, share = passes.image[..., where], passes.half_weights[0] / sum(passes.half_weights)
            image[..., where] = detail.restored(image[..., where], raw, halves, denoised, share)
            # Not twice
            self.seconds = before + time.perf_counter() - begin
        return image

    @cached_property
    def merged_features(self):
        """Features in the resolution of the sensor's film, a dict as of `auxiliary_features`."""
        return {name: merged(plane, self.parts, self._filter) for name, plane in self.features.items()}

    def _denoised(self, image, channels, quality, features):
        begin = time.perf_counter()
        planes = np.asarray(image, np.float32)
        rgb = np.nan_to_num(colour(planes, channels), nan=0.0, posinf=0.0, neginf=0.0)
        inputs = {"color": rgb, **{name: features[name] for name in GUIDES}}
        network, copies = self._networks[quality or self.quality], 1 if quality else self.copies
        filtered = sum(self._mirrored(inputs, network, axes) for axes in MIRRORED[:copies]) / np.float32(copies)
        planes = with_colour(planes, channels, filtered)
        self.seconds += time.perf_counter() - begin
        return type(image)(planes) if isinstance(image, mi.TensorXf) else planes

    def _usual_way(self, ways, spp, time_limit):
        """Return the network and the copies that leave the least error for `spp` samples and the time of the
        denoiser."""
        if spp is None or time_limit is not None:
            return ways[0]
        if self.parts == 1:
            ways = [way for way in ways if way[0] == ways[0][0]]

        def error(way):
            # Of the image with other samples that would take as long as with a network without cost
            return self._error_of(way) * (spp + self.parts**2 * way[1] * SAMPLES[way[0]]) ** -POWER

        return min(ways, key=error)

    def _error_of(self, way):
        """Return the error of a network and a number of copies for equal samples, over that of `ERRORS`."""
        return ERRORS[self.parts][way[0]] * COPIES[way[1]]

    def _choose(self, ways, left):
        """Choose the network and the copies that leave the least error `left` seconds before the limit."""
        if self._expected(ways[0][0]) < NEGLIGIBLE * left:
            ways = [way for way in ways if way[0] == ways[0][0]]
        seconds = {way: way[1] * self._expected(way[0]) for way in ways}
        errors = {way: self._error_of(way) * (left - spent) ** POWER for way, spent in seconds.items() if spent < left}
        cheapest = [way for way in ways if way[1] == 1][-1]
        self.quality, self.copies = min(errors, key=errors.get, default=cheapest)

    def _reserve(self, spp, time_limit):
        """Set the expected time, and whether the limits of the image allow detail."""
        of_image = self._expected(self.quality)
        of_halves = 2 * SAMPLES[detail.QUALITY] / SAMPLES[self.quality] * of_image
        self.has_detail, self.restores = False, spp is None or spp >= detail.LEAST_SAMPLES
        if time_limit is not None:
            self.restores &= of_halves <= DETAIL_SHARE * time_limit
        self.expected_seconds = self.copies * of_image
        # Without a limit of time, nothing is reserved
        if self.restores and time_limit is not None:
            self.expected_seconds += of_halves

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

    def _mirrored(self, inputs, network, axes):
        """Return what `_filtered` makes of inputs that are mirrored along `axes`, mirrored back."""
        turned = {name: np.flip(plane, axes) for name, plane in inputs.items()}
        return np.flip(self._filtered(turned, network), axes)

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
