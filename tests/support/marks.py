"""Marks of parameters."""

import pytest


def stress(*values):
    """Parameters of a test that only the stress run takes."""
    return [
        pytest.param(*(value if isinstance(value, tuple) else [value]), marks=pytest.mark.stress) for value in values
    ]
