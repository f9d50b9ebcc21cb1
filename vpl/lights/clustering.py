"""Bottom-up clustering of lights into a binary tree with any merge cost, and reductions over the tree (NumPy only).

Parallel locally-ordered clustering [PLOC]: sort the lights along a Morton curve; find the cheapest partner of every
cluster within a window to either side; merge mutual partners; repeat. A cluster is a column of an array. The caller
defines its rows, the merge and the cost.

Clustering n lights yields rounds of merges (nodes, left, right): a slice of new nodes and two (k,) int32 arrays of
their children. Nodes 0 to n - 1 are the lights along the curve, n to 2n - 2 the inner nodes.

Departure from the paper: where mutual pairs are rare (costs that grow along the curve make chains), clusters without a
mutual partner merge too. The number of rounds, hence the depth, stays logarithmic.

[PLOC] Meister and Bittner 2018, Parallel locally-ordered clustering for bounding volume hierarchy construction.
"""

from itertools import pairwise

import numpy as np

# Clusters per chunk: a chunk and its temporaries fit in a second-level cache. Even, because parity breaks ties.
_CHUNK = 8192


def require_rows(good, name, array, quality):
    """Raise ValueError with the argument's name, the required quality, and the first row where ``good`` is false."""
    if not good.all():
        row = int(np.argmin(good))
        raise ValueError(f"{name} must be {quality}, but row {row} is {array[row].tolist()}")


def cluster(clusters, nearest, join, rare=16):
    """Merge clusters until one is left [PLOC, algorithm 1]; returns the rounds of merges.

    clusters: (k, n), one column per light along the curve. nearest: maps (k, m) clusters to the indices of their
    cheapest partners, (m,) int32. join: maps (k, r) first and (k, r) second clusters of pairs to (k, r) merged
    clusters. rare: number of clusters per mutual pair above which mutual pairs are too few.
    """
    node, made, rounds = np.arange(clusters.shape[1], dtype=np.int32), clusters.shape[1], []
    clusters = clusters.copy()
    while len(node) > 1:
        low, high = _match(nearest(clusters), rare)
        rounds.append((slice(made, made + len(low)), node[low], node[high]))
        # The merged cluster replaces the first of the two on the curve; the second is removed.
        clusters[:, low] = join(clusters.take(low, axis=1), clusters.take(high, axis=1))
        node[low] = np.arange(made, made + len(low), dtype=np.int32)
        made += len(low)
        keep = np.delete(np.arange(len(node)), high)
        clusters, node = clusters.take(keep, axis=1), node[keep]
    return rounds


def nearest_in_window(clusters, window, cost):
    """Index of every cluster's cheapest partner within the window, (m,) int32.

    cost: maps (k, r) first and (k, r) second clusters of pairs to (r,) float32, not negative (nor -0.0).

    Every pair is evaluated once and offered to both of its clusters. A cluster keeps the least integer key: the bits of
    the float32 cost, which order like integers because costs are not negative. The lowest bits hold the partner's
    place: 0 or 1 for adjacent clusters, else 2 * distance, plus 1 if the partner comes later. All clusters share this
    total order of pairs: by cost, then by distance (adjacent pairs with an even first index before odd), then by first
    index. Therefore the least pair is mutual despite ties, and equal clusters pair up two by two.
    """
    count = clusters.shape[1]
    window = min(window, count - 1)
    cost_bits = np.int32(-1 << (2 * window + 1).bit_length())
    best = np.full(count, np.iinfo(np.int32).max, np.int32)
    parity = np.arange(min(count, _CHUNK), dtype=np.int32) & 1
    for begin in range(0, count - 1, _CHUNK):
        for distance in range(1, min(window, count - 1 - begin) + 1):
            end = min(begin + _CHUNK, count - distance)
            first, second = slice(begin, end), slice(begin + distance, end + distance)
            key = cost(clusters[:, first], clusters[:, second]).view(np.int32)
            key &= cost_bits
            key |= parity[: end - begin] if distance == 1 else np.int32(2 * distance)
            np.minimum(best[second], key, out=best[second])
            key |= distance > 1
            np.minimum(best[first], key, out=best[first])
    return _partner(best & ~cost_bits)


def nearest_of_all(clusters, cost):
    """Index of every cluster's cheapest partner without a window, (m,) int32; time and memory grow as m².

    cost: the cost of nearest_in_window for clusters that broadcast, in any precision. The order of ties is the same.
    """
    count = clusters.shape[1]
    index = np.arange(count)
    costs = cost(clusters[:, :, None], clusters[:, None, :])
    np.fill_diagonal(costs, np.inf)
    offset = index - index[:, None]
    place = np.where(np.abs(offset) == 1, np.minimum(index, index[:, None]) & 1, 2 * np.abs(offset) + (offset > 0))
    place[costs > costs.min(axis=1, keepdims=True)] = 2 * count
    return _partner(place.min(axis=1))


