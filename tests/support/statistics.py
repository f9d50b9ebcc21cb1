"""Statistical comparisons of images."""

import numpy as np
from scipy import stats

# Of a t test, below which means are not the same
LEAST_P = 0.01


def relative_error(image, expected):
    """Sum of absolute differences over the sum of what is expected."""
    return np.abs(image - expected).sum() / expected.sum()


def same_mean_over_seeds(pairs, tiles=4):
    """The p value of a t test, Šidák-corrected, on the differences of paired images, (ours, expected), a pair a seed.

    Of the means over tiles and over the image, which are where bias shows.
    """
    excess = []
    for found, every in pairs:
        size = found.shape[0] // tiles
        blocks = (found - every)[: size * tiles, : size * tiles].reshape(tiles, size, tiles, size, 3)
        excess.append(np.append(blocks.mean((1, 3)).reshape(-1), (found - every).mean((0, 1))))
    excess = np.array(excess)
    noisy = excess.std(0) > 1e-6 * np.abs(every).mean()
    assert noisy[-3:].all()
    p_values = stats.ttest_1samp(excess[:, noisy], 0).pvalue
    return 1 - (1 - p_values.min()) ** noisy.sum()


def assert_same_mean_over_seeds(pairs, tiles=4):
    """See :func:`same_mean_over_seeds`."""
    assert same_mean_over_seeds(pairs, tiles) > LEAST_P
