"""Matrix recovery that separates light, as [MSR] does, instead of visibility: kept to be compared with."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def light_of_entries(unoccluded, present):
    """Entries of the separated matrix where all arrives: E in units of its mean, 0 where there is none.

    Stands in for :func:`vpl.matrix.recovery.whole_entries`; ``unoccluded``: E, Float.
    """
    total = float(dr.sum(dr.float64_array_t(mi.Float)(unoccluded))[0])
    return unoccluded * dr.opaque(mi.Float, dr.width(unoccluded) / total if total > 0 else 0.0)
