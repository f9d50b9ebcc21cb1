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
from ..lights.perturbed import Perturbed

# Four unit vectors make three consecutive pairs (incident, outgoing) at which the BSDF is evaluated. All vectors stay
# away from the horizon and no pair is near a mirror direction. The last vector looks back at 60 degrees, where the
# rough metal of a blend material reflects next to nothing.
_DIRECTIONS = [
    np.array(d) / np.linalg.norm(d) for d in ((0, 0, 1), (0.6, 0, 0.8), (-0.35, 0.75, 0.5612), (-0.55, 0.67, 0.5))
]
_PAIRS = len(_DIRECTIONS) - 1


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


@dr.syntax
def minorant_of(
    si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, side: mi.Float, perturbed: Perturbed, active: mi.Bool
) -> mi.UnpolarizedSpectrum:
    """Minorant F of a BSDF (1 / sr): the least value over three fixed pairs of directions on one side.

    A BSDF with only a diffuse lobe has the same value in all directions, and is evaluated for a single pair.  ``side``:
    see :func:`side_of`.  F is 0

    - where a lane is not ``active``;
    - on ``perturbed`` shapes: no BSDF sample goes above the surface but below the perturbed normal, so a virtual light
      there would carry light never subtracted by the traced part;
    - for a BSDF without a diffuse lobe: BSDF samples rarely go to directions with a value as low as the minorant, and
      would subtract the minorant as fireflies.
    """
    flags = bsdf.flags()
    active &= mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) & ~perturbed.at(si, active)
    context, turned = mi.BSDFContext(), mi.SurfaceInteraction3f(si)
    # Inactive lanes skip the loop
    pair = dr.select(active, dr.select(is_diffuse(flags), mi.UInt32(_PAIRS - 1), 0), _PAIRS)
    least = dr.full(mi.UnpolarizedSpectrum, dr.inf, dr.width(active))
    # A loop in the kernel holds the code of every material once instead of three times
    while dr.hint(pair < _PAIRS, exclude=[si, context, perturbed, turned]):
        turned.wi, out = _direction(pair, side), _direction(pair + 1, side)
        value = finite_or_zero(mi.unpolarized_spectrum(bsdf.eval(context, turned, out, active)))
        least = dr.minimum(least, value / dr.abs(out.z))
        pair += 1
    return least & active


def _direction(number: mi.UInt32, side: mi.Float) -> mi.Vector3f:
    """A fixed direction on one side of a surface."""
    direction = mi.Vector3f(*_DIRECTIONS[0].tolist())
    for k, other in enumerate(_DIRECTIONS[1:], 1):
        direction = dr.select(number == k, mi.Vector3f(*other.tolist()), direction)
    return direction * mi.Vector3f(1, 1, side)
