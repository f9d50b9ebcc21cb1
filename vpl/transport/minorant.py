"""Lambertian minorant of a BSDF: the diffuse part carried by virtual lights.

The minorant F of a BSDF is a constant reflected radiance per irradiance, for light from the directions of a
:class:`Lobe`.  Both depend only on the point and the side of the surface, so a virtual light at x2 and a camera path
through x2 agree on them.  The estimator stays unbiased for any F and any lobe.  Values close to those of the diffuse
lobe leave the least variance to trace.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, finite_or_zero
from ..core.materials import Materials, tells_density
from ..lights.perturbed import is_perturbed


def _pair(angle: float, azimuth: float) -> tuple[list[float], list[float]]:
    """Incident and outgoing direction on the side +z: ``angle`` - 4 and ``angle`` degrees from the normal, and 14
    degrees of azimuth from each other."""
    angles = np.radians([(angle - 4, azimuth - 14), (angle, azimuth)])
    return tuple([float(np.sin(h) * np.cos(a)), float(np.sin(h) * np.sin(a)), float(np.cos(h))] for h, a in angles)


# The directions at which BSDFs are evaluated are close to each other and far from the normal. Gloss and rough metal
# reflect next to nothing back to where light comes from at this angle
_PAIR = _pair(60, 129)
# The same for estimates of perturbed normals, in four directions around the normal
_AROUND = [_pair(45, azimuth) for azimuth in (0, 90, 180, 270)]
# Largest difference of the sums of the values at opposite directions, as a fraction of the whole sum: a Lambertian
# surface has none, rounding and weak gloss make some percent
_LARGEST_DIFFERENCE = 0.1


def outward_of(si: mi.SurfaceInteraction3f) -> mi.Normal3f:
    """Geometric normal on the side where a ray arrived."""
    return si.n * dr.mulsign(mi.Float(1), dr.dot(si.n, si.to_world(si.wi)))


def side_of(si: mi.SurfaceInteraction3f) -> mi.Float:
    """+1 or -1: factor of the shading normal for the geometric side of arrival of a ray."""
    return dr.mulsign(mi.Float(1), dr.dot(outward_of(si), si.sh_frame.n))


def agrees(si: mi.SurfaceInteraction3f, side: mi.Float) -> mi.Bool:
    """Whether a ray arrived at the same side of the shading normal as of the surface."""
    return si.wi.z * side > 0


def is_diffuse(flags: mi.UInt32) -> mi.Bool:
    """Whether a BSDF with these flags has only a diffuse lobe: the minorant then describes every direction."""
    other_lobes = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
    return (flags & other_lobes) == 0


@dataclass
class Lobe:
    """Cosine lobes, one per lane, cut off below the surface.

    ``normal``: axis, in world space: the shading normal on the side of arrival, or an estimate of a normal that a bump
    or normal map perturbs; ``outward``: geometric normal on this side.
    """

    normal: mi.Normal3f
    outward: mi.Normal3f

    def cosine(self, direction: mi.Vector3f) -> mi.Float:
        """Cosine of world space directions to the axis; 0 behind the axis or below the surface."""
        return dr.select(dr.dot(self.outward, direction) > 0, dr.maximum(dr.dot(self.normal, direction), 0), 0)


class Minorants:
    """Minorants of the materials with a diffuse lobe.

    Other materials have none: their BSDF samples rarely go to directions with a value as low as the minorant, and would
    subtract the minorant as fireflies.  Neither have blends and masks of materials with a bump or normal map: the
    density of their samples is not that of :mod:`vpl.split.covered`.

    ``perturbed``: the materials of these with a bump or normal map, None if there are none.
    """

    def __init__(self, materials: Materials):
        diffuse = materials.having(mi.BSDFFlags.DiffuseReflection)
        self._materials = diffuse.where(lambda bsdf: tells_density(bsdf) or not is_perturbed(bsdf))
        perturbed = list(filter(is_perturbed, self._materials.bsdfs))
        self.perturbed = Materials(perturbed) if perturbed else None

    def at(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, side: mi.Float, active: mi.Bool
    ) -> tuple[mi.UnpolarizedSpectrum, Lobe]:
        """Minorant F of a BSDF (1 / sr) on one ``side``, see :func:`side_of`, and its lobe; F is 0 for materials
        without a minorant, and where a lane is not ``active``."""
        facing = si.sh_frame.n * side
        if self.perturbed is None:
            value = self._materials.call(bsdf, _value, si, side, active=active)
        else:
            value, axis = self._materials.call(bsdf, self._value_and_axis, si, side, active=active)
            facing = dr.select(dr.squared_norm(axis) > 0, si.to_world(axis), facing)
        value = finite_or_zero(mi.unpolarized_spectrum(value)) & active
        return value, Lobe(mi.Normal3f(facing), outward_of(si))

    def _value_and_axis(self, bsdf, si, side, active):
        """(F, axis of the lobe in the frame of the surface, or 0 for the shading normal).

        Photometric stereo: values of a Lambertian surface at four directions give its normal times its reflectance over
        pi, and the sums of the values at opposite directions are equal.  F is 0 where they differ, or where a value is
        0: a direction is below the horizon of the perturbed normal, more than 45 degrees from the shading normal, or
        shows gloss.
        """
        if bsdf not in self.perturbed:
            return _value(bsdf, si, side, active), mi.Vector3f(0)
        values = [finite_or_zero(mi.unpolarized_spectrum(_value(bsdf, si, side, active, pair))) for pair in _AROUND]
        east, north, west, south = map(channel_mean, values)
        total, difference = east + west + north + south, east + west - north - south
        # Values are over the cosine of the direction to the shading normal, and that of 45 degrees is its sine
        axis = mi.Vector3f(east - west, north - south, total / 2)
        length = dr.norm(axis)
        known = (dr.minimum(dr.minimum(east, west), dr.minimum(north, south)) > 0) & (
            dr.abs(difference) < _LARGEST_DIFFERENCE * total
        )
        value = sum(values) * (length / (2 * total))
        return dr.select(known, value, 0), dr.select(known, axis / length * mi.Vector3f(1, 1, side), 0)


def _value(bsdf, si, side, active, pair=_PAIR):
    """Reflected radiance per irradiance for a ``pair`` of directions."""
    turned, to_side = mi.SurfaceInteraction3f(si), mi.Vector3f(1, 1, side)
    turned.wi, out = (mi.Vector3f(*direction) * to_side for direction in pair)
    return bsdf.eval(mi.BSDFContext(), turned, out, active) / pair[1][2]
