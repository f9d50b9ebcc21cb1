"""Emitter samplers: the choice of an emitter for next-event estimation, and the density.

- ``base``: interface of the samplers, and their results
- ``glass``: shadow rays through smooth glass
- ``uniform``: Mitsuba's own choice
- ``cell_choice``: learned probabilities of sources by spatial cell
- ``arriving_power``: light of each source that arrives in each cell, from which they are learned
- ``cell_emitters``: shared part of the samplers that learn by cell
- ``learned``: emitters and regions of the environment, chosen by visibility from a pilot's vertices
- ``emitter_tree``: tree over emitters, walked to draw one or to find the probability of one
- ``tree_emitters``: many emitters, chosen through this tree
- ``irradiance``: irradiance that a sampler finds at places on surfaces
"""

from __future__ import annotations

from ...lights.emitter_groups import EmitterGroups
from ...lights.emitters import read_emitters
from .base import EmitterSampler
from .learned import LearnedEmitters
from .tree_emitters import TreeEmitters
from .uniform import UniformEmitters

# With fewer emitters, occlusion matters more than distance, and the tree gains nothing over learned probabilities
_FEWEST_IN_TREE = 64


def emitter_sampler(scene, rays: int, groups: EmitterGroups | None = None) -> EmitterSampler:
    """The sampler that suits a scene, with about ``rays`` rays to learn by; ``groups`` of its emitters, or None.

    :class:`TreeEmitters` for 64 emitters or more, if arrays can hold every emitter; :class:`UniformEmitters` for a
    single emitter with a position; :class:`LearnedEmitters` otherwise.
    """
    count = len(scene.emitters())
    if count > 1 or scene.environment() is not None:
        tree = _tree(scene, rays, groups) if count >= _FEWEST_IN_TREE else None
        return tree or LearnedEmitters(scene, groups)
    return UniformEmitters(scene, groups)


def _tree(scene, rays: int, groups: EmitterGroups | None) -> TreeEmitters | None:
    """The tree over the emitters; None if a tree cannot hold the emitters."""
    try:
        emitters = read_emitters(scene, groups.number) if groups else read_emitters(scene)
    except ValueError:
        # Only Mitsuba can sample a point on one of the emitters
        return None
    if emitters.others or emitters.area.textured or emitters.dropped or not TreeEmitters.located(emitters):
        return None
    return TreeEmitters(scene, emitters, rays, groups)
