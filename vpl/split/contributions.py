"""Contributions of paths: sums, a drawn contribution, and sums by layer.

A *layer* is a part of the image: the contributions of paths of one, two, or more edges, or of one group of emitters.
Every contribution belongs to one group and has one length.  The layers of all lengths therefore sum to the image, as do
the layers of all groups, and each has the mean that ``path`` would give for this light alone.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..lights.emitter_groups import EmitterGroups

# Layers by length of the path, in edges as counted by ``max_depth``: one, two, or more
LENGTHS = ("emission", "direct", "indirect")
# Most sums of an image: their indices have 32 bits
_LARGEST = 2**32 - 1


@dataclass(frozen=True)
class Layers:
    """The layers of an image: ``by_length``, whether there are those of :data:`LENGTHS`; ``groups``: or None."""

    by_length: bool
    groups: EmitterGroups | None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the layers, in the order of their sums."""
        return (LENGTHS if self.by_length else ()) + (self.groups.names if self.groups else ())

    def sums(self, rays: int) -> LayerSums | None:
        """Sums of ``rays`` camera rays, all 0; None without layers."""
        return LayerSums(self, rays) if self.names else None


class LayerSums:
    """Sums of contributions for each camera ray and layer.

    No dataclass: Dr.Jit must not take the sums, to which loops scatter, into the state of these loops.
    """

    def __init__(self, layers: Layers, rays: int):
        self._layers, self._stride = layers, len(layers.names)
        self._channels, self._first = dr.size_v(mi.UnpolarizedSpectrum), dr.opaque(mi.UInt32, 0)
        size = rays * self._stride * self._channels
        if size > _LARGEST:
            raise ValueError(
                f"{rays} camera rays with {self._stride} layers need {size} sums, more than {_LARGEST}: lower the "
                "samples of a pass, by samples_per_pass or pass_spp"
            )
        self._sums = dr.zeros(mi.Float, size)
        dr.eval(self._sums)

    def part(self, first: int) -> LayerSums:
        """The same sums, with camera rays numbered from the ray ``first`` on."""
        part = copy(self)
        part._first = dr.opaque(mi.UInt32, first)
        return part

    def add(self, contribution, ray: mi.UInt32, length: mi.UInt32, group: mi.UInt32) -> None:
        """Add the contribution of paths of ``length`` edges from an emitter in ``group`` to the camera rays ``ray``."""
        numbers = []
        if self._layers.by_length:
            numbers.append(dr.minimum(length, len(LENGTHS)) - 1)
        if self._layers.groups:
            numbers.append(group + (len(LENGTHS) if self._layers.by_length else 0))
        for number in numbers:
            row = ((self._first + ray) * self._stride + number) * self._channels
            for channel in range(self._channels):
                value = contribution[channel]
                dr.scatter_add(self._sums, value, row + channel, value != 0, mode=dr.ReduceMode.Local)

    def of(self, layer: str, kept: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Sums of a layer by name, 0 for the rays that are not ``kept``."""
        row = dr.arange(mi.UInt32, dr.width(kept)) * self._stride + self._layers.names.index(layer)
        found = mi.UnpolarizedSpectrum(
            *(dr.gather(mi.Float, self._sums, row * self._channels + channel) for channel in range(self._channels))
        )
        return dr.select(kept, found, 0)


@dataclass
class Contributions:
    """Contributions found by paths.

    ``radiance``: sum; ``drawn``: a contribution, drawn in proportion to absolute value; ``length``: edges of the path
    of ``drawn``; ``group``: of its emitter, see :class:`vpl.lights.emitter_groups.EmitterGroups`; ``level``: sum of
    absolute values; ``sums`` by layer, or None.  All but ``radiance`` and ``sums`` are None if none is drawn.
    """

    radiance: mi.UnpolarizedSpectrum
    drawn: mi.UnpolarizedSpectrum | None
    length: mi.UInt32 | None
    group: mi.UInt32 | None
    level: mi.Float | None
    sums: LayerSums | None

    @classmethod
    def none(cls, count: int, sums: LayerSums | None = None, draws: bool = True) -> Contributions:
        """No contribution yet; ``draws``: whether one is drawn."""
        radiance = dr.zeros(mi.UnpolarizedSpectrum, count)
        if not draws:
            return cls(radiance, None, None, None, None, sums)
        return cls(radiance, mi.UnpolarizedSpectrum(radiance), mi.UInt32(0), mi.UInt32(0), mi.Float(0), sums)

    def add(self, contribution, length, group, sample, lane=None) -> None:
        """Add the contribution of paths with ``length`` edges from emitters in ``group``.

        ``sample``: a uniform number, if a contribution is drawn; ``lane``: numbers of the camera rays, if there are
        layers.
        """
        self.radiance += contribution
        if self.drawn is not None:
            level = dr.sum(dr.abs(contribution))
            taken = sample * (self.level + level) < level
            self.drawn = dr.select(taken, contribution, self.drawn)
            self.length, self.group = dr.select(taken, length, self.length), dr.select(taken, group, self.group)
            self.level += level
        if self.sums is not None:
            self.sums.add(contribution, lane, length, group)

    @property
    def one(self) -> mi.UnpolarizedSpectrum:
        """The drawn contribution over its probability."""
        return self.drawn * dr.select(self.level > 0, self.level / dr.sum(dr.abs(self.drawn)), 0)
