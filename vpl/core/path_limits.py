"""Where paths end: the longest path and Russian roulette by throughput, as in Mitsuba's ``path``."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .arrays import upload_limit

# Largest survival probability in Mitsuba's ``path``
_MOST_SURVIVAL = 0.95


def throughput_survival(largest, eta, applies):
    """Survival probability of paths, like Mitsuba's ``path``; ``largest`` component of the throughput; ``eta``:
    relative index of refraction; 1 where roulette does not apply."""
    return dr.select(applies, dr.minimum(largest * dr.square(eta), _MOST_SURVIVAL), 1)


@dataclass
class PathLimits:
    """Limits on the device: ``max_depth``, the edges of the longest path; ``rr_depth``, the number of edges from which
    Russian roulette may end paths."""

    max_depth: mi.UInt32
    rr_depth: mi.UInt32

    @classmethod
    def of(cls, max_depth: float, rr_depth: int) -> PathLimits:
        """Opaque limits; ``max_depth`` may be infinite."""
        return cls(upload_limit(max_depth), dr.opaque(mi.UInt32, rr_depth))

    def survival(self, throughput, eta, depth) -> mi.Float:
        """Survival probability of paths with ``depth`` edges and a spectrum ``throughput``."""
        return throughput_survival(dr.max(throughput), eta, depth >= self.rr_depth)
