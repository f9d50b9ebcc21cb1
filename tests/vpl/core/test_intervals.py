"""Intervals found by their share of a cumulative sum."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from vpl.core.arrays import download, upload
from vpl.core.sampling import GuidedSums, find_interval


def test_intervals_are_found_by_their_share():
    rng = np.random.default_rng(0)
    share = rng.random(50) * (rng.random(50) < 0.6)
    cumulative = np.concatenate([[0.0], np.cumsum(share)])
    device = upload(dr.float64_array_t(mi.Float), cumulative)
    for first, last in [(0, 50), (7, 8), (10, 30), (49, 50)]:
        n = 20_000
        sample = (mi.Float(dr.arange(mi.UInt32, n)) + 0.5) / n
        found = download(find_interval(device, mi.UInt32(first), mi.UInt32(last), sample))
        assert found.min() >= first
        assert found.max() < last
        expected = share[first:last]
        if expected.sum() > 0:
            drawn = np.bincount(found - first, minlength=last - first) / n
            assert np.allclose(drawn, expected / expected.sum(), atol=2 / n)
    ends = [0.0, float(np.nextafter(np.float32(1), np.float32(0)))]
    found = download(find_interval(device, mi.UInt32(0), mi.UInt32(50), upload(mi.Float, ends)))
    assert (share[found] > 0).all()


@pytest.mark.parametrize(
    "weight", [[0.0], [1.0], [0.0, 0.0], [0.0, 3.0, 0.0], [1e300, 1e-300, 1.0], "random", "skewed"]
)
def test_guided_search_finds_the_same_intervals(weight):
    rng = np.random.default_rng(1)
    if weight == "random":
        weight = rng.random(1000) * (rng.random(1000) < 0.6)
    elif weight == "skewed":
        weight = 10.0 ** rng.uniform(-12, 3, 1000)
    count, n = len(weight), 50_000
    first = rng.integers(0, count, n)
    last = rng.integers(first + 1, count + 1)
    sample = rng.random(n)
    sample[:2] = 0, np.nextafter(1, 0)
    precise = dr.float64_array_t(mi.Float)
    at = upload(mi.UInt32, first), upload(mi.UInt32, last), upload(precise, sample)
    sums = upload(precise, np.concatenate([[0.0], np.cumsum(weight)]))
    assert np.array_equal(download(GuidedSums(np.array(weight)).find(*at)), download(find_interval(sums, *at)))
