"""Parameters of scene objects, for reading only.

``mitsuba.traverse`` does what an optimiser needs: it defines a class for every object and notes which values change.
Where a scene has a hundred thousand emitters, that takes ten times as long as looking at their values.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np


class Parameters(Mapping):
    """Parameters by name, fetched when they are asked for."""

    def __init__(self):
        self._found: dict = {}

    def __contains__(self, name) -> bool:
        return name in self._found

    def __iter__(self):
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __getitem__(self, name: str):
        value, cpptype, node = self._found[name]
        return value if cpptype is None else mi.get_property(value, cpptype, node)

    def add(self, name: str, value, cpptype, node) -> None:
        """Take what Mitsuba says of a parameter."""
        self._found[name] = value, cpptype, node


def parameters_of(node, below: bool = True) -> Parameters:
    """Parameters of an object and, if wanted, of all objects below it, with the objects' own names before theirs."""
    found = Parameters()
    _reader()(node, "", found, {node} if below else None)
    return found


def matrix_of(transform) -> np.ndarray:
    """A transformation with one lane as a (4, 4) float64 matrix."""
    return np.array([[x[0] if dr.is_jit_v(x) else x for x in row] for row in transform.matrix], np.float64)


def numbers(value) -> list[float]:
    """The components of a number, or of a vector or colour with one lane."""
    if not dr.is_array_v(value):
        return [float(value)]
    if not dr.is_jit_v(value):
        return [float(component) for component in value]
    return [float(component[0]) for component in (value if dr.depth_v(value) > 1 else (value,))]


@cache
def _reader():
    # Mitsuba has no classes before a variant is set
    class Reader(mi.TraversalCallback):
        """Adds the parameters of a node to ``found`` when it is made."""

        def __init__(self, node, prefix: str, found: Parameters, visited: set | None):
            super().__init__()
            self.node, self.prefix, self.found, self.visited = node, prefix, found, visited
            node.traverse(self)

        def put(self, name, value, flags, cpptype=None):
            """Called by Mitsuba for every parameter."""
            if not isinstance(value, mi.Object):
                self.found.add(self.prefix + name, value, cpptype, self.node)
            elif self.visited is not None and value not in self.visited:
                self.visited.add(value)
                Reader(value, f"{self.prefix}{name}.", self.found, self.visited)

    return Reader
