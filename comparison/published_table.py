"""Description of a paper's table: methods with their published figures, columns, selection of runs."""

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Method:
    """Method of a paper: its name there, the corresponding integrator and parameters, and the published `figures`: name
    in `quantities.QUANTITIES` -> numbers, one per scene."""

    name: str
    integrator: str
    figures: dict
    parameters: dict = field(default_factory=dict)

    def made(self, run):
        """Return whether a run used this method."""
        return run["integrator"] == self.integrator and self.parameters.items() <= run["parameters"].items()


@dataclass(frozen=True)
class Ratio:
    """Column with the ratio of a quantity between a row and the first method: first over row if `less`, else row over
    first."""

    head: str
    quantity: str
    less: bool = True


@dataclass(frozen=True)
class Table:
    """Table of a paper.

    `paper`, `name`  such as "IC" and "Table 1"
    `methods`        the first is the base of comparisons
    `needed`         integrators that must have runs
    `quantities`     columns, followed by the columns of `ratios` (by name)
    `departures`     differences from the paper's measurements, in sentences
    `takes`          predicate that selects runs by their results
    `equal`          the quantity held equal if runs form curves: "error", "rays", or None
    `metric`         the error held equal or interpolated
    `curves_only`    whether the table requires curves
    """

    paper: str
    name: str
    title: str
    methods: tuple
    needed: tuple
    quantities: tuple
    departures: str
    ratios: dict = field(default_factory=dict)
    takes: Callable = lambda run: True
    equal: str | None = None
    metric: str | None = None
    curves_only: bool = False

    def method_of(self, run):
        """Return the method of a run, None if the run does not belong to this table. Among several matches, the method
        with the most parameters wins."""
        made = [method for method in self.methods if method.made(run)] if self.takes(run) else []
        return max(made, key=lambda method: len(method.parameters), default=None)
