"""Direct light at all gather points of an image, from few sources or many [IAS].

Gather points form sites, sites form groups, and each group gets a cut through the sources.  A group with few sources is
lit by the plain sum (:mod:`vpl.direct.all_sources`), a group with many by iterative adaptive sampling
(:mod:`vpl.direct.passes`).

[IAS] Donikian et al. 2006, Accurate direct illumination using iterative adaptive sampling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import chunks, download, upload
from ..core.path_limits import PathLimits
from ..core.sampling import derived_seed
from ..points.bsdf_proxies import probe_materials
from ..points.camera_paths import GatherPoints, PixelGrid
from ..points.surfaces import Batch, LambertianSurface, make_batches
from .all_sources import SourceRounds
from .cluster_cuts import GroupCuts, cut_clusters, has_wide_source
from .passes import SiteEstimates, SitePasses
from .site_table import PassContext, SiteTable
from .sites import Sites, bound_groups, divide_points
from .sources import Sources
from .unoccluded_passes import UnoccludedPasses

# Entries (pairs of a site and a cluster) processed at a time, some 28 bytes each
_ENTRIES = 12_000_000
# Number of sources, in samples of a pass, up to which a group is summed.  A sum traces twice as many rays a second and
# has no variance.  Sampling takes at least two passes
_SUM_ADVANTAGE = 4
# Sites of the pilot, which estimates the mean radiance of the image
_PILOT_SITES = 1024
# Clusters below this fraction of a group's unoccluded light may be coarse
FAINT_SHARE = 0.005
FIELDS = ("noise", "passes", "shadow_rays", "visible")


@dataclass(frozen=True, kw_only=True)
class DirectOptions:
    """Properties of ``adaptivedirect`` and ``unoccludeddirect``, under the same names.

    ``lights``: "clusters", "all" or "auto"; or "unoccluded", the reference method.  ``cluster_angle``: steradians [IAS
    section 5.7]; ``max_passes``, ``max_samples`` of a pixel: [IAS section 5.9]; ``time``: seconds, 0 for no limit;
    ``rr_depth``: see :class:`vpl.core.path_limits.PathLimits`.
    """

    error: float = 0.03
    dark_floor: float = 0.1
    lights: str = "auto"
    cluster_angle: float = 0.02
    max_passes: int = 15
    max_samples: int = 20_000
    samples_per_ray: int = 100
    bsdf_share: float = 0.125
    time: float = 0.0
    rr_depth: int = 5


@dataclass
class DirectLight:
    """Direct light, one value for every gather point.

    - ``noise``: estimated standard error over radiance
    - ``shadow_rays``: rays of the site divided by its number of points
    - ``visible``: fraction of samples that found light
    - ``clusters``: sizes of cuts, summed over points
    """

    radiance: mi.UnpolarizedSpectrum
    noise: mi.Float
    passes: mi.Float
    shadow_rays: mi.Float
    visible: mi.Float
    clusters: int = 0


def light_directly(
    scene, traits, sources: Sources, points: GatherPoints, grid: PixelGrid, max_depth, options: DirectOptions,
    seed: int, stopped: Callable[[], bool] = lambda: False, level: float | None = None,
) -> DirectLight:  # fmt: skip
    """Direct light of ``sources`` at all gather points.

    ``level``: mean radiance of the gather points, the unit of ``dark_floor``; None lets a pilot estimate it.
    ``stopped``: called before every pass; True ends the render.
    """
    start = perf_counter()
    found, clusters = np.zeros((points.count, 3 + len(FIELDS)), np.float32), 0
    if sources.count or sources.extended:
        parts = [
            _BatchLight(scene, traits, sources, points, batch, grid, max_depth, options, derived_seed(seed, 2, k))
            for k, batch in enumerate(make_batches(points, probe_materials(points, traits)))
        ]
        if level is None:
            level = sum(part.pilot(derived_seed(seed, 0, k)) * part.batch.count for k, part in enumerate(parts))
            level /= points.count
        done = 0
        for number, part in enumerate(parts):
            done += part.batch.count
            deadline = start + options.time * done / points.count if options.time > 0 else np.inf
            found[part.rows] = part.solve(level, derived_seed(seed, 1, number), stopped, deadline)
            clusters += part.clusters
    columns = [upload(mi.Float, column) for column in found.T.copy()]
    radiance = mi.UnpolarizedSpectrum(*columns[: dr.size_v(mi.UnpolarizedSpectrum)])
    return DirectLight(radiance, *columns[3:], clusters=clusters)


class _BatchLight:
    """Direct light at the points of one batch."""

    def __init__(self, scene, traits, sources, points, batch: Batch, grid, max_depth, options, seed: int):
        self.batch, self.options, self.grid, self.nodes = batch, options, grid, sources.nodes
        self._common = scene, traits, sources, batch
        self._beyond = PathLimits.of(max_depth, options.rr_depth) if traits.delta and max_depth > 2 else None
        self.rows = download(batch.index)
        pixel = download(points.ray)[self.rows].astype(np.int64) // grid.samples
        position, normal = download(batch.position), download(batch.normal)
        generator = np.random.default_rng(seed)
        self._single = options.lights == "unoccluded"  # sources instead of clusters
        # The reference method visits the points of a site one after another, in random order
        self.sites = divide_points(pixel, grid.width, position, normal, generator if self._single else None)
        two_sided = np.zeros(batch.count, bool)
        if batch.proxy.without_cosines:
            two_sided |= download(batch.proxy.no_cosine)
        self._two_sided = upload(mi.UInt32, two_sided) == 1
        self._bounds = bound_groups(self.sites, position, normal, two_sided)
        self._choose()

    def _choose(self) -> None:
        """Choose the cut, the method (sum or passes) and the number of BSDF samples of every group."""
        options, count = self.options, self._bounds.count
        self._cuts = self._cut(np.arange(count), options.cluster_angle)
        group = self._cuts.group
        sources = (self.nodes.last.astype(np.int64) - self.nodes.first)[self._cuts.node]
        # Number of sources in each group's cut, and of sources with an extent
        self._source_count, extended = (
            np.bincount(group, number, count) for number in (sources, self.nodes.extended[self._cuts.node])
        )
        self._summed = np.full(count, options.lights == "all")
        if options.lights == "auto" and self._beyond is None:
            of_pass = np.maximum(SiteEstimates.samples_per_cluster * self._cuts.size, SiteEstimates.least_samples)
            self._summed = (extended == 0) & (self._source_count <= _SUM_ADVANTAGE * of_pass)
        # Small sources on diffuse surfaces need no BSDF samples, unless light arrives by way of delta surfaces
        self._bsdf = np.ones(count) * options.bsdf_share
        if isinstance(self.batch.surfaces, LambertianSurface) and self._beyond is None:
            self._bsdf *= has_wide_source(self.nodes, self._bounds, self._cuts)

    def _cut(self, groups, solid_angle: float) -> GroupCuts:
        cuts = cut_clusters(self.nodes, self._bounds.select(groups), solid_angle, FAINT_SHARE)
        # With delta surfaces a group without sources still needs BSDF samples, and so a cut that is not empty
        return cuts if self._beyond is None or self.nodes.count == 0 else cuts.without_empty()

    @property
    def clusters(self) -> int:
        """Size of the cut of each point's group, summed over the points."""
        return int((self.sites.points * self._cuts.size[self.sites.group]).sum())

    def pilot(self, seed: int) -> float:
        """Estimate the mean radiance of the batch by one pass over some of the groups."""
        order = np.random.default_rng(seed).permutation(self._bounds.count)
        sites = self.sites.per_group[order]
        enough = (np.cumsum(sites) <= _PILOT_SITES) & (np.cumsum(sites * self._cuts.size[order]) <= _ENTRIES)
        chosen = np.sort(order[: max(1, int(enough.sum()))])
        part = self.sites.select(chosen)
        passes = SitePasses(*self._task(part, self._cuts.select(chosen), chosen), 0.0, self.options)
        passes.max_passes = 1
        if self._single:
            # The sample count of the method itself
            passes.estimates.least_samples = passes.estimates.most_samples = self.options.samples_per_ray
        passes.run(self._two_sided, seed, lambda number: False)
        return float(np.average(passes.result()[0].mean(1), weights=part.points))

    def _task(self, part: Sites, cuts: GroupCuts, groups):
        """(PassContext, fraction of the pixel's rays, BSDF samples per emitter sample) of the sites of some groups."""
        table = SiteTable.of(part, cuts)
        return (
            PassContext(*self._common, table, self._beyond),
            part.points / self.grid.samples,
            self._bsdf[groups][part.group],
        )

    def solve(self, level: float, seed: int, stopped, deadline: float) -> np.ndarray:
        """Compute (n, 3 + len(FIELDS)) float32: RGB radiance of every point, then its FIELDS."""
        per_site = np.zeros((self.sites.count, 3 + len(FIELDS)), np.float32)
        start, spent, number = perf_counter(), 0, 0
        for summed in (True, False):
            for groups in self._portions(np.flatnonzero(self._summed == summed), summed):
                spent += len(groups)
                until = start + (deadline - start) * spent / len(self._summed)
                halted = partial(_halted, stopped, until)
                part, result = self._light(groups, summed, level, derived_seed(seed, number), halted)
                per_site[self.sites.of_groups(groups)] = self._columns(part, result)
                number += 1
        per_point = per_site[self.sites.point_site]
        per_point[:, :3] *= self._own_reflectance()
        return per_point

    def _own_reflectance(self) -> np.ndarray:
        """Reflectance of every point relative to the mean of its site, (n, channels) or (1,).

        The points of a site share incident light, and each keeps its own reflectance.  Textures thus stay sharp under
        filters wider than a pixel.  The mean over the site is unchanged.
        """
        if self.sites.count == self.batch.count:
            return np.ones(1)
        own, site = download(self.batch.surfaces.reflectance()), self.sites.point_site
        total = np.stack([np.bincount(site, channel) for channel in own.T], axis=1)
        mean = (total / self.sites.points[:, None])[site]
        return np.where(mean > 0, own / np.where(mean > 0, mean, 1), 1)

    def _portions(self, groups: np.ndarray, summed: bool):
        """Divide groups into portions of at most _ENTRIES entries."""
        if summed:
            entries = self._source_count[groups]
        else:
            size = self._source_count if self._single else self._cuts.size
            entries = size[groups] * self.sites.per_group[groups]
        for first, last in chunks(entries, _ENTRIES):
            yield groups[first:last]

    def _light(self, groups, summed: bool, level, seed, halted):
        """Light some groups: (their sites, result of :meth:`SiteEstimates.result`)."""
        single = summed or self._single
        part, cuts = self.sites.select(groups), self._cut(groups, 0.0) if single else self._cuts.select(groups)
        context, share, bsdf = self._task(part, cuts, groups)
        if summed:
            # "auto" sums only over sources without extent, which BSDF samples cannot hit
            method = SourceRounds(context, part, share, bsdf * (self.options.lights == "all"), level, self.options)
            method.run(seed, halted)
        else:
            method = (UnoccludedPasses if self._single else SitePasses)(context, share, bsdf, level, self.options)
            method.run(self._two_sided, seed, halted)
        return part, method.result()

    def _columns(self, part: Sites, result) -> np.ndarray:
        radiance, variance, passes, rays, visible = result
        level = radiance.mean(1)
        noise = np.where(level > 0, np.sqrt(variance) / np.where(level > 0, level, 1), 0)
        return np.concatenate([radiance, np.stack([noise, passes, rays / part.points, visible], 1)], 1)


def _halted(stopped, until: float, number: int) -> bool:
    """Whether to stop before a pass; the deadline never stops the first one."""
    return stopped() or (number > 0 and perf_counter() > until)
