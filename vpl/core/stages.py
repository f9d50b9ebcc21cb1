"""Names of the stages of a render, by which its seconds are kept: what methods write and comparisons read.

Who wants to know which stage a render is in listens, and is told as each begins, in the thread that renders.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from contextvars import ContextVar
from enum import StrEnum


class Stage(StrEnum):
    """A stage of a render; its value is the key in ``statistics["seconds"]``."""

    # ---- Every integrator
    SCENE = "scene"  # emitters and materials are read
    GATHER = "gather"  # camera rays are followed to gather points
    SOURCES = "sources"  # emitters become sources in clusters
    DIRECT = "direct"  # direct light of emitters

    # ---- Virtual lights
    TRACE = "trace"  # light paths leave virtual lights
    TREE = "tree"  # light trees are built
    PROBE = "probe"  # materials are probed
    PILOT = "pilot"  # the mean radiance is estimated
    EVALUATE = "evaluate"  # what was chosen is shaded and traced

    # ---- Lightcuts and Multidimensional Lightcuts
    ESTIMATE = "estimate"  # the radiance that error bounds are compared with
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
    TRACED = "traced"  # what virtual lights do not carry
    CLUSTERS = "clusters"  # gather vertices of pixels are clustered
    CUTS = "cuts"  # their light cuts are chosen, shaded and traced


_LISTENER: ContextVar[Callable[[Stage], None] | None] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Callable[[Stage], None]):
    """While the block runs, ``listener`` is called with every stage that begins in this thread; what it raises ends the
    render."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def tell(stage: Stage) -> None:
    """Say that a stage begins."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage)
