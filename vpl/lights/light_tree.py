"""Light tree: a binary tree over point-like lights, built bottom-up with NumPy, in a layout for stackless traversal.

Every node stores bounds of its lights (box of positions, cone of directions), their summed flux and a representative
light [LC, section 3]. Parallel locally-ordered clustering (:mod:`vpl.lights.clustering`) builds the tree: every cluster
searches its cheapest partner within ``window`` neighbours to either side. The merge cost is the cluster size [LC,
section 5]

    intensity * (α² + c² (1 − cos β)²),     α: diagonal of the merged box, β: half-angle of the merged cone.

Departures from the papers, measured on 60,000 lights (a room of boxes and spheres, the same room with bumpy normals,
ellipsoids; see benchmarks/light_tree.py) by the mean size of a cut of 2% for a diffuse receiver:

- The clustering replaces 1 − cos β by d² / 8, where d is the diagonal of the box of the directions. The two agree for
  close directions; for a hemisphere the replacement is half. Cuts are 2 to 5% smaller than with cones joined pairwise.
- c is a quarter of the scene's diagonal (``angular_weight`` = 1/16; the paper uses 1). The paper's weight lowers the
  paper's cost by 20 to 30%, but makes cuts 21% larger on ellipsoids, 35% on bumpy walls and 2% on flat walls.
- The Morton code contains no directions: with directions, cuts shrank by 7% on flat walls and grew by 40% on bumpy
  walls.

Kernels use :class:`vpl.lights.device_tree.DeviceTree`.

[LC] Walter et al. 2005, Lightcuts: a scalable approach to illumination.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import carries_light
from ..core.cones import COSINE_ROUNDING
from ..core.morton import morton_order
from .clustering import (
    accumulate,
    cluster,
    cone_axes,
    layout,
    nearest_in_window,
    reduce_over_leaves,
    require_rows,
)

# Factor of the squared angular term of the metric: a quarter of the scene's diagonal, squared
ANGULAR_WEIGHT = 1 / 16
# Neighbours along the curve, to either side, that may become the partner of a cluster
WINDOW = 16
# Columns of LightTree.records, and their number
BOX_MIN, BOX_MAX, CONE_AXIS, CONE_COS = slice(0, 3), slice(3, 6), slice(6, 9), 9
INTENSITY, FLUX, ESCAPE, REPRESENTATIVE = 10, slice(11, 14), 14, 15
# Clusters of surface lights have no representative, and the least c of their lights instead
LEAST_C = REPRESENTATIVE
COLUMNS = 16


@dataclass(frozen=True)
class LightTree:
    """A tree over n lights: 2n - 1 records in preorder.

    The children of the inner node i are i + 1 and escape[i + 1]; for a leaf, escape[i] == i + 1. Traversal starts at
    i = 0, refines a node by i = i + 1, accepts or skips a whole subtree by i = escape[i], and stops at 2n - 1.

    records: (2n - 1, 16) float32. BOX_MIN, BOX_MAX: exact bounds of the positions, world units (zeros for lights at
      infinity). CONE_AXIS, CONE_COS: unit axis and cosine of the half-angle of a cone around the directions (+z and -1
      for omnidirectional lights). INTENSITY, FLUX: summed flux, as the mean over channels and per channel. ESCAPE,
      REPRESENTATIVE: uint32 bit patterns, see the properties. LEAST_C: in place of REPRESENTATIVE, see ScatteredGroup.
    leaf_order: (n,) uint32, the caller's indices of the lights in preorder. A node's lights are a contiguous range.
    depth: edges from the root to the deepest leaf.
    """

    records: np.ndarray
    leaf_order: np.ndarray
    depth: int

    @property
    def escape(self) -> np.ndarray:
        """(2n - 1,) uint32 view: first node after each node's subtree."""
        return self.records.view(np.uint32)[:, ESCAPE]

    @property
    def representative(self) -> np.ndarray:
        """(2n - 1,) uint32 view: representative light of each node, an index into the caller's arrays; 0 in trees
        without any."""
        return self.records.view(np.uint32)[:, REPRESENTATIVE]

    @property
    def is_leaf(self) -> np.ndarray:
        """(2n - 1,) bool: whether a node is a leaf. The leaves hold the lights in the order of ``leaf_order``."""
        return self.escape == np.arange(len(self.records)) + 1


