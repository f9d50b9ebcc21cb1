"""Share w of virtual lights in the light between two surfaces: the only place that computes w.

Light from a point x2 reaches a point x1 with the geometry term G = cosθ1 cosθ2 / d².  Virtual lights carry the share

    w = 1 / (1 + c² G),

and paths trace the rest, 1 - w.  w G never exceeds 1 / c², so no virtual light makes a bright spot nearby.  The bounds,
the contribution of a light and the traced part use the same functions: with different values of w, the sum of the two
parts would be biased.
"""

from __future__ import annotations

import drjit as dr


def carried_share(squared_c: float, geometry_term: float) -> float:
    """w, from c² (world units²) and the geometry term G (1 / world units²); 0 where G is infinite."""
    return dr.rcp(1 + squared_c * geometry_term)


def carried_geometry_term(squared_c: float, geometry_term: float) -> float:
    """w G, an increasing function of G; 1 / c² if G is infinite."""
    return dr.rcp(dr.rcp(geometry_term) + squared_c)
