"""One gather point that is shaded for several of its pixel [IC section 4, "Anti-aliasing"].

[IC] suggests to shade, for each pair of clusters, only one of the points that belong to the same pixel.  Here the
choice is made once for all pairs: in every small cluster of points each pixel has one point, drawn at random, that
all the pixel's points in that cluster take their light from. The mean over draws is the
light of all of them, texture included, where a pixel's samples have the same weight.
"""

from __future__ import annotations

import numpy as np

from ..points.point_tree import PointTree

# A cluster holds at most the samples of so many pixels
_PIXELS = 4


def share_samples(tree: PointTree, pixel: np.ndarray, samples: int, generator):
    """Choose the points to shade.

    ``pixel``: (n,) pixel of every point along the tree; ``samples``: camera rays of a pixel.
    Returns (rows along the tree to shade, for each point the place in them of the one that stands for it).
    """
    cluster = tree.leaf.astype(np.int64)
    while True:
        parent = tree.parent[cluster]
        grows = (tree.count[parent] <= _PIXELS * samples) & (parent != cluster)
        if not grows.any():
            break
        cluster = np.where(grows, parent, cluster)
    group = np.unique(cluster * (int(pixel.max()) + 1) + pixel, return_inverse=True)[1]
    # The first in a random order stands for its group
    shuffled = generator.permutation(len(pixel))
    _, first = np.unique(group[shuffled], return_index=True)
    rows = shuffled[first]
    # Along the tree, so that neighbouring lanes share what they are lit by
    along = np.argsort(rows)
    return rows[along], np.argsort(along)[group]
