"""Parameters of scene objects, for reading only.

``mitsuba.traverse`` serves optimisers: it defines a class for every object and tracks changed values, which takes ten
times as long as reading the values in a scene of a hundred thousand emitters.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np


class Parameters(Mapping):
    """Parameters by name, fetched at access."""

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
        """Add a parameter as Mitsuba describes it."""
        self._found[name] = value, cpptype, node


def parameters_of(node, below: bool = True) -> Parameters:
    """Parameters of an object and, with ``below``, of all objects below, with the names of objects as prefixes."""
    found = Parameters()
    _read(node, "", found, {node} if below else None)
    return found


def children_of(node, kind: type) -> list:
    """Objects of a class directly below an object."""
    return [value for _, value, _ in _members(node) if isinstance(value, kind)]


def matrix_of(transform, columns: Sequence[int] = range(4), of_normals: bool = False) -> np.ndarray:
    """Matrix of a transformation of one lane, or some of its columns, (4, columns) float64; ``of_normals``: the matrix
    that Mitsuba transforms normals by."""
    # Reading a number takes a microsecond, which counts for thousands of emitters
    matrix = transform.inverse_transpose if of_normals else transform.matrix
    rows = ([row[column] for column in columns] for row in matrix)
    return np.array([[x[0] if dr.is_jit_v(x) else x for x in row] for row in rows], np.float64)


def numbers(value) -> list[float]:
    """Components of a number, or of a vector or colour of one lane."""
    if not dr.is_array_v(value):
        return [float(value)]
    if not dr.is_jit_v(value):
        return [float(component) for component in value]
    return [float(component[0]) for component in (value if dr.depth_v(value) > 1 else (value,))]


def fingerprint(nodes) -> str:
    """Hash (hexadecimal) of objects and all objects below, in any order: of the texts that Mitsuba prints, and of the
    values of all parameters."""
    known: dict = {}
    return hashlib.blake2b(b"".join(sorted(_digest(node, known) for node in nodes))).hexdigest()


def fingerprint_without_camera(scene) -> str:
    """Hash (hexadecimal) of a scene without the sensors and the integrator."""
    return fingerprint(one for one in children_of(scene, mi.Object) if not isinstance(one, mi.Sensor | mi.Integrator))


def _digest(node, known: dict) -> bytes:
    if node in known:
        return known[node]
    # A cycle leads back to an object above
    known[node] = b""
    digest = hashlib.blake2b(f"{node.class_name()} {node}".encode())
    for name, value, cpptype in _members(node):
        digest.update(name.encode())
        if isinstance(value, mi.Object):
            digest.update(_digest(value, known))
            continue
        value = value if cpptype is None else mi.get_property(value, cpptype, node)
        # Mitsuba prints six digits of a transformation
        value = getattr(value, "matrix", value)
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
    """List of (name, value, C++ type) of the parameters of a node and the objects directly below it.  The type is None
    unless Python needs it to read the value."""
    reader = _reader()()
    node.traverse(reader)
    return reader.members


@cache
def _reader():
    # Mitsuba has no classes until a variant is set
    class Reader(mi.TraversalCallback):
        """Collects the parameters that a node reports."""

        def __init__(self):
            super().__init__()
            self.members = []

        def put(self, name, value, flags, cpptype=None):
            """Add a parameter; called by Mitsuba."""
            self.members.append((name, value, cpptype))

    return Reader


def constant_rgb(parameters, name) -> list[float] | None:
    """RGB value of a spectrum parameter without spatial variation, else None."""
    value = parameters.get(f"{name}.value")
    if value is None:
        return None
    components = numbers(value)
    return components * 3 if len(components) == 1 else components[:3]
