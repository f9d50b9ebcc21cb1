"""Relays: glass and mirrors by way of which light arrives, as targets of paths.

Next-event estimation finds no emitter behind glass: only samples of the BSDF that happen to meet the glass do.  A lamp
in a glass globe then lights a room by few paths with much light each.  Here, a path leaves a surface by one of several
choices: a sample of the BSDF, or a direction in the cone around a ball that holds a piece of glass.  The density of a
direction is that of the mixture of all choices, so every direction has one weight, whichever choice drew it [Veach
1997, section 9.2.4, "the one-sample model"].  Next-event estimation is weighted beside the BSDF alone.

The probabilities are learned by spatial cell, from the light that a few paths find by each choice
(:mod:`vpl.split.relays_found`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.materials import Materials, tells_density
from .emitters.cell_choice import CellChoice

_KINDS = mi.BSDFFlags
# Lobes of relays, and lobes that exclude a material: shadow rays pass null lobes, and virtual lights carry light from
# diffuse lobes
_PASSED = int(_KINDS.DeltaReflection) | int(_KINDS.DeltaTransmission) | int(_KINDS.GlossyTransmission)
_REFUSED = int(_KINDS.DiffuseReflection) | int(_KINDS.DiffuseTransmission) | int(_KINDS.Null)
# Of the samples of a cell, the fraction that is drawn by the probabilities of unknown cells, and in these, the fraction
# that the BSDF draws: its paths find all other light, so it draws at least 3/8 everywhere (decisions.md)
_USUAL_SHARE, _OF_BSDF = 0.5, 0.75
# Largest difference of equal probabilities, which are rounded to 2^-23
_ROUNDED = 1e-6
# Least squared sine of the angle of a cone: directions are rounded by 1e-7
_LEAST_CONE = 1e-8


def relays_by(flags):
    """Whether a BSDF with these ``flags``, an integer or UInt32, relays light."""
    return ((flags & _PASSED) != 0) & ((flags & _REFUSED) == 0)


class Relays:
    """Choice between a sample of the BSDF, source 0 of ``choice``, and directions to balls around pieces of relays.

    ``count`` n; ``center`` (n, 3), ``radius`` (n,) of the balls: world units; ``light`` (n,) of each relay, for the
    probabilities in unknown cells; ``materials`` at which paths choose, see :func:`vpl.core.materials.tells_density`.
    """

    def __init__(self, center: np.ndarray, radius: np.ndarray, light: np.ndarray, materials: Materials):
        self.count = len(radius)
        # Glass is left by its BSDF: it lies in the balls, and directions to them would seldom pass it
        self.materials = materials.where(lambda bsdf: tells_density(bsdf) and not relays_by(int(bsdf.flags())))
        self._balls = upload(mi.Float, np.concatenate([center, radius[:, None]], 1).astype(np.float32))
        self._last = dr.opaque(mi.UInt32, self.count)
        usual = np.concatenate([[_OF_BSDF], (1 - _OF_BSDF) * light / light.sum()])
        self.choice = CellChoice(usual, _USUAL_SHARE, np.zeros(0, int))

    @property
    def drawn(self) -> float:
        """Mean of the part of the light in a cell that comes by relays, over the cells where light was found."""
        usual, cells = self.choice.pmf[0], self.choice.pmf[1:]
        known = cells[np.abs(cells - usual).max(1) > _ROUNDED]
        learned = known[:, 1:].sum(1) - _USUAL_SHARE * (1 - _OF_BSDF)
        return float(np.mean(learned) / (1 - _USUAL_SHARE)) if len(known) else 0.0

    def cell(self, position: mi.Point3f, facing: mi.Normal3f) -> mi.UInt32:
        """Number of the spatial cell of each vertex; ``facing``: normal on the visible side."""
        return self.choice.cell(position, facing)

    def draw(self, origin: mi.Point3f, cell: mi.UInt32, number: mi.Float, place: mi.Point2f, active: mi.Bool):
        """(Drawn choice, direction if it is a relay, a new uniform number) for each vertex.

        ``number``, ``place``: uniform numbers for the choice, and for the direction.
        """
        source, _, rest = self.choice.draw(cell, number, active)
        source = dr.select(active, source, 0)
        axis, height = self._cone(origin, source - 1, source > 0)
        below = place.x * height
        sine, (around_sine, around_cosine) = dr.sqrt(below * (2 - below)), dr.sincos(dr.two_pi * place.y)
        local = mi.Vector3f(sine * around_cosine, sine * around_sine, 1 - below)
        return source, mi.Frame3f(axis).to_world(local), rest

    @dr.syntax
    def density(
        self, origin: mi.Point3f, cell: mi.UInt32, drawn: mi.UInt32, direction: mi.Vector3f, of_bsdf: mi.Float,
        active: mi.Bool,
    ):  # fmt: skip
        """Density of each ``direction`` from a vertex, 1 / sr; ``drawn``: the choice that drew it; ``of_bsdf``: density
        of the samples of the BSDF, times their probability."""
        active, last, sampled = mi.Bool(active), self._last, mi.Float(of_bsdf)
        number = dr.zeros(mi.UInt32, dr.width(active))
        while dr.hint(active & (number < last), exclude=[origin, cell, drawn, direction, active, last]):
            axis, height = self._cone(origin, number, active)
            # 1 - cosine of the angle between both, without cancellation
            inside = 0.5 * dr.squared_norm(direction - axis) <= height
            number += 1
            # A direction at the edge of its own cone, rounded to the outside, would have a far too small density
            inside = active & (inside | (number == drawn))
            probability = self.choice.probability(cell, number, inside)
            sampled += dr.select(inside, probability * dr.inv_two_pi / height, 0)
        return sampled

    def _cone(self, origin, number, active):
        """(Axis, 1 - cosine of the angle) of the cone from each origin around a ball; all directions in the ball."""
        ball = dr.gather(mi.Vector4f, self._balls, number, active)
        offset = mi.Point3f(ball.xyz) - origin
        squared = dr.squared_norm(offset)
        outside = active & (squared > dr.square(ball.w))
        squared_sine = dr.select(outside, dr.maximum(dr.square(ball.w) / squared, _LEAST_CONE), 0)
        height = dr.select(outside, squared_sine / (1 + dr.sqrt(1 - squared_sine)), 2)
        axis = dr.select(outside, dr.normalize(offset), mi.Vector3f(0, 0, 1))
        return axis, height
