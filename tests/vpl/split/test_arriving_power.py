"""Light of sources in cells: the kernels against loops over cells, sources and rays."""

import mitsuba as mi
import numpy as np
import pytest

from vpl.core.arrays import download, upload, upload_vectors
from vpl.split.emitters.arriving_power import RAYS, Looks, arriving_power

# Weights of the neighbours, at most, and of the prior, in rays
NEIGHBOURS, PRIOR = 4.0, 1.0


def expected_power(reached, unoccluded, learnable, neighbours):
    """Power (cells, sources) of ``reached``, ``unoccluded`` (cells, sources, rays), one pair at a time."""
    possible = np.where(np.isfinite(unoccluded), unoccluded, 0).astype(np.float64) ** 2 * learnable[:, None]
    found = possible * (reached > 0)

    def seen(*which):
        return np.count_nonzero(found[which]) / max(np.count_nonzero(possible[which]), 1)

    cells, sources, _ = found.shape
    power = np.zeros((cells, sources))
    for cell in range(cells):
        near = [number - 1 for number in neighbours[cell] if number > 0]
        for source in range(sources):
            visible = min(seen(cell) * seen(slice(None), source) / max(seen(), 1e-9), 1)
            total = PRIOR * (visible * possible[cell, source].mean()) ** 0.5
            total += sum(RAYS * found[other, source].mean() ** 0.5 for other in near)
            rays = RAYS * len(near) + PRIOR
            weight = min(rays, NEIGHBOURS)
            own = RAYS * found[cell, source].mean()
            power[cell, source] = ((own + weight * (total / rays) ** 2) / (RAYS + weight)) ** 0.5
    return power


@pytest.mark.parametrize(("cells", "sources"), [(40, 7), (1, 5), (30, 1), (1, 1)])
@pytest.mark.parametrize("sight", [0.0, 0.3, 1.0])
def test_power_is_that_of_loops(cells, sources, sight):
    rng = np.random.default_rng(cells + sources)
    shape = cells, sources, RAYS
    unoccluded = (rng.exponential(1, shape) * 10.0 ** rng.uniform(-3, 3, sources)[:, None]).astype(np.float32)
    unoccluded[rng.random(shape) < 0.1] = 0
    if cells > 1:
        unoccluded[0, 0], unoccluded[1, 0] = np.inf, np.nan
    reached = np.where(rng.random(shape) < sight, unoccluded, 0)
    learnable = np.arange(sources) != 3
    neighbours = rng.integers(0, cells + 1, (cells, 26)) * (rng.random((cells, 26)) < 0.3)
    looks = Looks.none(cells * sources)
    # In two parts where there is more than one cell
    for part in np.array_split(np.arange(cells), min(cells, 2)):
        spectrum = mi.UnpolarizedSpectrum(upload_vectors(mi.Color3f, np.repeat(reached[part].reshape(-1, 1), 3, 1)))
        light = upload(mi.Float, unoccluded[part])
        looks.write(int(part[0]) * sources, spectrum, light, upload(mi.UInt32, learnable) > 0)
    found = download(arriving_power(looks, sources, neighbours)).reshape(cells, sources)
    expected = expected_power(reached, unoccluded, learnable, neighbours)
    assert expected.any() == (sight > 0 and unoccluded.any())
    np.testing.assert_allclose(found, expected, rtol=1e-6)
