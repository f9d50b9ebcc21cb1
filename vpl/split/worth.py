"""Worth of following a path: what it would still bring, next to what its pixel shows, against what following it costs.

Russian roulette by it ends paths where the same time spent on new ones takes more noise away [Vorba and Křivánek 2016,
"Adjoint-driven Russian roulette"; Rath et al. 2022, "EARS: efficiency-aware Russian roulette", eq. 14: a path goes on
in proportion to the root of its variance over its cost].  What surfaces send back is known from a pilot, site by site,
without regard to direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, upload
from .sites import Sites

# Paths are not ended with more probability, for what they are worth is known only roughly
_LEAST_SURVIVAL = 0.1
# Sites that are told apart; vertices of average radiance that each is taken to have had, besides its own
_MOST_SITES, _PRIOR = 1024, 4.0


@dataclass
class Worth:
    """``sites``, with the ``radiance`` that each sends back, root mean square; ``known``: whether anything is; opaque
    values."""

    sites: Sites
    radiance: object
    known: object

    @classmethod
    def unknown(cls) -> Worth:
        """Nothing is known: paths go on."""
        return cls(Sites.none(), upload(mi.Float, np.ones(2)), dr.opaque(mi.Bool, False))

    @classmethod
    def of(cls, position: np.ndarray, normal: np.ndarray, radiance: np.ndarray) -> tuple[Worth, np.ndarray]:
        """(Worth as known from vertices (n, 3) that sent back ``radiance`` (n,), what the others tell of each)."""
        sites, site = Sites.around(position, normal, _MOST_SITES)
        size = int(site.max()) + 1
        squared, number = np.bincount(site, radiance**2, size), np.bincount(site, minlength=size)
        prior = _PRIOR * np.mean(radiance**2)
        others = np.maximum(squared[site] - radiance**2, 0) + prior
        expected = np.sqrt(others / (number[site] - 1 + _PRIOR))
        rms = np.sqrt((squared + prior) / (number + _PRIOR))
        return cls(sites, upload(mi.Float, rms), dr.opaque(mi.Bool, True)), expected

    def survival(self, si, side, throughput, importance, left):
        """Probability with which a path goes on from a vertex.

        ``throughput`` with which it arrives there; ``importance``: what radiance is multiplied by to be compared with
        1, where a path is always worth its cost; ``left``: the share of the surface's reflection that is traced, by
        which alone paths end where nothing is known.
        """
        radiance = dr.gather(mi.Float, self.radiance, self.sites.at(si.p, si.sh_frame.n * side))
        worth = left * channel_mean(dr.abs(throughput)) * radiance * importance
        return dr.select(self.known, dr.clip(worth, _LEAST_SURVIVAL, 1), left)


def survival_of(worth: np.ndarray) -> np.ndarray:
    """Probabilities with which paths of some worth go on."""
    return np.clip(worth, _LEAST_SURVIVAL, 1)
