"""Standard error of an image, estimated from its passes, and the schedule of estimates.

Passes are independent images of the same expectation, for every integrator, sampler and film filter (a filter wider
than a pixel correlates neighbours, but not passes). So the variance of a pixel between passes gives the standard error
of their average.
"""

import mitsuba as mi
import numpy as np

SHARE = 0.95  # fraction of the pixels that must not exceed the error
DARK = 0.1  # of the mean of the image: lower bound of the scale of relative errors, about as in relMSE
NEIGHBOURS = 2  # pixels in each direction over which variances are averaged
LEAST_PASSES = 8  # effective passes before the first estimate
GROWTH = 1.25  # of the samples between estimates


class ErrorEstimate:
    """Weighted variance between passes of the mean over colour channels, in double precision.

    With x_k the value of a pixel in pass k of weight w_k (`Pass.weight`), W = Σ w_k and m = Σ w_k x_k / W, the estimate
    of the variance of m is Σ w_k² (x_k − m)² / (W² − Σ w_k²). The estimate is unbiased if the variance of x_k is
    proportional to 1 / w_k, and for passes of equal size. It is nearly unbiased if passes of different sizes have equal
    variance, as by virtual lights of each pass. Memory: three images of one channel, and the first pass, which is
    subtracted from all passes against cancellation.
    """

    def __init__(self):
        self._count, self._weight, self._weight_squared = 0, 0, 0
        self._origin, self._sum, self._first_moment, self._second_moment = 0.0, 0.0, 0.0, 0.0

    def add(self, image, weight):
        """Add a pass: colour (height, width, 3) and weight."""
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
    def effective_passes(self):
        """Number of passes of equal weight whose average would be as precise."""
        return effective_number(self._weight, self._weight_squared)

    @property
    def state(self):
        """Complete state, a dict from name to number or array (settable)."""
        return dict(vars(self))

    @state.setter
    def state(self, values):
        vars(self).update(values)

    @property
    def standard_error(self):
        """Standard error of the average, (height, width) float64; requires two passes. Not finite where a pass is
        not."""
        mean = self._sum / self._weight
        spread = self._second_moment - 2 * mean * self._first_moment + mean**2 * self._weight_squared
        return np.sqrt(np.maximum(spread, 0) / (self._weight**2 - self._weight_squared))

    def relative(self):
        """Return the relative standard error that 95% of the pixels do not exceed, None for fewer than two passes.

        The error of a pixel of value m, in an image of mean a, is relative to √(m² + (0.1 a)²), the scale of relMSE.
        With few passes the variance of a single pixel is uncertain, and the percentile would be too high; therefore
        variances are averaged over 5 × 5 pixels. Pixels that are not finite are ignored.
        """
        if self._count < 2:
            return None
        mean = self._origin + self._sum / self._weight
        with np.errstate(invalid="ignore"):
            variance = np.square(self.standard_error)
        finite = np.isfinite(mean) & np.isfinite(variance)
        if not finite.any():
            return None
        relative = _over_scale(variance, mean, finite)
        shared = _box_sum(relative) / np.maximum(_box_sum(finite.astype(np.float64)), 1)
        return float(np.sqrt(np.percentile(shared[finite], 100 * SHARE)))


def relative_squares(first, second, image):
    """Return the squared difference of two images (height, width, channels), a mean over channels, relative to the
    squared scale of relMSE of another `image`; 0 where it is not finite. (height, width) float64."""
    difference = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    return relative_products(difference, difference, image)


def relative_products(first, second, image):
    """Return the product of two images (height, width, channels), in the form of `relative_squares`."""
    products = (np.asarray(first, np.float64) * np.asarray(second, np.float64)).mean(axis=-1)
    mean = np.asarray(image, np.float64).mean(axis=-1)
    return _over_scale(products, mean, np.isfinite(products) & np.isfinite(mean))


def smoothed(plane, times=1):
    """Return the means of a plane over the neighbours of each pixel inside the image, 5 × 5 pixels, by a filter that is
    applied some `times`; (height, width)."""
    return filtered(plane, times) / filtered(np.ones_like(plane), times)


def filtered(plane, times=1):
    """Return `smoothed` with zeros outside the image."""
    for _ in range(times):
        plane = _box_sum(plane) / (2 * NEIGHBOURS + 1) ** 2
    return plane


def _over_scale(products, mean, finite):
    """Return `products` over m² + (0.1 a)², for an image m of one channel with the mean a; 0 where not `finite`."""
    result = np.zeros_like(mean)
    if not finite.any():
        return result
    scale = np.square(mean) + np.square(DARK * np.abs(mean[finite]).mean())
    return np.divide(products, scale, out=result, where=finite & (scale > 0))


def _box_sum(plane):
    """Return the sums over the neighbours of each pixel inside the image, (height, width).

    Differences of running sums would leave rounding errors of bright regions in dark ones.
    """
    for axis in (0, 1):
        widths = [(NEIGHBOURS, NEIGHBOURS) if along == axis else (0, 0) for along in (0, 1)]
        padded, size = np.pad(plane, widths), plane.shape[axis]
        plane = sum(np.take(padded, range(first, first + size), axis) for first in range(2 * NEIGHBOURS + 1))
    return plane


def effective_number(weight, weight_squared):
    """Return (Σ w_k)² / Σ w_k² for the sum `weight` and the sum of squares `weight_squared`, 0 without passes."""
    return weight**2 / weight_squared if weight_squared else 0.0


class ErrorGoal:
    """The `error` that ends a render, and the schedule of its estimates.

    A render that stops at the first estimate below a bound is biased towards low estimates. Therefore the error is
    estimated rarely: after at least 8 effective passes, and then after each increase of the samples by a quarter. The
    number of samples at an estimate depends on the cost of passes, not on their content. In simulations (tests), the
    reported error is 0 to 20% too high for noise that is independent between pixels, and unbiased for noise common to
    the whole image. It is 20% too low at worst: if each pass of any size shifts the whole image equally, and about ten
    passes are enough. (Then brighter images, of lower relative error, also end earlier: the image is too bright by half
    of its standard error.)
    """

    def __init__(self, error):
        self.error, self._next = error, 0

    def is_due(self, progressive):
        """Return whether an estimate is due for the passes of a `Progressive`."""
        return self._is_due(progressive.estimate.effective_passes, progressive.spp)

    def resume(self, passes):
        """Skip the estimates that were made for a list of passes (`Pass`) from a checkpoint; return whether there was
        one after the last pass."""
        spp, weight, squared, is_due = 0, 0.0, 0.0, False
        for one in passes:
            spp, weight, squared = spp + one.spp, weight + one.weight, squared + one.weight**2
            is_due = self._is_due(effective_number(weight, squared), spp)
        return is_due

    def _is_due(self, effective, spp):
        if round(effective) < LEAST_PASSES or spp < self._next:
            return False
        self._next = GROWTH * spp
        return True

    def samples(self, found, spp):
        """Return the expected samples per pixel at the end of the render, from the last estimate: the error `found` of
        `spp` samples per pixel."""
        return max(self._next, spp * (found / self.error) ** 2)

    def warn_if_missed(self, found, limit):
        """Log a warning if the `limit` ("spp" or "time") ended the render above the error, or at an unknown one."""
        if not self.is_reached(found):
            ended = "an unknown error, as there is one pass" if found is None else f"an error of {found:.2%}"
            mi.Log(
                mi.LogLevel.Warn, f"The error of {self.error:.2%} was not reached: {limit} ended the render at {ended}."
            )

    def is_reached(self, found):
        """Return whether an estimated error (None: unknown) is low enough."""
        return found is not None and found <= self.error
