"""How far an image is from a reference; images are (height, width, 3), errors plain numbers.

A path-traced reference has noise of its own. Where its standard error is known, the expected square of that noise is
taken off every squared error, so that a perfect image scores zero on average; and an error that is smaller than the
noise is named as such, because it can then no longer be told from zero.
"""

import flip_evaluator
import numpy as np

EPSILON = 1e-2  # added to the square of the reference in relMSE, as a fraction of the square of its mean
TRIMMED = 1e-3  # fraction of the pixels, those with the largest errors, that trimmed relMSE leaves out
SQUARED = ("relmse", "relmse_trimmed")  # errors whose noise falls with the samples, not with their root
NAMES = ("relative_l1", "rmse", "relmse", "relmse_trimmed")


def compare(image, reference, standard_error=None):
    """Return a dict of errors of `image` against `reference`, both linear.

    relative_l1     sum |x - r| / sum r; the noise is not taken off, but `noise` says what it alone would give
    rmse            square root of the mean of (x - r)² - se²
    relmse          mean of ((x - r)² - se²) / (r² + EPSILON mean(r)²): scale does not matter
    relmse_trimmed  the same without the 0.1% of pixels where (x - r)² / (r² + ...) is largest
    bias            (mean x - mean r) / mean r
    noise           the same errors (but `bias`) that an exact image would show for the reference's noise alone
    below_noise     names of errors that cannot be told from the noise: smaller than `least`
    bad_pixels      number of pixels that are not finite; they count as black

    Without `standard_error` the noise is taken as zero and `below_noise` is empty. Raises ValueError if the shapes
    differ or the reference is black.
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

    totals = {  # error -> raw value, value of the noise
        "rmse": (squared.mean(), variance.mean()),
        "relmse": (raw.mean(), noise.mean()),
        "relmse_trimmed": (raw[kept].mean(), noise[kept].mean()),
    }
    errors = {name: max(0.0, total - of_noise) for name, (total, of_noise) in totals.items()}
    noises = {name: of_noise for name, (_, of_noise) in totals.items()}
    errors["rmse"], noises["rmse"] = np.sqrt(errors["rmse"]), np.sqrt(noises["rmse"])
    errors["relative_l1"] = np.abs(image - reference).sum() / reference.sum()
    noises["relative_l1"] = np.sqrt(2 / np.pi * variance).sum() / reference.sum()  # the mean of |n| for a normal n
    below = [name for name in NAMES if errors[name] < least(name, noises)]
    errors["bias"] = (image.mean() - mean) / mean
    return {
        **{name: float(value) for name, value in errors.items()},
        "noise": {name: float(value) for name, value in noises.items()},
        "below_noise": below,
        "bad_pixels": int(bad.sum()),
    }


def least(name, noise):
    """Return the least error that can be told from the reference's noise, given that one's errors (a dict).

    It is the noise itself; for relative_l1, from which that is not taken off, it is where an error adds as much to the
    noise, in quadrature, as that has.
    """
    return noise[name] * (np.sqrt(2) if name == "relative_l1" else 1)


def relative_error(image, reference):
    """Return |x - r| / (r + 1% of the mean r), (height, width), averaged over the channels: what error images show."""
    return (np.abs(image - reference) / _floored(reference)).mean(axis=-1)


def signed_error(image, reference):
    """Return (x - r) / (r + 1% of the mean r), (height, width), averaged over the channels: where images are too bright
    or too dark, whereas noise has both signs."""
    return ((image - reference) / _floored(reference)).mean(axis=-1)


def _floored(reference):
    return np.abs(reference) + EPSILON * reference.mean()


def distance(image, reference):
    """Return the Euclidean distance of the colours, (height, width)."""
    return np.sqrt(np.square(np.asarray(image, np.float64) - reference).sum(axis=-1))


def flip(image, reference):
    """Return the map of HDR-FLIP, (height, width) from 0 to 1, its mean, and the settings it was made with (a dict).

    How different the two look when flipped between, over the exposures at which the reference shows something; for 67
    pixels per degree of the eye's view. Negative values and values that are not finite count as black. The reference
    must not be black.
    """
    # Of images that are as dark as 1e-7 FLIP finds no exposures, and ends the process; it does not depend on the scale.
    scale = 1 / np.mean(reference, dtype=np.float64)
    shown = [np.nan_to_num(scale * np.asarray(one, np.float64), posinf=0, neginf=0) for one in (reference, image)]
    shown = [np.clip(one, 0, np.finfo(np.float32).max).astype(np.float32) for one in shown]
    values, mean, settings = flip_evaluator.evaluate(*shown, "HDR", applyMagma=False)
    stops = {key: settings[key] + float(np.log2(scale)) for key in ("startExposure", "stopExposure")}
    return np.clip(values[..., 0], 0, 1), float(mean), settings | stops


def _all_but_largest(values, fraction):
    """Return a mask (height, width) that leaves out the given fraction of the values, the largest, rounded down."""
    mask = np.ones(values.size, bool)
    count = int(fraction * values.size)
    if count:
        mask[np.argpartition(values.ravel(), -count)[-count:]] = False
    return mask.reshape(values.shape)


def _size(image):
    return f"{image.shape[1]}x{image.shape[0]}"
