"""Regions of environments that are kept between calls."""

import sys
from concurrent.futures import ThreadPoolExecutor

import mitsuba as mi
import numpy as np
import pytest

from vpl.core.arrays import download
from vpl.direct.environment_regions import regions_of


def constant(level: float):
    return mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": level}}).environment()


def called_between_lines(function, other, *arguments):
    """Result of a function, before each line of which another thread calls ``other``; and how many lines there were."""
    lines, before = 0, sys.gettrace()

    def trace(frame, event, _):
        nonlocal lines
        if frame.f_code is not function.__code__:
            return None
        if event == "line":
            lines += 1
            pool.submit(other).result()
        return trace

    with ThreadPoolExecutor(1) as pool:
        sys.settrace(trace)
        try:
            return function(*arguments), lines
        finally:
            sys.settrace(before)


@pytest.mark.parametrize("known", [False, True])
def test_a_thread_gets_the_regions_of_its_own_environment(known):
    ours, theirs = constant(1.0), constant(5.0)
    expected = regions_of(ours if known else theirs, 4).irradiance.sum()
    assert expected == pytest.approx(4 * np.pi * (1 if known else 5), rel=1e-4)
    regions, lines = called_between_lines(regions_of, lambda: regions_of(theirs, 4), ours, 4)
    assert lines > 1
    assert regions.environment is ours
    assert regions.irradiance.sum() == pytest.approx(4 * np.pi, rel=1e-4)


def test_regions_are_kept_until_the_environment_or_an_argument_changes():
    environment = constant(1.0)
    regions = regions_of(environment, 4)
    assert regions_of(environment, 4) is regions
    assert regions_of(environment, 5).count == 5
    again = regions_of(environment, 4)
    parameters = mi.traverse(environment)
    parameters["radiance.value"] = 2.0
    parameters.update()
    assert regions_of(environment, 4).irradiance.sum() == pytest.approx(2 * again.irradiance.sum())


def test_regions_show_their_own_environment_after_an_equal_one_was_edited():
    edited, untouched = constant(1.0), constant(1.0)
    regions_of(edited, 4)
    parameters = mi.traverse(edited)
    parameters["radiance.value"] = 3.0
    parameters.update()
    radiance = regions_of(untouched, 4).radiance(mi.Vector3f(0, 0, 1), mi.Bool(True))
    assert download(radiance.x) == pytest.approx(1)
