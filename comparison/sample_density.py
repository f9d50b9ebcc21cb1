"""Numbers of samples of pixels for images that will be denoised: more where the denoiser leaves noise.

The error of a denoised image is concentrated at edges, textures, lamps and shadows, which neighbours cannot smooth.
Two halves of the samples of a pass show where: their squared difference, smoothed, and that of the halves denoised
apart. Each of them predicts the error of a denoised image, and their product does so best. Later passes have numbers of
samples in proportion to a power of the product.

A pass has a common weight for all pixels, which does not depend on their noise, and numbers that depend on earlier
passes only, so the mean of the raw image does not change.
"""

from __future__ import annotations

import time

import numpy as np

from vpl.split.pixel_rays import MULTIPLE, PixelRays

from .convergence import relative_squares, smoothed
from .images import colour, colour_indices

QUALITY = "fast"  # of the denoiser: a quarter of the time of "high", and the same error in three scenes
LEAST_SAMPLES = 8  # of a pass that determines the density: fewer leave too much noise in its halves
LUMINANCE = 0.212671, 0.715160, 0.072169  # of red, green and blue, as in Mitsuba's films of one channel
# Power of the product of both squared differences: numbers of samples are in proportion to it. Denoised error over that
# with the root of the squared difference of the denoised halves: 0.99 to 1.00 in three scenes, raw error 0.76 to 0.91.
# The optimum is flat (decisions.md)
POWER = 0.25
OUTLIERS = 0.995  # quantile of the differences that limits them: fireflies
SMOOTHED = 2  # times that differences are averaged over 5 × 5 pixels: as by a Gaussian filter of 2 pixels


class SampleDensity:
    """Samples of the pixels of a render's passes. `denoise`: function from an image (height, width, channels), the
    names of its channels and the quality "fast" to the denoised image; None for equal numbers in all passes. `parts`:
    of the film, see fine_film.py.

    `relative` (height, width): samples of a pixel over the mean, None before a pass determined them; `seconds` that the
    decision took.
    """

    def __init__(self, denoise=None, parts=1):
        self._denoise, self._parts, self.relative, self.seconds = denoise, parts, None, 0.0

    @property
    def multiple(self):
        """The samples per pixel of which passes have multiples whose pixels have different numbers."""
        return MULTIPLE * self._parts**2

    @property
    def probe_multiple(self):
        """The samples per pixel of which a pass that determines the samples has a multiple: halves of the samples of
        pixels of the film."""
        return max(MULTIPLE, 2 * self._parts**2)

    def suits(self, integrator, sensor, spp=None):
        """Return whether the pixels of a pass may have different numbers of samples, `spp` in the mean, by default as
        few as possible."""
        differs = getattr(integrator, "may_differ", lambda *_: False)
        return self._denoise is not None and differs(sensor, spp or self.multiple, self._parts)

    def suits_probe(self, integrator, sensor, spp):
        """Return whether a pass of `spp` samples per pixel may determine the samples of later passes."""
        # Halves need fewer samples than different numbers
        enough = -(-spp // self.multiple) * self.multiple
        return spp % self.probe_multiple == 0 and self.suits(integrator, sensor, enough)

    def of_pass(self, integrator, sensor, spp):
        """Return samples over their mean for the pixels of a pass, None for equal numbers."""
        return self.relative if self.suits(integrator, sensor, spp) else None

    def learn(self, image, half, channels):
        """Determine the samples from a pass: its `image` (height, width, channels), and the colour of every second
        sample, `half` (height, width, 3)."""
        begin = time.perf_counter()
        self._learn(image, half, channels)
        self.seconds += time.perf_counter() - begin

    def _learn(self, image, half, channels):
        whole = colour(image, channels)
        if len(colour_indices(channels)) == 1:
            half = half @ np.float32(LUMINANCE)[:, None]
        half = np.broadcast_to(half, whole.shape)
        halves = half, 2 * whole - half
        denoised = [self._denoise(one, ["R", "G", "B"], QUALITY) for one in halves]
        mean = 0.5 * (denoised[0] + denoised[1])
        left, noise = (_smoothed(relative_squares(*pair, mean)) for pair in (denoised, halves))
        if not (left.any() and noise.any()):
            return
        density = (left * noise) ** POWER
        numbers = PixelRays.by_density(density, MULTIPLE).numbers.reshape(density.shape)
        self.relative = numbers / MULTIPLE


def _smoothed(squares):
    """Return squared differences (height, width) without outliers, as means over neighbours."""
    squares = np.minimum(squares, np.quantile(squares, OUTLIERS))
    squares = smoothed(squares, SMOOTHED)
    # The logarithm of the density must be finite, and without this minimum, black pixels would have no samples
    return np.maximum(squares, 1e-6 * squares.max())
