"""Properties of plugins, and properties of functions over random examples."""

import os

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vpl.core.arrays import upload


def examples(usual: int, most: int = 10_000) -> int:
    """How many random examples a test of a property takes: a few, or as many as the stress run asks for."""
    return min(max(usual, int(os.environ.get("MANYLIGHTS_EXAMPLES", "0"))), most)


def unit_vectors(rng, count):
    """Directions all around, (count, 3) float32."""
    vectors = rng.normal(size=(count, 3))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def assert_property_is_refused(plugin, name, value):
    """With an error that names the property and the value."""
    with pytest.raises((ValueError, RuntimeError)) as error:
        mi.load_dict({"type": plugin, name: value})
    assert f'property "{name}" must be' in str(error.value) and f"got {value!r}" in str(error.value)


def assert_properties_are_shown(plugin, given):
    """The printed plugin shows the values of properties."""
    text = str(mi.load_dict({"type": plugin, **given}))
    assert all(f"{name} = {value}" in text for name, value in given.items())


def points(columns):
    """Points on the device from an array (n, 3)."""
    return mi.Point3f(*(upload(mi.Float, columns[:, k]) for k in range(3)))


def seeds(usual):
    """A property of random scenes, by their seed."""

    def decorate(test):
        return settings(max_examples=examples(usual), deadline=None)(given(st.integers(0, 2**31))(test))

    return decorate
