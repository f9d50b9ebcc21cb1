"""Light cluster trees: one for omnidirectional lights, six for oriented lights by main axis (NumPy only).

Lights are paired greedily from the bottom up: each merge makes the smallest possible bounding sphere [IAS, section
4.3.1]. Omnidirectional lights have a tree of their own. Oriented lights have a tree for each of +X, −X, +Y, −Y, +Z, −Z,
by the direction nearest to the light's axis. A renderer descends until a cluster's sphere subtends a small enough solid
angle.

A merge never shrinks a sphere. Two clusters that are mutual best partners thus remain partners in the greedy algorithm,
and every mutual pair may merge at once. With an unlimited search window, the locally-ordered clustering of
vpl/lights/clustering.py builds the greedy trees, up to ties.

Departures from the paper:

- While a tree has more than 256 clusters, the search window is 32 neighbours to either side along a Morton curve.
  Compared with the greedy tree, which takes quadratic time, the radii of the clusters of 3,000 random lights sum up to
  1.6% more in a plane and 3% more in a cube.
- With less than one mutual pair in 64 clusters, clusters without a mutual partner merge, too. Otherwise lights at
  exponentially growing distances would form a chain, as deep as the number of lights.
- A cluster's sphere is the smallest around the spheres of its two children, which may exceed the smallest around the
  lights. The paper does not specify its spheres.
- Clusters have a cone of directions, absent in the paper. Directions in one of the six trees are up to 110 degrees
  apart, and the cone bounds the lit directions better than the tree's axis.

[IAS] Donikian et al. 2006, Accurate direct illumination using iterative adaptive sampling.
"""

from dataclasses import dataclass

import numpy as np

from ..core.morton import morton_order
from ..lights.clustering import (
    accumulate,
    cluster,
    cone_axes,
    layout,
    nearest_in_window,
    nearest_of_all,
    reduce_over_leaves,
    require_rows,
)

# Search window to either side along the curve; up to _FEW clusters the window is unlimited
_WINDOW, _FEW = 32, 256
# Clusters per mutual pair above which clusters without a mutual partner merge: up to 30 occur among random lights
_RARE = 64
# Extents, and sums of the intensities of up to 10^8 lights, stay within float64
_LARGEST = 1e300
# Safety margins of bounds: factor on distances, decrement of cosines. A distance plus a radius has at most six
# roundings of 2^-53; the cosine of a sum of two angles has some 25.
_OUTWARD = 1 + 2.0**-50
_COSINE_ROUNDING = 2.0**-48


@dataclass(frozen=True)
class ClusterForest:
    """Up to seven trees over n lights in one array of m nodes, tree after tree, each in preorder.

    The children of the inner node i are i + 1 and escape[i + 1]; for a leaf, escape[i] == i + 1. A walk over every tree
    starts at i = 0, descends by i = i + 1, skips a subtree by i = escape[i], and ends at m.

    center, radius: (m, 3) and (m,) float64, world units: a sphere around the children's spheres; the light's own sphere
      for leaves. A check of the containment in float64 needs a tolerance of some 1e-15 relative to the radius.
    axis, cone_cos: (m, 3) and (m,) float64, unit axis and cosine of the half-angle of a cone around the cones of the
      lights below; +z and -1 for omnidirectional lights.
    intensity: (m,) float64, summed over the lights below.
    centroid: (m, 3) float64, world units: intensity-weighted mean of the centres of the lights below.
    escape: (m,) uint32, the node that follows this node's subtree.
    first, last: (m,) uint32: the node's lights are leaf_order[first:last].
    depth: (m,) uint32, edges from the root of the node's tree.
    roots: (t,) uint32, the first node of each tree that has lights: omnidirectional, then +X, -X, +Y, -Y, +Z, -Z;
      m == 2n - t.
    leaf_order: (n,) uint32, the caller's indices of the lights in preorder.
    """

    center: np.ndarray
    radius: np.ndarray
    axis: np.ndarray
    cone_cos: np.ndarray
    intensity: np.ndarray
    centroid: np.ndarray
    escape: np.ndarray
    first: np.ndarray
    last: np.ndarray
    depth: np.ndarray
    roots: np.ndarray
    leaf_order: np.ndarray


