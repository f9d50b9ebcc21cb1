"""Emitters, points and comparisons for tests of direct sources."""

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import download, upload

COUNT = 100_000


def patches(height=6, width=10, seed=1):
    """Random colours, some of them black."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(0.1, 3, (height, width, 3)) * (rng.random((height, width, 1)) < 0.7)).astype(np.float32)


def texture(pixels=None, **more):
    return {"type": "bitmap", "bitmap": mi.Bitmap(patches() if pixels is None else pixels), "raw": True, **more}


def area(radiance=(1.0, 2.0, 0.5)):
    value = radiance if isinstance(radiance, dict) else {"type": "rgb", "value": list(radiance)}
    return {"type": "area", "radiance": value}


def interactions(points, repeat=1):
    """Each point so many times."""
    rows = np.repeat(np.asarray(points, np.float32), repeat, axis=0)
    result = dr.zeros(mi.SurfaceInteraction3f, len(rows))
    result.p = mi.Point3f(*(upload(mi.Float, rows[:, k]) for k in range(3)))
    return result


def colours(value, count):
    return np.broadcast_to(download(value), (count, 3)).astype(float)


def assert_means_agree(first, second, relative=2e-3):
    """First and second: samples (n, ...) of two estimators of the same."""
    (a, error_a), (b, error_b) = mean_and_error(first), mean_and_error(second)
    allowed = 5 * np.hypot(error_a, error_b) + relative * np.abs(b).max() + 1e-9
    assert (np.abs(a - b) < allowed).all(), (a, b, allowed)


def uniform_index(sampler, count):
    return dr.minimum(mi.UInt32(sampler.next_1d() * count), count - 1)


def mean_and_error(values):
    return values.mean(0), values.std(0) / np.sqrt(len(values))


def assert_mostly(condition, share=0.995):
    """All samples except for a few, which rounding moves over an edge."""
    assert np.mean(condition) >= share, np.mean(condition)


def sky(pixels, to_world=None, **more):
    plugin = {"type": "envmap", "bitmap": mi.Bitmap(np.asarray(pixels, np.float32)), **more}
    return plugin | ({} if to_world is None else {"to_world": to_world})


def smooth_map(height=64, width=128):
    y, x = np.meshgrid(np.arange(height) * np.pi / height, np.arange(width) * 2 * np.pi / width, indexing="ij")
    waves = [np.cos(k * x + phase) * np.sin(q * y) for k, phase, q in [(1, 0.5, 1), (2, 3, 2), (5, 1, 3)]]
    return np.exp(2 * sum(waves))[..., None] * np.array([1.0, 0.7, 0.3])


def tilted():
    return mi.ScalarTransform4f().rotate([0.36, 0.8, -0.48], 70)


SKIES = {
    "envmap": lambda: sky(smooth_map()),
    "rotated envmap": lambda: sky(smooth_map(), tilted()),
    "odd size": lambda: sky(smooth_map(33, 75), tilted()),
    "scaled": lambda: sky(smooth_map(), scale=1e4),
    "constant": lambda: {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
}
