"""A tree over gather points: a compressed octree by normal, then by position (NumPy only) [IC section 3].

Every point gets a code of 63 bits: its material, three octree levels of the cube of unit normals, then sixteen of the
cube around all positions.  Sorted by code, points lie along a Morton curve, and every node of the octree is a
contiguous range. Following [IC], an octant is reached by halving along one axis after the other, so the tree is
binary: a range is split at the highest bit in which its first and last code differ, which leaves out every level that
would not branch.

Departures from the paper, and why:

- The cube of normals has seven cells a side instead of eight, so that 0 lies inside a cell: the rounding of the normals
  of a wall along an axis would otherwise scatter its points over four of them.
- Materials are told apart first, where the caller asks for it ([IC] section 5 suggests as much): bounds of lobes are
  tighter, and kernels work on packets of points that call one BSDF.
- Far from the middle of the points, cells grow with the distance from it.  A few points at the horizon would otherwise
  take all cells.
- A leaf holds up to ``leaf_size`` points.  They are as near to each other as the image resolves, and kernels work on
  packets of points.
- Points with one and the same code (coincident ones, or nearer to each other than the finest cell) are split by count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.morton import interleave

_NORMAL_CELLS, _NORMAL_BITS, _POSITION_BITS, _MATERIAL_BITS = 7, 3, 16, 6
# Points from which the extent of their middle is found
_SAMPLE = 1 << 16


@dataclass(frozen=True)
class PointTree:
    """A binary tree over n points; nodes are numbered breadth first, siblings next to each other.

    ``order``: (n,) uint32, the caller's index of every point along the curve; a node's points are
    ``order[first : first + count]``.
    ``first``, ``count``: (m,) uint32.
    ``child``: (m,) uint32, the first child, the second being the next node; 0 for a leaf.
    ``parent``: (m,) uint32, 0 for the root.
    ``levels``: node at which each level begins, and m: ``levels[k]:levels[k + 1]`` are the nodes of level k.
    ``leaf``: (n,) uint32, the leaf that holds each point along the curve.
    """

    order: np.ndarray
    first: np.ndarray
    count: np.ndarray
    child: np.ndarray
    parent: np.ndarray
    levels: np.ndarray
    leaf: np.ndarray

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self.first)

    @cached_property
    def leaves(self) -> np.ndarray:
        """Leaves along the curve, so that their ranges follow each other: (l,) int64."""
        begins = np.concatenate([[True], self.leaf[1:] != self.leaf[:-1]])
        return self.leaf[begins].astype(np.int64)

    def reduce(self, values: np.ndarray, function: np.ufunc) -> np.ndarray:
        """Combine a value of the points, (n, ...) in the caller's order, for every node, (m, ...).

        ``function``: np.minimum, np.maximum, np.add, np.logical_or ...
        """
        leaves, values = self.leaves, values[self.order]
        if len(leaves) < len(values):
            values = function.reduceat(values, self.first[leaves], axis=0)
        return self.gather_up(values, leaves, function)

    def gather_up(self, at_leaves: np.ndarray, leaves: np.ndarray, function: np.ufunc) -> np.ndarray:
        """Combine values of ``leaves`` for every node: a node's is ``function`` of its children's."""
        result = np.zeros((self.size, *at_leaves.shape[1:]), at_leaves.dtype)
        result[leaves] = at_leaves
        for nodes, first, second in self._inner_from_below():
            result[nodes] = function(result[first], result[second])
        return result

    def push_down(self, values: np.ndarray) -> np.ndarray:
        """Add to every node the values of all its ancestors: (m, ...) from (m, ...)."""
        result = values.copy()
        for first, last in zip(self.levels[1:-1], self.levels[2:], strict=True):
            result[first:last] += result[self.parent[first:last]]
        return result

    def _inner_from_below(self):
        """(Inner nodes, their first children, their second ones) level by level, the deepest level first.

        The children of a level's nodes are the next level, siblings next to each other, so slices pick them.
        """
        for k in range(len(self.levels) - 3, -1, -1):
            first, last, end = self.levels[k : k + 3]
            yield first + np.flatnonzero(self.child[first:last]), slice(last, end, 2), slice(last + 1, end, 2)


def _cells(position: np.ndarray) -> np.ndarray:
    """Cells of positions in a cube of 2^_POSITION_BITS a side, (n, 3) float64: even in the middle, growing outwards."""
    sample = position[:: max(len(position) // _SAMPLE, 1)].astype(np.float64)
    low, middle, high = np.percentile(sample, (10, 50, 90), axis=0)
    unit = (high - low).max() or np.abs(position - middle).max() or 1.0
    # Linear up to about the unit, then logarithmic
    stretched = np.arcsinh((position - middle) / unit)
    stretched -= stretched.min(axis=0)
    return stretched * ((2**_POSITION_BITS - 1) / (stretched.max() or 1.0))


def point_codes(position: np.ndarray, normal: np.ndarray, material: np.ndarray | None = None) -> np.ndarray:
    """Codes of points, (n,) uint64: the material above where the normal points to above where the point is."""
    by_normal = np.clip((normal + 1) * (0.5 * _NORMAL_CELLS), 0, _NORMAL_CELLS - 1)
    code = interleave(by_normal) << np.uint64(3 * _POSITION_BITS)
    code |= interleave(_cells(position))
    if material is not None:
        # By first appearance among the points: the numbers themselves may differ from one load of a scene to the next
        _, appearance, found = np.unique(material, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(appearance))[found].astype(np.uint64) & np.uint64(2**_MATERIAL_BITS - 1)
        code |= rank << np.uint64(3 * (_POSITION_BITS + _NORMAL_BITS))
    return code


def _split(codes: np.ndarray, first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Places at which the second half of each range of sorted codes begins."""
    low, high = codes[first], codes[first + count - 1]
    differing = low ^ high
    # Every bit below the highest one that differs, by filling downwards
    for shift in (1, 2, 4, 8, 16, 32):
        differing |= differing >> np.uint64(shift)
    halves = np.searchsorted(codes, high & ~(differing >> np.uint64(1)))
    return np.where(low == high, first + count // 2, halves)


def build_point_tree(position, normal, leaf_size: int = 1, material=None) -> PointTree:
    """Build the tree over points.

    position: (n, 3) float32, finite, world units, n > 0.  normal: (n, 3) float32 unit vectors.
    leaf_size: most points of a leaf, at least 1.  material: None, or (n,) integers; different ones are kept apart as
    far as 64 classes go.

    Raises ValueError, naming the argument, where an input is not as described.
    """
    if leaf_size < 1:
        raise ValueError(f"leaf_size must be at least 1, got {leaf_size}")
    for name, values in (("position", position), ("normal", normal)):
        if values.ndim != 2 or values.shape[1] != 3 or len(values) != len(position) or len(values) == 0:
            raise ValueError(f"{name} must have the shape (n, 3) with one n > 0 for both, got {values.shape}")
    require_finite(position=position, normal=normal)
    length = np.einsum("ij,ij->i", normal, normal)
    if (np.abs(length - 1) > 1e-3).any():
        row = int(np.argmax(np.abs(length - 1)))
        raise ValueError(f"normal must be of unit length, but row {row} is {normal[row].tolist()}")
    return tree_over_codes(point_codes(position, normal, material), leaf_size)


def require_finite(**arrays: np.ndarray) -> None:
    """Raise a ValueError that names the array, (n, k), and its first row that is not finite."""
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(axis=1)))
            raise ValueError(f"{name} must be finite, but row {row} is {values[row].tolist()}")


