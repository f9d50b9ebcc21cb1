"""Direct light at all gather points of an image, from few sources or many [IAS].

Points become sites, sites form groups, groups get their cuts through the sources; then each is lit by the cheaper of
two ways: by iterative adaptive sampling (:mod:`vpl.site_passes`) or, where its sources are few, by summing over all of
them (:mod:`vpl.all_sources`).

[IAS] Donikian et al. 2006, Accurate direct illumination using iterative adaptive sampling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from .all_sources import SourceRounds
from .arrays import download, upload
from .cluster_cuts import GroupCuts, all_leaves, cut_clusters, has_wide_source
from .gather import GatherPoints
from .pixel_regions import representatives
from .point_groups import Sites, bound_groups, find_groups, find_sites
from .proxies import probe_materials
from .sampling import derived_seed
from .site_passes import SitePasses
from .site_table import Scenery, SiteTable
from .sources import Sources
from .surfaces import Batch, LambertianSurface, make_batches
from .unoccluded_passes import UnoccludedPasses

# Entries (pairs of a site and a cluster) that are worked on at a time: some 28 bytes each
_ENTRIES = 12_000_000
# Sums trace twice as many rays in a second as passes do, have no noise, and two passes are needed at least
_SUM_WORTH = 4
# Sites of the pilot, which finds the mean radiance of the image
_PILOT_SITES = 4096
FIELDS = ("noise", "passes", "shadow_rays", "regions", "visible")


@dataclass(frozen=True, kw_only=True)
class DirectOptions:
    """What users choose; see the plugin ``adaptivedirect``."""

    error: float = 0.02
    dark_floor: float = 0.1
    lights: str = "auto"
    solid_angle: float = 0.02
    max_passes: int = 15
    max_samples: int = 20000
    samples_per_cluster: float = 1.5
    least_samples: int = 50
    most_samples: int = 400
    bsdf_share: float = 0.125
    evaluated: bool = True
    prior: float = 1.0
    inverse_variance: bool = False
    antialiasing: bool = True
    time: float = 0.0


@dataclass
class PixelGrid:
    """How camera rays lie in the image: ``samples`` of a pixel follow each other, ``width`` pixels make a row."""

    width: int
    samples: int


@dataclass
class DirectLight:
    """Per gather point: ``radiance``; ``noise``: estimated standard error over radiance; ``passes``; ``shadow_rays``,
    shared out among the points that were shaded as one; ``regions``: points that were shaded in the site; ``visible``:
    share of the samples that found light. Float but the radiance."""

    radiance: object
    noise: object
    passes: object
    shadow_rays: object
    regions: object
    visible: object


def light_directly(
    scene, traits, sources: Sources, points: GatherPoints, grid: PixelGrid, max_depth, options: DirectOptions,
    seed: int, stopped: Callable[[], bool] = lambda: False,
) -> DirectLight:  # fmt: skip
    """Direct light of ``sources`` at all gather points."""
    found = np.zeros((points.count, 3 + len(FIELDS)), np.float32)
    if sources.count or sources.extended:
        shapes = download(dr.reinterpret_array(mi.UInt32, points.si.shape))
        parts = [
            _BatchLight(scene, traits, sources, points, batch, shapes, grid, max_depth, options)
            for batch in make_batches(points, probe_materials(points, traits))
        ]
        rays = max(points.count, 1)
        level = sum(part.pilot(derived_seed(seed, 0, k)) * part.batch.count / rays for k, part in enumerate(parts))
        start, done = perf_counter(), 0
        for number, part in enumerate(parts):
            done += part.batch.count
            deadline = start + options.time * done / rays if options.time > 0 else np.inf
            found[part.rows] = part.solve(level, derived_seed(seed, 1, number), stopped, deadline)
    columns = [upload(mi.Float, column) for column in found.T.copy()]
    radiance = mi.UnpolarizedSpectrum(*columns[: dr.size_v(mi.UnpolarizedSpectrum)])
    return DirectLight(radiance, *columns[3:])


class _BatchLight:
    """Direct light at the points of one batch."""

    def __init__(self, scene, traits, sources, points, batch: Batch, shapes, grid, max_depth, options):
        self.batch, self.options, self.grid = batch, options, grid
        self._common = scene, traits, sources, batch
        self._beyond = dr.opaque(mi.UInt32, int(min(max_depth, 0xFFFFFFFF))) if traits.delta and max_depth > 2 else None
        self.rows = download(batch.index)
        pixel = download(points.ray)[self.rows].astype(np.int64) // grid.samples
        position, normal = download(batch.position), download(batch.normal)
        two_sided = np.zeros(batch.count, bool)
        if batch.proxy.without_cosines:
            two_sided |= download(batch.proxy.no_cosine)
        self._two_sided = upload(mi.UInt32, two_sided) == 1
        self._standing = np.arange(batch.count)
        if options.antialiasing and grid.samples > 1:
            self._standing = representatives(pixel, shapes[self.rows], position, normal)
        group = _groups_of(self._standing, pixel, grid.width, position, normal)
        self.sites = find_sites(group, pixel)
        bounds = bound_groups(self.sites, position, normal, two_sided)
        self._choose(sources, bounds)

    def _choose(self, sources: Sources, bounds) -> None:
        """Cuts of all groups, and which of them sum over all sources."""
        options, nodes = self.options, sources.nodes
        self._cuts = cut_clusters(nodes, bounds, 0.0 if options.lights == "unoccluded" else options.solid_angle)
        if options.lights == "auto":
            self._summed = self._worth_summing(nodes, bounds.count)
        else:
            self._summed = np.full(bounds.count, options.lights == "all")
        self._leaves = all_leaves(nodes, bounds, np.flatnonzero(self._summed))
        # Emitter samples alone are enough for small sources and matt surfaces, unless light comes by way of a mirror
        self._bsdf = np.ones(bounds.count) * options.bsdf_share
        if isinstance(self.batch.surfaces, LambertianSurface) and self._beyond is None:
            self._bsdf *= has_wide_source(sources.nodes, bounds, self._cuts)

    def _worth_summing(self, nodes, count: int) -> np.ndarray:
        """Groups whose sources, all without extent, are so few that to sum over them all is cheaper, (g,) bool."""
        if self._beyond is not None:
            return np.zeros(count, bool)
        group, node = np.repeat(np.arange(count), self._cuts.size), self._cuts.node
        held, extended = (
            np.bincount(group, values, count)
            for values in ((nodes.last.astype(np.int64) - nodes.first)[node], nodes.extended[node])
        )
        a_pass = np.maximum(self.options.samples_per_cluster * self._cuts.size, self.options.least_samples)
        return (extended == 0) & (held <= _SUM_WORTH * a_pass)

    def pilot(self, seed: int) -> float:
        """Mean radiance of the batch's points, roughly: one pass over some of the groups."""
        groups = len(self._summed)
        step = max(1, self.sites.count // _PILOT_SITES)
        chosen = np.arange(0, groups, step)
        passes, part = self._passes(chosen, 0.0)
        passes.max_passes = 1
        passes.run(self._two_sided, seed, lambda: False)
        return float(np.average(passes.result()[0].mean(1), weights=part.points))

    def _passes(self, groups, level: float):
        part, cuts = _select(self.sites, self._cuts, groups)
        share = part.points / self.grid.samples
        method = UnoccludedPasses if self.options.lights == "unoccluded" else SitePasses
        return method(self._scenery(part, cuts), share, self._bsdf[groups][part.group], level, self.options), part

    def _scenery(self, part: Sites, cuts: GroupCuts) -> Scenery:
        return Scenery(*self._common, SiteTable.of(part, cuts, self._standing[part.order]), self._beyond)

    def solve(self, level: float, seed: int, stopped, deadline: float) -> np.ndarray:
        """The columns of :class:`DirectLight` per point, the radiance as three."""
        per_site = np.zeros((self.sites.count, 3 + len(FIELDS)), np.float32)
        start, spent, number = perf_counter(), 0, 0
        for summed in (True, False):
            cuts = self._leaves if summed else self._cuts
            for groups in _portions(np.flatnonzero(self._summed == summed), self.sites, cuts, not summed):
                spent += len(groups)
                until = start + (deadline - start) * spent / len(self._summed)
                halt = lambda until=until: stopped() or perf_counter() > until  # noqa: E731
                part, result = self._light(groups, summed, level, derived_seed(seed, number), halt)
                sites = np.concatenate([np.arange(*self.sites.group_first[[g, g + 1]]) for g in groups])
                per_site[sites] = self._columns(part, result)
                number += 1
        return per_site[self.sites.point_site]

    def _light(self, groups, summed: bool, level, seed, halt):
        if not summed:
            passes, part = self._passes(groups, level)
            passes.run(self._two_sided, seed, halt)
            return part, passes.result()
        part, leaves = _select(self.sites, self._leaves, groups)
        share = part.points / self.grid.samples
        # Where it was chosen by itself, no source has an extent
        bsdf = self._bsdf[groups][part.group] * (self.options.lights == "all")
        rounds = SourceRounds(self._scenery(part, leaves), part, share, bsdf, level, self.options)
        rounds.run(seed, halt)
        return part, rounds.result()

    def _columns(self, part: Sites, result) -> np.ndarray:
        radiance, variance, passes, rays, visible = result
        level = radiance.mean(1)
        noise = np.where(level > 0, np.sqrt(variance) / np.where(level > 0, level, 1), 0)
        regions = np.bincount(
            np.repeat(np.arange(part.count), part.points), self._standing[part.order] == part.order, part.count
        )
        return np.concatenate([radiance, np.stack([noise, passes, rays / part.points, regions, visible], 1)], 1)


def _groups_of(standing, pixel, width, position, normal) -> np.ndarray:
    """Group of every point: that of the point which stands for it."""
    shaded, place = np.unique(standing, return_inverse=True)
    return find_groups(pixel[shaded], width, position[shaded], normal[shaded])[place]


def _portions(groups: np.ndarray, sites: Sites, cuts: GroupCuts | None, by_entry: bool):
    """Divide groups into portions with few enough entries; those that keep no entries are not divided."""
    if len(groups) == 0:
        return
    if not by_entry:
        yield groups
        return
    entries = np.cumsum(cuts.size[groups] * np.diff(sites.group_first)[groups])
    first = 0
    while first < len(groups):
        before = entries[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(entries, before + _ENTRIES, side="right")))
        yield groups[first:last]
        first = last


def _select(sites: Sites, cuts: GroupCuts, groups: np.ndarray) -> tuple[Sites, GroupCuts]:
    """The sites and cuts of some groups, which are numbered anew."""

    def ranges(first, chosen):
        size = np.diff(first)[chosen]
        ends = np.cumsum(size)
        return np.repeat(first[:-1][chosen] - ends + size, size) + np.arange(size.sum()), np.concatenate([[0], ends])

    chosen, group_first = ranges(sites.group_first, groups)
    points, first = ranges(sites.first, chosen)
    nodes, cut_first = ranges(cuts.first, groups)
    group = np.repeat(np.arange(len(groups)), np.diff(group_first))
    part = Sites(group, sites.pixel[chosen], sites.point_site, sites.order[points], first, group_first)
    return part, GroupCuts(cuts.node[nodes], cut_first)
