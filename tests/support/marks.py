"""Marks of parameters."""

import os

import pytest

# Variant of Mitsuba in which the tests run: tests/conftest.py sets it
VARIANT = os.environ.get("MANYLIGHTS_VARIANT", "llvm_ad_rgb")


def stress(*values):
    """Parameters of a test that only the stress run takes."""
    rows = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*row, marks=pytest.mark.stress) for row in rows]


def not_on_cuda(reason):
    """Skip a test on CUDA, where it fails by hits of OptiX or by rounding."""
    return pytest.mark.skipif(VARIANT.startswith("cuda"), reason=reason)
