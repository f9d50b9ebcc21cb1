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


def pixel_means(values: np.ndarray, at: np.ndarray, width: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Means of ``values`` (n,) in the pixels ``at`` (n,), pairs of two next to each other, float64: (around each of
    ``count`` pixels of an image so many wide; around each value, as all others tell but that beside it, (n,))."""
    beside = np.arange(len(values)) ^ 1
    grid, others = np.full((1, 1), np.mean(values)), np.full(len(values), np.mean(values))
    for (down, across), cell in _divisions(at, width, count):
        # Values of the larger cell's mean that each is taken to have had; of n values the relative variance is below n
        prior = min(noise(values, others), len(values)) / _SPREAD
        number, total = (np.bincount(cell, x, down * across) for x in (np.ones(len(values)), values))
        around = grid.repeat(2, 0).repeat(2, 1)[:down, :across].reshape(-1)
        grid = _mean(total, number, prior, around).reshape(down, across)
        both = cell == cell[beside]
        own = values + both * values[beside]
        others = _mean(total[cell] - own, number[cell] - 1 - both, prior, others)
    return grid.reshape(-1)[:count], others


def _divisions(at: np.ndarray, width: int, count: int) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """((Cells down, cells across), the cell of each of the pixels ``at``), from four cells to one for each pixel."""
    height = -(-count // width)
    side = 1 << (max(width, height) - 1).bit_length()
    while side > 1:
        side //= 2
        down, across = -(-height // side), -(-width // side)
        yield (down, across), at // width // side * across + at % width // side


def _mean(total, number, prior: float, around):
    """Means of cells of so many values, and ``prior`` of the mean around."""
    whole = number + prior
    return np.where(whole > 0, total + prior * around, around) / np.where(whole > 0, whole, 1)
