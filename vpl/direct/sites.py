"""Gather points sorted into sites and groups, the units of adaptive direct lighting (NumPy only).

The image is divided into blocks of 8 x 8 pixels; the points of a block are divided into six classes by the main axis of
their normals [IAS section 4.1].  What remains together is a *group*: its points share statistics about the clusters.
The points of one pixel in one group are a *site*, which has statistics of its own, is sampled as a whole, and whose
points all show its radiance.

Departure from the paper: a class of a block falls apart further where its points do, along the largest gap between
them, so that what is seen over the edge of something near shares no statistics with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import ranges
from ..core.cones import mean_axes
from .cluster_cuts import PointGroups

BLOCK = 8  # pixels along the side of a block [IAS section 4]
# A group falls apart at a gap of more than this share of its extent, in as many rounds at most
_GAP, _ROUNDS = 0.3, 3
_SLACK = 1e-5  # of cosines in single precision


@dataclass
class Sites:
    """``group``, ``pixel`` (s,): of every site, in rising order of both; ``point_site`` (n,): site of every point;
    ``first`` (s + 1,): the points of site i are ``order[first[i] : first[i + 1]]``; ``group_first`` (g + 1,): the first
    site of each group."""

    group: np.ndarray
    pixel: np.ndarray
    point_site: np.ndarray
    order: np.ndarray
    first: np.ndarray
    group_first: np.ndarray

    @property
    def count(self) -> int:
        return len(self.group)

    @property
    def points(self) -> np.ndarray:
        """(s,) int64, points of every site."""
        return np.diff(self.first)

    @property
    def per_group(self) -> np.ndarray:
        """(g,) int64, sites of every group."""
        return np.diff(self.group_first)

    def of_groups(self, groups: np.ndarray) -> np.ndarray:
        """The sites of some groups, group by group."""
        return ranges(self.group_first[groups], self.per_group[groups])

    def select(self, groups: np.ndarray) -> Sites:
        """The sites of some groups, which are numbered anew; ``point_site`` stays that of the whole."""
        chosen, size = self.of_groups(groups), self.per_group[groups]
        points = self.points[chosen]
        return Sites(
            np.repeat(np.arange(len(groups)), size), self.pixel[chosen], self.point_site,
            self.order[ranges(self.first[chosen], points)], np.concatenate([[0], np.cumsum(points)]),
            np.concatenate([[0], np.cumsum(size)]),
        )  # fmt: skip


def normal_class(normal: np.ndarray) -> np.ndarray:
    """0 to 5: the face of a cube that each normal, (n, 3), points to: +x, -x, +y, -y, +z, -z."""
    axis = np.abs(normal).argmax(1)
    return 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0)


def find_groups(pixel, width: int, position, normal) -> np.ndarray:
    """Number the groups: (n,) int64 for points of the pixels ``pixel`` (n,) of an image ``width`` wide.

    ``position``, ``normal``: (n, 3), world units.
    """
    across = -(-width // BLOCK)
    block = (pixel // width // BLOCK) * across + pixel % width // BLOCK
    group = np.unique(block * 6 + normal_class(normal), return_inverse=True)[1]
    for _ in range(_ROUNDS):
        refined = _split_at_gaps(group, position)
        if refined.max() == group.max():
            break
        group = refined
    return group


def _split_at_gaps(group, position) -> np.ndarray:
    """Divide each group at the largest gap along the longest side of its box, if that is wide."""
    count = group.max() + 1
    order = np.argsort(group, kind="stable")
    first = np.searchsorted(group[order], np.arange(count))
    inside = position[order]
    extent = np.maximum.reduceat(inside, first) - np.minimum.reduceat(inside, first)
    axis = extent.argmax(1)
    along = position[np.arange(len(group)), axis[group]]
    order = np.lexsort((along, group))
    gap = np.diff(along[order], prepend=-np.inf)
    gap[first] = 0
    largest = np.maximum.reduceat(gap, first)
    owner = group[order]
    wide = (largest > _GAP * extent.max(1)) & (largest > 0)
    at = (gap == largest[owner]) & wide[owner]
    # Everything from the first of the largest gaps on becomes a group of its own
    passed = np.cumsum(at)
    before = np.concatenate([[0], passed])[first]
    beyond = passed > before[owner]
    refined = np.empty(len(group), np.int64)
    refined[order] = 2 * owner + beyond
    return np.unique(refined, return_inverse=True)[1]


def divide_points(pixel, width: int, position, normal, generator=None) -> Sites:
    """Divide points into sites and groups; arguments as in :func:`find_groups`.

    The points of one pixel and class are a site, which goes to the group of the first of them.  ``generator``: of
    NumPy; if there is one, it shuffles the points of each site.
    """
    key = pixel * 6 + normal_class(normal)
    count = np.bincount(key)
    kept = np.flatnonzero(count)
    first = np.empty(len(count), np.int64)
    first[key[::-1]] = np.arange(len(key))[::-1]
    first = first[kept]
    few = find_sites(find_groups(pixel[first], width, position[first], normal[first]), pixel[first])
    count[kept] = few.point_site
    site = count[key]
    order = (
        np.argsort(site, kind="stable") if generator is None else np.lexsort((generator.permutation(len(key)), site))
    )
    return Sites(
        few.group, few.pixel, site, order, np.concatenate([[0], np.cumsum(np.bincount(site))]), few.group_first
    )


def find_sites(group: np.ndarray, pixel: np.ndarray) -> Sites:
    """The sites of points in the groups and pixels given, both (n,)."""
    key, site, counts = np.unique(
        group.astype(np.int64) * (int(pixel.max()) + 1) + pixel, return_inverse=True, return_counts=True
    )
    of_site = key // (int(pixel.max()) + 1)
    group_first = np.searchsorted(of_site, np.arange(of_site[-1] + 2))
    return Sites(
        of_site, key % (int(pixel.max()) + 1), site, np.argsort(site, kind="stable"),
        np.concatenate([[0], np.cumsum(counts)]), group_first,
    )  # fmt: skip


def bound_groups(sites: Sites, position, normal, two_sided: np.ndarray) -> PointGroups:
    """Boxes of the positions and cones of the normals of every group.

    ``two_sided`` (n,): points that are lit from both sides.
    """
    first = sites.first[sites.group_first[:-1]]
    position, normal = position[sites.order], normal[sites.order]
    total = np.add.reduceat(normal, first, dtype=np.float64)
    axis, _ = mean_axes(total, normal[first])
    points = np.diff(np.append(first, len(position)))
    cosine = np.einsum("ij,ij->i", normal, np.repeat(axis, points, axis=0))
    least = np.clip(np.minimum.reduceat(cosine, first) - _SLACK, -1, 1)
    least[np.logical_or.reduceat(two_sided[sites.order], first)] = -1
    low, high = (of.reduceat(position, first).astype(np.float64) for of in (np.minimum, np.maximum))
    return PointGroups(low, high, axis, least)
