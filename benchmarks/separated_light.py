"""Matrix recovery with separation of light, as in [MSR], instead of visibility; for comparisons."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def light_of_entries(unoccluded, present):
    """Entries of the separated matrix at full visibility: E divided by its mean (0 for zero light).

    Replaces :func:`vpl.matrix.recovery.whole_entries`; ``unoccluded``: E, Float.
    """
    total = float(dr.sum(dr.float64_array_t(mi.Float)(unoccluded))[0])
    return unoccluded * dr.opaque(mi.Float, dr.width(unoccluded) / total if total > 0 else 0.0)
