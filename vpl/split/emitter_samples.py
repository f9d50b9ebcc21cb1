"""Directions to emitters, and emitters that rays met: what the choices of :mod:`vpl.split.next_event` return."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ..core.arrays import finite_or_zero


@dataclass
class EmitterSample:
    """Directions to emitters, one per lane.

    ``direction``; ``weight``: radiance that arrives if nothing is between, over the density; ``density`` per solid
    angle, 1 of emitters that are points or directions, which ``is_point`` tells; ``ray``: towards what is sampled.
    ``nearness``: cosine at the emitter over squared distance, 0 of points, infinite where no virtual light stands for
    the emitter; None where none ever does.
    """

    direction: object
    weight: object
    density: object
    is_point: object
    ray: object
    nearness: object = None

    def chosen_with(self, probability) -> EmitterSample:
        """The same where the emitter was chosen with a probability."""
        weight = finite_or_zero(self.weight / probability)
        return EmitterSample(self.direction, weight, self.density * probability, self.is_point, self.ray, self.nearness)

    def arriving(self, scene, active):
        """The weight where nothing is between, 0 elsewhere."""
        possible = active & (dr.max(self.weight) > 0) & (self.density > 0)
        return dr.select(possible & ~scene.ray_test(self.ray, possible), self.weight, 0)


@dataclass
class MetEmitter:
    """Emitters that rays met: ``radiance``; ``density`` with which a sample would have been drawn there; ``nearness``:
    as that of :class:`EmitterSample`."""

    radiance: object
    density: object
    nearness: object = None