def build_cluster_forest(center, radius, axis, cone_cos, intensity) -> ClusterForest:
    """Cluster lights into trees by the algorithm of the module's docstring.

    center, radius: (n, 3) and (n,) float64, world units, up to 1e300: the lights' bounding spheres, of radius 0 for
      points; n may be 0.
    axis, cone_cos: (n, 3) unit vectors and (n,) float64: axis and cosine of the half-angle of a cone around the normals
      of the light's surface, which emits within 90 degrees of a normal; 1 for a flat light. The cosine -1 marks an
      omnidirectional light, with an axis that is ignored.
    intensity: (n,) float64, positive, up to 1e300, any unit.

    Raises ValueError, naming the argument and the first invalid light, for invalid input.
    """
    center, radius, axis, cone_cos, intensity = _validate(center, radius, axis, cone_cos, intensity)
    kind = _kinds(axis, cone_cos)
    trees = [members for members in (np.flatnonzero(kind == number) for number in range(7)) if len(members)]
    forest = _allocate([len(members) for members in trees])
    for root, members in zip(forest.roots.astype(np.int64), trees, strict=True):
        order = members[morton_order(center[members])]
        spheres = np.concatenate([center[order].T, radius[None, order]])
        rounds = _cluster(spheres)
        node_at, leaves, depth = layout(len(order), rounds)
        nodes, leaf = slice(root, root + len(node_at)), order[node_at[leaves == 1]]
        _fill_links(forest, nodes, leaf, leaves, depth)
        spheres = accumulate(spheres, rounds, _join_spheres).take(node_at, axis=1)
        forest.center[nodes], forest.radius[nodes] = spheres[:3].T, spheres[3]
        moments = np.concatenate([center[order].T, intensity[None, order]])
        moments = accumulate(moments, rounds, _join_moments).take(node_at, axis=1)
        forest.centroid[nodes], forest.intensity[nodes] = moments[:3].T, moments[3]
        if kind[leaf[0]] > 0:
            axes = cone_axes(axis[order].T, rounds).take(node_at, axis=1)
            forest.cone_cos[nodes] = _cone_cosines(axes, axis[leaf].T, cone_cos[leaf], leaves, depth)
            axes[:, leaves == 1] = axis[leaf].T
            forest.axis[nodes] = axes.T
    return forest


def _validate(center, radius, axis, cone_cos, intensity):
    """Return float64 arrays with normalised axes; raise ValueError for invalid input."""
    arrays = {"center": center, "radius": radius, "axis": axis, "cone_cos": cone_cos, "intensity": intensity}
    for name, value in arrays.items():
        array = arrays[name] = np.asarray(value, np.float64)
        columns = (3,) if name in ("center", "axis") else ()
        if array.ndim == 0 or array.shape[1:] != columns:
            raise ValueError(f"{name} must have the shape {'(n, 3)' if columns else '(n,)'}, got {array.shape}")
        if len(array) != len(arrays["center"]):
            raise ValueError(f"{name} has {len(array)} rows, but center has {len(arrays['center'])}")
    center, radius, axis, cone_cos, intensity = arrays.values()
    require_rows((np.abs(center) <= _LARGEST).all(axis=1), "center", center, f"finite and at most {_LARGEST:g}")
    require_rows((radius >= 0) & (radius <= _LARGEST), "radius", radius, f"from 0 to {_LARGEST:g}")
    require_rows(np.abs(cone_cos) <= 1, "cone_cos", cone_cos, "from -1 to 1")
    require_rows((intensity > 0) & (intensity <= _LARGEST), "intensity", intensity, f"positive, at most {_LARGEST:g}")
    axis = np.where((cone_cos == -1)[:, None], (0, 0, 1), axis)
    require_rows(np.isfinite(axis).all(axis=1), "axis", axis, "finite")
    with np.errstate(over="ignore"):
        length = np.linalg.norm(axis, axis=1)
    require_rows(np.abs(length - 1) < 1e-3, "axis", axis, "of unit length")
    # Comparison by bits would make a negative zero the least cost
    return center, radius + 0.0, axis / length[:, None], cone_cos, intensity


def _kinds(axis, cone_cos):
    """Tree of each light, (n,) int64: 0 omnidirectional, then +X, -X, +Y, -Y, +Z, -Z; the first in case of ties."""
    main = np.argmax(np.stack([axis, -axis], axis=2).reshape(-1, 6), axis=1)
    return np.where(cone_cos == -1, 0, 1 + main)


