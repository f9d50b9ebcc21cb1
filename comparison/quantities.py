"""Quantities in the tables of the papers, by name, as functions of the result of a run (see worker.run).

Shadow rays and upper bounds count all samples of a pixel; seconds count all passes of the image.
"""

from collections.abc import Callable
from dataclasses import dataclass

from vpl.core.stages import Stage

from . import analysis

# Preparation before a method starts: VPLs and light trees
LIGHT_STAGES = (Stage.TRACE, Stage.LIGHTS, Stage.TREE)
CHOOSING_STAGES = {
    "matrixrecovery": (Stage.SLICES, Stage.INITIAL_CUT, Stage.COLUMNS, Stage.PREDICTION),
    "lightslice": (Stage.SLICES, Stage.SHARED_COLUMNS, Stage.ROWS, Stage.COLUMNS),
}
SEPARATION_STAGES = (Stage.SHADING, Stage.SEPARATION, Stage.CORRECTION)


@dataclass(frozen=True)
class Quantity:
    """Column of a table: its head, a function from the result of a run to a number (None: unknown), and whether it is
    shown as a percentage."""

    head: str
    of: Callable
    percent: bool = False


def _error(name):
    return lambda run: run["errors"][name] if "errors" in run else None


def _per_pixel(name):
    return lambda run: None if run[name] is None else run[name] * run["spp"]


def _ratio(over, under):
    """Return a function that computes the ratio of two counters."""

    def of(run):
        above, below = (run["statistics"].get(name) for name in (over, under))
        return above / below if above is not None and below else None

    return of


def _stages(run, names):
    """Return the total seconds of some stages, None if the method has none of them."""
    spent = [seconds for name, seconds in run["statistics"].get("seconds", {}).items() if name in names]
    return sum(spent) if spent else None


def _render_seconds(run):
    return run["seconds"] - (_stages(run, LIGHT_STAGES) or 0)


def _light_count(run):
    lights = run["statistics"].get("lights")
    return None if lights is None else sum(lights.values())


def _per_pass(name):
    """Return a function that computes the mean of a counter over passes."""

    def of(run):
        count = run["statistics"].get(name)
        return None if count is None else count / run["passes"]

    return of


QUANTITIES = {
    "light_seconds": Quantity("lights [s]", lambda run: _stages(run, LIGHT_STAGES)),
    "seconds": Quantity("time [s]", lambda run: run["seconds"]),
    "render_seconds": Quantity("render [s]", _render_seconds),
    "choosing_seconds": Quantity("choosing [s]", lambda run: _stages(run, CHOOSING_STAGES.get(run["integrator"], ()))),
    "separation_seconds": Quantity("separation [s]", lambda run: _stages(run, SEPARATION_STAGES)),
    "rays": Quantity("rays per pixel", lambda run: analysis.cost_of(run, "rays")),
    "bounds": Quantity("bounds per pixel", _per_pixel("bounds_per_sample")),
    "columns": Quantity("columns or cut", lambda run: run["cut_size_per_sample"]),
    "sampling_rate": Quantity("sampling rate", _ratio("shadow_rays", "entries"), percent=True),
    "slices": Quantity("slices", _per_pass("slices")),
    "lights": Quantity("lights", _light_count),
    "points": Quantity("surface points", _per_pass("gather_points")),
    "memory": Quantity("peak memory [GB]", lambda run: run["peak_memory_bytes"] / 1e9),
    "passes": Quantity("passes per point", _ratio("passes", "gather_points")),
    "clusters": Quantity("clusters per point", _ratio("clusters", "gather_points")),
    "relative_l1": Quantity("rel. L1", _error("relative_l1"), percent=True),
    "rmse": Quantity("RMSE", _error("rmse")),
    "relmse_trimmed": Quantity("relMSE, trimmed", _error("relmse_trimmed")),
}
