"""The standard error of an image, estimated from its passes, and when to look at it.

The passes of a render are independent images of the same expectation, whatever the integrator, the sampler or the
film's filter are (a filter wider than a pixel makes neighbours alike, but not passes), so the spread of a pixel over
them says how far their average is from that expectation.
"""

from itertools import accumulate

import mitsuba as mi
import numpy as np

SHARE = 0.95  # of the pixels whose error is to be below the one that is asked for
DARK = 0.1  # of the mean of the image: darker pixels have their error relative to about that, as in relMSE
NEIGHBOURS = 2  # pixels in either direction over which variances are averaged
LEAST_PASSES = 8  # before the first look
GROWTH = 1.25  # of the samples from one look to the next


class ErrorEstimate:
    """The spread of weighted passes about their average, in double precision, of the mean over colour channels.

    With x_k the value of a pixel in pass k of w_k samples per pixel, W = Σ w_k and m = Σ w_k x_k / W, the variance of m
    is estimated by Σ w_k² (x_k − m)² / (W² − Σ w_k²). Its expectation is the variance of m where that of x_k is
    inverse to w_k, and for passes of one size whatever it depends on; it is close to it where all passes have the same
    variance in spite of their sizes, as when each has virtual lights of its own. Memory: three images of one channel,
    and the first pass, which is subtracted from all so that nothing cancels.
    """

    def __init__(self):
        self._count, self._weight, self._weight_squared = 0, 0, 0
        self._origin, self._sum, self._first_moment, self._second_moment = 0.0, 0.0, 0.0, 0.0

    def add(self, image, weight):
        """Add a pass: its colour, (height, width, 3), and its samples per pixel."""
        level = np.asarray(image, np.float64).mean(axis=-1)
        if self._count == 0:
            self._origin = level
        level = level - self._origin
        self._count += 1
        self._weight += weight
        self._weight_squared += weight**2
        self._sum = self._sum + weight * level
        self._first_moment = self._first_moment + weight**2 * level
        self._second_moment = self._second_moment + weight**2 * level**2

    @property
    def state(self):
        """What it holds, name -> number or array: all that another one needs to go on (settable)."""
        return dict(vars(self))

    @state.setter
    def state(self, values):
        vars(self).update(values)

    @property
    def standard_error(self):
        """Of the average of the passes, (height, width) float64; needs two passes. Not finite where a pass is not."""
        mean = self._sum / self._weight
        spread = self._second_moment - 2 * mean * self._first_moment + mean**2 * self._weight_squared
        return np.sqrt(np.maximum(spread, 0) / (self._weight**2 - self._weight_squared))

    def relative(self):
        """Return the relative standard error that 95% of the pixels do not exceed, None before there are two passes.

        Of a pixel with the value m in an image with the mean a it is relative to √(m² + (0.1 a)²), the scale of relMSE.
        Few passes leave the variance of single pixels uncertain, and a high percentile of uncertain values is too high:
        5 × 5 pixels share their mean. Pixels that are not finite are left out.
        """
        if self._count < 2:
            return None
        mean = self._origin + self._sum / self._weight
        with np.errstate(invalid="ignore"):
            variance = np.square(self.standard_error)
        finite = np.isfinite(mean) & np.isfinite(variance)
        if not finite.any():
            return None
        scale = np.square(mean) + np.square(DARK * np.abs(mean[finite]).mean())
        lit = finite & (scale > 0)
        relative = np.divide(variance, scale, out=np.zeros_like(mean), where=lit)
        shared = _box_sum(relative) / np.maximum(_box_sum(finite.astype(np.float64)), 1)
        return float(np.sqrt(np.percentile(shared[finite], 100 * SHARE)))


def _box_sum(plane):
    """Return the sums over the neighbours of each pixel that are in the image, (height, width)."""
    for axis in (0, 1):
        widths = [(NEIGHBOURS + 1, NEIGHBOURS) if along == axis else (0, 0) for along in (0, 1)]
        total = np.cumsum(np.pad(plane, widths), axis=axis)
        size, step = plane.shape[axis], 2 * NEIGHBOURS + 1
        plane = np.take(total, range(step, step + size), axis) - np.take(total, range(size), axis)
    return np.maximum(plane, 0)


class ErrorGoal:
    """When to look at the error of a render, and whether it is as low as `error`.

    Who stops as soon as an estimate falls below a bound stops, on average, when it happens to be too low. So the
    estimate is looked at only now and then: after at least 8 passes, and then whenever there are a quarter more samples
    than at the look before. How many samples there are at a look depends on what passes cost, not on what they show.
    Tests simulate it: what is reported at the end is 0 to 20% above the truth for noise that is each pixel's own, and
    right on average where it is the whole image's. It is a fifth too low at worst: where each pass, however large,
    shifts the whole image by the same amount and some ten passes are enough. (There a brighter image, whose relative
    error is less, also ends earlier: it is too bright by half of its standard error.)
    """

    def __init__(self, error):
        self.error, self._next = error, 0

    def is_due(self, progressive):
        """Is it time to look at the passes of a `Progressive`?"""
        return self._is_due(len(progressive.passes), progressive.spp)

    def resume(self, passes):
        """Leave out the looks that were taken at a list of passes (`Pass`) which a render goes on from."""
        for count, spp in enumerate(accumulate(one.spp for one in passes), 1):
            self._is_due(count, spp)

    def _is_due(self, count, spp):
        if count < LEAST_PASSES or spp < self._next:
            return False
        self._next = GROWTH * spp
        return True

    def samples(self, found, spp):
        """Return about how many samples per pixel there will be at the look that ends the render, if there are `spp` at
        the last one, with an error `found`."""
        return max(self._next, spp * (found / self.error) ** 2)

    def warn_if_missed(self, found, limit):
        """Log a warning if a `limit` ("spp" or "time") ended the render at an estimated error that is too high, or not
        known."""
        if not self.is_reached(found):
            ended = "an unknown error, as there is one pass" if found is None else f"an error of {found:.2%}"
            mi.Log(
                mi.LogLevel.Warn, f"The error of {self.error:.2%} was not reached: {limit} ended the render at {ended}."
            )

    def is_reached(self, found):
        """Is an estimated error (None: it is not known) low enough?"""
        return found is not None and found <= self.error
