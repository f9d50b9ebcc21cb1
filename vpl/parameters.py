"""Parameters of scene objects, for reading only.

``mitsuba.traverse`` does what an optimiser needs: it defines a class for every object and notes which values change.
Where a scene has a hundred thousand emitters, that takes ten times as long as looking at their values.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np


def parameters_of(node, below: bool = True) -> dict:
    """{name: value} of an object and, if wanted, of all objects below it, named as ``mitsuba.traverse`` does."""
    found = {}
    _reader()(node, "", found, below)
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

        def __init__(self, node, prefix: str, found: dict, below: bool):
            super().__init__()
            self.node, self.prefix, self.found, self.below = node, prefix, found, below
            node.traverse(self)

        def put(self, name, value, flags, cpptype=None):
            """Called by Mitsuba for every parameter."""
            if isinstance(value, mi.Object):
                if self.below:
                    Reader(value, f"{self.prefix}{name}.", self.found, True)
            else:
                self.found[self.prefix + name] = (
                    value if cpptype is None else mi.get_property(value, cpptype, self.node)
                )

    return Reader
