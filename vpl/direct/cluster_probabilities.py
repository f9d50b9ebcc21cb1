"""Cluster probabilities of sites [IAS section 4.1].

The first pass samples in proportion to unoccluded contributions.  Later passes rely increasingly on the samples of the
site and of its group.

Departure from the paper: its uniform function gives every cluster the same probability.  Here the function without
feedback is proportional to unoccluded contributions, apart from a constant fraction.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import channel_mean, finite_or_zero
from .site_table import SEEN, PassContext, SiteTable, Statistics

# Least importance of a cluster, relative to the mean over the site's clusters: covers errors of the estimate
_LEAST_SHARE = 0.01
# Fraction of the uniform function that is constant over a site's clusters
_EVEN_SHARE = 0.1


@dataclass
class Mixture:
    """Weights of the uniform, block and pixel functions in a pass [IAS eq. 6]; ``prior``: number of imaginary samples
    that found everything visible."""

    uniform: mi.Float
    block: mi.Float
    pixel: mi.Float
    prior: mi.Float


def cluster_importance(surface, normal, two_sided, node):
    """Estimate the unoccluded contribution (mean over channels) of a cluster to the radiance of a surface.

    Uses the point of the bounding sphere highest above the surface, so that a cluster partly below the horizon counts,
    and the largest emission cosine of any source in the cluster.
    """
    infinite, radius = node.infinite, dr.maximum(node.radius, 0)
    lift = dr.select(two_sided, mi.Vector3f(0), mi.Vector3f(normal))
    half_sine = dr.safe_sqrt(1 - dr.square(dr.maximum(node.cone_cos, 0)))
    offset = node.centroid - surface.interaction.p + lift * radius
    to_light = dr.select(infinite, node.axis + lift * half_sine, offset)
    length2 = dr.squared_norm(to_light)
    to_light *= dr.select(length2 > 0, dr.rsqrt(length2), 0)
    distance2 = dr.maximum(dr.squared_norm(node.centroid - surface.interaction.p), dr.square(radius))
    facing = dr.clip(half_sine + radius * dr.rsqrt(distance2) - dr.dot(node.axis, to_light), 0, 1)
    facing = dr.select(infinite | (node.cone_cos < 0), 1, facing)
    factor = dr.select(infinite, 1, dr.select(distance2 > 0, facing / distance2, 0))
    return channel_mean(surface.reflected(to_light, mi.Bool(True))) * node.intensity * factor


@dr.syntax
def update_importance(context: PassContext, two_sided, sites):
    """Set the importance of the entries of some sites, positive.  ``two_sided``: Bool per point of the batch."""
    table, importance, sources = context.table, context.importance, context.sources
    size, cut, entry, first, members = (
        dr.gather(mi.UInt32, column, sites)
        for column in (table.size, table.cut, table.entry, table.member_first, table.members)
    )
    middle = dr.gather(mi.UInt32, table.member_row, first + members // 2)
    surface, normal = context.batch.surfaces_at(middle), dr.gather(mi.Normal3f, context.batch.normal, middle)
    both = dr.gather(mi.Bool, two_sided, middle)
    total, k = dr.zeros(mi.Float, dr.width(sites)), dr.zeros(mi.UInt32, dr.width(sites))
    while dr.hint(k < size, exclude=[sources, table, surface, normal, both, importance, cut, entry, size]):
        node = sources.node(dr.gather(mi.UInt32, table.node, cut + k))
        value = finite_or_zero(cluster_importance(surface, normal, both, node))
        dr.scatter(importance, value, entry + k)
        total += value
        k += 1
    dr.eval(total, importance)
    least = dr.select(total > 0, _LEAST_SHARE * total / mi.Float(size), 1)
    k = dr.zeros(mi.UInt32, dr.width(sites))
    while dr.hint(k < size, exclude=[importance, least, entry, size]):
        dr.scatter_add(importance, least, entry + k, mode=dr.ReduceMode.NoConflicts)
        k += 1
    dr.eval(importance)


@dr.syntax
def sum_over_groups(table: SiteTable, statistics: Statistics, totals, place):
    """Update sums over the sites of a group, for each node of its cut.

    ``totals``: Float arrays (samples, samples that saw the source, gain); ``place``: indices of nodes to update.
    """
    entries = dr.opaque(mi.UInt32, table.entries)
    at, stride, sites = (
        dr.gather(mi.UInt32, column, place) for column in (table.group_entry, table.group_stride, table.group_sites)
    )
    samples, seen, gain = (dr.zeros(mi.Float, dr.width(place)) for _ in range(3))
    k = dr.zeros(mi.UInt32, dr.width(place))
    while dr.hint(k < sites, exclude=[statistics, entries, stride, sites]):
        tried, saw, gained = _statistics_of(statistics, at, entries)
        samples += tried
        seen += saw
        gain += gained
        at += stride
        k += 1
    for total, values in zip(totals, (samples, seen, gain), strict=True):
        dr.scatter(total, values, place)
    dr.eval(totals)


def _statistics_of(statistics: Statistics, entry, entries):
    """(samples, samples that saw the source, gain) of entries, both halves together."""
    counts = [dr.gather(mi.UInt32, statistics.counts, entry + half * entries) for half in (0, 1)]
    gain = [dr.gather(mi.Float, statistics.gain, entry + half * entries) for half in (0, 1)]
    tried = mi.Float((counts[0] & (SEEN - 1)) + (counts[1] & (SEEN - 1)))
    return tried, mi.Float((counts[0] >> 16) + (counts[1] >> 16)), gain[0] + gain[1]


@dr.syntax
def update_probabilities(context: PassContext, of_groups, mixture: Mixture, sites):
    """Set the probabilities of the entries of some sites [IAS eq. 4 to 6].

    C / sqrt(u) of [IAS] eq. 4 is importance × gain / sqrt(fraction of samples that saw the source).  The block gets
    ``mixture.prior`` imaginary samples that found the expected light.  The pixel gets the same number of imaginary
    samples with the averages of the block.
    """
    table, importance, statistics = context.table, context.importance, context.statistics
    probability = context.probability
    entries = dr.opaque(mi.UInt32, table.entries)
    size, cut, entry = (dr.gather(mi.UInt32, column, sites) for column in (table.size, table.cut, table.entry))
    sums, k = dr.zeros(mi.Vector3f, dr.width(sites)), dr.zeros(mi.UInt32, dr.width(sites))
    while dr.hint(k < size, exclude=[importance, statistics, of_groups, mixture, entries, size, cut, entry]):
        sums += _guides(importance, statistics, of_groups, mixture.prior, entries, entry + k, cut + k)
        k += 1
    dr.eval(sums)
    shares = mi.Vector3f(mixture.uniform, mixture.block, mixture.pixel)
    # Normalised functions [IAS eq. 5], blended [IAS eq. 6]
    scale = dr.select(sums > 0, shares / sums, 0)
    scale /= dr.sum(scale * sums)
    even = _EVEN_SHARE * scale.x * sums.x / mi.Float(size)
    scale.x *= 1 - _EVEN_SHARE
    k = dr.zeros(mi.UInt32, dr.width(sites))
    while dr.hint(
        k < size,
        exclude=[importance, statistics, of_groups, mixture, entries, size, cut, entry, scale, even, probability],
    ):
        guides = _guides(importance, statistics, of_groups, mixture.prior, entries, entry + k, cut + k)
        dr.scatter(probability, dr.dot(scale, guides) + even, entry + k)
        k += 1
    dr.eval(probability)


def _guides(importance, statistics, of_groups, prior, entries, entry, node):
    """Importance of entries without feedback, with block feedback, and with pixel feedback."""
    level = dr.gather(mi.Float, importance, entry)
    samples, seen, gain = (dr.gather(mi.Float, values, node) for values in of_groups)
    block_gain, block_seen = (gain + prior) / (samples + prior), (seen + prior) / (samples + prior)
    samples, seen, gain = _statistics_of(statistics, entry, entries)
    pixel_gain = (gain + prior * block_gain) / (samples + prior)
    pixel_seen = (seen + prior * block_seen) / (samples + prior)

    def guide(gain, seen):
        """C / sqrt(u) [IAS eq. 4]."""
        return dr.select(seen > 0, level * gain * dr.rsqrt(seen), 0)

    return mi.Vector3f(level, guide(block_gain, block_seen), guide(pixel_gain, pixel_seen))
