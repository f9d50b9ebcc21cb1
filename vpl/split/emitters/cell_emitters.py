"""Shared part of the emitter samplers that learn probabilities by spatial cell."""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from ...lights.emitter_groups import EmitterGroups
from ...points.camera_paths import SceneTraits
from .cell_choice import CellChoice
from .glass import Glass
from .irradiance import irradiance_from_emitters

# Surfaces that light passes on its way from an emitter, at most, while emitters are learned: a bound of the time. The
# veils of the scene veils are 16
_MOST = 32


class CellEmitters:
    """Shared part of the samplers with a :class:`CellChoice`; ``_scene``, ``choice``, ``groups``, ``traits``,
    ``glass``: set by the subclass."""

    learns_sky, refracts = False, False

    choice: CellChoice
    groups: EmitterGroups | None
    traits: SceneTraits
    glass: Glass | None

    def cell(self, position, facing):
        """See :meth:`vpl.split.emitters.base.EmitterSampler.cell`."""
        return self.choice.cell(position, facing)

    def _group_met(self, si) -> mi.UInt32:
        """Group of the emitter at the end of a ray, 0 without groups."""
        return self.groups.met(si) if self.groups else mi.UInt32(0)

    def learn(self, position: np.ndarray, normal: np.ndarray, rays: int, seed: int) -> bool:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.learn`."""

        def look(places, cell, seed: int):
            return irradiance_from_emitters(self._scene, self, places, cell, 1, dr.opaque(mi.UInt32, _MOST), seed)

        return self.choice.learn(position, normal, rays, seed, look)

    def forget(self) -> None:
        """See :meth:`vpl.split.emitters.base.EmitterSampler.forget`."""
        self.choice.forget()

    def simplest(self):
        """See :meth:`vpl.split.emitters.base.EmitterSampler.simplest`."""
        return self

    def copy(self):
        """See :meth:`vpl.split.emitters.base.EmitterSampler.copy`."""
        other = copy(self)
        other.choice = copy(self.choice)
        return other

    def through_glass(self):
        """See :meth:`vpl.split.emitters.base.EmitterSampler.through_glass`."""
        other = self.copy()
        other.forget()
        other.glass.make_scenes()
        other.refracts = True
        return other
