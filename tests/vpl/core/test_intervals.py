"""Intervals found by their share of a cumulative sum."""

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import download, upload
from vpl.core.sampling import find_interval


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
