"""What one virtual light contributes to one gather point, without visibility: the only such formula in the project."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import rgb_to_spectrum, upload
from .lights import AT_INFINITY, VirtualLights, finite_or_zero

_RECORD = 16


@dataclass
class Light:
    """Lights in a kernel: one per lane.  Units as in :class:`vpl.lights.VirtualLights`."""

    position: object
    direction: object
    intensity: object
    depth: object
    cone: object


class DeviceLights:
    """Virtual lights of one kind on the device, as packed records that one gather fetches."""

    def __init__(self, lights: VirtualLights):
        records = np.zeros((lights.count, _RECORD), np.float32)
        if lights.position is not None:
            records[:, 0:3] = lights.position
        records[:, 3] = lights.depth.view(np.float32)
        records[:, 4:7] = lights.direction
        records[:, 8:11] = lights.intensity
        records[:, 12:14] = lights.cone
        self.kind = lights.kind
        self.count = lights.count
        self.scalar_intensity = lights.intensity.mean(1, dtype=np.float64)
        self._records = upload(mi.Float, records)

    def gather(self, index, active=True) -> Light:
        """Fetch one light per lane."""
        first = dr.gather(mi.Vector4f, self._records, index * 4, active)
        second = dr.gather(mi.Vector4f, self._records, index * 4 + 1, active)
        third = dr.gather(mi.Vector4f, self._records, index * 4 + 2, active)
        cone = mi.Vector2f(0)
        if self.kind == "spot":
            fourth = dr.gather(mi.Vector4f, self._records, index * 4 + 3, active)
            cone = mi.Vector2f(fourth.x, fourth.y)
        depth = dr.reinterpret_array(mi.UInt32, first.w)
        return Light(first.xyz, second.xyz, mi.Color3f(third.x, third.y, third.z), depth, cone)


def spot_falloff(cosine, cone):
    """Mitsuba's spot profile: 1 inside the beam, linear in the angle down to the cut-off, 0 outside.

    ``cosine``: of the angle to the axis; ``cone``: cut-off and beam angle in radians.
    """
    cutoff, beam = cone.x, cone.y
    slope = (cutoff - dr.safe_acos(cosine)) / (cutoff - beam)
    return dr.select(cosine >= dr.cos(beam), 1, dr.select(cosine > dr.cos(cutoff), slope, 0))


def geometry(kind: str, position, light: Light, smallest_distance):
    """Direction to the light and the factor by which its intensity arrives there.

    Returns (unit vector from ``position`` to the light, factor).  The factor is 1/d² for points, times the falloff for
    spots, cos/d² with d not smaller than ``smallest_distance`` for oriented lights ([IC] section 5: clamping), and 1
    for lights at infinity.  A light exactly at ``position`` has no direction: its factor is 0.
    """
    if kind in AT_INFINITY:
        return -light.direction, mi.Float(1)
    offset = light.position - position
    distance2 = dr.squared_norm(offset)
    apart = distance2 > 0
    to_light = offset * dr.select(apart, dr.rsqrt(distance2), 0)
    if kind == "oriented":
        cosine = dr.maximum(-dr.dot(light.direction, to_light), 0)
        factor = cosine / dr.maximum(distance2, dr.square(smallest_distance))
    else:
        factor = dr.rcp(distance2)
        if kind == "spot":
            factor *= spot_falloff(-dr.dot(light.direction, to_light), light.cone)
    return to_light, dr.select(apart, factor, 0)


def contribution(kind: str, surface, light: Light, smallest_distance, active=True):
    """Radiance that leaves a surface due to an unoccluded light: BSDF × cosine × geometry × intensity.

    ``surface``: see :mod:`vpl.surfaces`.  Values that are not finite count as zero.
    """
    to_light, factor = geometry(kind, surface.interaction.p, light, smallest_distance)
    active = active & (factor > 0)
    reflected = surface.reflected(to_light, active)
    return finite_or_zero(reflected * rgb_to_spectrum(light.intensity) * factor) & active
