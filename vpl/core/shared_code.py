"""Kernel code shared by shapes that differ only in numbers."""

from __future__ import annotations

import drjit as dr

from .parameters import parameters_of

# Shape whose numbers Mitsuba 3.9.1 compiles into kernels as literals, which multiplies the code by the number of shapes
_HELD = "Rectangle"


def share_code(scene) -> None:
    """Make the transformations of rectangles opaque, so that kernels load them from memory.

    Values and images do not change; kernels compiled afterwards do. With 46 rectangles a kernel that samples points on
    them has 415 operations instead of 2156 and compiles in 0.05 s instead of 0.18 s.
    """
    places = [parameters_of(shape, below=False)["to_world"] for shape in scene.shapes() if shape.class_name() == _HELD]
    held = [to_world for to_world in places if to_world.matrix[0, 0].state == dr.VarState.Literal]
    dr.make_opaque(held)
