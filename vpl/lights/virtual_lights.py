"""Virtual lights: stored columns, device records, and the geometry of light arriving at a point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import carries_light, upload, usable

# Kinds of virtual light. "point" and "spot" lights radiate from a real point of the scene and are never clamped.
# "oriented" and "surface" lights represent a piece of surface; "surface" lights taper off nearby, and paths trace the
# missing light. "directional" and "environment" lights lie at infinity: an "environment" light represents a piece of
# sky within reach of a camera path, a "directional" light an emitter out of reach.
KINDS = ("point", "spot", "oriented", "directional", "environment", "surface")

AT_INFINITY = ("directional", "environment")

_RECORD = 16
_COLUMNS = ("position", "direction", "intensity", "depth", "cone", "group", "facing", "uncertainty", "c")


@dataclass
class VirtualLights:
    """Lights of a single kind, as NumPy arrays of n rows.

    ``position`` (n, 3) float32, world units (None for lights at infinity);
    ``direction`` (n, 3) float32: surface normal, spot axis, or the travel direction of the light;
    ``intensity`` (n, 3) float32: radiant intensity of points and spots, exitant flux / pi of oriented lights
    (radiance times area), irradiance of lights at infinity;
    ``depth`` (n,) uint32: edges of the light path up to the light, 0 for lights representing an emitter;
    ``cone`` (n, 2) float32: cut-off angle and beam angle of spots in radians, (pi, pi) elsewhere;
    ``group`` (n,) uint32: of the emitter of the light, see :class:`vpl.lights.emitter_groups.EmitterGroups`;
    ``facing`` (n, 3) float32: normal of the lit half-space of lights on surfaces, for example a shading normal (None:
    only ``direction`` limits the light);
    ``uncertainty`` (n,) float32: of the position of lights on surfaces along ``direction``, world units (None: 0);
    ``c`` (n,) float32: of surface lights, see :mod:`vpl.transport.carried_share`, world units (None: 0).
    """

    kind: str
    position: np.ndarray | None
    direction: np.ndarray
    intensity: np.ndarray
    depth: np.ndarray
    cone: np.ndarray
    group: np.ndarray
    facing: np.ndarray | None = None
    uncertainty: np.ndarray | None = None
    c: np.ndarray | None = None

    @property
    def count(self) -> int:
        return len(self.intensity)

    @classmethod
    def of(cls, kind, position, direction, intensity, depth=0, cone=None, facing=None) -> VirtualLights:
        """Convert any sequences to the documented shapes and types."""
        intensity = np.asarray(intensity, np.float32).reshape(-1, 3)
        count = len(intensity)
        return cls(
            kind,
            None if position is None else np.asarray(position, np.float32).reshape(-1, 3),
            np.asarray(direction, np.float32).reshape(-1, 3),
            intensity,
            np.broadcast_to(np.asarray(depth, np.uint32), (count,)).copy(),
            np.full((count, 2), np.pi, np.float32) if cone is None else np.asarray(cone, np.float32).reshape(-1, 2),
            np.zeros(count, np.uint32),
            None if facing is None else np.asarray(facing, np.float32).reshape(-1, 3),
        )

    def select(self, keep) -> VirtualLights:
        """The rows picked by a mask or an index array."""
        columns = (getattr(self, name) for name in _COLUMNS)
        return VirtualLights(self.kind, *(None if column is None else column[keep] for column in columns))

    @staticmethod
    def concatenate(parts: list[VirtualLights]) -> VirtualLights:
        """Join lights of the same kind."""
        if any(part.facing is not None for part in parts):
            parts = [part if part.facing is not None else replace(part, facing=part.direction) for part in parts]
        joined = [
            None if getattr(parts[0], c) is None else np.concatenate([getattr(p, c) for p in parts]) for c in _COLUMNS
        ]
        return VirtualLights(parts[0].kind, *joined)

    def without_bad(self) -> tuple[VirtualLights, int]:
        """Drop lights without intensity and lights with an invalid value (not finite, or a negative intensity or an
        intensity above ``LARGEST_VALUE``); returns the number of lights with an invalid value."""
        finite = usable(self.intensity).all(1) & np.isfinite(self.direction).all(1)
        if self.position is not None:
            finite &= np.isfinite(self.position).all(1)
        keep = finite & carries_light(self.intensity)
        return (self if keep.all() else self.select(keep)), int((~finite).sum())


@dataclass
class Light:
    """Lights in a kernel, a light per lane.  Units as in :class:`vpl.lights.virtual_lights.VirtualLights`."""

    position: mi.Point3f
    direction: mi.Vector3f
    intensity: mi.Color3f
    depth: mi.UInt32
    cone: mi.Vector2f
    group: mi.UInt32
    facing: mi.Vector3f | None = None
    uncertainty: mi.Float | None = None
    c: mi.Float | None = None


class DeviceLights:
    """Virtual lights of a single kind on the device, as packed records."""

    def __init__(self, lights: VirtualLights):
        records = np.zeros((lights.count, _RECORD), np.float32)
        if lights.position is not None:
            records[:, 0:3] = lights.position
        records[:, 3] = lights.depth.view(np.float32)
        records[:, 4:7] = lights.direction
        if lights.uncertainty is not None:
            records[:, 7] = lights.uncertainty
        records[:, 8:11] = lights.intensity
        records[:, 11] = lights.group.view(np.float32)
        records[:, 12:14] = lights.cone
        if lights.facing is not None:
            records[:, 12:15] = lights.facing
        if lights.c is not None:
            records[:, 15] = lights.c
        self.kind = lights.kind
        self._facing = lights.facing is not None
        self.count = lights.count
        self.scalar_intensity = lights.intensity.mean(1, dtype=np.float64)
        self._records = upload(mi.Float, records)

    def gather(self, index, active=True) -> Light:
        """Fetch one light per lane."""
        first = dr.gather(mi.Vector4f, self._records, index * 4, active)
        second = dr.gather(mi.Vector4f, self._records, index * 4 + 1, active)
        third = dr.gather(mi.Vector4f, self._records, index * 4 + 2, active)
        cone, facing, c = mi.Vector2f(0), None, mi.Float(0)
        if self.kind in ("spot", "surface") or self._facing:
            fourth = dr.gather(mi.Vector4f, self._records, index * 4 + 3, active)
            cone, facing = mi.Vector2f(fourth.x, fourth.y), fourth.xyz if self._facing else None
            c = fourth.w
        depth = dr.reinterpret_array(mi.UInt32, first.w)
        color = mi.Color3f(third.x, third.y, third.z)
        group = dr.reinterpret_array(mi.UInt32, third.w)
        return Light(first.xyz, second.xyz, color, depth, cone, group, facing, second.w, c)


def spot_falloff(cosine, cone):
    """Mitsuba's spot profile: 1 inside the beam, linear in the angle down to the cut-off, 0 outside.

    ``cosine``: of the angle to the axis; ``cone``: cut-off and beam angle in radians.
    """
    cutoff, beam = cone.x, cone.y
    slope = (cutoff - dr.safe_acos(cosine)) / (cutoff - beam)
    return dr.select(cosine >= dr.cos(beam), 1, dr.select(cosine > dr.cos(cutoff), slope, 0))


def geometry(kind: str, position, light: Light, smallest_distance):
    """Direction to the light, and the ratio of arriving irradiance to intensity.

    Returns (unit vector from ``position`` to the light, factor).  The factor is

    - 1/d² for points, times the falloff for spots;
    - cos/d² for oriented lights, with d clamped to at least ``smallest_distance`` ([IC] section 5);
    - cos/d² for surface lights;
    - 1 for lights at infinity.

    The factor is 0 where a light does not face ``position``, and for a light exactly at ``position``, because the
    direction is undefined.
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
    elif kind == "surface":
        cosine = dr.maximum(-dr.dot(light.direction, to_light), 0)
        factor = cosine / distance2
    else:
        factor = dr.rcp(distance2)
        if kind == "spot":
            factor *= spot_falloff(-dr.dot(light.direction, to_light), light.cone)
    arrives = apart if light.facing is None else apart & (dr.dot(light.facing, to_light) < 0)
    return to_light, dr.select(arrives, factor, 0)
