"""Sites and their clusters on the device: what the kernels of direct lighting read.

Everything is an array over *entries*: one entry per site and cluster of the site's group.  A site's samples come in two
halves that never see each other's numbers; a lane works for one half of one site.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..points.surfaces import Batch
from .cluster_cuts import GroupCuts
from .sites import Sites
from .sources import Sources

SEEN = 1 << 16  # counters hold samples in their lower half and those that saw the source in their upper half


@dataclass
class SiteTable:
    """Sites on the device, s of them, with g groups and their cuts.

    ``size``, ``cut``, ``entry`` (s,): clusters of each site, where its cut and its entries begin; ``member_first``,
    ``members`` (s,): where the site's points begin in ``member_row``, and how many they are; ``node``: nodes of all
    cuts; ``group_*`` (per node of a cut): where its entry of the group's first site is, how far it is from site to
    site, and how many sites there are.
    """

    size: object
    cut: object
    entry: object
    member_first: object
    members: object
    member_row: object
    node: object
    group_entry: object
    group_stride: object
    group_sites: object
    entries: int

    @property
    def count(self) -> int:
        return dr.width(self.size)

    @classmethod
    def of(cls, sites: Sites, cuts: GroupCuts) -> SiteTable:
        """Table of sites with the cuts of their groups."""
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
    """Observations of every entry, by each half (the second after all entries of the first): ``counts``: samples and
    those that saw the source; ``gain``: sum of their contributions over the entry's importance."""

    counts: object
    gain: object

    @classmethod
    def empty(cls, entries: int) -> Statistics:
        return cls(dr.zeros(mi.UInt32, 2 * entries), dr.zeros(mi.Float, 2 * entries))


@dataclass
class Scenery:
    """Context that all lanes of a pass have in common.

    ``importance``, ``probability``: Float per entry; ``statistics``: of all entries; a ``probability`` of None means
    that every cluster is sampled for certain.  ``max_depth``: UInt32, or None where no path goes beyond a gather point
    by way of mirrors or glass.
    """

    scene: object
    traits: object
    sources: Sources
    batch: Batch
    table: SiteTable
    max_depth: object
    importance: object = None
    statistics: Statistics | None = None
    probability: object = None


@dataclass
class Lanes:
    """Lanes of a pass: for each a site, its half (0, 1), and how many emitter and BSDF samples to take."""

    site: object
    half: object
    samples: object
    bsdf_samples: object
