"""Floors of BSDFs, and how much of a connection virtual lights carry.

Radiance that a point x1 receives from a point x2 on another surface is split in two,

    f1 f2 = w F1 F2 + (f1 f2 - w F1 F2),    w = 1 / (1 + c² cosθ1 cosθ2 / d²).

The first term is left to virtual lights at x2, the second is traced.  F, the *floor* of a BSDF, is its Lambertian part:
a function of the point and of the side of the surface alone, so that whoever makes a light at x2 and whoever meets x2
on a path from the camera agree on it.  Any F and any w keep the sum as it is; a floor that is close to the diffuse
lobe, and a c that grows with the distance between lights, leave the least noise.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero
from ..lights.perturbed import Perturbed

# The pairs of directions at which a BSDF is looked at: unit vectors well away from the horizon, of which no pair is
# near a mirror direction.  The last looks back along itself at 60 degrees: where a texture leaves but the rough metal
# of a blend, that reflects next to nothing there
_DIRECTIONS = [
    np.array(d) / np.linalg.norm(d) for d in ((0, 0, 1), (0.6, 0, 0.8), (-0.35, 0.75, 0.5612), (-0.55, 0.67, 0.5))
]
_PAIRS = len(_DIRECTIONS) - 1


def side_of(si):
    """+1 or -1: the sign that turns the shading normal to the side of the geometric surface that a ray arrived at."""
    arrived = dr.dot(si.n, si.to_world(si.wi))
    return dr.mulsign(dr.mulsign(mi.Float(1), arrived), dr.dot(si.n, si.sh_frame.n))


def agrees(si, side):
    """Whether a ray arrived at the same side of the shading normal as of the surface."""
    return si.wi.z * side > 0


@dr.syntax
def floor_of(si, bsdf, side, perturbed: Perturbed, active):
    """The floor F of a BSDF: its least value over three fixed pairs of directions on one side, an unpolarized spectrum.

    ``side``: see :func:`side_of`.  0 where not ``active``; on ``perturbed`` shapes, because light from directions above
    the surface but below their normal would be carried, and never taken off: no sample of the BSDF goes there; and for
    BSDFs without a diffuse lobe: samples of others hardly ever go where these are as low as their floor, and would take
    it off in fireflies.
    """
    active &= mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection) & ~perturbed.at(si, active)
    context, turned = mi.BSDFContext(), mi.SurfaceInteraction3f(si)
    # Where no floor is asked for, none is looked at
    pair = dr.select(active, mi.UInt32(0), _PAIRS)
    least = dr.full(mi.UnpolarizedSpectrum, dr.inf, dr.width(active))
    # A loop of kernels, so that the code of every material is in them once
    while dr.hint(pair < _PAIRS, exclude=[si, context, perturbed, turned]):
        turned.wi, out = _direction(pair, side), _direction(pair + 1, side)
        value = finite_or_zero(mi.unpolarized_spectrum(bsdf.eval(context, turned, out, active)))
        least = dr.minimum(least, value / dr.abs(out.z))
        pair += 1
    return least & active


def _direction(number, side):
    """A fixed direction on one side of a surface."""
    direction = mi.Vector3f(*_DIRECTIONS[0].tolist())
    for k, other in enumerate(_DIRECTIONS[1:], 1):
        direction = dr.select(number == k, mi.Vector3f(*other.tolist()), direction)
    return direction * mi.Vector3f(1, 1, side)


def carried_share(squared_c, cosine1, cosine2, distance2):
    """w of the split, from the cosines at both ends and the squared distance; 0 at distance 0."""
    return distance2 / (distance2 + squared_c * cosine1 * cosine2)


def carried_share_of_emitter(squared_c, nearness, cosine):
    """w for light straight from an emitter, by its ``nearness``: cosine there over squared distance, infinite where no
    virtual light stands for it; ``cosine``: at the vertex."""
    return dr.rcp(1 + squared_c * nearness * cosine) & dr.isfinite(nearness)
