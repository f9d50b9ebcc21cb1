"""Cost of a sample of ``manylights`` over that of ``path``, with stages and mean numbers of edges.

One thread, warm, the sampler ``independent``; both integrators in turn.  CPU seconds, because they depend least on what
else the machine does.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import geometric_mean
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import scenes
from benchmarks.rivals import DEPTH, KINDS
from vpl.core.stages import Stage
from vpl.split import estimator

SAMPLES = (16, 64, 256)
# Groups of stages in the table
GROUPS = {
    "start_seconds": (Stage.SCENE, Stage.PILOT, Stage.LIGHTS, Stage.TREE),
    "traced_seconds": (Stage.RECORDED, Stage.TRACED),
    "gathered_seconds": (Stage.CLUSTERS, Stage.CUTS),
}


@contextmanager
def one_thread():
    """Within the block, Dr.Jit uses one thread.  Scenes must be loaded before: Mitsuba's readers need two."""
    number = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(number)


@contextmanager
def counted_edges(edges: list):
    """Within the block, the mean number of edges of the paths of every part of an image is appended to ``edges``."""
    trace = estimator.trace_camera_rays

    def counted(*arguments, **sums):
        traced = trace(*arguments, **sums)
        # A path that ends at its first hit has one edge
        edges.append(float(dr.mean(mi.Float(traced.edges))[0]) + 1)
        return traced

    with mock.patch.object(estimator, "trace_camera_rays", counted):
        yield


class Contestant:
    """One integrator with one number of samples per pixel: CPU ``seconds`` of its renders."""

    def __init__(self, scene, kind: str, spp: int):
        self.seconds: list[float] = []
        self._scene, self._spp, self.edges = scene, spp, []
        self.integrator = mi.load_dict({"type": kind, "max_depth": DEPTH})
        self._render(0)
        with counted_edges(self.edges):
            self._render(0)

    def _render(self, seed: int) -> float:
        def image():
            return mi.render(self._scene, integrator=self.integrator, spp=self._spp, seed=seed)

        return scenes.timed(image, time.process_time)[1]

    def measure(self, seed: int) -> None:
        """Render once more."""
        self.seconds.append(self._render(seed))

    @property
    def stages(self) -> dict[str, float]:
        """Seconds of the last render in each of GROUPS."""
        found = self.integrator.statistics["seconds"]
        return {name: sum(found.get(stage, 0.0) for stage in stages) for name, stages in GROUPS.items()}


def whole_edges(scene) -> float:
    """Mean number of edges of the paths of ``path``: those of ``manylights`` without lights and roulette."""
    edges: list[float] = []
    plugin = mi.load_dict({"type": "manylights", "max_depth": DEPTH, "virtual_lights": False})
    with counted_edges(edges), mock.patch.object(estimator, "with_roulette", lambda view, _: (view, {})):
        mi.render(scene, integrator=plugin, spp=4)
    return float(np.mean(edges))


def cost(names, width: int, passes: int) -> Iterator[dict]:
    """Print CPU seconds of ``manylights`` over those of ``path``, scene by scene and for each of SAMPLES."""
    print(f"cost, {width} wide, one thread, {passes} renders of each: CPU seconds; stages of manylights in seconds")
    print(f"{'scene':16s}{'samples':>8s}{'path':>8s}{'ours':>8s}{'ratio':>7s}", end="")
    print("".join(f"{name.partition('_')[0]:>10s}" for name in GROUPS) + f"{'edges':>14s}{'µs an edge':>16s}")
    rows = {}
    for name in names:
        scene = scenes.load(name, width)
        with one_thread():
            row = {f"{spp} samples": cost_of(name, scene, width, spp, passes) for spp in SAMPLES}
        rows[name] = row
        yield rows
    for spp in SAMPLES:
        ratios = [row[f"{spp} samples"]["cost_ratio"] for row in rows.values()]
        print(f"geometric mean at {spp} samples: {geometric_mean(ratios):.2f}, highest {max(ratios):.2f}")


def cost_of(name: str, scene, width: int, spp: int, passes: int) -> dict:
    """Print and return one row."""
    theirs, ours = (Contestant(scene, kind, spp) for kind in KINDS)
    for number in range(passes):
        for contestant in (theirs, ours):
            contestant.measure(100 + number)
    their_seconds, our_seconds = (float(np.median(one.seconds)) for one in (theirs, ours))
    edges, stages = (whole_edges(scene), float(np.mean(ours.edges))), ours.stages
    paths = width * scenes.height(name, width) * spp
    spent = their_seconds, stages["traced_seconds"]
    each = [1e6 * seconds / (paths * number) for seconds, number in zip(spent, edges, strict=True)]
    ratio = our_seconds / their_seconds
    print(f"{name:16s}{spp:8d}{their_seconds:8.2f}{our_seconds:8.2f}{ratio:7.2f}", end="")
    print("".join(f"{seconds:10.2f}" for seconds in stages.values()), end="")
    print(f"{edges[0]:7.2f}{edges[1]:7.2f}{each[0]:8.2f}{each[1]:8.2f}", flush=True)
    return {
        "path": {"seconds": their_seconds, "edges": edges[0]},
        "manylights": {"seconds": our_seconds, "edges": edges[1]} | stages,
        "cost_ratio": ratio,
    }
