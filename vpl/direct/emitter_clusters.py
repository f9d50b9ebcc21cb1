"""Light cluster trees: omnidirectional lights in one, oriented lights in six by their main axis (NumPy only).

Lights are paired greedily from the bottom up, always the two clusters whose bounding sphere is smallest [IAS, section
4.3.1]. Lights that differ too much never meet in a cluster: those that radiate everywhere have a tree of their own,
oriented ones have a tree for each of the directions +X, −X, +Y, −Y, +Z, −Z that is nearest to theirs. A renderer walks
down until a cluster's sphere subtends a small enough solid angle.

Joining two clusters only ever makes their spheres larger, so a pair of which each is the other's best partner will be
paired by the greedy algorithm too, whatever it does before: all such pairs may merge at once. With every cluster
looking at all others, the locally-ordered clustering of vpl/lights/clustering.py thus builds the greedy trees, up to
ties.

Departures from the paper:

- While a tree has more than 256 clusters left, they look only at the 32 neighbours to either side along a Morton curve.
  The radii of 3,000 random lights' clusters sum up to 1.6% more in a plane, 3% more in a cube than those of the greedy
  tree, which takes time quadratic in the number of lights.
- Where there is less than one mutual pair to 64 clusters, as among lights whose distances grow exponentially, others
  join their best partner too: the greedy tree is a chain there, as deep as there are lights.
- A cluster's sphere is the smallest around the spheres of its two children, which is larger than the smallest around
  its lights. How the paper finds its spheres, it does not say.
- Clusters have a cone of directions, which the paper does not mention: within one of the six trees directions are up to
  110 degrees apart, and what a cluster shines on is bounded better by the cone than by the tree's axis.

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

# Clusters look at this many neighbours to either side, or at all others where they are no more than _FEW
_WINDOW, _FEW = 32, 256
# Clusters to a mutual pair that are too many: up to 30 occur among random lights
_RARE = 64
# No extent, and no sum of intensities of up to 10^8 lights, exceeds float64 then
_LARGEST = 1e300
# Distances are enlarged and cosines lowered by these before they bound something. No more than six roundings of 2^-53
# go into a distance plus a radius, the worth of some 25 into the cosine of an angle between two axes plus another.
_OUTWARD = 1 + 2.0**-50
_COSINE_ROUNDING = 2.0**-48


@dataclass(frozen=True)
class ClusterForest:
    """Up to seven trees over n lights, all in one array of m nodes, in preorder and one tree after another.

    The children of the inner node i are i + 1 and escape[i + 1]; for a leaf, escape[i] == i + 1. To walk all trees,
    start at i = 0; refine by i = i + 1; take or skip a whole subtree by i = escape[i]; stop at m.

    center, radius: (m, 3) and (m,) float64, world units: a sphere that contains the children's spheres, those of leaves
      being the lights' own. That holds for these very numbers; only checking it in float64 again needs a tolerance, of
      some 1e-15 relative to the radius.
    axis, cone_cos: (m, 3) and (m,) float64, unit axis and cosine of the half-angle of a cone that contains the cones of
      all lights below; +z and -1 for lights that radiate everywhere.
    intensity: (m,) float64, summed over the lights below.
    centroid: (m, 3) float64, world units: mean of the centres of the lights below, weighted by their intensities.
    escape: (m,) uint32, the node that follows this node's subtree.
    first, last: (m,) uint32: the node's lights are leaf_order[first:last].
    depth: (m,) uint32, edges from the root of the node's tree.
    roots: (t,) uint32, the trees' first nodes: that of the lights that radiate everywhere, then +X, -X, +Y, -Y, +Z, -Z,
      less those without lights; m == 2n - t.
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
    """Cluster lights into trees; the module's docstring says how.

    center, radius: (n, 3) and (n,) float64, world units, up to 1e300: the lights' bounding spheres, of radius 0 for
      points; n may be 0.
    axis, cone_cos: (n, 3) unit vectors and (n,) float64: axis and cosine of the half-angle of a cone around the normals
      of the light's surface, within 90 degrees of which it emits; 1 for a flat light. The cosine -1 marks a light that
      radiates everywhere, whose axis is ignored.
    intensity: (n,) float64, positive, up to 1e300, any unit.

    Raises ValueError, naming the argument and the first bad light, where an input is not as described.
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
    """Return the inputs as float64 arrays, axes normalised; raise ValueError for what is not as asked."""
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
    # A negative zero would be the least of all costs, which are compared by their bits
    return center, radius + 0.0, axis / length[:, None], cone_cos, intensity


def _kinds(axis, cone_cos):
    """The lights' trees, (n,) from 0 to 6: everywhere, then +X, -X, +Y, -Y, +Z, -Z, the first of them where equal."""
    main = np.argmax(np.stack([axis, -axis], axis=2).reshape(-1, 6), axis=1)
    return np.where(cone_cos == -1, 0, 1 + main)