def build_light_tree(position, direction, flux, rng=None, window=WINDOW, angular_weight=ANGULAR_WEIGHT) -> LightTree:
    """Cluster lights into a binary tree by the method of the module's docstring.

    position: (n, 3) float32, world units; None for lights at infinity, which are clustered by direction alone.
    direction: (n, 3) float32 unit vectors; None for omnidirectional lights, which are clustered by position alone.
    flux: (n, 3) float32, finite, not negative, any unit, positive in at least one channel per light.
    rng: numpy.random.Generator for the representatives, None for a tree without any; the topology is independent of it.
    window: neighbours tried to either side, 1 to 1024; clustering time is proportional to the window.
    angular_weight: factor of the squared angular term of the metric, relative to the squared positional term.

    Raises ValueError with the argument's name and the first invalid light.
    """
    if not 1 <= window <= 1024:
        raise ValueError(f"window must be from 1 to 1024, got {window}")
    if not 0 <= angular_weight < np.inf:
        raise ValueError(f"angular_weight must be finite and not negative, got {angular_weight}")
    position, direction, flux = _validate(position, direction, flux)
    order = _sort_lights(position, direction)
    clusters = _start_clusters(position, direction, flux, order, angular_weight)
    rounds = _cluster(clusters, int(window), position is not None)
    return _assemble(order, rounds, position, direction, flux, rng)


def cluster_sizes(records: np.ndarray) -> np.ndarray:
    """Cluster size [LC, section 5] of every node of a tree, (m,) float64, from its records, (m, 16).

    Unit: intensity times the squared diagonal of the root's box; for lights without positions, intensity alone.
    """
    diagonal2 = np.square(records[:, BOX_MAX].astype(np.float64) - records[:, BOX_MIN]).sum(1)
    angular = np.square(1 - records[:, CONE_COS].astype(np.float64))
    if diagonal2[0] > 0:
        angular = ANGULAR_WEIGHT * angular + diagonal2 / diagonal2[0]
    return records[:, INTENSITY] * angular


def _validate(position, direction, flux):
    """Return the inputs as float32 arrays or None; raise ValueError if build_light_tree does not allow them."""
    if position is None and direction is None:
        raise ValueError("position and direction are both None: clustering needs at least one of them")
    arrays = {"flux": flux, "position": position, "direction": direction}
    for name, value in arrays.items():
        if value is None and name != "flux":
            continue
        with np.errstate(over="ignore"):  # overflow to infinity is rejected below
            array = arrays[name] = np.asarray(value, dtype=np.float32)
        if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
            raise ValueError(f"{name} must have the shape (n, 3) with n > 0, got {array.shape}")
        require_rows(np.isfinite(array).all(axis=1), name, array, "finite")
        if len(array) != len(arrays["flux"]):
            raise ValueError(f"{name} has {len(array)} rows, but flux has {len(arrays['flux'])}")
    flux, position, direction = arrays.values()
    require_rows((flux >= 0).all(axis=1), "flux", flux, "not negative")
    require_rows(carries_light(flux), "flux", flux, "positive in some channel")
    if flux.sum(axis=0, dtype=np.float64).max() > np.finfo(np.float32).max:
        raise ValueError("flux is too large: its sum over the lights exceeds float32")
    if direction is not None:
        length = np.linalg.norm(direction.astype(np.float64), axis=1)
        require_rows(np.abs(length - 1) < 1e-3, "direction", direction, "of unit length")
    return position, direction, flux


def _sort_lights(position, direction):
    """Indices of the lights along a Morton curve with 21 bits per axis, (n,) int64."""
    by_direction = position is None or (direction is not None and (position == position[0]).all())
    return morton_order((direction if by_direction else position).astype(np.float64))


def _start_clusters(position, direction, flux, order, angular_weight):
    """Clusters of one light each in ``order``: (2k + 1, n) float32, boxes and a last row of intensities.

    The first k rows are negated lower corners, the next k upper corners: one maximum joins two boxes, and one sum gives
    extents. k is 3, or 6 with positions (in units of the scene's largest extent) before directions. A factor s on
    directions includes all factors of the metric: (s d)⁴ = angular_weight c² (d² / 8)², where c is the diagonal.
    """
    corners, weight, diagonal = [], 1.0, 1.0  # without positions any scale gives the same order of costs
    if position is not None:
        low = position.min(axis=0).astype(np.float64)
        extent = position.max(axis=0) - low
        largest = extent.max() or 1.0
        corners += [((position[:, axis] - low[axis]) / largest).astype(np.float32)[order] for axis in range(3)]
        if extent.max() > 0:
            weight, diagonal = angular_weight, np.linalg.norm(extent / largest)
    if direction is not None:
        scale = np.float32(weight**0.25 * (diagonal / 8) ** 0.5)
        corners += [direction[:, axis][order] * scale for axis in range(3)]
    upper = np.stack(corners)
    # The factor reserves most float32 exponents for dim lights and keeps the sum of all lights finite
    mean = flux.mean(axis=1, dtype=np.float64)[order]
    return np.concatenate([-upper, upper, (mean / mean.max() * 2.0**64).astype(np.float32)[None]])


