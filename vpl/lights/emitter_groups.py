"""Named groups of the emitters of a scene, for images of the light of each group.

People call them light groups.  Here a *light group* holds virtual lights of one kind
(:class:`vpl.lights.light_set.LightGroup`), and an *emitter group* holds emitters.
"""

from __future__ import annotations

import difflib
from fnmatch import fnmatchcase

import drjit as dr
import mitsuba as mi

from ..core.registry import RegistryTable
from ..core.shapes import registered_shapes

# Name of the last group: emitters without another group
OTHER = "other"
# Most words in the error message of a pattern
_MOST_NAMED = 12


class EmitterGroups:
    """Groups of the emitters of a scene, numbered from 0 in the order of their ``names``; the last is :data:`OTHER`.

    ``patterns``: of the emitters in each group, by name of the group, where ``*`` and ``?`` stand for any characters.
    An emitter belongs to the first group of which a pattern is equal to the id of the emitter, the id of its shape, or
    its class, such as ``SunskyEmitter``.  Raises ValueError for a pattern without an emitter.
    """

    def __init__(self, scene, patterns: dict[str, tuple[str, ...]]):
        self.names, self._patterns = (*patterns, OTHER), patterns
        self._require_emitters(scene.emitters())
        emitting = [(index, shape.emitter()) for index, shape in registered_shapes(scene) if shape.is_emitter()]
        index, numbers = [index for index, _ in emitting], [self.number(emitter) for _, emitter in emitting]
        self._of_shape = RegistryTable(index, numbers)
        environment = scene.environment()
        self._of_environment = dr.opaque(mi.UInt32, 0 if environment is None else self.number(environment))

    def number(self, emitter) -> int:
        """Number of the group of an emitter."""
        words = _words(emitter)
        for number, patterns in enumerate(self._patterns.values()):
            if any(_matches(pattern, word) for pattern in patterns for word in words):
                return number
        return len(self._patterns)

    def met(self, si) -> mi.UInt32:
        """Number of the group of the emitter at the end of a ray, a shape's or the environment."""
        return dr.select(si.is_valid(), self._of_shape.at(si.shape), self._of_environment)

    def _require_emitters(self, emitters: list) -> None:
        """Raise ValueError for a pattern without an emitter."""
        words = sorted({word for emitter in emitters for word in _words(emitter)})
        for name, patterns in self._patterns.items():
            for pattern in patterns:
                if not any(_matches(pattern, word) for word in words):
                    known = _known(pattern, words)
                    raise ValueError(f'light_groups: no emitter of group "{name}" is called "{pattern}"; {known}')


def _words(emitter) -> list[str]:
    """Id of an emitter, id of its shape, and class, if they exist."""
    shape = emitter.get_shape()
    words = emitter.id(), shape.id() if shape is not None else "", emitter.class_name()
    return [word for word in words if word]


def _matches(pattern: str, word: str) -> bool:
    # Brackets are usual in ids, and no wildcards here
    return fnmatchcase(word, pattern.replace("[", "[[]"))


def _known(pattern: str, words: list[str]) -> str:
    """The words that an error message lists: those near the pattern, or the first."""
    if not words:
        return "the scene has no emitters"
    named = difflib.get_close_matches(pattern, words, _MOST_NAMED) or words[:_MOST_NAMED]
    more = f" and {len(words) - len(named)} more" if len(words) > len(named) else ""
    return "emitters are called " + ", ".join(f'"{word}"' for word in named) + more
