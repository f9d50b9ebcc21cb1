"""Means of an image around its pixels, from values at some of them.

The image is divided into four cells, these into four again, down to single pixels.  A cell is taken to have had some
values of the larger one's mean besides its own, the more of them the noisier values are, so that it tells what is known
of it and no more: edges are where values show them, in images of any size.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .balance import noise

# Relative variance of the mean of a cell around that of the larger one
_SPREAD = 0.15


def means_of_others(values: np.ndarray, at: np.ndarray, width: int, count: int) -> tuple[np.ndarray, list[float]]:
    """(Mean around each of ``values`` (n,), pairs of two next to each other, as all others tell but that beside it,
    (n,); how many values of the larger cell's mean cells of each size were taken to have had).

    ``at``: the pixel of each, of ``count`` pixels of an image so many wide.  How noisy values are is judged by all.
    """
    number = len(values)
    beside = np.arange(number) ^ 1
    rest = max(number - 2, 1)
    others = (np.sum(values) - values - values[beside]) / rest if number > 2 else np.full(number, np.mean(values))
    priors = []
    for (down, across), cell in _divisions(at, width, count):
        # Of n values the relative variance is below n
        priors.append(min(noise(values, others), number) / _SPREAD)
        inside, total = _sums(cell, values, down * across)
        both = cell == cell[beside]
        total, inside = total[cell] - values - both * values[beside], inside[cell] - 1 - both
        others = _mean(total, inside, priors[-1], others)
    return others, priors


def pixel_means(values: np.ndarray, at: np.ndarray, width: int, count: int, priors: list[float]) -> np.ndarray:
    """Mean of ``values`` (n,) in the pixels ``at`` (n,) around each of ``count`` pixels of an image so many wide,
    (count,); ``priors``: see :func:`means_of_others`."""
    grid = np.full((1, 1), np.mean(values))
    for ((down, across), cell), prior in zip(_divisions(at, width, count), priors, strict=True):
        inside, total = _sums(cell, values, down * across)
        around = grid.repeat(2, 0).repeat(2, 1)[:down, :across].reshape(-1)
        grid = _mean(total, inside, prior, around).reshape(down, across)
    return grid.reshape(-1)[:count]


def _divisions(at: np.ndarray, width: int, count: int) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """((Cells down, cells across), the cell of each of the pixels ``at``), from four cells to one for each pixel."""
    height = -(-count // width)
    side = 1 << (max(width, height) - 1).bit_length()
    while side > 1:
        side //= 2
        down, across = -(-height // side), -(-width // side)
        yield (down, across), at // width // side * across + at % width // side


def _sums(cell: np.ndarray, values: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """How many values each cell has, and their sums."""
    return np.bincount(cell, minlength=cells), np.bincount(cell, values, cells)


def _mean(total, number, prior: float, around):
    """Means of cells of so many values, and ``prior`` of the mean around."""
    whole = number + prior
    return np.where(whole > 0, total + prior * around, around) / np.where(whole > 0, whole, 1)
