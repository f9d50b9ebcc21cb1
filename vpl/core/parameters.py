"""Parameters of scene objects, for reading only.

``mitsuba.traverse`` does what an optimiser needs: it defines a class for every object and notes which values change.
Where a scene has a hundred thousand emitters, that takes ten times as long as looking at their values.
"""

from __future__ import annotations

import hashlib
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
    _read(node, "", found, {node} if below else None)
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


def fingerprint(nodes) -> str:
    """What tells objects from others, in whatever order they come: of each of them, and of all below it, what Mitsuba
    prints, and the values of all parameters."""
    known: dict = {}
    return hashlib.blake2b(b"".join(sorted(_digest(node, known) for node in nodes))).hexdigest()


def fingerprint_without_camera(scene) -> str:
    """What tells a scene from others, but for its sensors and its integrator."""
    objects = (value for _, value, _ in _members(scene) if isinstance(value, mi.Object))
    return fingerprint(one for one in objects if not isinstance(one, mi.Sensor | mi.Integrator))


def _digest(node, known: dict) -> bytes:
    if node in known:
        return known[node]
    # Met again on the way, it is one that this one belongs to
    known[node] = b""
    digest = hashlib.blake2b(f"{node.class_name()} {node}".encode())
    for name, value, cpptype in _members(node):
        digest.update(name.encode())
        if isinstance(value, mi.Object):
            digest.update(_digest(value, known))
            continue
        value = value if cpptype is None else mi.get_property(value, cpptype, node)
        digest.update(np.ascontiguousarray(value).tobytes() if dr.is_array_v(value) else str(value).encode())
    known[node] = digest.digest()
    return known[node]


def _read(node, prefix: str, found: Parameters, visited: set | None) -> None:
    """Add the parameters of a node to ``found``."""
    for name, value, cpptype in _members(node):
        if not isinstance(value, mi.Object):
            found.add(prefix + name, value, cpptype, node)
        elif visited is not None and value not in visited:
            visited.add(value)
            _read(value, f"{prefix}{name}.", found, visited)


def _members(node) -> list[tuple]:
    """(Name, value, its type in C++ where Python knows it by that alone) of all parameters of a node, and of all
    objects right below it."""
    reader = _reader()()
    node.traverse(reader)
    return reader.members


@cache
def _reader():
    # Mitsuba has no classes before a variant is set
    class Reader(mi.TraversalCallback):
        """Notes what a node says of itself."""

        def __init__(self):
            super().__init__()
            self.members = []

        def put(self, name, value, flags, cpptype=None):
            """Called by Mitsuba for every parameter."""
            self.members.append((name, value, cpptype))

    return Reader
