"""Detail that a denoiser removed, taken back from the raw image.

An image of many samples has little noise, and the denoiser still blurs detail that albedo and normal do not show. So
long renders would keep the errors of the denoiser. The result is D + a (F − D), where F is the raw image, D the
denoised one, and a a number from 0 to 1 for each pixel. The a of the least expected squared error is

    a = 1 − E[n (n − d)] / E[(F − D)²],

where n is the noise of F and d the noise that it causes in D [Stein 1981, "Estimation of the mean of a multivariate
normal distribution"]. The halves A and B of the passes, with the fractions w and 1 − w of the weight, tell both:
√(w (1 − w)) (A − B) has the variance of n, and the same difference of the denoised halves responds as D does. Means
over neighbours stand for the expectations. Twice their standard error is subtracted from a, so that a is 0 where they
are uncertain.

Noise that both halves share, as virtual lights of a pass have, is blurred: D and F contain it alike.
"""

import numpy as np

from .convergence import box_mean, relative_products

QUALITY = "fast"  # network of the halves. Error with "fast" and with "high", 60 s, four scenes: 0.919 and 0.928
# Of the weight of the passes, for the smaller half: halves have similar noise. Passes that double their samples have a
# third
LEAST_SHARE = 0.3
# Least samples per pixel. Error over that without, two standard errors subtracted: 500 to 2000 samples 0.89 to 0.99 in
# six scenes; 228 to 404 samples 0.92 to 1.02 in six
LEAST_SAMPLES = 200
DOUBT = 2.0  # standard errors. With 1: 0.919 and 0.990 in images of 60 s and 30 s, with 2: 0.926 and 0.981
OUTLIERS = 0.999  # quantile of the absolute values that limits them: fireflies
SMOOTHED = 4  # times that products are averaged over 5 × 5 pixels: as by a Gaussian filter of 2.8 pixels
# Pixels of such a mean: 4π times the variance of the filter, 2 for each time
AVERAGED = 4 * np.pi * 2 * SMOOTHED


def suits(passes):
    """Return whether `rendering.Passes` are enough for their image to show detail that a denoiser removes."""
    weights = passes.half_weights
    return passes.spp >= LEAST_SAMPLES and min(weights) >= LEAST_SHARE * sum(weights)


def restored(denoised, raw, halves, denoised_halves, share):
    """Return a denoised image with detail of the raw one, (height, width, channels).

    `halves`: two images of which `raw` is the mean, the first with the fraction `share` of the weight;
    `denoised_halves`: both denoised. Pixels that are not finite stay denoised.
    """
    noise, left = (
        (share * (1 - share)) ** 0.5 * (np.asarray(first, np.float64) - second)
        for first, second in (halves, denoised_halves)
    )
    detail = np.asarray(raw, np.float64) - denoised
    with np.errstate(invalid="ignore"):
        seen, noisy = (
            _limited(relative_products(*pair, denoised)) for pair in ((detail, detail), (noise, noise - left))
        )
    scale = np.maximum(_smoothed(seen), np.finfo(np.float64).tiny)
    fraction = _smoothed(noisy) / scale
    variance = np.maximum(_smoothed(np.square(noisy - fraction * seen)), 0) / AVERAGED
    kept = np.clip(1 - fraction - DOUBT * np.sqrt(variance) / scale, 0, 1)
    kept = kept[..., None] * np.isfinite(detail).all(axis=-1, keepdims=True)
    return denoised + kept * np.nan_to_num(detail, posinf=0.0, neginf=0.0)


def _limited(products):
    """Return products (height, width) with outliers limited."""
    largest = np.quantile(np.abs(products), OUTLIERS)
    return np.clip(products, -largest, largest)


def _smoothed(products):
    """Return means over neighbours, (height, width)."""
    for _ in range(SMOOTHED):
        products = box_mean(products)
    return products
