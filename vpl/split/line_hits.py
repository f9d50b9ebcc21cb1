"""Crossings of random lines with surfaces, each counted once.

Single precision places a hit on a large shape up to some 1e-7 of the size of the shape beside the true surface: a
millimetre on a planet of ten kilometres.  Three consequences matter to virtual lights:

- A ray that continues behind a hit meets the same surface again.  Between two crossings of a primitive in the same
  direction, a line must cross it in the other direction.  A repeated hit of a primitive on the same side is therefore
  no new crossing.
- A line may find a surface outside of the box although the surface lies inside, or inside although the surface lies
  outside.  Lines therefore begin and end outside of the box by more than the error, and hits inside count.  The
  distance is random, because distances along a ray to a large shape are multiples of the error.
- The next arriving ray finds the surface elsewhere and may end before the light.  A light therefore stores the
  uncertainty of its position, and shadow rays end above the surface by the uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, select_record, upload
from ..core.loops import recorded_once
from ..core.meshes import corners_of
from ..core.sampling import independent_sampler
from ..core.shapes import SceneShapes, registered_shapes
from .line_sampling import Lines

# Largest distance between a surface and a point found on it, as a fraction of the extent of the shape or triangle: two
# units in the last place
_UNCERTAINTY = 2.0**-22
# Step behind a surface after a repeated hit, as a fraction of the rest of the line; doubled each time
_FIRST_STEP = 1e-6
# Largest number of hits of a line: ends an endless row of hits at a single place
_MOST_LAYERS = 1024


@dataclass
class LineHits:
    """Crossings of lines with surfaces.

    ``ray``: begins shortly before each surface; ``position``: crossing of line and surface; both evaluated;
    ``uncertainty`` (n,) float32: uncertainty of ``position`` along the normal.  World units.
    """

    ray: mi.Ray3f
    position: mi.Point3f
    uncertainty: np.ndarray

    @property
    def count(self) -> int:
        return len(self.uncertainty)


def hits_of(scene, lines: Lines, scene_size: float, seed: int) -> LineHits:
    """Crossings of ``lines`` with surfaces inside the boxes, line by line; ``scene_size``: world units."""
    margin = dr.opaque(mi.Float, _UNCERTAINTY * scene_size)
    before = margin * (1 + independent_sampler(seed, lines.count).next_1d())
    segments = lines.origin - before * lines.direction, lines.direction, lines.length + before + margin
    dr.eval(segments)
    # The same kernel counts and records the crossings
    number = _meet(scene, segments, dr.zeros(mi.UInt32, lines.count), False, _Found.none(1))
    found = _Found.none(int(dr.sum(number)[0]))
    if dr.width(found.line):
        _meet(scene, segments, dr.prefix_reduce(dr.ReduceOp.Add, number), True, found)
    # Uses the position and box of the density
    found = dr.gather(_Found, found, dr.compress(lines.hold(found.line, found.position)))
    ray = mi.Ray3f(found.start, dr.gather(mi.Vector3f, lines.direction, found.line))
    dr.eval(ray, found)
    return LineHits(ray, found.position, _uncertainty(scene, found, scene_size))


@dataclass
class _Found:
    """Output arrays of :func:`_meet`.

    ``start`` of the ray to a surface; ``position`` on the surface; registry index of its ``shape``; number of the
    ``primitive``; number of the ``line``.
    """

    start: mi.Point3f
    position: mi.Point3f
    shape: mi.UInt32
    primitive: mi.UInt32
    line: mi.UInt32

    @classmethod
    def none(cls, count: int) -> _Found:
        """Arrays of ``count`` entries, not written yet."""
        kinds = (mi.Point3f, mi.Point3f, mi.UInt32, mi.UInt32, mi.UInt32)
        return cls(*(dr.zeros(kind, count) for kind in kinds))


def _uncertainty(scene, found: _Found, scene_size: float) -> np.ndarray:
    """Uncertainty of positions, (n,) float32, if above Mitsuba's offset of rays; 0 elsewhere."""
    position, shape = download(found.position), download(found.shape)
    offset = mi.math.RayEpsilon * (1 + np.abs(position).max(1, initial=0))
    shapes = dict(registered_shapes(scene))
    extents = np.zeros(int(shape.max(initial=0)) + 1)
    # Shapes of groups are not registered
    for index in np.intersect1d(shape, list(shapes)):
        box = shapes[index].bbox()
        # Rectangles that Mitsuba merged have no box
        extents[index] = max(box.extents()) if box.valid() else scene_size
    uncertainty = (_UNCERTAINTY * extents[shape]).astype(np.float32)
    large = uncertainty > offset
    for index in np.unique(shape[large]):
        if shapes[index].is_mesh():
            row = np.flatnonzero(large & (shape == index))
            triangle = dr.gather(mi.UInt32, found.primitive, upload(mi.UInt32, row))
            uncertainty[row] = _UNCERTAINTY * _longest_edges(shapes[index], triangle)
    return np.where(uncertainty > offset, uncertainty, np.float32(0))


def has_large_curves(scene) -> bool:
    """Whether hits on a shape that is no mesh are more uncertain than Mitsuba's offset of rays near the origin."""
    shapes = SceneShapes.of(scene)
    meshes = [group for group in shapes.groups if all(shape.is_mesh() for _, shape in group.shapes)]
    of_meshes = {index for group in meshes for index, _ in group.instances}
    curves = (shape for index, shape in shapes.own if not shape.is_mesh() and index not in of_meshes)
    boxes = (shape.bbox() for shape in curves)
    return any(_UNCERTAINTY * max(box.extents()) > mi.math.RayEpsilon for box in boxes if box.valid())


def _longest_edges(mesh, triangle: mi.UInt32) -> np.ndarray:
    """Longest edge of each ``triangle`` of a mesh, (n,) float32, world units."""
    corners = corners_of(mesh, triangle)
    lengths = [dr.norm(corners[k] - corners[k - 1]) for k in range(3)]
    return download(dr.maximum(dr.maximum(lengths[0], lengths[1]), lengths[2]))


@recorded_once
@dr.syntax
def _meet(scene, lines, first, find: bool, found: _Found):
    """Number of surface crossings of each of the ``lines`` (origin, direction, length).

    With ``find``, writes them to ``found``, for each line from the index ``first`` on.
    """
    origin, direction, length = lines
    find = dr.opaque(mi.Bool, find)
    dr.make_opaque(first, found)
    place, remaining, number = mi.Point3f(origin), mi.Float(length), dr.zeros(mi.UInt32, dr.width(length))
    this, active = dr.arange(mi.UInt32, dr.width(length)), length > 0
    step, last = mi.Float(0), _Primitive.none(dr.width(length))
    while dr.hint(active, exclude=[scene, origin, direction, length, first, find, this, found]):
        ray = mi.Ray3f(place, direction, remaining, 0.0, [])
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=active)
        active &= si.is_valid()
        si.p, met = ray(si.t), _Primitive.of(si, direction)
        again = met.equals(last)
        crossed = active & ~again
        crossing = _Found(place, si.p, met.shape, met.number, this)
        dr.scatter(found, crossing, first + number, crossed & find)
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
    """Primitive and side of a hit."""

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
        """The primitive hit by a ray at ``si``."""
        shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (si.shape, si.instance))
        return cls(shape, instance, mi.UInt32(si.prim_index), dr.dot(si.n, direction) < 0)

    def equals(self, other: _Primitive) -> mi.Bool:
        """Whether both are the same primitive from the same side."""
        same = (self.shape == other.shape) & (self.instance == other.instance)
        return same & (self.number == other.number) & (self.enters == other.enters)
