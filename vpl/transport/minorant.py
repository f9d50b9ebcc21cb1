"""Lambertian minorant of a BSDF: the diffuse part carried by virtual lights.

The minorant F of a BSDF is a constant reflected radiance per irradiance.  F depends only on the point and the side of
the surface, so a virtual light at x2 and a camera path through x2 agree on F.  The estimator stays unbiased for any F.
F close to the diffuse lobe leaves the least variance to trace.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero
from ..core.materials import Materials
from ..lights.perturbed import is_perturbed

# Incident and outgoing direction at which the BSDF is evaluated, on the side +z: 56 and 60 degrees from the normal and
# close to each other. Gloss and rough metal reflect next to nothing back to where light comes from at this angle
_INCIDENT, _OUTGOING = (np.array(d) / np.linalg.norm(d) for d in ((-0.35, 0.75, 0.5612), (-0.55, 0.67, 0.5)))


def side_of(si: mi.SurfaceInteraction3f) -> mi.Float:
    """+1 or -1: factor of the shading normal for the geometric side of arrival of a ray."""
    arrived = dr.dot(si.n, si.to_world(si.wi))
    return dr.mulsign(dr.mulsign(mi.Float(1), arrived), dr.dot(si.n, si.sh_frame.n))


def agrees(si: mi.SurfaceInteraction3f, side: mi.Float) -> mi.Bool:
    """Whether a ray arrived at the same side of the shading normal as of the surface."""
    return si.wi.z * side > 0


def is_diffuse(flags: mi.UInt32) -> mi.Bool:
    """Whether a BSDF with these flags has only a diffuse lobe: the minorant then describes every direction."""
    other_lobes = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
    return (flags & other_lobes) == 0


def with_minorant(materials: Materials) -> Materials:
    """Those of the ``materials`` that have a minorant.

    Two kinds of materials have none:

    - those with a bump or normal map: no BSDF sample goes above the surface but below the perturbed normal, so a
      virtual light there would carry light never subtracted by the traced part;
    - those without a diffuse lobe: BSDF samples rarely go to directions with a value as low as the minorant, and would
      subtract the minorant as fireflies.
    """
    diffuse = materials.having(mi.BSDFFlags.DiffuseReflection)
    return diffuse.where(lambda bsdf: not is_perturbed(bsdf))


def minorant_of(
    si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, side: mi.Float, materials: Materials, active: mi.Bool
) -> mi.UnpolarizedSpectrum:
    """Minorant F of a BSDF (1 / sr): the value for a fixed pair of directions on one side.

    ``side``: see :func:`side_of`; ``materials``: those with a minorant, see :func:`with_minorant`.  F is 0 for all
    others, and where a lane is not ``active``.
    """
    turned, to_side = mi.SurfaceInteraction3f(si), mi.Vector3f(1, 1, side)
    turned.wi, out = (mi.Vector3f(*direction.tolist()) * to_side for direction in (_INCIDENT, _OUTGOING))
    value = finite_or_zero(mi.unpolarized_spectrum(materials.call(bsdf, _value, turned, out, active=active)))
    return (value / dr.abs(out.z)) & active


def _value(bsdf, si, out, active):
    return bsdf.eval(mi.BSDFContext(), si, out, active)