def _allocate(counts):
    """Allocate a forest of trees with ``counts`` lights, with roots set and every cone omnidirectional."""
    lights = np.cumsum([0, *counts])
    nodes = 2 * lights[-1] - len(counts)
    index = {name: np.empty(nodes, np.uint32) for name in ("escape", "first", "last", "depth")}
    return ClusterForest(
        center=np.empty((nodes, 3)),
        radius=np.empty(nodes),
        axis=np.tile([0.0, 0.0, 1.0], (nodes, 1)),
        cone_cos=np.full(nodes, -1.0),
        intensity=np.empty(nodes),
        centroid=np.empty((nodes, 3)),
        roots=(2 * lights[:-1] - np.arange(len(counts))).astype(np.uint32),
        leaf_order=np.empty(lights[-1], np.uint32),
        **index,
    )


def _fill_links(forest, nodes, leaf, leaves, depth):
    """Set escape, first, last and depth of the nodes of a tree (a slice), and the order of its lights."""
    trees_before = np.searchsorted(forest.roots, nodes.start)
    is_leaf = leaves == 1
    first = (nodes.start + trees_before) // 2 + np.cumsum(is_leaf) - is_leaf
    forest.first[nodes], forest.last[nodes] = first, first + leaves
    forest.leaf_order[first[0] : first[0] + len(leaf)] = leaf
    forest.escape[nodes] = np.arange(nodes.start, nodes.stop) + 2 * leaves - 1
    forest.depth[nodes] = depth


def _cluster(spheres):
    """Rounds of merges of (4, n) spheres along the curve: see vpl/lights/clustering.py."""
    extent = np.ptp(spheres[:3], axis=1).max() + spheres[3].max() or 1.0

    def relative_cost(first, second):
        return (_joined_radius(first, second) / extent).astype(np.float32)

    def nearest(spheres):
        if spheres.shape[1] <= _FEW:
            return nearest_of_all(spheres, _joined_radius)
        return nearest_in_window(spheres, _WINDOW, relative_cost)

    return cluster(spheres, nearest, _join_spheres, _RARE)


def _distance(first, second):
    """Distances of pairs of points, the first three rows of both arrays, without overflow or underflow."""
    x, y, z = (first[axis] - second[axis] for axis in range(3))
    return np.hypot(np.hypot(x, y), z)


def _joined_radius(first, second):
    """Radii of the smallest spheres around pairs of spheres (4, ...), apart from rounding."""
    both = 0.5 * (_distance(first, second) + (first[3] + second[3]))
    # The sphere of one may contain both
    return np.maximum(both, np.maximum(first[3], second[3]))


def _join_spheres(first, second):
    """Smallest spheres around pairs of spheres, all (4, r).

    The radius is computed from the rounded centre, so that the sphere contains both in spite of rounding.
    """
    distance = _distance(first, second)
    beyond = np.minimum(_joined_radius(first, second) - first[3], distance)
    share = np.divide(beyond, distance, out=np.zeros_like(distance), where=distance > 0)
    center = first[:3] + share * (second[:3] - first[:3])
    # Exact if the second sphere contains the first
    center = np.where(share == 1, second[:3], center)
    reach = []
    for sphere in (first, second):
        away = _distance(center, sphere)
        reach.append(np.where(away > 0, (away + sphere[3]) * _OUTWARD, sphere[3]))
    return np.concatenate([center, np.maximum(*reach)[None]])


def _join_moments(first, second):
    """Centroids and intensities of pairs of clusters, all (4, r), without overflow."""
    total = first[3] + second[3]
    centroid = first[:3] + second[3] / total * (second[:3] - first[:3])
    return np.concatenate([centroid, total[None]])


def _cone_cosines(axes, directions, cosines, leaves, depth):
    """Cosines of the half-angles of the cones of every node, rounded down except at leaves, (2n - 1,).

    Arguments in preorder: axes (3, 2n - 1), directions (3, n) and cosines (n,) of the lights, leaves and depth
    (2n - 1,).
    """

    def reach(node, light):
        # From half the chord, because the cosine does not resolve small angles
        chord = _distance(axes.take(node, axis=1), light)
        return 2 * np.arcsin(np.minimum(0.5 * chord, 1)) + light[3]

    angle = np.zeros(len(leaves))
    reduce_over_leaves(np.vstack([directions, np.arccos(cosines)]), leaves, depth, reach, np.maximum, angle)
    result = np.maximum(np.cos(np.minimum(angle, np.pi)) - _COSINE_ROUNDING, -1)
    result[leaves == 1] = cosines
    return result
