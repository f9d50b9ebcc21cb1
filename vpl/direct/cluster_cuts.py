"""Clusters of sources that light a group of gather points: cuts through the cluster forest [IAS section 4.3].

A cluster is fine enough if its bounding sphere subtends less than a given solid angle from every point of the group.  A
single source always is.  Clusters that cannot light any point of the group are left out: clusters behind its surfaces,
and clusters that face away.  The points of a group share one cut, and the statistics of the clusters.

Departure from the paper: clusters that send little light may subtend a larger solid angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import even_chunks, ranges
from .sources import Nodes

# Solid angle of a single source above which sampling by area alone is inefficient, sr
_WIDE = 0.1
# Largest solid angle of a faint cluster, sr
_FAINT_ANGLE = 0.3
# Pairs of a group and a node processed together, some 300 bytes each; usual upper bound of the nodes of a cut
_PAIRS, _USUAL_CUT = 1 << 20, 1024
_SLACK = 1e-5  # tolerance of angles, rad: rounding keeps a cluster rather than losing it


@dataclass
class PointGroups:
    """Groups of gather points, all arrays float64.

    ``low``, ``high`` (g, 3): boxes of positions; ``axis`` (g, 3), ``cone_cos`` (g,): cones of normals on the lit side,
    with a cosine of -1 for two-sided surfaces.
    """

    low: np.ndarray
    high: np.ndarray
    axis: np.ndarray
    cone_cos: np.ndarray

    @property
    def count(self) -> int:
        return len(self.cone_cos)

    def select(self, rows) -> PointGroups:
        """Some of the groups."""
        return PointGroups(self.low[rows], self.high[rows], self.axis[rows], self.cone_cos[rows])


@dataclass
class GroupCuts:
    """Cuts in one array: group g has the nodes ``node[first[g] : first[g + 1]]``, in ascending order."""

    node: np.ndarray
    first: np.ndarray

    @property
    def size(self) -> np.ndarray:
        """(g,) int64, clusters of each group."""
        return np.diff(self.first)

    @property
    def group(self) -> np.ndarray:
        """The group of every entry of ``node``."""
        return np.repeat(np.arange(len(self.size)), self.size)

    def select(self, groups: np.ndarray) -> GroupCuts:
        """The cuts of some groups."""
        size = self.size[groups]
        return GroupCuts(self.node[ranges(self.first[groups], size)], np.concatenate([[0], np.cumsum(size)]))

    def without_empty(self) -> GroupCuts:
        """These cuts, with the first node for groups without any."""
        empty = np.flatnonzero(self.size == 0)
        size = np.maximum(self.size, 1)
        node = np.insert(self.node, self.first[empty], np.zeros(len(empty), np.uint32))
        return GroupCuts(node, np.concatenate([[0], np.cumsum(size)]))


def cut_clusters(nodes: Nodes, groups: PointGroups, solid_angle: float, faint_share: float = 0.0) -> GroupCuts:
    """The coarsest clusters that are fine enough, per group; a ``solid_angle`` of 0 gives single sources.

    A cluster is fine enough if it subtends at most ``solid_angle`` steradians.  A faint cluster, with less than
    ``faint_share`` of the group's unoccluded light, may subtend up to 0.3 steradians.
    """
    roots, pairs = _roots(nodes), [np.zeros((2, 0), np.int64)]
    # The depth of cuts is unknown, so the number of groups in a chunk allows for cuts of the usual size
    width = max(1, min(nodes.count, _USUAL_CUT) if solid_angle > 0 else nodes.count)
    for first, last in even_chunks(groups.count, width, _PAIRS):
        chosen = np.arange(first, last)
        group, node = np.repeat(chosen, len(roots)), np.tile(roots, len(chosen))
        if faint_share > 0 and 0 < solid_angle < _FAINT_ANGLE:
            group, node = _descend(nodes, groups, group, node, _FAINT_ANGLE)
            light = _unoccluded_light(nodes, node, groups, group)
            faint = light < faint_share * np.bincount(group, light, groups.count)[group]
            pairs.append(np.stack([group[faint], node[faint]]))
            group, node = group[~faint], node[~faint]
        pairs.append(_descend(nodes, groups, group, node, solid_angle))
    return _by_group(np.concatenate(pairs, axis=1), nodes.count, groups.count)


def _descend(nodes: Nodes, groups: PointGroups, group, node, solid_angle: float):
    """Descend from pairs of a group and a node to the coarsest nodes that are fine enough and may light the group.

    Returns groups and nodes, (2, k) int64.
    """
    found = [np.zeros((2, 0), np.int64)]
    while len(group):
        lit = _may_light(nodes, node, groups, group)
        group, node = group[lit], node[lit]
        single = nodes.escape[node] == node + 1
        nearest = np.clip(nodes.center[node], groups.low[group], groups.high[group]) - nodes.center[node]
        # 2 pi (1 - cos asin(r / d)) < solid_angle
        small = np.square(nodes.radius[node]) < _squared_sine(solid_angle) * np.einsum("ij,ij->i", nearest, nearest)
        done = single | small
        found.append(np.stack([group[done], node[done]]))
        group, left = np.tile(group[~done], 2), node[~done] + 1
        node = np.concatenate([left, nodes.escape[left].astype(np.int64)])
    return np.concatenate(found, axis=1)


def _unoccluded_light(nodes: Nodes, node, groups: PointGroups, group) -> np.ndarray:
    """Estimate the unoccluded irradiance of a cluster at the middle of a group that faces it."""
    extent = np.linalg.norm(groups.high - groups.low, axis=1)[group] / 2
    offset = nodes.centroid[node] - ((groups.low + groups.high) / 2)[group]
    nearest = np.maximum(nodes.radius[node], extent)
    distance2 = np.maximum(np.einsum("ij,ij->i", offset, offset), np.square(nearest))
    return nodes.intensity[node] / np.where(nodes.infinite[node] | (distance2 == 0), 1, distance2)


def has_wide_source(nodes: Nodes, groups: PointGroups, cuts: GroupCuts) -> np.ndarray:
    """Whether a group's cut has a source at a finite position of more than 0.1 steradians, (g,) bool."""
    group, node = cuts.group, cuts.node.astype(np.int64)
    nearest = np.clip(nodes.center[node], groups.low[group], groups.high[group]) - nodes.center[node]
    wide = np.square(nodes.radius[node]) > _squared_sine(_WIDE) * np.einsum("ij,ij->i", nearest, nearest)
    return np.bincount(group, wide & (nodes.radius[node] > 0), groups.count) > 0


