"""Named groups of the emitters of a scene, for images of the light of each group.

People call them light groups.  Here a *light group* holds virtual lights of one kind
(:class:`vpl.lights.light_set.LightGroup`), and an *emitter group* holds emitters.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

import drjit as dr
import mitsuba as mi

from ..core.registry import RegistryTable

# Name of the last group: emitters without another group
OTHER = "other"


class EmitterGroups:
    """Groups of the emitters of a scene, numbered from 0 in the order of their ``names``; the last is :data:`OTHER`.

    ``patterns``: of the emitters in each group, by name of the group, where ``*`` and ``?`` stand for any characters.
    An emitter belongs to the first group of which a pattern is equal to the id of the emitter, the id of its shape, or
    its class, such as ``SunskyEmitter``.  Raises ValueError for a pattern without an emitter.
    """

    def __init__(self, scene, patterns: dict[str, tuple[str, ...]]):
        self.names, self._patterns = (*patterns, OTHER), patterns
        self._require_emitters(scene.emitters())
        shapes = [shape for shape in scene.shapes() if shape.is_emitter()]
        index = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        self._of_shape = RegistryTable(index, [self.number(shape.emitter()) for shape in shapes])
        environment = scene.environment()
        self._of_environment = dr.opaque(mi.UInt32, 0 if environment is None else self.number(environment))

    def number(self, emitter) -> int:
        """Number of the group of an emitter."""
        for number, patterns in enumerate(self._patterns.values()):
            if any(_matches(pattern, emitter) for pattern in patterns):
                return number
        return len(self._patterns)

    def met(self, si) -> mi.UInt32:
        """Number of the group of the emitter at the end of a ray, a shape's or the environment."""
        return dr.select(si.is_valid(), self._of_shape.at(si.shape), self._of_environment)

    def _require_emitters(self, emitters: list) -> None:
        """Raise ValueError for a pattern without an emitter."""
        for name, patterns in self._patterns.items():
            for pattern in patterns:
                if not any(_matches(pattern, emitter) for emitter in emitters):
                    known = sorted({f'"{word}"' for emitter in emitters for word in _words(emitter)})
                    raise ValueError(
                        f'light_groups: no emitter of the group "{name}" is called "{pattern}"; emitters are called '
                        f"{', '.join(known) or 'nothing: there are none'}"
                    )


def _words(emitter) -> list[str]:
    """Id of an emitter, id of its shape, and class, if they exist."""
    shape = emitter.get_shape()
    words = emitter.id(), shape.id() if shape is not None else "", emitter.class_name()
    return [word for word in words if word]


def _matches(pattern: str, emitter) -> bool:
    return any(fnmatchcase(word, pattern) for word in _words(emitter))