def _allocate(counts):
    """A forest of trees over so many lights each, with its roots, and with cones of lights that radiate everywhere."""
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
    """Link the nodes of one tree, a slice, to each other and to its lights, in preorder."""
    trees_before = np.searchsorted(forest.roots, nodes.start)
    is_leaf = leaves == 1
    first = (nodes.start + trees_before) // 2 + np.cumsum(is_leaf) - is_leaf
    forest.first[nodes], forest.last[nodes] = first, first + leaves
    forest.leaf_order[first[0] : first[0] + len(leaf)] = leaf
    forest.escape[nodes] = np.arange(nodes.start, nodes.stop) + 2 * leaves - 1
    forest.depth[nodes] = depth


def _cluster(spheres):
    """Rounds of merges, as vpl/lights/clustering.py describes them, of (4, n) spheres along the curve."""
    extent = np.ptp(spheres[:3], axis=1).max() + spheres[3].max() or 1.0

    def relative_cost(first, second):
        return (_joined_radius(first, second) / extent).astype(np.float32)

    def nearest(spheres):
        if spheres.shape[1] <= _FEW:
            return nearest_of_all(spheres, _joined_radius)
        return nearest_in_window(spheres, _WINDOW, relative_cost)

    return cluster(spheres, nearest, _join_spheres, _RARE)


def _distance(first, second):
    """Distances of pairs of points, the first three rows of both arrays; neither overflows nor underflows."""
    x, y, z = (first[axis] - second[axis] for axis in range(3))
    return np.hypot(np.hypot(x, y), z)


def _joined_radius(first, second):
    """Radii of the smallest spheres around pairs of spheres (4, ...), apart from rounding."""
    both = 0.5 * (_distance(first, second) + (first[3] + second[3]))
    # The larger sphere's where it contains the other
    return np.maximum(both, np.maximum(first[3], second[3]))


def _join_spheres(first, second):
    """Smallest spheres around pairs of spheres, all (4, r).

    Every radius is found from the very centre that is returned, so that the sphere holds both however that was rounded.
    """
    distance = _distance(first, second)
    beyond = np.minimum(_joined_radius(first, second) - first[3], distance)
    share = np.divide(beyond, distance, out=np.zeros_like(distance), where=distance > 0)
    center = first[:3] + share * (second[:3] - first[:3])
    # Exactly the second's where that contains the first
    center = np.where(share == 1, second[:3], center)
    reach = []
    for sphere in (first, second):
        away = _distance(center, sphere)
        reach.append(np.where(away > 0, (away + sphere[3]) * _OUTWARD, sphere[3]))
    return np.concatenate([center, np.maximum(*reach)[None]])


def _join_moments(first, second):
    """Centroids and intensities of pairs of clusters, all (4, r); no product with an intensity that may overflow."""
    total = first[3] + second[3]
    centroid = first[:3] + second[3] / total * (second[:3] - first[:3])
    return np.concatenate([centroid, total[None]])


def _cone_cosines(axes, directions, cosines, leaves, depth):
    """Cosines of the half-angles of all nodes' cones, rounded to the wider side but for the leaves', (2n - 1,).

    All in preorder: axes (3, 2n - 1), directions (3, n) and cosines (n,) of the lights, leaves and depth (2n - 1,).
    """

    def reach(node, light):
        # Half the chord rather than the cosine, which tells no small angles apart
        chord = _distance(axes.take(node, axis=1), light)
        return 2 * np.arcsin(np.minimum(0.5 * chord, 1)) + light[3]

    angle = np.zeros(len(leaves))
    reduce_over_leaves(np.vstack([directions, np.arccos(cosines)]), leaves, depth, reach, np.maximum, angle)
    result = np.maximum(np.cos(np.minimum(angle, np.pi)) - _COSINE_ROUNDING, -1)
    result[leaves == 1] = cosines
    return result
