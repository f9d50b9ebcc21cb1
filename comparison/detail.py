"""Detail that a denoiser removes, taken back from the raw image.

An image of many samples has little noise, and the denoiser still blurs detail that albedo and normal do not show. Long
renders would therefore keep the errors of the denoiser. The result is D + a (F − D), where F is the raw image, D the
denoised one, and a a number from 0 to 1 for each pixel. The a of the least expected squared error is

    a = 1 − E[n (n − d)] / E[(F − D)²],

where n is the noise of F and d the noise that it causes in D [Stein 1981, "Estimation of the mean of a multivariate
normal distribution"]. Both follow from the halves A and B of the passes, with the fractions w and 1 − w of the weight.
If their variances are in inverse proportion to these weights, √(w (1 − w)) (A − B) has the variance of n. The same
difference of the denoised halves stands for d. Means over neighbours stand for the expectations. Twice their standard
error is subtracted from a, so that a is 0 where they are uncertain.

Errors of these assumptions: A half has more noise than the image, and the denoiser smooths it more, so d and a are too
small. Where passes continue lattices, A and B deviate in opposite directions, so n is too large and a too small. Noise
that neighbouring pixels share, as that of virtual lights, stays in D as in F: n − d and F − D hardly contain it. A wide
filter of the film correlates neighbouring pixels, and the standard error is then too small.
"""

import numpy as np

from .convergence import filtered, relative_products, smoothed

QUALITY = "fast"  # network of the halves. Error with "fast" and with "high", 60 s, four scenes: 0.919 and 0.928
LEAST_SHARE = 0.4  # of the weight, for the smaller half
# Least samples per pixel. Error over that without: 500 to 2000 samples 0.87 to 0.99 in five scenes; 228 to 404 samples
# 0.93 to 1.01 in seven
LEAST_SAMPLES = 200
DOUBT = 2.0  # standard errors. With 1: 0.919 and 0.990 in images of 60 s and 30 s, with 2: 0.926 and 0.981
OUTLIERS = 0.999  # quantile of the products; pixels with larger ones, such as fireflies, stay denoised
SMOOTHED = 4  # times that products are averaged over 5 × 5 pixels: as by a Gaussian filter of 2.8 pixels
# Number of independent pixels of such a mean: 4π times the variance of the filter, 2 for each time
AVERAGED = 4 * np.pi * 2 * SMOOTHED


def suits(passes):
    """Return whether `rendering.Passes` are enough for their image to show detail that a denoiser removes."""
    weights = passes.half_weights
    enough = passes.has_halves and passes.spp >= LEAST_SAMPLES
    return enough and min(weights) >= LEAST_SHARE * sum(weights)


def restored(denoised, raw, halves, denoised_halves, share):
    """Return a denoised image with detail of the raw one, (height, width, channels).

    `halves`: two images of which `raw` is the mean, the first with the fraction `share` of the weight;
    `denoised_halves`: both denoised. Pixels that are not finite stay denoised.
    """
    with np.errstate(invalid="ignore"):
        noise, denoised_noise = (
            (share * (1 - share)) ** 0.5 * (np.asarray(first, np.float64) - second)
            for first, second in (halves, denoised_halves)
        )
        detail = np.asarray(raw, np.float64) - denoised
        seen = relative_products(detail, detail, denoised)
        noisy = relative_products(noise, noise - denoised_noise, denoised)
    usual = (seen <= np.quantile(seen, OUTLIERS)) & (np.abs(noisy) <= np.quantile(np.abs(noisy), OUTLIERS))
    usual &= np.isfinite(detail).all(axis=-1)
    kept = np.where(usual, _fractions(seen * usual, noisy * usual), 0)
    return denoised + kept[..., None] * np.where(usual[..., None], detail, 0)


def _fractions(seen, noisy):
    """Return the fraction a (height, width) of each pixel, from its (F − D)² and n (n − d)."""
    mean = smoothed(seen, SMOOTHED)
    # Rounding of larger numbers nearby decides below this
    is_known = mean > 1e-9 * seen.max()
    scale = np.where(is_known, mean, 1)
    fraction = np.where(is_known, smoothed(noisy, SMOOTHED) / scale, 1)
    # At the border of the image, means are over fewer pixels
    number = AVERAGED * filtered(np.ones_like(seen), SMOOTHED)
    variance = smoothed(np.square(noisy - fraction * seen), SMOOTHED) / number
    return np.clip(1 - fraction - DOUBT * np.sqrt(variance) / scale, 0, 1)
