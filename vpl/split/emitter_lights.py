"""Emitters with a place as virtual lights, for scenes of many: what a first vertex receives of them is split, too.

    f1 L = w F1 L + (f1 L - w F1 L)

Points and spots are lights as they are, with w = 1; area emitters are as many points on them as is asked for, with the
w of :mod:`vpl.split.floors`.  So a light cut stands for thousands of emitters, where next-event estimation would draw
one; it is left what gloss and w leave.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.sampling import derived_seed
from ..lights.emitters import Emitters
from ..lights.light_set import ScatteredGroup, area_lights
from ..lights.virtual_lights import VirtualLights


@dataclass
class EmitterLights:
    """Virtual lights that stand for emitters.

    ``omni``: points and spots, of kind "spot", none or some; ``carried`` (rows,) bool: area emitters that lights stand
    for, of ``emitters``.
    """

    emitters: Emitters
    omni: VirtualLights
    carried: np.ndarray

    def spacing(self, count: int) -> float:
        """Typical distance between ``count`` lights on area emitters, world units: as they are drawn by power, the mean
        over them of the area that each stands for is that of all over their number."""
        area = float(self.emitters.area.area[self.carried].sum(dtype=np.float64))
        return (area / count) ** 0.5 if count else 0.0

    def groups(self, count: int, seed: int) -> list[ScatteredGroup]:
        """The lights with their trees, ``count`` of them on area emitters."""
        lights = [self.omni]
        area = self.emitters.area
        # The others emit nothing here, so that none is drawn on them
        area = replace(area, radiance=np.where(self.carried[:, None], area.radiance, 0).astype(np.float32))
        if np.any(area.power > 0):
            on_areas = area_lights(replace(self.emitters, area=area), count, derived_seed(seed, 0))
            lights.append(replace(on_areas, kind="surface", facing=on_areas.direction).without_bad()[0])
        return [ScatteredGroup.of(x, derived_seed(seed, 1, k)) for k, x in enumerate(lights) if x.count]
