"""Random directions and seeds of random examples."""

import numpy as np
from hypothesis import strategies as st

SEEDS = st.integers(0, 2**32 - 1)


UP, DOWN = (0.0, 0, 1), (0.0, 0, -1)


def random_unit(rng, *shape):
    vector = rng.normal(size=(*shape, 3))
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def around(rng, axis, cosine, count):
    """Unit vectors in the cones of the given axes (k, 3) and cosines (k,), some of them on the rim: (k, count, 3)."""
    cosine = cosine[:, None] * np.ones(count)
    z = np.where(rng.random(cosine.shape) < 0.3, cosine, rng.uniform(cosine, 1))
    side = np.cross(axis[:, None], random_unit(rng, len(axis), count))
    side /= np.linalg.norm(side, axis=2, keepdims=True)
    return z[..., None] * axis[:, None] + np.sqrt(1 - z * z)[..., None] * side
