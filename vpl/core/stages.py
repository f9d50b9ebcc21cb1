"""Names of the stages of a render, the keys of its timings.

A listener is called at the start of each stage, in the rendering thread.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from contextvars import ContextVar
from enum import StrEnum


class Stage(StrEnum):
    """Stage of a render; the value is the key in ``statistics["seconds"]``."""

    # ---- Every integrator
    COMPILE = "compile"  # Dr.Jit compiles kernels, during any stage; only in first passes, and never told to a listener
    SCENE = "scene"  # emitters and materials are read
    GATHER = "gather"  # camera rays are followed to gather points
    SOURCES = "sources"  # emitters become sources in clusters
    DIRECT = "direct"  # direct light of emitters

    # ---- Virtual lights
    TRACE = "trace"  # light paths leave virtual lights
    TREE = "tree"  # light trees are built
    PROBE = "probe"  # materials are probed
    PILOT = "pilot"  # the mean radiance is estimated
    EVALUATE = "evaluate"  # selected lights are shaded and traced

    # ---- Lightcuts and Multidimensional Lightcuts
    ESTIMATE = "estimate"  # radiance that error bounds refer to
    CUT = "cut"
    GATHER_TREE = "gather_tree"
    THRESHOLD = "threshold"
    PAIRS = "pairs"
    SUM = "sum"

    # ---- IlluminationCut
    POINT_TREE = "point_tree"
    PHASE_ONE = "phase_one"
    PHASE_TWO = "phase_two"
    VISIBILITY = "visibility"  # pairs are probed

    # ---- LightSlice and matrix recovery
    SLICES = "slices"
    SHARED_COLUMNS = "shared_columns"
    ROWS = "rows"  # of the light matrix, sampled
    COLUMNS = "columns"
    INITIAL_CUT = "initial_cut"
    PREDICTION = "prediction"
    SHADING = "shading"  # unoccluded light of all entries
    SEPARATION = "separation"
    CORRECTION = "correction"

    # ---- The split of `manylights`
    LIGHTS = "lights"  # surface lights find their irradiance
    RECORDED = "recorded"  # the kernel of paths is put together, for the first part of an image
    TRACED = "traced"  # the remainder that virtual lights do not carry
    CLUSTERS = "clusters"  # gather vertices of pixels are clustered
    CUTS = "cuts"  # their light cuts are chosen, shaded and traced


_LISTENER: ContextVar[Callable[[Stage], None] | None] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Callable[[Stage], None]):
    """Call ``listener`` with every stage that starts in this thread while the block runs. Its exceptions end the
    render."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def tell(stage: Stage) -> None:
    """Report the start of a stage to the listener."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage)
