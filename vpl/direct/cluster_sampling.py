"""Kernels of direct lighting: draw a cluster, a source, a point on the source, and trace a shadow ray [IAS]."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import channel_mean, finite_or_zero
from ..core.loops import recorded_once
from ..core.sampling import SpreadSamples, independent_sampler
from .emitter_sampling import emission_beyond_delta, power_heuristic
from .site_table import SEEN, Lanes, PassContext, SiteTable


@dataclass
class Drawn:
    """Estimates of a pass, per lane; ``variance``: of the channel mean; ``seen``: samples that found light."""

    radiance: mi.UnpolarizedSpectrum
    variance: mi.Float
    rays: mi.UInt32
    seen: mi.UInt32


@dataclass
class _Site:
    """The site of each lane: columns of :class:`SiteTable`, and the numbers of samples."""

    size: mi.UInt32
    cut: mi.UInt32
    entry: mi.UInt32
    member_first: mi.UInt32
    members: mi.UInt32
    samples: mi.Float
    bsdf_samples: mi.Float

    @classmethod
    def of(cls, table: SiteTable, lanes: Lanes) -> _Site:
        names = ("size", "cut", "entry", "member_first", "members")
        columns = (dr.gather(mi.UInt32, getattr(table, name), lanes.site) for name in names)
        return cls(*columns, mi.Float(lanes.samples), mi.Float(lanes.bsdf_samples))


@recorded_once
@dr.syntax
def draw_samples(context: PassContext, lanes: Lanes, seed: int) -> Drawn:
    """Draw stratified samples of the clusters of every lane's site, and add to the site's statistics."""
    table, statistics, sources = context.table, context.statistics, context.sources
    count = dr.width(lanes.site)
    random = independent_sampler(seed, count)
    points = SpreadSamples.random(random)
    site = _Site.of(table, lanes)
    own = lanes.half * dr.opaque(mi.UInt32, table.entries) + site.entry
    total, last, differences = dr.zeros(mi.UnpolarizedSpectrum, count), mi.Float(0), mi.Float(0)
    rays, seen = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
    i, k = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
    # Double precision, because the remainder of the number, after many clusters, also draws the source
    precise = dr.float64_array_t(mi.Float)
    below = dr.zeros(precise, count)
    p = dr.gather(mi.Float, context.probability, site.entry)
    while dr.hint(i < lanes.samples, exclude=[context, table, statistics, sources, lanes, site, own, points]):
        # ---- Cluster: strata are equal parts of the sum of probabilities
        target = (precise(i) + precise(random.next_1d())) / precise(site.samples)
        while dr.hint((below + precise(p) <= target) & (k + 1 < site.size), exclude=[context, site, target]):
            below += precise(p)
            k += 1
            p = dr.gather(mi.Float, context.probability, site.entry + k)
        inside = dr.clip(mi.Float((target - below) / precise(p)), 0, dr.one_minus_epsilon(mi.Float))
        value, weight, arrives, visible = _emitter_sample(context, site, k, p, inside, points.at(i))
        # ---- Statistics: lanes never share an entry, so no atomics are needed.  The MIS weight is left out: it would
        # lower the probability of a cluster that BSDF samples find, pass after pass
        gain = channel_mean(value) * p / dr.gather(mi.Float, context.importance, site.entry + k)
        dr.scatter_add(statistics.gain, gain, own + k, mode=dr.ReduceMode.NoConflicts)
        one = dr.select(visible, mi.UInt32(SEEN + 1), mi.UInt32(1))
        dr.scatter_add(statistics.counts, one, own + k, mode=dr.ReduceMode.NoConflicts)
        value *= weight
        level = channel_mean(value)
        # Differences of neighbouring strata leave out the variance that stratification removes; the sample variance of
        # [IAS section 4.2] includes it
        differences += dr.select(i > 0, dr.square(level - last), 0)
        last = level
        total += value
        rays += dr.select(arrives, 1, 0)
        seen += dr.select(visible, 1, 0)
        i += 1
    variance = differences * 0.5 / (dr.maximum(site.samples - 1, 1) * site.samples)
    total /= site.samples
    if dr.hint(sources.extended, mode="scalar"):
        more, more_variance, more_seen = _bsdf_samples(context, site, lanes.bsdf_samples, random)
        total += more
        variance += more_variance
        rays += lanes.bsdf_samples
        seen += more_seen
    dr.eval(total, variance, rays, seen, statistics.gain, statistics.counts)
    return Drawn(total, variance, rays, seen)


@recorded_once
@dr.syntax
def sum_sources(context: PassContext, lanes: Lanes, seed: int) -> Drawn:
    """Take one sample of every cluster of every lane's site.  ``lanes.samples`` must be 1; the variance is 0."""
    count = dr.width(lanes.site)
    random = independent_sampler(seed, count)
    site = _Site.of(context.table, lanes)
    total, rays, seen = dr.zeros(mi.UnpolarizedSpectrum, count), mi.UInt32(0), mi.UInt32(0)
    k = dr.zeros(mi.UInt32, count)
    while dr.hint(k < site.size, exclude=[context, lanes, site]):
        point = mi.Point3f(random.next_1d(), random.next_1d(), random.next_1d())
        value, weight, arrives, visible = _emitter_sample(context, site, k, mi.Float(1), random.next_1d(), point)
        total += value * weight
        rays += dr.select(arrives, 1, 0)
        seen += dr.select(visible, 1, 0)
        k += 1
    if dr.hint(context.sources.extended, mode="scalar"):
        more, _, more_seen = _bsdf_samples(context, site, lanes.bsdf_samples, random)
        total += more
        rays += lanes.bsdf_samples
        seen += more_seen
    variance = dr.zeros(mi.Float, count)
    dr.eval(total, variance, rays, seen)
    return Drawn(total, variance, rays, seen)


