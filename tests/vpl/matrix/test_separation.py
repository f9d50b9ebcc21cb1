"""Separation of a low-rank matrix and sparse errors."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from vpl.core.arrays import download, upload
from vpl.matrix.separation import SeparationLimits, separate, sketch


def planted(seed, shape, rank, errors):
    """Visibility of low rank: (what it is, the same with a share of entries wrong)."""
    rng = np.random.default_rng(seed)
    count, n, m = shape
    columns = rng.random((count, n, rank)).argmax(2)
    patterns = rng.random((count, rank, m)) < 0.6
    true = np.take_along_axis(patterns, columns[:, :, None], 1).astype(np.float32)
    wrong = rng.random(shape) < errors
    return true, np.where(wrong, 1 - true, true)


def separated(matrices, free=None, weight=None, **limits):
    """Z and the rest of what is found, for matrices (s, n, m)."""
    matrices = np.asarray(matrices, np.float32)
    free = np.ones(matrices.shape, bool) if free is None else free
    weight = np.ones_like(matrices) if weight is None else weight
    mask = upload(mi.UInt32, free) == 1
    arrays = [upload(mi.Float, values) for values in (matrices, weight)]
    dr.eval(mask)
    found = separate(arrays[0], mask, arrays[1], matrices.shape, SeparationLimits(**limits))
    return download(found.error).reshape(matrices.shape), found


def test_sparse_errors_are_told_from_low_rank():
    true, wrong = planted(0, (3, 60, 90), 4, 0.04)
    error, found = separated(wrong, residual=0.01, progress=-1.0, relative=0.12)
    assert not found.failed.any() and (found.rank == 4).all()
    corrected = wrong - np.round(error)
    assert (corrected != true).mean() < 0.1 * (wrong != true).mean()


def test_entries_that_were_traced_are_never_wrong():
    _, wrong = planted(1, (2, 40, 50), 3, 0.05)
    free = np.random.default_rng(2).random(wrong.shape) < 0.5
    error, _ = separated(wrong, free)
    assert (error[~free] == 0).all() and (error[free] != 0).any()


def test_errors_are_of_the_sign_and_size_that_entries_allow():
    _, wrong = planted(3, (2, 40, 50), 3, 0.1)
    weight = np.random.default_rng(4).random(wrong.shape).astype(np.float32) * 5
    error, _ = separated(wrong * weight, None, weight)
    rest = wrong * weight - error
    assert (rest > -1e-4).all() and (rest < weight + 1e-4).all()


def test_the_sketch_has_the_leading_singular_values():
    rng = np.random.default_rng(5)
    matrix = (rng.random((80, 6)) @ rng.random((6, 120)) + 1e-3 * rng.random((80, 120))).astype(np.float32)
    values, vectors = sketch(matrix, rng.standard_normal((120, 14)).astype(np.float32))
    exact = np.linalg.svd(matrix, compute_uv=False)
    assert np.allclose(values[:4], exact[:4], rtol=1e-2)
    assert np.allclose(np.linalg.norm(vectors, axis=1)[:4], values[:4], rtol=1e-3)


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 30), (2, 30, 1), (3, 2, 2), (1, 50, 40)])
@pytest.mark.parametrize("kind", ["zero", "one", "random", "single", "bright", "no weight", "rank one"])
def test_hostile_matrices_stay_finite(shape, kind):
    rng = np.random.default_rng(6)
    matrices = {
        "zero": np.zeros(shape), "one": np.ones(shape), "random": rng.random(shape).round(),
        "single": np.zeros(shape), "bright": rng.random(shape), "no weight": rng.random(shape).round(),
        "rank one": rng.random((shape[0], shape[1], 1)) * rng.random((shape[0], 1, shape[2])),
    }[kind]  # fmt: skip
    weight = np.ones(shape)
    if kind in ("single", "bright"):
        matrices[0, 0, 0] = 1e12 if kind == "bright" else 1
    if kind == "no weight":
        # One over E is infinite here
        weight[:, :, ::2] = 0
        matrices *= weight
    error, found = separated(matrices, None, np.maximum(weight, matrices))
    assert np.isfinite(error).all() and len(found.residual) <= 20
    assert (error[weight == 0] == 0).all()
    if kind in ("zero", "one"):
        assert not found.failed.any() and np.abs(error).max() < 1e-3


def test_values_that_are_not_finite_make_their_matrix_fail_alone():
    _, wrong = planted(7, (3, 30, 40), 3, 0.05)
    wrong[1, 4, 5] = np.nan
    _, found = separated(wrong)
    assert found.failed.tolist() == [False, True, False]
