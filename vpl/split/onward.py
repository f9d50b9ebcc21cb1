"""Directions in which paths go on: samples of the BSDF, or directions to relays (:mod:`vpl.split.relays`).

A direction to a relay takes the place of the first emitter sample of its vertex, so that the materials are called once.
Therefore first emitter samples are divided by the probability that no relay is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .emitters.base import EmitterSample
from .relays import Relays


@dataclass
class Turned:
    """Directions onward, one per lane.

    ``sample`` of the BSDF, with the density of its direction without relays, see :mod:`vpl.split.covered`; ``weight``:
    BSDF × cosine over ``density``, the density with which the direction is drawn, 1 / sr, without meaning for delta
    lobes.
    """

    sample: mi.BSDFSample3f
    weight: mi.Spectrum
    density: mi.Float

    @classmethod
    def none(cls, count: int) -> Turned:
        """Paths that go nowhere."""
        return cls(dr.zeros(mi.BSDFSample3f, count), dr.zeros(mi.Spectrum, count), dr.zeros(mi.Float, count))


@dataclass
class RelayChoice:
    """Choice between the BSDF and relays, one per lane.

    ``relays``; ``si``: surfaces; ``cell`` of the relays; ``chooses``: whether there is a choice; ``drawn``: choice, 0
    for the BSDF; ``direction`` to a relay; ``of_bsdf``: probability of the BSDF, 1 without a choice.
    """

    relays: Relays
    si: mi.SurfaceInteraction3f
    cell: mi.UInt32
    chooses: mi.Bool
    drawn: mi.UInt32
    direction: mi.Vector3f
    of_bsdf: mi.Float

    @property
    def to_relay(self) -> mi.Bool:
        """Whether a relay is drawn."""
        return self.drawn > 0

    @classmethod
    def of(cls, relays: Relays, hit, numbers: tuple, active: mi.Bool) -> tuple[RelayChoice, tuple]:
        """The choice at each ``hit`` by the ``numbers`` of a lattice, and the remaining numbers; the BSDF where a lane
        is not ``active``."""
        chosen, place, lobe, turn = numbers
        si, chooses = hit.si, active & relays.materials.hold(hit.bsdf, hit.smooth)
        cell = relays.cell(si.p, hit.facing)
        drawn, direction, rest = relays.draw(si.p, cell, lobe, turn, chooses)
        of_bsdf = dr.select(chooses, relays.choice.probability(cell, mi.UInt32(0), chooses), 1)
        lobe = dr.select(chooses, rest, lobe)
        return cls(relays, si, cell, chooses, drawn, direction, of_bsdf), (chosen, place, lobe, turn)

    def instead(self, sample: EmitterSample, number: mi.UInt32) -> EmitterSample:
        """The emitter ``sample`` with a ``number`` at its vertex, or, if a relay is drawn, the direction to it with the
        weight 0."""
        first = number == 0
        to_relay = self.to_relay & first
        weight = dr.select(to_relay, 0, sample.weight / dr.select(first, self.of_bsdf, 1))
        return replace(sample, direction=dr.select(to_relay, self.direction, sample.direction), weight=weight)

    def chosen(self, before: Turned, turned: Turned, direction, value, density, number: mi.UInt32) -> Turned:
        """Where a relay is drawn, its ``direction``, with BSDF × cosine ``value`` as weight; otherwise ``turned``.

        ``density`` of the direction, see :class:`Turned`; ``before``: the result of the sample before.
        """
        along = dr.zeros(mi.BSDFSample3f, dr.width(density))
        along.wo, along.pdf, along.eta = direction, density, mi.Float(1)
        along.sampled_type = mi.UInt32(mi.BSDFFlags.GlossyReflection)
        along = dr.select(number == 0, Turned(along, value, density), before)
        return dr.select(self.to_relay, along, turned)

    def mixed(self, turned: Turned) -> Turned:
        """The directions ``turned`` with the density of the mixture, and weights over it."""
        bs = turned.sample
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        counts = self.chooses & ~delta
        direction = self.si.to_world(bs.wo)
        mixture = self.relays.density(self.si.p, self.cell, self.drawn, direction, bs.pdf * self.of_bsdf, counts)
        density = dr.select(counts, mixture, bs.pdf)
        # BSDF × cosine over the density of the mixture
        of_sample = dr.select(counts, bs.pdf / density, dr.rcp(self.of_bsdf))
        factor = dr.select(self.to_relay, dr.rcp(density), of_sample)
        return Turned(bs, dr.select(density > 0, turned.weight * factor, 0), density)