def _emitter_sample(context: PassContext, site: _Site, k, p, inside, point):
    """Sample a point on the k-th cluster of each site, which was drawn with probability ``p``.

    ``inside``: uniform number that draws the source; ``point``: three uniform numbers.
    Returns (radiance over density, MIS weight, whether the unoccluded contribution is positive, whether the point is
    visible, too).
    """
    node = context.sources.node(dr.gather(mi.UInt32, context.table.node, site.cut + k))
    rank, share = context.sources.member(node, inside)
    surface = context.batch.surfaces_at(_member(context.table, site, point.z))
    sample = mi.Point2f(point.x, point.y)
    drawn = context.sources.sample(rank, surface.interaction, inside, sample, mi.Bool(True))
    reflected, bsdf_pdf = surface.reflected_with_density(drawn.direction, mi.Bool(True))
    pdf = p * share * drawn.pdf
    weight = dr.select(drawn.pdf > 0, power_heuristic(site.samples * pdf, site.bsdf_samples * bsdf_pdf), 1)
    value = finite_or_zero(reflected * drawn.value / (p * share))
    arrives = dr.any(value > 0)
    visible = arrives & ~context.scene.ray_test(surface.interaction.spawn_ray_to(drawn.p), arrives)
    # The weight is not finite if the point lies on the source, without a direction
    return dr.select(visible, value, 0), dr.select(visible, weight, 0), arrives, visible


@dr.syntax
def _bsdf_samples(context: PassContext, site: _Site, bsdf_samples, random):
    """Take the BSDF samples: (MIS-weighted radiance, variance of the channel mean, samples that found light)."""
    count = dr.width(bsdf_samples)
    total, last, differences = dr.zeros(mi.UnpolarizedSpectrum, count), mi.Float(0), mi.Float(0)
    seen, j = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
    while dr.hint(j < bsdf_samples, exclude=[context, site]):
        value = _bsdf_sample(context, site, random)
        level = channel_mean(value)
        differences += dr.select(j > 0, dr.square(level - last), 0)
        last = level
        total += value
        seen += dr.select(level > 0, 1, 0)
        j += 1
    scale = dr.select(bsdf_samples > 0, dr.rcp(site.bsdf_samples), 0)
    return total * scale, differences * 0.5 * scale / dr.maximum(site.bsdf_samples - 1, 1), seen


def _bsdf_sample(context: PassContext, site: _Site, random):
    """MIS-weighted radiance over density along a direction drawn from the BSDF."""
    surface = context.batch.surfaces_at(_member(context.table, site, random.next_1d()))
    direction, weight, bsdf_pdf = surface.sample(random.next_1d(), random.next_2d(), mi.Bool(True))
    going = dr.any(weight > 0)
    ray = surface.interaction.spawn_ray(direction)
    hit = context.scene.ray_intersect_preliminary(ray, active=going)
    radiance, rank, source_pdf = context.sources.find(hit, ray, going)
    pdf = source_pdf * _probability_of(context, site, rank, going)
    radiance *= power_heuristic(site.bsdf_samples * bsdf_pdf, site.samples * pdf)
    if context.beyond is not None:
        surface_hit = context.traits.interactions.at(hit, ray, going)
        radiance += emission_beyond_delta(
            context.sources.emitters, context.traits, surface_hit, surface.depth + 1, context.beyond, random, going,
        )  # fmt: skip
    return finite_or_zero(weight * radiance) & going


@dr.syntax
def _probability_of(context: PassContext, site: _Site, rank, active):
    """Probability that an emitter sample of a site draws the source of a rank; 0 for sources outside the cut."""
    low, high = dr.zeros(mi.UInt32, dr.width(rank)), mi.UInt32(site.size)
    active = active & (rank < context.sources.count)
    while dr.hint(active & (high > low + 1), exclude=[context, site, rank, active]):
        middle = (low + high) >> 1
        before = _cluster(context, site, middle, active).first <= rank
        low = dr.select(before, middle, low)
        high = dr.select(before, high, middle)
    node = _cluster(context, site, low, active)
    active &= (node.first <= rank) & (rank < node.last)
    share = context.sources.member_probability(node, rank, active)
    if context.probability is not None:
        share *= dr.gather(mi.Float, context.probability, site.entry + low, active)
    return share & active


def _cluster(context: PassContext, site: _Site, k, active):
    return context.sources.node(dr.gather(mi.UInt32, context.table.node, site.cut + k, active), active)


def _member(table: SiteTable, site: _Site, sample):
    """Row in the batch of a random point of each site."""
    place = dr.minimum(mi.UInt32(sample * mi.Float(site.members)), site.members - 1)
    return dr.gather(mi.UInt32, table.member_row, site.member_first + place)
