"""Surfaces that random lines meet, each counted once per crossing.

Single precision places a hit on a large shape up to some 1e-7 of the size of the shape beside the true surface: a
millimetre on a planet of ten kilometres.  Three consequences matter to virtual lights:

- A ray that continues behind a hit meets the same surface again.  Between two crossings of a primitive in the same
  direction, a line must cross it in the other direction.  So a hit of the same primitive as the hit before, on the same
  side, is no other crossing.
- A line may find a surface outside of its box that lies inside, and the other way round.  So lines begin and end
  outside of their boxes by more than the error, and hits inside count.  The distance is random, because distances along
  a ray to a large shape are multiples of the error.
- The next ray that arrives finds the surface elsewhere and may end before the light.  So a light knows the uncertainty
  of its position, and shadow rays end above the surface by so much.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, select_record, upload, upload_vectors
from ..core.loops import recorded_once
from ..core.registry import RegistryTable
from ..lights.emitters import registered_shapes
from .line_sampling import Lines

# Largest distance between a surface and a point found on it, as a fraction of the extent of its shape: two units in the
# last place
_UNCERTAINTY = 2.0**-22
# Step behind a surface that is met again, as a fraction of the rest of the line; doubled each time
_FIRST_STEP = 1e-6
# Surfaces that a line may meet: ends an endless row of hits at one place
_MOST_LAYERS = 1024


@dataclass
class LineHits:
    """Crossings of lines with surfaces, one per lane, evaluated.

    ``ray``: begins shortly before the surface; ``position``: where the line meets the surface, world units;
    ``uncertainty`` of that position along the normal, world units.
    """

    ray: mi.Ray3f
    position: mi.Point3f
    uncertainty: mi.Float

    @property
    def count(self) -> int:
        return len(self.uncertainty)


def hits_of(scene, lines: Lines, scene_size: float, generator) -> LineHits:
    """All crossings of ``lines`` with surfaces inside their boxes, line by line; ``scene_size``: world units."""
    margin = _UNCERTAINTY * scene_size
    before = (margin * (1 + generator.random(len(lines.length)))).astype(np.float32)
    origin, direction = (
        upload_vectors(mi.Vector3f, x) for x in (lines.origin - before[:, None] * lines.direction, lines.direction)
    )
    segments = origin, direction, upload(mi.Float, lines.length + before + np.float32(margin))
    extents = _extents(scene)
    # The same kernel counts the crossings and finds them
    number = _meet(scene, segments, extents, dr.zeros(mi.UInt32, len(before)), False, _Found.none(1))
    found = _Found.none(int(dr.sum(number)[0]))
    if dr.width(found.line):
        _meet(scene, segments, extents, dr.prefix_reduce(dr.ReduceOp.Add, number), True, found)
    # Position and box as the density sees them
    row = np.flatnonzero(lines.hold(download(found.line), download(found.position)))
    found = dr.gather(_Found, found, upload(mi.UInt32, row))
    hits = LineHits(
        mi.Ray3f(found.start, dr.gather(mi.Vector3f, direction, found.line)), found.position,
        _UNCERTAINTY * found.extent,
    )  # fmt: skip
    dr.eval(hits)
    return hits


def _extents(scene) -> RegistryTable:
    """Bits of the extent of each shape that is no mesh, single precision, world units; 0 for meshes."""
    shapes = [(index, shape.bbox()) for index, shape in registered_shapes(scene) if not shape.is_mesh()]
    extent = np.float32([max(box.extents()) if box.valid() else 0 for _, box in shapes])
    return RegistryTable([index for index, _ in shapes], extent.view(np.uint32))


@dataclass
class _Found:
    """Output arrays of :func:`_meet`.

    ``start`` of the ray to a surface; ``position`` on the surface; ``extent`` of its shape; number of the ``line``.
    """

    start: mi.Point3f
    position: mi.Point3f
    extent: mi.Float
    line: mi.UInt32

    @classmethod
    def none(cls, count: int) -> _Found:
        """Arrays of ``count`` entries, not written yet."""
        zeros = (dr.zeros(kind, count) for kind in (mi.Point3f, mi.Point3f, mi.Float, mi.UInt32))
        return cls(*zeros)


@recorded_once
@dr.syntax
def _meet(scene, lines, extents: RegistryTable, first, find: bool, found: _Found):
    """Number of surfaces that each of the ``lines`` (origin, direction, length) crosses.

    With ``find``, writes them to ``found``, for each line from the index ``first`` on.
    """
    origin, direction, length = lines
    find = dr.opaque(mi.Bool, find)
    dr.make_opaque(first, found)
    place, remaining, number = mi.Point3f(origin), mi.Float(length), dr.zeros(mi.UInt32, dr.width(length))
    this, active = dr.arange(mi.UInt32, dr.width(length)), length > 0
    step, last = mi.Float(0), _Primitive.none(dr.width(length))
    while dr.hint(active, exclude=[scene, origin, direction, length, extents, first, find, this, found]):
        ray = mi.Ray3f(place, direction, remaining, 0.0, [])
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=active)
        active &= si.is_valid()
        si.p, met = ray(si.t), _Primitive.of(si, direction)
        again = met.equals(last)
        crossed = active & ~again
        extent = dr.reinterpret_array(mi.Float, extents.at(si.shape, crossed))
        dr.scatter(found, _Found(place, si.p, extent, this), first + number, crossed & find)
        number += dr.select(crossed, 1, 0)
        last = select_record(active, met, last)
        onward = si.spawn_ray(direction)
        step = dr.select(again, dr.maximum(2 * step, _FIRST_STEP * length), 0)
        place, remaining = dr.select(active, onward.o + step * direction, place), remaining - si.t - step
        active &= (remaining > 0) & (number < _MOST_LAYERS)
    dr.eval(number, found)
    return number


@dataclass
class _Primitive:
    """Primitive that a line met, and from which side."""

    shape: mi.UInt32
    instance: mi.UInt32
    number: mi.UInt32
    enters: mi.Bool

    @classmethod
    def none(cls, count: int) -> _Primitive:
        """Nothing met so far."""
        return cls(*(dr.zeros(mi.UInt32, count) for _ in range(3)), dr.zeros(mi.Bool, count))

    @classmethod
    def of(cls, si, direction) -> _Primitive:
        """The primitive that a ray met at ``si``."""
        shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (si.shape, si.instance))
        return cls(shape, instance, mi.UInt32(si.prim_index), dr.dot(si.n, direction) < 0)

    def equals(self, other: _Primitive) -> mi.Bool:
        """Whether both are the same primitive from the same side."""
        same = (self.shape == other.shape) & (self.instance == other.instance)
        return same & (self.number == other.number) & (self.enters == other.enters)