def _cluster(clusters, window, has_position):
    """Rounds of merges (:mod:`vpl.lights.clustering`) of the clusters from _start_clusters."""

    def cost(first, second):
        return _merge_cost(first, second, has_position)

    return cluster(clusters, lambda clusters: nearest_in_window(clusters, window, cost), _join)


def _join(first, second):
    """Merge pairs of clusters: first, second and result are (2k + 1, r)."""
    joined = np.maximum(first, second)
    np.add(first[-1], second[-1], out=joined[-1])
    return joined


def _merge_cost(first, second, has_position):
    """Cluster size [LC, section 5] of merged pairs of clusters, (r,) float32."""
    half, joined = len(first) // 2, np.maximum(first[:-1], second[:-1])
    extent = np.square(np.add(joined[:half], joined[half:], out=joined[:half]), out=joined[:half])
    for axis in range(0, half, 3):
        extent[axis] += extent[axis + 1]
        extent[axis] += extent[axis + 2]
    cost = extent[0]
    if not has_position:
        cost *= cost
    elif half > 3:
        extent[3] *= extent[3]
        cost += extent[3]
    cost *= first[-1] + second[-1]
    return cost


def _assemble(order, rounds, position, direction, flux, rng) -> LightTree:
    """Lay out a clustering of the lights in ``order`` in preorder, with exact bounds and float64 sums."""
    node_at, leaves, depth = layout(len(order), rounds)
    leaf_order = order[node_at[node_at < len(order)]]

    records = np.zeros((len(node_at), COLUMNS), np.float32)
    if position is not None:
        for columns, operation in ((BOX_MIN, np.minimum), (BOX_MAX, np.maximum)):
            records[:, columns] = accumulate(position.take(order, axis=0).T, rounds, operation).T
    total = accumulate(flux.take(order, axis=0).T.astype(np.float64), rounds, np.add)
    records[:, INTENSITY], records[:, FLUX] = total.mean(axis=0), total.T
    bits = records.view(np.uint32)
    bits[node_at, ESCAPE] = np.arange(len(node_at)) + 2 * leaves - 1
    if rng is not None:
        bits[:, REPRESENTATIVE] = _draw_representatives(order, rounds, total.mean(axis=0), rng)
    records[:, CONE_AXIS], records[:, CONE_COS] = (0, 0, 1), -1
    if direction is not None:
        unit = (direction / np.linalg.norm(direction.astype(np.float64), axis=1, keepdims=True)).astype(np.float32)
        axis = cone_axes(unit.take(order, axis=0).T, rounds).astype(np.float32)
        unit = unit.take(leaf_order, axis=0).T.copy()
        records[:, CONE_AXIS] = axis.T
        records[node_at, CONE_COS] = _cone_cosines(axis.take(node_at, axis=1), unit, leaves, depth)
    return LightTree(records.take(node_at, axis=0), leaf_order.astype(np.uint32), int(depth.max()))


def _draw_representatives(order, rounds, intensity, rng):
    """Representative light of every node, (2n - 1,) int64: a child's, drawn in proportion to the children's intensity.

    A light represents a node with probability (light's intensity) / (node's intensity) [LC, section 3.1], therefore
    cuts are unbiased. One child of every node has the same representative as the node.
    """
    representative = np.concatenate([order, np.empty(len(order) - 1, np.int64)])
    draw = np.concatenate([np.empty(len(order)), rng.random(len(order) - 1)])
    for nodes, left, right in rounds:
        takes_left = draw[nodes] * (intensity[left] + intensity[right]) < intensity[left]
        representative[nodes] = representative[np.where(takes_left, left, right)]
    return representative


def _cone_cosines(axis, directions, leaves, depth):
    """Cosines of the half-angles of the nodes' cones, rounded towards wider cones, (2n - 1,) float32.

    Arrays in preorder: axis (3, 2n - 1), directions (3, n), leaves and depth (2n - 1,). The least cosine over a node's
    lights is exact; a union of the children's cones is not.
    """

    def product(node, direction):
        return sum(axis[k].take(node) * direction[k] for k in range(3))

    cosine = np.ones(len(leaves), np.float32)
    reduce_over_leaves(directions, leaves, depth, product, np.minimum, cosine)
    return np.clip(cosine - np.float32(COSINE_ROUNDING), -1, 1)
