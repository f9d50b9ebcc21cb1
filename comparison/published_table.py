"""Description of a table of a paper: its methods with their published figures, its columns, which runs fill it."""

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Method:
    """A method of a paper: what it is called there, our integrator, with which parameters that one is this method, and
    the paper's figures, a dict from names of `quantities.QUANTITIES` to numbers, one a scene."""

    name: str
    integrator: str
    figures: dict
    parameters: dict = field(default_factory=dict)

    def made(self, run):
        """Return whether a run is of this method."""
        return run["integrator"] == self.integrator and self.parameters.items() <= run["parameters"].items()


@dataclass(frozen=True)
class Ratio:
    """A column that compares a quantity with that of the table's first method: how many times less it is than that, or,
    not `less`, how many times as much."""

    head: str
    quantity: str
    less: bool = True


@dataclass(frozen=True)
class Table:
    """A table: its paper and name, such as "IC" and "Table 1", and its title; its methods, of which the first is what
    others are compared with; the integrators without which it makes no sense; its columns, quantities and then ratios
    (by name); how ours departs from the paper's, in sentences; and

    `takes`        which runs it is about, a function of a run's result
    `equal`        what methods have in common, where runs make curves to read it off: "error", "rays", or None
    `metric`       the error that is then equal, or that is read off
    `curves_only`  whether there is no such table without curves
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
        """Return the method that a run is of, None if it is no part of this table; of several, the one that more
        parameters say."""
        made = [method for method in self.methods if method.made(run)] if self.takes(run) else []
        return max(made, key=lambda method: len(method.parameters), default=None)
