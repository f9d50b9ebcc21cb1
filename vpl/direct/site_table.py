"""Sites, clusters and statistics on the device, for the kernels of direct lighting.

Statistics are arrays over *entries*, the pairs of a site and a cluster of the site's group.  The samples of a site form
two independent halves.  A lane samples one half of one site.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.path_limits import PathLimits
from ..points.camera_paths import SceneTraits
from ..points.surfaces import Batch
from .cluster_cuts import GroupCuts
from .sites import Sites
from .sources import Sources

# Counters hold samples in the lower 16 bits, samples that saw the source in the upper 16 bits.  A half of a site takes
# at most 50,000 samples, half of the largest ``max_samples``
SEEN = 1 << 16


@dataclass
class SiteTable:
    """A number s of sites with the cuts of their groups.

    - ``size``, ``cut``, ``entry`` (s,): number of clusters of each site, its first index in ``node``, its first entry
    - ``member_first``, ``members`` (s,): first index in ``member_row`` and number of points of each site
    - ``member_row``: row in the batch of every point, site by site
    - ``node``: nodes of the cuts, group by group
    - ``group_entry``, ``group_stride``, ``group_sites``, for each element of ``node``: entry of the group's first site,
      distance to the entry of the next site, number of sites
    - ``entries``: number of entries
    """

    size: mi.UInt32
    cut: mi.UInt32
    entry: mi.UInt32
    member_first: mi.UInt32
    members: mi.UInt32
    member_row: mi.UInt32
    node: mi.UInt32
    group_entry: mi.UInt32
    group_stride: mi.UInt32
    group_sites: mi.UInt32
    entries: int

    @property
    def count(self) -> int:
        return dr.width(self.size)

    @classmethod
    def of(cls, sites: Sites, cuts: GroupCuts) -> SiteTable:
        """Table of sites and of the cuts of their groups."""
        size = cuts.size[sites.group]
        entry = np.concatenate([[0], np.cumsum(size)])
        group = cuts.group
        local = np.arange(len(cuts.node)) - cuts.first[group]
        columns = (
            size, cuts.first[sites.group], entry[:-1], sites.first[:-1], sites.points, sites.order, cuts.node,
            entry[sites.group_first[group]] + local, cuts.size[group], sites.per_group[group],
        )  # fmt: skip
        return cls(*(upload(mi.UInt32, column) for column in columns), int(entry[-1]))


@dataclass
class Statistics:
    """Statistics of every entry, first of one half, then of the second.

    ``counts``: numbers of samples, packed by SEEN; ``gain``: sum of contributions relative to the entry's importance.
    """

    counts: mi.UInt32
    gain: mi.Float

    @classmethod
    def empty(cls, entries: int) -> Statistics:
        return cls(dr.zeros(mi.UInt32, 2 * entries), dr.zeros(mi.Float, 2 * entries))


@dataclass
class PassContext:
    """Context shared by the lanes of a pass.

    ``importance``, ``probability``: one value per entry; without ``probability`` every cluster is sampled.
    ``beyond``: limits of the paths that continue through delta surfaces beyond a gather point; None if none does.
    """

    scene: mi.Scene
    traits: SceneTraits
    sources: Sources
    batch: Batch
    table: SiteTable
    beyond: PathLimits | None
    importance: mi.Float | None = None
    statistics: Statistics | None = None
    probability: mi.Float | None = None


@dataclass
class Lanes:
    """Lanes of a pass: site, half (0 or 1), and numbers of emitter and BSDF samples."""

    site: mi.UInt32
    half: mi.UInt32
    samples: mi.UInt32
    bsdf_samples: mi.UInt32
