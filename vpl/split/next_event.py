"""Next-event estimation: how the emitter that a vertex is lit by is chosen, and with what density."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.arrays import finite_or_zero
from ..lights.emitters import read_emitters
from .emitter_samples import EmitterSample, MetEmitter
from .learned_emitters import LearnedEmitters
from .site_choice import NoChoice
from .tree_emitters import TreeEmitters

# With fewer emitters, what is hidden decides more than what is near, and Mitsuba's own choice is as good
_FEWEST_IN_TREE = 64


def emitters_of(scene, rays: int):
    """The choice of emitters that suits a scene, with about so many ``rays`` to learn by: :class:`TreeEmitters` where
    they are many, and all of kinds that arrays can hold, :class:`LearnedEmitters`, or :class:`UniformEmitters` where
    there is nothing to choose."""
    count = len(scene.emitters())
    if count > 1 or scene.environment() is not None:
        return (_in_tree(scene, rays) if count >= _FEWEST_IN_TREE else None) or LearnedEmitters(scene)
    return UniformEmitters(scene)


def _in_tree(scene, rays: int) -> TreeEmitters | None:
    """The emitters in a tree; None where it cannot hold them."""
    try:
        emitters = read_emitters(scene)
    except ValueError:
        # There is an emitter of which only Mitsuba knows how to draw a point
        return None
    if emitters.others or emitters.area.textured or emitters.dropped or not TreeEmitters.located(emitters):
        return None
    return TreeEmitters(scene, emitters, rays)


class UniformEmitters:
    """Mitsuba's own choice: every emitter with the same probability."""

    # No virtual lights stand for emitters
    lights = None

    def __init__(self, scene):
        self._scene, self.choice = scene, NoChoice()

    def sample(self, si, site, chosen, member, place, active) -> EmitterSample:
        """A direction to an emitter of each vertex ``si`` of a ``site``: ``chosen``, ``member``, ``place``: numbers
        that choose an emitter or part of one, a place in that part, and a place on the emitter."""
        ds, weight = self._scene.sample_emitter_direction(si, place, False, active)
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        ray = dr.select(far, si.spawn_ray(ds.d), si.spawn_ray_to(ds.p))
        return EmitterSample(ds.d, finite_or_zero(mi.unpolarized_spectrum(weight)), ds.pdf, ds.delta, ray)

    def met(self, vertex, site, ray, si, has_density, active) -> MetEmitter:
        """What a ray from ``vertex`` met at ``si``."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        density = self._scene.pdf_emitter_direction(origin, ds, active & has_density)
        emitted = si.emitter(self._scene, active).eval(si, active)
        return MetEmitter(finite_or_zero(mi.unpolarized_spectrum(emitted)) & active, density)
