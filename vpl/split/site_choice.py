"""Choice among sources of light by what a pilot's vertices see of them, place by place.

Space is divided into cubes, and the vertices in a cube by the way that they face: a site.  Sites in which the pilot's
paths had vertices learn which sources light them: from some of their vertices a few rays go to every source, and what
neighbouring cubes found counts as well.  A share of the samples is kept for the usual choice, which is all that other
sites have.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, upload, upload_vectors
from ..core.sampling import RowChoice, independent_sampler
from .irradiance import Places
from .sites import Sites

# Rays by which sources are learned, as a share of the camera rays
_LEARNING_SHARE = 0.25
# Rays from a site to each source; how many of them all sites may have together
_RAYS_EACH, _MOST_RAYS = 2, 1 << 20
# Rays from a site that those of its neighbours count for, at most; rays from these that the visibility on average
# counts for
_NEIGHBOURS, _PRIOR = 4.0, 1.0


def learning_rays(paths: int) -> int:
    """Number of rays to learn by, for so many camera rays."""
    return int(_LEARNING_SHARE * paths)


class SiteChoice:
    """The choice of sources by site; before :meth:`learn`, the usual one everywhere.

    ``usual`` (n,) float64: probabilities of sources, which sum to 1; ``share`` of the samples that keep them;
    ``ignored``: indices of sources that nothing is learned of.
    """

    def __init__(self, usual: np.ndarray, share: float, ignored: np.ndarray):
        self.count, self._stride = len(usual), dr.opaque(mi.UInt32, len(usual) + 1)
        self._usual, self._share, self._ignored = usual, share, ignored
        # While it learns, every source has a site of its own, at which no other is drawn
        self._learns = dr.opaque(mi.Bool, False)
        self.forget()

    def _use(self, probability: np.ndarray) -> None:
        """``probability`` (sites, sources) float64 of each source; rows sum to 1."""
        self._rows = RowChoice(probability.ravel(), np.full(len(probability), self.count))

    @property
    def pmf(self) -> np.ndarray:
        """Probabilities (sites + 1, sources) with which sources are drawn; first where nothing is known."""
        return self._rows.pmf.reshape(-1, self.count)

    # ---------------------- Learning ----------------------

    def forget(self) -> None:
        """Know nothing of any place."""
        self._sites = Sites.none()
        # Twice, because arrays of one entry make other kernels
        self._use(np.stack([self._usual, self._usual]))

    def learn(self, position: np.ndarray, normal: np.ndarray, rays: int, seed: int, look: Callable) -> bool:
        """Learn from vertices, (n, 3) each, with about so many rays at most: whether anything was learned.

        ``look(places, site)``: what :func:`vpl.split.irradiance.irradiance_from_emitters` finds by one sample each."""
        each = _RAYS_EACH * self.count
        most = min(rays, _MOST_RAYS) // each
        if most < 1 or len(position) == 0:
            return False
        self._sites, site = Sites.around(position, normal, most)
        size = np.bincount(site)[1:]
        order, sites = np.argsort(site, kind="stable"), len(size)
        first = upload(mi.UInt32, np.cumsum(size) - size)
        lane = dr.arange(mi.UInt32, sites * each)
        row = lane // dr.opaque(mi.UInt32, each)
        source = lane // _RAYS_EACH % dr.opaque(mi.UInt32, self.count)
        sampler = independent_sampler(seed, len(lane))
        number = mi.UInt32(sampler.next_1d() * mi.Float(dr.gather(mi.UInt32, upload(mi.UInt32, size), row)))
        vertex = dr.gather(mi.UInt32, first, row) + number
        position, normal = (upload_vectors(mi.Point3f, x[order]) for x in (position, normal))
        facing = mi.Normal3f(dr.gather(mi.Point3f, normal, vertex))
        # Normals twice, as arrays of their own, so that the kernel is that of lights, which have two
        places = Places(dr.gather(mi.Point3f, position, vertex), facing + dr.opaque(mi.Float, 0.0), facing)
        dr.eval(places, source)
        self._learns = dr.opaque(mi.Bool, True)
        reached, unoccluded = look(places, source)
        self._learns = dr.opaque(mi.Bool, False)
        reached, unoccluded = (
            download(x).astype(np.float64).reshape(sites, self.count, _RAYS_EACH)
            for x in (channel_mean(reached), unoccluded)
        )
        self._use(self._shares(unoccluded, reached > 0))
        return True

    def _shares(self, unoccluded: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Probabilities (sites + 1, sources) by root mean squares of what arrived; first where nothing is known."""
        possible = np.nan_to_num(unoccluded, posinf=0) ** 2
        possible[:, self._ignored] = 0
        found = possible * seen
        # The less neighbours have looked, the more a source is expected to be seen as often as the site sees others and
        # others see that source
        of_site, of_source, of_all = (_share(found, possible, axes) for axes in ((1, 2), (0, 2), (0, 1, 2)))
        visible = np.minimum(of_site * of_source / max(float(of_all.squeeze()), 1e-9), 1)[..., 0]
        found, possible = found.mean(2), possible.mean(2)
        # Roots of what the neighbours found: some of them are next to an emitter that is far from here
        expected, rays = self._of_neighbours(found**0.5, (visible * possible) ** 0.5)
        rays = np.minimum(rays, _NEIGHBOURS)
        power = ((_RAYS_EACH * found + rays * expected**2) / (_RAYS_EACH + rays)) ** 0.5
        total = power.sum(1, keepdims=True)
        learned = np.where(total > 0, power / np.maximum(total, np.finfo(np.float64).tiny), self._usual)
        return np.concatenate([self._usual[None], (1 - self._share) * learned + self._share * self._usual])

    def _of_neighbours(self, power: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(Mean ``power`` (sites, sources) at the neighbours of each site, with a ``guess`` as if it was some rays'; by
        how many rays that is known, (sites, 1))."""
        neighbours, total = self._sites.neighbours(), _PRIOR * guess
        # Nothing comes from where no neighbour is
        padded = np.concatenate([np.zeros((1, self.count)), _RAYS_EACH * power])
        for neighbour in neighbours.T:
            total += padded[neighbour]
        rays = _RAYS_EACH * np.count_nonzero(neighbours, 1)[:, None] + _PRIOR
        return total / rays, rays

    # ---------------------- Sampling ----------------------

    def site(self, position, facing):
        """The site of each vertex; ``facing``: shading normal, on the side that is seen."""
        return self._sites.at(position, facing)

    def draw(self, site, number, active):
        """A source for each site by a uniform number: (source, its probability, another uniform number)."""
        known = active & ~self._learns
        row = self._rows.draw(site, number, known)
        source = dr.select(self._learns, site, row - self._row(site))
        probability = dr.select(self._learns, 1, self._rows.probability(row, known))
        return source, probability, dr.select(self._learns, number, self._rows.rest(row, number, known))

    def probability(self, site, source, active):
        """Probability of a source at each site."""
        known = self._rows.probability(self._row(site) + source, active & ~self._learns)
        return dr.select(self._learns, dr.select(active & (site == source), mi.Float(1), 0), known)

    def _row(self, site):
        """Where the row of a site begins in the table of probabilities."""
        return site * self._stride


def _share(found: np.ndarray, possible: np.ndarray, axes: tuple) -> np.ndarray:
    """Share of the possible rays that found light, over some axes, which are kept."""
    return np.count_nonzero(found, axes, keepdims=True) / np.maximum(np.count_nonzero(possible, axes, keepdims=True), 1)


class NoChoice:
    """A choice that is everywhere the same, in the place of a :class:`SiteChoice`."""

    def learn(self, position: np.ndarray, normal: np.ndarray, rays: int, seed: int, look: Callable) -> bool:
        """There is nothing to learn."""
        return False

    def site(self, position, facing):
        """The only site."""
        return mi.UInt32(0)
