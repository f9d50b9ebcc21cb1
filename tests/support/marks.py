"""Marks of parameters."""

import pytest


def stress(*values):
    """Parameters of a test that only the stress run takes."""
    rows = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*row, marks=pytest.mark.stress) for row in rows]
