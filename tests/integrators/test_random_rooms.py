"""Random rooms with few to many emitters, glass, masks and instances: the mean of ``manylights`` is that of ``prb``.

Sharp lobes and suns are left out: `prb` finds their light so seldom that its error is unknown.
"""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import MATERIALS
from tests.support.marks import stress
from tests.support.rendering import plugin_with_model, render
from tests.support.scenes import closed_box, rgb, wall
from tests.support.statistics import CONFIRMATION, compare_means

SIZE, SEEDS = 24, 8
LEVEL = 1e-3  # of the p value of the confirmation: two in a thousand rooms fail by chance
OPAQUE = ("diffuse", "textured", "plastic", "roughplastic", "roughconductor", "bumpmap", "twosided")
SURFACES = (*OPAQUE, "mask", "thindielectric", "principled", "blendbsdf")
SHAPES = "rectangle", "cube", "disk", "sphere", "cylinder"
EMITTERS = "area", "area", "point", "spot", "directional", "constant"


class Room:
    """A room by a ``seed``: ``scene``, ``settings`` of the integrators, and whether virtual lights cost ``nothing``."""

    def __init__(self, seed):
        self._rng = np.random.default_rng(seed)
        self._hides = self._rng.random() < 0.2
        emitters = int(self._rng.choice([1, 2, 5, 70, 90]))
        # Behind glass, `prb` hardly finds few panels
        kinds = [["area"], ["panel"] if emitters > 5 else ["area"], EMITTERS][self._rng.integers(3)]
        parts = {"sky" if kind == "constant" else f"lamp{i}": self._emitter(kind, emitters, i)
                 for i, kind in enumerate(self._rng.choice(kinds, emitters))}  # fmt: skip
        scene = closed_box(parts, SIZE)
        for name in ("ceiling", "right", "front"):
            if self._rng.random() < 0.3:
                del scene[name]
        for name in {"floor", "ceiling", "left", "right", "back", "front"} & scene.keys():
            scene[name]["bsdf"] = self._material(OPAQUE)
        for i in range(self._rng.integers(1, 6)):
            scene |= self._object(f"object{i}")
        if self._rng.random() < 0.4:
            sheet = MATERIALS[self._rng.choice(["thindielectric", "mask"])]()
            scene["sheet"] = wall([0, self._rng.uniform(0.3, 0.68), 0], [1, 0, 0], -90, 1.0, bsdf=sheet)
        # Mitsuba's distance of an environment ignores rectangles
        for side in (-1, 1):
            place = mi.ScalarTransform4f().translate([50 * side, 60 * side, 70 * side])
            scene[f"far{side}"] = {"type": "cube", "to_world": place.scale(1e-3)}
        scene["sensor"]["sampler"]["type"] = str(self._rng.choice(["independent", "multijitter"]))
        self.scene = mi.load_dict(scene)
        depth = int(self._rng.choice([2, 3, 4, 6]))
        self.settings = {"max_depth": depth, "rr_depth": 5, "hide_emitters": self._hides}
        self.nothing = self._rng.random() < 0.5

    def _material(self, names=SURFACES):
        return MATERIALS[self._rng.choice(names)]()

    def _shape(self, size, names=SHAPES):
        axis = self._rng.normal(size=3)
        turned = mi.ScalarTransform4f().translate(self._rng.uniform(-0.8, 0.8, 3).tolist())
        turned = turned.rotate((axis / np.linalg.norm(axis)).tolist(), self._rng.uniform(0, 360))
        return {"type": str(self._rng.choice(names)), "to_world": turned.scale(size * self._rng.uniform(0.5, 1.5))}

    def _emitter(self, kind, number, index):
        """The emitter ``index`` of a ``number`` of emitters, smaller and brighter the more there are."""
        level, place = self._rng.uniform(0.5, 3), self._rng.uniform(-0.8, 0.8, 3)
        if kind == "area":
            radiance = rgb(level * number**0.3)
            return self._shape(0.2 / number**0.3) | {"emitter": {"type": "area", "radiance": radiance}}
        if kind == "panel":
            # Without overlap: shadow rays end a thousandth of their length before an emitter
            place = [-0.85 + 0.17 * (index % 10), 0.95, -0.85 + 0.17 * (index // 10)]
            panel = wall(place, [1, 0, 0], 90, self._rng.uniform(0.04, 0.08))
            return panel | {"emitter": {"type": "area", "radiance": rgb(level)}}
        if kind == "point":
            return {"type": "point", "position": place.tolist(), "intensity": rgb(level / number)}
        if kind == "spot":
            aim = mi.ScalarTransform4f().look_at(place.tolist(), [0.1, -0.5, 0], [0.1, 1, 0.1])
            return {"type": "spot", "to_world": aim, "intensity": rgb(3 * level / number), "cutoff_angle": 40.0}
        if kind == "directional":
            return {"type": "directional", "direction": [place[0], -1.0, place[2]], "irradiance": rgb(level / number)}
        return {"type": "constant", "radiance": rgb(level)}

    def _object(self, name):
        """A shape, or two instances of a group.  Behind hidden emitters, `prb` moves shapes that are no meshes."""
        names = ("rectangle", "cube") if self._hides else SHAPES
        shape = self._shape(self._rng.uniform(0.1, 0.5), names) | {"bsdf": self._material()}
        if self._rng.random() > 0.15:
            return {name: shape}
        group = {f"group {name}": {"type": "shapegroup", "shape": shape}}
        for i in range(2):
            place = mi.ScalarTransform4f().translate(self._rng.uniform(-0.4, 0.4, 3).tolist())
            of_group = {"type": "ref", "id": f"group {name}"}
            group[f"{name} {i}"] = {"type": "instance", "to_world": place.scale(0.8), "of": of_group}
        return group

    def pair(self, seed):
        """(Image by ``manylights``, image by ``prb``)."""
        with plugin_with_model(**({"pays_below": 1e30, "fewest_light_paths": 4000} if self.nothing else {})):
            found = render(self.scene, "manylights", 32, seed, **self.settings)
        return found, render(self.scene, "prb", 128, 1000 + seed, **self.settings)


@pytest.mark.parametrize("number", [0, 1, *stress(*range(2, 60))])
def test_random_rooms_have_the_mean_of_prb(number):
    room = Room(number)
    pairs = [room.pair(seed) for seed in range(SEEDS)]
    if not np.any(pairs):
        pytest.skip("no light arrives in this room")
    result = compare_means(pairs, 3)
    if result.p_value < 20 * LEVEL:
        more = range(SEEDS, (1 + CONFIRMATION) * SEEDS)
        result = compare_means([room.pair(seed) for seed in more], 3, LEVEL)
        assert result.p_value > LEVEL
