"""Separation of a batch of matrices into a low-rank part and sparse errors [MSR section 6].

Minimises the sum of |Z| in D = XY + Z [MSR equation 11] by alternating directions of an augmented Lagrangian [SWZ]: X
and Y by least squares, Z by shrinkage, multipliers by the residual.  Z is 0 for traced entries.  Any other entry is
either right or wrong, a constraint that is relaxed to the sphere of equation 12.

NumPy (BLAS) multiplies matrices.  One kernel per step updates the entries of every matrix.

[SWZ] Shen, Wen and Zhang 2014, Augmented Lagrangian alternating direction method for matrix separation based on
low-rank factorization.  [HMT] Halko, Martinsson and Tropp 2011, Finding structure with randomness.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock

import drjit as dr
import mitsuba as mi
import numpy as np
from threadpoolctl import threadpool_limits

from ..core.arrays import download, upload

# Step of the multipliers, in units of the penalty; [SWZ] allows up to 1.6, with larger errors here
_STEP = 1.0
# Growth of the residual since the first iteration above which a separation has failed
_DIVERGED = 2.0
# Columns of a sketch in excess of the largest rank [HMT]
_OVERSAMPLING = 8
# Held while BLAS is limited to one thread: the limit belongs to the process, and its end restores the previous one
_BLAS_LIMIT = Lock()


@dataclass(frozen=True)
class SeparationLimits:
    """Stops after ``iterations``, at a relative residual of at most ``residual``, or if the residual decreases by less
    than the fraction ``progress`` in an iteration.

    ``rank``: largest rank; ``relative``: least singular value that counts, relative to the largest.
    """

    iterations: int = 20
    residual: float = 0.1
    progress: float = 0.1
    rank: int = 32
    relative: float = 0.05


@dataclass
class Separation:
    """``error``: Z, in the layout of D.  Per matrix: ``rank``, ``iterations``, ``failed`` (not finite, or diverged).
    ``residual``: list of ‖XY + Z − D‖ / ‖D‖ of the matrices after each iteration.
    """

    error: mi.Float
    rank: np.ndarray
    iterations: np.ndarray
    failed: np.ndarray
    residual: list[np.ndarray]


@contextmanager
def _one_core_each():
    """Function that calls ``work`` for each of some numbers, in parallel, with BLAS limited to one thread.

    Matrices are too small for several threads each: BLAS threads that wait for each other cost ten times as much on a
    busy machine.  A second thread waits until the first leaves the block.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with _BLAS_LIMIT, threadpool_limits(1, "blas"), ThreadPoolExecutor(cores) as pool:
        yield lambda work, numbers: list(pool.map(work, numbers))


