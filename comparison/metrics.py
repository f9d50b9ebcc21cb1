"""Errors of images against a reference. Images are (height, width, 3), errors plain numbers.

A path-traced reference has noise. If its standard error is known, each squared error is reduced by the expected squared
noise, so that an exact image scores zero on average. An error below the noise of the reference is marked, because it
cannot be distinguished from zero.
"""

import numpy as np

EPSILON = 1e-2  # relMSE: weight of the squared mean reference in the denominator
TRIMMED = 1e-3  # trimmed relMSE: fraction of the pixels, with the largest errors, that is excluded
SQUARED = ("relmse", "relmse_trimmed")  # errors proportional to the variance instead of the standard deviation
NAMES = ("relative_l1", "rmse", "relmse", "relmse_trimmed")


def compare(image, reference, standard_error=None):
    """Return a dict of errors of `image` against `reference`, both linear.

    relative_l1     sum |x - r| / sum r, without noise correction
    rmse            square root of the mean of (x - r)² - se²
    relmse          mean of ((x - r)² - se²) / (r² + EPSILON mean(r)²), independent of the scale
    relmse_trimmed  the same without the 0.1% of pixels with the largest (x - r)² / (r² + ...)
    bias            (mean x - mean r) / mean r
    noise           the errors above (except `bias`) of an exact image against the noisy reference
    below_noise     names of errors below the detection threshold, see `detection_threshold`
    bad_pixels      number of non-finite pixels, which count as black

    Without `standard_error` the noise is zero and `below_noise` is empty. Raises ValueError if the shapes differ or the
    reference is black.
    """
    if image.shape != reference.shape:
        raise ValueError(f"the image is {_size(image)} pixels, the reference {_size(reference)}")
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    mean = reference.mean()
    if not mean > 0:
        raise ValueError("the reference is black")
    bad = ~np.isfinite(image).all(axis=-1)
    image = np.where(bad[..., None], 0, image)
    variance = np.zeros_like(reference) if standard_error is None else np.square(np.asarray(standard_error, np.float64))
    squared, scale = np.square(image - reference), np.square(reference) + EPSILON * mean**2
    raw, noise = squared / scale, variance / scale
    kept = _all_but_largest(raw.mean(axis=-1), TRIMMED)

    totals = {  # error -> uncorrected value, value of the noise
        "rmse": (squared.mean(), variance.mean()),
        "relmse": (raw.mean(), noise.mean()),
        "relmse_trimmed": (raw[kept].mean(), noise[kept].mean()),
    }
    errors = {name: max(0.0, total - of_noise) for name, (total, of_noise) in totals.items()}
    noises = {name: of_noise for name, (_, of_noise) in totals.items()}
    errors["rmse"], noises["rmse"] = np.sqrt(errors["rmse"]), np.sqrt(noises["rmse"])
    errors["relative_l1"] = np.abs(image - reference).sum() / reference.sum()
    noises["relative_l1"] = np.sqrt(2 / np.pi * variance).sum() / reference.sum()  # E|n| of normal noise n
    below = [name for name in NAMES if errors[name] < detection_threshold(name, noises)]
    errors["bias"] = (image.mean() - mean) / mean
    return {
        **{name: float(value) for name, value in errors.items()},
        "noise": {name: float(value) for name, value in noises.items()},
        "below_noise": below,
        "bad_pixels": int(bad.sum()),
    }


def detection_threshold(name, noise):
    """Return the smallest error that is distinguishable from the noise of the reference; `noise` is a dict of errors.

    This is the noise itself. Exception: relative_l1 has no noise correction; its threshold is the quadratic sum of the
    noise and an equal error.
    """
    return noise[name] * (np.sqrt(2) if name == "relative_l1" else 1)


def relative_error(image, reference):
    """Return |x - r| / (r + 1% of the mean r), (height, width), averaged over the channels, for error images."""
    return (np.abs(image - reference) / _denominator(reference)).mean(axis=-1)


def signed_error(image, reference):
    """Return (x - r) / (r + 1% of the mean r), (height, width), averaged over the channels. Bias has one sign in a
    region; noise has both."""
    return ((image - reference) / _denominator(reference)).mean(axis=-1)


def _denominator(reference):
    return np.abs(reference) + EPSILON * reference.mean()


def distance(image, reference):
    """Return the Euclidean distance between colours, (height, width)."""
    return np.sqrt(np.square(np.asarray(image, np.float64) - reference).sum(axis=-1))


def flip(image, reference):
    """Return the HDR-FLIP map, (height, width) from 0 to 1, its mean, and its settings (a dict).

    FLIP estimates the perceived difference when alternating between two images, over all useful exposures of the
    reference, at 67 pixels per degree of view. Negative and non-finite values count as black. The reference must not be
    black.
    """
    # FLIP is scale-invariant, but finds no exposures for images as dark as 1e-7 and then ends the process
    scale = 1 / np.mean(reference, dtype=np.float64)
    shown = [np.nan_to_num(scale * np.asarray(one, np.float64), posinf=0, neginf=0) for one in (reference, image)]
    shown = [np.clip(one, 0, np.finfo(np.float32).max).astype(np.float32) for one in shown]
    import flip_evaluator  # optional: only comparisons need the package

    values, mean, settings = flip_evaluator.evaluate(*shown, "HDR", applyMagma=False)
    stops = {key: settings[key] + float(np.log2(scale)) for key in ("startExposure", "stopExposure")}
    return np.clip(values[..., 0], 0, 1), float(mean), settings | stops


def _all_but_largest(values, fraction):
    """Return a mask (height, width) without the given fraction (rounded down) of the largest values."""
    mask = np.ones(values.size, bool)
    count = int(fraction * values.size)
    if count:
        mask[np.argpartition(values.ravel(), -count)[-count:]] = False
    return mask.reshape(values.shape)


def _size(image):
    return f"{image.shape[1]}x{image.shape[0]}"
