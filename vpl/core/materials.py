"""Calls of the materials of a scene's surfaces.

Dr.Jit records the call of a BSDF pointer for every BSDF in memory: also for a BSDF inside another one, such as that of
``twosided``, and for those of other scenes.  A surface never has such a BSDF, but its code is recorded and compiled.
The switch of this module has the materials of surfaces alone.  In a room with 62 materials (kitchen), the kernel of
paths has 8100 instead of 16 800 operations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial

import drjit as dr
import mitsuba as mi

from .parameters import children_of
from .registry import RegistryTable
from .shapes import SceneShapes

# Materials whose samples have the density of the drawn part, by class
_OF_PARTS = ("BlendBSDF", "MaskBSDF")


def tells_density(bsdf: mi.BSDF) -> bool:
    """Whether samples of a BSDF come with the density that the BSDF gives any direction.

    In Mitsuba 3.9.1, a sample of ``blendbsdf`` or ``mask`` has that of the drawn material alone.
    """
    return bsdf.class_name() not in _OF_PARTS and all(map(tells_density, children_of(bsdf, mi.BSDF)))


class Materials:
    """The materials ``bsdfs``, some or all of those of a scene's surfaces."""

    def __init__(self, bsdfs: list[mi.BSDF]):
        # A switch needs a case, even if no lane reaches it
        self.bsdfs = bsdfs or [mi.load_dict({"type": "null"})]
        indices = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in self.bsdfs]
        self._numbers = RegistryTable(indices, range(1, len(indices) + 1))

    def __contains__(self, bsdf: mi.BSDF) -> bool:
        """Whether ``bsdf`` is one of the materials."""
        return any(bsdf is one for one in self.bsdfs)

    @classmethod
    def of(cls, shapes: SceneShapes) -> Materials:
        """The materials of all surfaces of a scene."""
        found = [shape.bsdf() for _, shape in shapes.of_hits]
        return cls(list({id(bsdf): bsdf for bsdf in found}.values()))

    @cached_property
    def flags(self) -> frozenset[int]:
        """Flags of the materials, each once."""
        return frozenset(int(bsdf.flags()) for bsdf in self.bsdfs)

    def where(self, test: Callable[[mi.BSDF], bool]) -> Materials:
        """The materials that pass a test."""
        return Materials([bsdf for bsdf in self.bsdfs if test(bsdf)])

    def having(self, flag: mi.BSDFFlags) -> Materials:
        """The materials with a kind of lobe."""
        return self.where(lambda bsdf: mi.has_flag(bsdf.flags(), flag))

    def hold(self, pointers: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether each pointer points to one of the materials."""
        return self._numbers.at(pointers, active) > 0

    def call(self, pointers: mi.BSDFPtr, function: Callable, *arguments, active: mi.Bool):
        """``function(bsdf, *arguments, active)`` for the material behind each pointer, with arrays as arguments; 0 for
        pointers to no material of this object and in lanes that are not ``active``."""
        number = self._numbers.at(pointers, active)
        cases = [partial(function, bsdf) for bsdf in self.bsdfs]
        return dr.switch(number - 1, cases, *arguments, active & (number > 0))

    def sample(self, pointers: mi.BSDFPtr, si: mi.SurfaceInteraction3f, lobe, direction, active: mi.Bool):
        """(Sample, weight) of the material behind each pointer, by a number and a pair of numbers; 0 as in
        :meth:`call`."""
        return self.call(pointers, _sampled, si, lobe, direction, active=active)


def _sampled(bsdf, si, lobe, direction, active):
    return bsdf.sample(mi.BSDFContext(), si, lobe, direction, active)