def tree_over_codes(codes: np.ndarray, leaf_size: int, leaf_bits: int = 63) -> PointTree:
    """The tree over points with the given codes, (n,) uint64: ranges split at the highest bit that differs in them.

    A leaf holds up to ``leaf_size`` points whose codes differ in their lowest ``leaf_bits`` bits only.
    """
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    first, count = np.zeros(1, np.int64), np.array([len(codes)])
    parents, nodes = np.zeros(1, np.int64), np.arange(1)
    levels, found = [0], []
    while len(nodes):
        inner = (count > leaf_size) | ((codes[first] ^ codes[first + count - 1]) >> np.uint64(leaf_bits) != 0)
        child = np.where(inner, levels[-1] + len(nodes) + 2 * (np.cumsum(inner) - inner), 0)
        found.append((first, count, child, parents))
        levels.append(levels[-1] + len(nodes))
        begin, length = first[inner], count[inner]
        middle = _split(codes, begin, length)
        parents = np.repeat(nodes[inner], 2)
        first = np.stack([begin, middle], axis=1).reshape(-1)
        count = np.stack([middle - begin, begin + length - middle], axis=1).reshape(-1)
        nodes = levels[-1] + np.arange(len(first))
    first, count, child, parent = (np.concatenate(column).astype(np.uint32) for column in zip(*found, strict=True))
    at_leaves = np.flatnonzero(child == 0)
    at_leaves = at_leaves[np.argsort(first[at_leaves])]
    leaf = np.repeat(at_leaves.astype(np.uint32), count[at_leaves])
    return PointTree(order.astype(np.uint32), first, count, child, parent, np.array(levels), leaf)