def _squared_sine(solid_angle: float) -> float:
    """Squared sine of the half-angle of a cone of a solid angle, 2 pi (1 - cos)."""
    return 1 - max(0.0, 1 - solid_angle / (2 * np.pi)) ** 2


def _by_group(pairs: np.ndarray, nodes: int, groups: int) -> GroupCuts:
    group, node = pairs
    order = np.argsort(group * nodes + node)
    first = np.concatenate([[0], np.cumsum(np.bincount(group, minlength=groups))])
    return GroupCuts(node[order].astype(np.uint32), first)


def _roots(nodes: Nodes) -> np.ndarray:
    roots, node = [], 0
    while node < nodes.count:
        roots.append(node)
        node = int(nodes.escape[node])
    return np.array(roots, np.int64)


def _may_light(nodes: Nodes, node, groups: PointGroups, group) -> np.ndarray:
    """Whether a cluster may light any point of a group, pair by pair; conservative."""
    infinite = nodes.infinite[node]
    middle, extent = (groups.low + groups.high) / 2, np.linalg.norm(groups.high - groups.low, axis=1) / 2
    offset = np.where(infinite[:, None], nodes.axis[node], nodes.center[node] - middle[group])
    distance = np.linalg.norm(offset, axis=1)
    blur = np.where(infinite, 0.0, nodes.radius[node] + extent[group])
    apart = distance > blur
    to_light = offset / np.where(distance > 0, distance, 1)[:, None]
    # Largest angle between directions from points of the group to points of the cluster
    spread = np.arcsin(np.minimum(blur / np.where(apart, distance, np.inf), 1))
    cone = np.arccos(np.clip(nodes.cone_cos[node], -1, 1))

    normals = np.arccos(np.clip(groups.cone_cos[group], -1, 1))
    incident = np.arccos(np.clip(np.einsum("ij,ij->i", to_light, groups.axis[group]), -1, 1))
    in_front = incident - normals - spread - np.where(infinite, cone, 0) < np.pi / 2 + _SLACK
    leaving = np.arccos(np.clip(-np.einsum("ij,ij->i", to_light, nodes.axis[node]), -1, 1))
    facing = infinite | (leaving - cone - spread < np.pi / 2 + _SLACK)
    return ~apart | (in_front & facing)
