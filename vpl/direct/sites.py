"""Gather points sorted into sites and groups, the units of adaptive direct lighting (NumPy only).

The image is divided into blocks of 8 × 8 pixels, and the points of a block into six classes by the main axis of their
normals [IAS section 4.1].  Each class of a block is a *group*, with common statistics of its clusters.  The points of
one pixel in one group are a *site*, with statistics and an estimate of its own.

Departure from the paper: groups are further split at large gaps between their points, so that a distant background
shares no statistics with a foreground object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import ranges
from ..core.cones import mean_axes
from .cluster_cuts import PointGroups

BLOCK = 8  # pixels along the side of a block [IAS section 4]
# Least gap that splits a group, relative to its extent; number of rounds of splitting
_GAP, _ROUNDS = 0.3, 3
_SLACK = 1e-5  # tolerance of single-precision cosines


@dataclass
class Sites:
    """A number s of sites, sorted by group, then pixel, of n points and g groups.

    ``group``, ``pixel`` (s,): of every site; ``point_site`` (n,): site of every point; ``first`` (s + 1,): site i has
    the points ``order[first[i] : first[i + 1]]``; ``group_first`` (g + 1,): first site of each group.
    """

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
        """Select the sites of some groups, and renumber the groups; ``point_site`` stays unchanged."""
        chosen, size = self.of_groups(groups), self.per_group[groups]
        points = self.points[chosen]
        return Sites(
            np.repeat(np.arange(len(groups)), size), self.pixel[chosen], self.point_site,
            self.order[ranges(self.first[chosen], points)], np.concatenate([[0], np.cumsum(points)]),
            np.concatenate([[0], np.cumsum(size)]),
        )  # fmt: skip


def normal_class(normal: np.ndarray) -> np.ndarray:
    """Main axis of each normal, (n, 3): 0 to 5 for +x, -x, +y, -y, +z, -z."""
    axis = np.abs(normal).argmax(1)
    return 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0)


def find_groups(pixel, width: int, position, normal) -> np.ndarray:
    """Group of every point, (n,) int64, for points of the pixels ``pixel`` (n,) of an image ``width`` wide.

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
    """Split each group at the largest gap along the longest side of its box, if wider than _GAP."""
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
    # The points beyond the first of the largest gaps form a new group
    passed = np.cumsum(at)
    before = np.concatenate([[0], passed])[first]
    beyond = passed > before[owner]
    refined = np.empty(len(group), np.int64)
    refined[order] = 2 * owner + beyond
    return np.unique(refined, return_inverse=True)[1]


def divide_points(pixel, width: int, position, normal, generator=None) -> Sites:
    """Divide points into sites and groups; arguments as in :func:`find_groups`.

    The points of one pixel and class form a site, in the group of its first point.  ``generator``: a NumPy generator
    that shuffles the points of each site, or None.
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
    """Boxes of positions and cones of normals of every group.  ``two_sided`` (n,): points lit from both sides."""
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