def _partner(place):
    """Indices of partners, (m,) int32, from their places.

    A place is 0 or 1 for an adjacent pair with an even or odd first index. Otherwise it is 2 * distance, plus 1 if the
    partner comes later.
    """
    index = np.arange(len(place), dtype=np.int32)
    far = np.where(place & 1, place >> 1, -(place >> 1))
    return np.where(place < 2, ((index + place) ^ 1) - place, index + far).astype(np.int32)


def _match(neighbour, rare):
    """Disjoint pairs of clusters to merge, two (k,) arrays of indices, the lower of each pair first.

    Mutual nearest neighbours merge. Where mutual pairs are rare, every remaining cluster proposes to its nearest
    neighbour. Proposals have distinct pseudorandom priorities (a Fibonacci hash of the index). A proposal with the
    highest priority at both clusters is accepted. No cluster receives more than 2 * window proposals, hence a constant
    fraction of the clusters merges on average.
    """
    index = np.arange(len(neighbour), dtype=np.int32)
    mutual = neighbour[neighbour] == index
    chosen = np.flatnonzero(mutual & (index < neighbour))
    if rare * len(chosen) < len(index):
        priority = (index.astype(np.uint32) * np.uint32(2654435769)).astype(np.int64)
        priority[mutual] = 2**32
        foremost = priority.copy()
        np.maximum.at(foremost, neighbour, priority)
        wins = (foremost == priority) & (foremost[neighbour] == priority)
        chosen = np.flatnonzero(wins & (~mutual | (index < neighbour)))
    return np.minimum(chosen, neighbour[chosen]), np.maximum(chosen, neighbour[chosen])


def layout(count, rounds):
    """Preorder of a tree over n lights, three (2n - 1,) arrays: node at each place, number of leaves, depth.

    The children of place i are at i + 1 and at i + 2k, where k is the number of leaves of the first child.
    """
    leaves = accumulate(np.ones((1, count), np.int64), rounds, np.add)[0]
    preorder = np.zeros(2 * count - 1, np.int64)
    depth = np.zeros(2 * count - 1, np.int32)
    for nodes, left, right in reversed(rounds):
        preorder[left] = preorder[nodes] + 1
        preorder[right] = preorder[nodes] + 2 * leaves[left]
        depth[left] = depth[right] = depth[nodes] + 1
    node_at = np.empty_like(preorder)
    node_at[preorder] = np.arange(len(preorder))
    return node_at, leaves[node_at], depth[node_at]


def accumulate(leaf_values, rounds, join):
    """Reduce (k, n) values of the lights along the curve to every node of the tree; returns (k, 2n - 1).

    join: a binary ufunc, or any function of two (k, r) arrays, the values of left and right children.
    """
    size, count = leaf_values.shape
    values = np.empty((size, 2 * count - 1), leaf_values.dtype)
    values[:, :count] = leaf_values
    for nodes, left, right in rounds:
        values[:, nodes] = join(values.take(left, axis=1), values.take(right, axis=1))
    return values


def reduce_over_leaves(values, leaves, depth, function, ufunc, out):
    """Set out at every inner node to the ufunc's reduction, over the leaves below, of a function of node and leaf.

    Arrays in preorder: values (k, n) of the leaves, leaves and depth from layout, out (2n - 1,). function: maps the
    (r,) node indices and (k, r) leaves' values of pairs to (r,).

    The inner nodes at a depth cover consecutive ranges of the deeper leaves. The work is the sum of the leaves' depths.
    """
    leaf_depth = depth[leaves == 1]
    inner = np.flatnonzero(leaves > 1)
    inner = inner[np.argsort(depth[inner], kind="stable")]
    bounds = np.searchsorted(depth[inner], np.arange(depth.max() + 1))
    for level, (begin, end) in enumerate(pairwise(bounds)):
        deeper = np.flatnonzero(leaf_depth > level)
        values, leaf_depth = values.take(deeper, axis=1), leaf_depth[deeper]
        nodes = inner[begin:end]
        covered = function(np.repeat(nodes, leaves[nodes]), values)
        out[nodes] = ufunc.reduceat(covered, np.cumsum(leaves[nodes]) - leaves[nodes])


def cone_axes(directions, rounds):
    """Unit axes of all nodes' cones, (3, 2n - 1) float64, for (3, n) unit directions of the lights along the curve.

    An axis points at the centre of the directions' box. Unlike the mean direction, the centre is independent of how
    many lights share a direction: cuts are 1 to 3% smaller. A zero centre (opposite walls) is replaced by the
    coordinate axis of the box's shortest side.
    """
    low, high = (accumulate(directions, rounds, ufunc).astype(np.float64) for ufunc in (np.minimum, np.maximum))
    axis = low + high
    length = np.linalg.norm(axis, axis=0)
    zero = np.flatnonzero(length == 0)
    axis[np.argmin((high - low)[:, zero], axis=0), zero] = length[zero] = 1
    return axis / length
