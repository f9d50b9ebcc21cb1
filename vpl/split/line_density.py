"""Density of random lines on surfaces by place, for kernels: a table along the Morton curve of the octree.

Nodes of the octree are ranges of Morton codes.  The ends of the ranges of all boxes cut the curve into intervals, and
an interval lies in at most one leaf and in a fixed set of parents.  A single search finds the interval of a place.  On
the side of a surface with the normal n, the density is

    anywhere + A + n·B.

Each interval has two records of A and B, for places outside and inside of the box of its leaf.  A box with the surface
area S that is drawn with probability p, with the mean normal M, adds p / S (1 + n·M): see
:mod:`vpl.split.line_sampling`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.morton import interleaved
from ..core.sampling import last_at_most
from .arrival_octree import LEVELS, SCENE_SHARE, ArrivalOctree, Boxes

# Levels of the octree whose nodes have a guide to the search: 32 768 guides, so that most searches end in a few steps
_GUIDED = 5
# Beyond every coordinate in single precision, world units
_REMOTE = 1e100


@dataclass
class LineDensity:
    """Expected hits of a line in an area of ``unit``², the squared extent of the scene, which keeps the numbers small.

    ``low``, ``per_cell``: lower corner of the octree, and the inverse of the size of its finest cells; ``guides``: for
    each node of the level ``_GUIDED``, the first interval and the last + 1; ``start``: Morton code of each interval;
    ``terms``: two records (B, A) of each interval; ``box``: lower and upper corner of the box in the leaf, four numbers
    each; ``anywhere``: through the whole scene.  World units; opaque.
    """

    unit: float
    low: mi.Point3d
    per_cell: mi.Float64
    guides: mi.UInt32
    start: mi.UInt64
    terms: mi.Float
    box: mi.Float
    anywhere: mi.Float

    @classmethod
    def of(cls, octree: ArrivalOctree) -> LineDensity:
        """The density of the lines through the boxes of an octree."""
        of_leaves, of_parents = _ranges(octree.leaves), _ranges(octree.parents)
        start = np.unique(np.concatenate([[np.uint64(8**LEVELS)], *of_leaves, *of_parents]))
        unit, box = octree.scene_size, np.zeros((len(start), 2, 4), np.float32)
        # Upper corners below the lower ones: nothing lies in the box of an interval without a leaf
        box[:, 1] = -1
        terms = np.repeat(_sum_of_parents(octree.parents, start, unit)[:, None], 2, 1)
        interval, row = _held(start, *of_leaves)
        terms[interval, 1] += _terms(octree.leaves, unit)[row]
        box[interval, :, :3] = _rounded_inwards(octree.leaves)[row]
        of_guide = (8**_GUIDED + np.arange(8**_GUIDED + 1, dtype=np.uint64)) << np.uint64(3 * (LEVELS - _GUIDED))
        first = np.searchsorted(start, of_guide[:-1], side="right") - 1
        guides = np.stack([first, np.searchsorted(start, of_guide[1:], side="left")], 1)
        # At least two entries: arrays of a single one change the kernels
        start, terms, box = (np.concatenate([x, x[-1:]]) for x in (start, terms, box))
        return cls._of(unit, octree.low, octree.size, guides, start, terms, box, SCENE_SHARE / 6)

    @classmethod
    def even(cls) -> LineDensity:
        """A density of one at every place, in world units: every place lies outside of a remote octree."""
        none = np.zeros((2, 2, 4))
        return cls._of(1.0, np.full(3, _REMOTE), 1.0, none[0], none[0, 0], none, none, 1.0)

    @classmethod
    def _of(cls, unit, low, size, guides, start, terms, box, anywhere) -> LineDensity:
        return cls(
            float(unit), mi.Point3d(*(dr.opaque(mi.Float64, float(x)) for x in low)),
            dr.opaque(mi.Float64, 2.0**LEVELS / size), upload(mi.UInt32, guides.ravel()), upload(mi.UInt64, start),
            upload(mi.Float, terms.ravel()), upload(mi.Float, box.ravel()),
            dr.opaque(mi.Float, float(anywhere)),
        )  # fmt: skip

    def at(self, position: mi.Point3f, normal: mi.Vector3f, active=True) -> mi.Float:
        """The density on the sides of surfaces with a ``normal``."""
        cell = (mi.Point3d(position) - self.low) * self.per_cell
        inside = active & dr.all((cell >= 0) & (cell < 2.0**LEVELS))
        code = interleaved([mi.UInt64(dr.select(inside, x, 0)) for x in cell]) | 8**LEVELS
        guide = mi.UInt32(code >> (3 * (LEVELS - _GUIDED))) & (8**_GUIDED - 1)
        first, last = dr.gather(mi.Vector2u, self.guides, guide, inside)
        row = last_at_most(self.start, first, last, code)
        low, high = (dr.gather(mi.Vector4f, self.box, 2 * row + k, inside) for k in range(2))
        in_box = dr.all((position >= low.xyz) & (position <= high.xyz))
        terms = dr.gather(mi.Vector4f, self.terms, 2 * row + dr.select(in_box, mi.UInt32(1), 0), inside)
        return self.anywhere + dr.select(inside, dr.maximum(terms.w + dr.dot(mi.Vector3f(normal), terms.xyz), 0), 0)

    def per_area(self, density: np.ndarray) -> np.ndarray:
        """Densities (n,) from :meth:`at` per world unit², float64, which holds the squares of small distances."""
        return density.astype(np.float64) / self.unit**2


def _rounded_inwards(boxes: Boxes) -> np.ndarray:
    """Lower and upper corners (n, 2, 3) of boxes in single precision, with the same single-precision points inside."""
    low, high = boxes.low, boxes.low + boxes.size
    corners = np.stack([low, high], 1).astype(np.float32)
    below, above = corners[:, 0] < low, corners[:, 1] > high
    corners[:, 0][below] = np.nextafter(corners[:, 0], np.float32(np.inf))[below]
    corners[:, 1][above] = np.nextafter(corners[:, 1], np.float32(-np.inf))[above]
    return corners


def _ranges(boxes: Boxes) -> tuple[np.ndarray, np.ndarray]:
    """First Morton code at the finest level, and the last + 1, of the nodes of boxes."""
    below = (3 * (LEVELS - boxes.level)).astype(np.uint64)
    return boxes.number << below, (boxes.number + np.uint64(1)) << below


def _terms(boxes: Boxes, unit: float) -> np.ndarray:
    """Records (n, 4) of boxes: the factors of the normal, and the density at a right angle to them, per ``unit``²."""
    density = boxes.chance * (unit**2 / boxes.surface)
    return np.concatenate([density[:, None] * boxes.turn, density[:, None]], 1)


def _held(start: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Intervals from ``start`` on that lie in one of the disjoint ranges; the range of each)."""
    order = np.argsort(first)
    place = np.searchsorted(first[order], start, side="right") - 1
    row = order[np.maximum(place, 0)]
    held = np.flatnonzero((place >= 0) & (start < last[row]))
    return held, row[held]


def _sum_of_parents(parents: Boxes, start: np.ndarray, unit: float) -> np.ndarray:
    """Sum of the records of the parents around each interval, (n, 4).  Parents of a level are disjoint."""
    first, last = _ranges(parents)
    terms, total = _terms(parents, unit), np.zeros((len(start), 4))
    for level in np.unique(parents.level):
        of_level = np.flatnonzero(parents.level == level)
        interval, row = _held(start, first[of_level], last[of_level])
        total[interval] += terms[of_level][row]
    return total
