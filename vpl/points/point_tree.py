"""A tree over gather points: a compressed octree by normal, then by position (NumPy only) [IC section 3].

Every point has a code of 63 bits: its material, three octree levels of the cube of unit normals, then sixteen levels of
the cube around the positions.  Sorted codes form a Morton curve, and every octree node is a contiguous range.
Following [IC], the tree is binary: an octant is halved along one axis after the other.  A range is split at the highest
bit that differs between its first and last code, which omits levels without a branch.

Departures from the paper, with reasons:

- The cube of normals has seven cells per axis instead of eight: 0 lies inside a cell.  With eight, rounding of normals
  would scatter the points of an axis-aligned wall over four cells.
- On request, materials are distinguished first ([IC] section 5 suggests it): bounds of lobes are tighter, and packets
  of points call a single BSDF.
- Far from the median position, cells grow with the distance.  Otherwise a few points at the horizon would leave most
  points in few cells.
- A leaf holds up to ``leaf_size`` points: their distance is that of neighbouring pixels, and kernels work on packets.
- Points with equal codes (coincident, or closer than the finest cell) are split by count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.morton import interleave

# Cells per axis of the cube of normals; bits per axis of its and of the positions' Morton codes; bits of the material
_NORMAL_CELLS, _NORMAL_BITS, _POSITION_BITS, _MATERIAL_BITS = 7, 3, 16, 6
# Points used to estimate percentiles of the positions
_SAMPLE = 1 << 16


@dataclass(frozen=True)
class PointTree:
    """A binary tree over n points with m nodes, numbered breadth first with adjacent siblings.

    ``order``: (n,) uint32, the caller's index of every point along the curve.
    ``first``, ``count``: (m,) uint32; the points of a node are ``order[first : first + count]``.
    ``child``: (m,) uint32, the first child, which the second child follows; 0 for a leaf.
    ``parent``: (m,) uint32, 0 for the root.
    ``levels``: first node of each level, then m: level k is ``levels[k]:levels[k + 1]``.
    ``leaf``: (n,) uint32, the leaf of each point along the curve.
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
        """Leaves along the curve, with consecutive ranges of points: (l,) int64."""
        begins = np.concatenate([[True], self.leaf[1:] != self.leaf[:-1]])
        return self.leaf[begins].astype(np.int64)

    def reduce(self, values: np.ndarray, function: np.ufunc) -> np.ndarray:
        """Reduce values of points, (n, ...) in the caller's order, to every node, (m, ...).

        ``function``: a binary ufunc such as np.minimum, np.maximum, np.add or np.logical_or.
        """
        leaves, values = self.leaves, values[self.order]
        if len(leaves) < len(values):
            values = function.reduceat(values, self.first[leaves], axis=0)
        return self.gather_up(values, leaves, function)

    def gather_up(self, at_leaves: np.ndarray, leaves: np.ndarray, function: np.ufunc) -> np.ndarray:
        """Reduce values of ``leaves`` to every node: ``function`` combines the values of both children."""
        result = np.zeros((self.size, *at_leaves.shape[1:]), at_leaves.dtype)
        result[leaves] = at_leaves
        for nodes, first, second in self._inner_from_below():
            result[nodes] = function(result[first], result[second])
        return result

    def push_down(self, values: np.ndarray) -> np.ndarray:
        """Add the values of every node's ancestors to its own: (m, ...) from (m, ...)."""
        result = values.copy()
        for first, last in zip(self.levels[1:-1], self.levels[2:], strict=True):
            result[first:last] += result[self.parent[first:last]]
        return result

    def _inner_from_below(self):
        """(Inner nodes, first children, second children) level by level from the deepest.

        The children of a level form the next level, with adjacent siblings: they are slices.
        """
        for k in range(len(self.levels) - 3, -1, -1):
            first, last, end = self.levels[k : k + 3]
            yield first + np.flatnonzero(self.child[first:last]), slice(last, end, 2), slice(last + 1, end, 2)


def _cells(position: np.ndarray) -> np.ndarray:
    """Cells of positions, (n, 3) float64 from 0 to 2^_POSITION_BITS - 1: uniform near the median, growing outwards."""
    sample = position[:: max(len(position) // _SAMPLE, 1)].astype(np.float64)
    low, middle, high = np.percentile(sample, (10, 50, 90), axis=0)
    unit = (high - low).max() or np.abs(position - middle).max() or 1.0
    # Nearly linear up to one unit, logarithmic beyond
    stretched = np.arcsinh((position - middle) / unit)
    stretched -= stretched.min(axis=0)
    return stretched * ((2**_POSITION_BITS - 1) / (stretched.max() or 1.0))


def point_codes(position: np.ndarray, normal: np.ndarray, material: np.ndarray | None = None) -> np.ndarray:
    """Codes of points, (n,) uint64: material, normal, position, from high to low bits."""
    by_normal = np.clip((normal + 1) * (0.5 * _NORMAL_CELLS), 0, _NORMAL_CELLS - 1)
    code = interleave(by_normal) << np.uint64(3 * _POSITION_BITS)
    code |= interleave(_cells(position))
    if material is not None:
        # Rank by first appearance among the points, because material numbers may differ between loads of a scene
        _, appearance, found = np.unique(material, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(appearance))[found].astype(np.uint64) & np.uint64(2**_MATERIAL_BITS - 1)
        code |= rank << np.uint64(3 * (_POSITION_BITS + _NORMAL_BITS))
    return code


def _split(codes: np.ndarray, first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """First index of the second half of each range of sorted codes."""
    low, high = codes[first], codes[first + count - 1]
    differing = low ^ high
    # Set every bit below the highest differing bit
    for shift in (1, 2, 4, 8, 16, 32):
        differing |= differing >> np.uint64(shift)
    halves = np.searchsorted(codes, high & ~(differing >> np.uint64(1)))
    return np.where(low == high, first + count // 2, halves)


def build_point_tree(position, normal, leaf_size: int = 1, material=None) -> PointTree:
    """Build the tree over points.

    position: (n, 3) float32, finite, world units, n > 0.  normal: (n, 3) float32 unit vectors.
    leaf_size: most points of a leaf, at least 1.  material: None, or (n,) integers, distinguished modulo 64.

    Raises ValueError with the argument's name if an input is invalid.
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
    """Raise a ValueError with the name of an array, (n, k), and its first non-finite row."""
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(axis=1)))
            raise ValueError(f"{name} must be finite, but row {row} is {values[row].tolist()}")


def tree_over_codes(codes: np.ndarray, leaf_size: int, leaf_bits: int = 63) -> PointTree:
    """Tree over points with the given codes, (n,) uint64: ranges are split at their highest differing bit.

    A leaf holds up to ``leaf_size`` points whose codes differ in the lowest ``leaf_bits`` bits only.
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