def sketch(matrix: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leading singular values of a matrix (n, m), (r,), and right singular vectors times singular values, (r, m).

    ``test``: random matrix, (m, r) [HMT].
    """
    basis, _ = np.linalg.qr(matrix @ test)
    part = basis.T @ matrix
    # The r × r Gram matrix is accurate enough, since singular values far below the largest do not count
    squares, vectors = np.linalg.eigh(part @ part.T)
    return np.sqrt(np.maximum(squares[::-1], 0)), vectors[:, ::-1].T @ part


def separate(whole, free, weight, shape: tuple[int, int, int], limits: SeparationLimits, seed: int = 0) -> Separation:
    """Separate s matrices of size n × m, stored one after another; ``shape``: (s, n, m).

    whole: D, Float, evaluated; padding is 0.  free: Bool, entries that may be wrong.  weight: Float, value of fully
    visible entries; an error is 0 or ± the weight.
    """
    count, n, m = shape
    state = _State(whole, free, weight, shape)
    matrices = state.target()
    width = min(limits.rank + _OVERSAMPLING, n, m)
    test = np.random.default_rng(seed).standard_normal((m, width)).astype(np.float32)
    norm = np.sqrt(np.square(matrices).sum((1, 2), dtype=np.float64))
    # Matrices of zeros have no errors
    active = np.flatnonzero(np.isfinite(norm) & (norm > 0))
    rank, right, product = np.zeros(count, np.int64), [np.zeros((0, m))] * count, np.zeros(shape, np.float32)

    def begin(number):
        """Initialise the rank of a matrix, and Y."""
        values, vectors = sketch(matrices[number], test)
        rank[number] = np.clip((values > limits.relative * values[0]).sum(), 1, limits.rank)
        right[number] = vectors[: rank[number]]

    def fit(number):
        """Update X, then Y, by least squares."""
        left, _ = np.linalg.qr(target[number] @ right[number].T)
        right[number] = left.T @ target[number]
        np.matmul(left, right[number], out=product[number])

    iterations, residual, first, history = np.zeros(count, np.int64), np.zeros(count), np.zeros(count), []
    with _one_core_each() as each:
        each(begin, active)
        for number in range(limits.iterations):
            if not len(active):
                break
            target = state.target()
            each(fit, active)
            iterations[active] += 1
            before, residual = residual, residual.copy()
            residual[active] = state.step(upload(mi.Float, product), active)[active] / norm[active]
            if number == 0:
                first, before = residual, np.full(count, np.inf)
            history.append(residual)
            falls = residual < (1 - limits.progress) * before
            active = active[falls[active] & (residual[active] > limits.residual)]
    failed = ~np.isfinite(norm + residual) | (residual > _DIVERGED * np.maximum(first, limits.residual))
    return Separation(state.error, rank, iterations, failed, history)


class _State:
    """Z and the multipliers of the matrices.  A step changes only active matrices."""

    def __init__(self, whole, free, weight, shape):
        self._whole, self._free, self._weight, self._shape = whole, free, weight, shape
        self.error, self._multiplier = (dr.zeros(mi.Float, dr.width(whole)) for _ in range(2))
        dr.eval(self.error, self._multiplier)
        ones = [dr.select(mask, mi.Float(1), 0) for mask in (weight > 0, self._loose())]
        rows = [dr.block_sum(values, shape[2]) for values in (dr.abs(whole), *ones)]
        dr.eval(rows)
        total, entries, self._number = (self._per_matrix(sums) for sums in rows)
        # By the choice of the penalty, entries shrink by the mean entry [SWZ]
        self._threshold = np.divide(total, entries, out=np.zeros(len(total)), where=entries > 0)
        self._target = mi.Float(whole)

    def _per_matrix(self, sums) -> np.ndarray:
        """Sum over each matrix, (s,) float64, from sums over rows."""
        return download(sums).reshape(self._shape[:2]).sum(1, dtype=np.float64)

    def _loose(self):
        return self._free & (self._weight > 0)

    def target(self) -> np.ndarray:
        """Target of XY: D − Z minus the multipliers, (s, n, m)."""
        return download(self._target).reshape(self._shape)

    def step(self, product, active: np.ndarray) -> np.ndarray:
        """Update Z and the multipliers for a new XY; return the norm of the residual per matrix."""
        count, n, m = self._shape
        live = np.zeros(count, np.float32)
        live[active] = 1
        lane = dr.arange(mi.UInt32, count * n * m) // dr.opaque(mi.UInt32, n * m)
        threshold, live = (dr.gather(mi.Float, upload(mi.Float, x), lane) for x in (self._threshold, live))
        normalized = self._normalized(product, threshold)
        squares = self._per_matrix(dr.block_sum(dr.select(self._loose(), dr.square(normalized), 0), m))
        # On the sphere of equation 12
        scale = np.sqrt(np.divide(self._number, squares, out=np.ones(count), where=squares > 0))
        scale = dr.gather(mi.Float, upload(mi.Float, scale), lane)
        size = 0.5 * (dr.clip(normalized * scale, -1, 1) + 1)
        error = dr.select(self._loose(), self._sign() * self._weight * size, 0)
        rest = product + error - self._whole
        # In units of one over the penalty
        multiplier = self._multiplier + _STEP * rest
        active_now = live > 0
        self.error = dr.select(active_now, error, self.error)
        self._multiplier = dr.select(active_now, multiplier, self._multiplier)
        self._target = self._whole - self.error - self._multiplier
        left = dr.block_sum(dr.square(rest), m)
        dr.eval(self.error, self._multiplier, self._target, left)
        return np.sqrt(self._per_matrix(left))

    def _sign(self):
        """Sign of a possible error: a wrong entry is too large if predicted visible, otherwise too small."""
        return dr.select(self._whole > 0.5 * self._weight, mi.Float(1), -1)

    def _normalized(self, product, threshold):
        """H [MSR equation 12] of the shrunk errors: −1 for right entries, 1 for wrong entries."""
        rest = self._whole - product - self._multiplier
        shrunk = dr.maximum(self._sign() * rest - threshold, 0)
        weight = dr.select(self._weight > 0, self._weight, 1)
        return dr.clip(2 * shrunk / weight - 1, -1, 1)
