"""Statistical tests of images with a stated least detectable bias.

A test of equal means is no stronger than the spread of its renders allows. :func:`compare_means` computes the least
relative bias of the image mean that a test with this spread finds nine times in ten; :func:`assert_same_mean` fails if
this bias exceeds the declared bound.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

# Least p value of a first sample that settles the matter, and of the four times larger sample that settles the others
SCREENING, SIGNIFICANCE = 0.05, 0.01
POWER = 0.9  # probability that a detectable bias is found
CONFIRMATION = 4  # size of the second sample, in sizes of the first
ROUNDING = 1e-5  # largest difference of a mean without variance, over the mean of the image
# That a spread is too large for the declared bound: Mitsuba orders shapes anew in each process, so spreads vary
CONFIDENCE = 0.999


class Comparison(NamedTuple):
    """Result of a test of equal means."""

    p_value: float
    detectable: float  # least relative bias of the image mean that is found with probability POWER


def relative_error(image, expected):
    """Sum of absolute differences over the sum of the expected values."""
    return np.abs(image - expected).sum() / expected.sum()


@cache
def detectable_shift(count, significance):
    """Least difference of a mean from 0, in standard errors, found with probability POWER by a two-sided t test."""
    critical = stats.t.ppf(1 - significance / 2, count - 1)
    return optimize.brentq(lambda shift: stats.nct.sf(critical, count - 1, shift) - POWER, 1, 10 * critical)


def compare_means(pairs, tiles=4, level=SCREENING):
    """Test images for equal means; ``pairs``: (found, expected) of each seed, arrays (height, width, channels).

    ``level``: significance by which a bias counts as found.

    Two t tests share the level [Šidák 1967]: a test of the image mean, and a test of the means of tiles and of
    channels, with the least p value corrected for their number.  Raises AssertionError if means without variance
    differ by more than ROUNDING.
    """
    found, expected = (np.array(images) for images in zip(*pairs, strict=True))
    count, height, width, channels = found.shape
    difference = found - expected
    means = difference.mean((1, 2, 3))
    rows, columns = height // tiles, width // tiles
    blocks = difference[:, : rows * tiles, : columns * tiles]
    blocks = blocks.reshape(count, tiles, rows, tiles, columns, channels).mean((2, 4)).reshape(count, -1)
    parts = np.concatenate([blocks, difference.mean((1, 2))], axis=1)
    # Tiles that see nothing but an emitter, and the direct light of a point, differ by rounding alone
    brightness = np.abs(expected).mean()
    assert brightness > 0, "the expected images are black"
    noisy = parts.std(0) > 1e-6 * brightness
    assert (np.abs(parts.mean(0)[~noisy]) <= ROUNDING * brightness).all(), "a difference without variance"
    if not noisy.any():
        return Comparison(1.0, 0.0)
    of_parts = corrected(stats.ttest_1samp(parts[:, noisy], 0).pvalue.min(), noisy.sum())
    of_mean = stats.ttest_1samp(means, 0).pvalue
    error = means.std(ddof=1) / np.sqrt(count) / expected.mean()
    return Comparison(corrected(min(of_mean, of_parts), 2), detectable_shift(count, 1 - (1 - level) ** 0.5) * error)


@cache
def certain_fraction(count):
    """Ratio of a lower confidence bound of a standard deviation to its estimate from ``count`` normal numbers."""
    return float(np.sqrt((count - 1) / stats.chi2.ppf(CONFIDENCE, count - 1)))


def corrected(p_value, count):
    """Probability that the least of ``count`` independent p values is at most ``p_value`` [Šidák 1967]."""
    return 1 - (1 - p_value) ** count


def assert_same_mean(pair, seeds, finds=0.01, tiles=4):
    """Fail if images differ in mean, or if their spread certainly hides a relative bias of the image mean of ``finds``.

    ``pair(seed)`` renders (found, expected), arrays (height, width, channels), for each seed of ``range(seeds)``.
    A difference at the level SCREENING, or a spread too large for the bound, is tested again at the level SIGNIFICANCE
    with four times as many new seeds, by which a bias shows more clearly.  Equal means fail once in 2000 tests, and
    once in 100 where the spread was too large.
    """
    result = compare_means([pair(seed) for seed in range(seeds)], tiles)
    certain = result.detectable * certain_fraction(seeds)
    if result.p_value <= SCREENING or certain > finds:
        more = range(seeds, (1 + CONFIRMATION) * seeds)
        result = compare_means([pair(seed) for seed in more], tiles, SIGNIFICANCE)
        certain = result.detectable * certain_fraction(CONFIRMATION * seeds)
        assert result.p_value > SIGNIFICANCE, f"p value {result.p_value:.2g}"
    assert certain <= finds, f"a bias below {certain:.2%} would go unseen"
