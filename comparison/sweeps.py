"""Settings: an integrator with its parameters and its effort. What `--sweep` varies, and the order of the runs.

A setting is rendered once with every seed. Runs take turns, so that a change of the machine's load meets all alike:
seed by seed, and for each seed the first setting of every integrator, then the second of every one, and so on.
"""

import re
from argparse import ArgumentTypeError
from dataclasses import dataclass, field
from itertools import product, zip_longest

from . import command_line
from .command_line import UsageError

EFFORTS = {"spp": command_line.positive(int), "time": command_line.positive(float)}  # how long, not how
DEFAULT_SPP = 4  # of a sweep over anything but an effort
# What an integrator is swept over unless it is said: the parameter that trades error for time...
DEFAULTS = {
    "vpl": ("vpl_count", (250, 1000, 4000, 16_000)),
    "lightcuts": ("error", (0.08, 0.04, 0.02, 0.01)),
    "mdlightcuts": ("error", (0.08, 0.04, 0.02, 0.01)),
    "illuminationcut": ("error", (0.08, 0.04, 0.02, 0.01)),
    "lightslice": ("columns", (50, 100, 200, 400)),
    "matrixrecovery": ("alpha", (0.008, 0.004, 0.002, 0.001)),
    "adaptivedirect": ("error", (0.12, 0.06, 0.03, 0.015)),
    "unoccludeddirect": ("error", (0.12, 0.06, 0.03, 0.015)),
}
# ... and, where nobody said anything, samples per pixel: every other value with each of these.
DEFAULT_SAMPLES = (1, 4, 16)
DEFAULT = ("spp", (4, 16, 64, 256))  # of all others: Mitsuba's own, and `manylights`, which chooses by itself


@dataclass
class Setting:
    """One point of a curve: the integrator `integrator`, named `label`, with `parameters`, for `spp` samples per pixel
    or `time` seconds (one of them is None). `swept` holds what the sweep gave it, effort included; {} without one."""

    label: str
    integrator: str
    parameters: dict
    spp: int | None
    time: float | None
    swept: dict = field(default_factory=dict)

    @property
    def name(self):
        """Text that tells it from others of its label, such as "error=0.02"; empty if it is the only one."""
        return ",".join(f"{key}={text(value)}" for key, value in self.swept.items())

    @property
    def title(self):
        return f"{self.label} {self.name}".strip()

    @property
    def file_name(self):
        """A part of the names of files that is its own, as long as `check_file_names` has nothing against it."""
        return re.sub(r"[^\w.,=+-]", "_", ".".join(filter(None, (self.label, self.name))))


def text(value):
    """Write a value as it was typed: a short number, `true`, or the text."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.10g}" if isinstance(value, int | float) else str(value)


def sweep(content):
    """Split `LABEL:KEY=VALUE,VALUE,...` into label, key and values, or `LABEL` or `all` into that, None and (); an
    argparse type. Raises ArgumentTypeError through it."""
    label, separator, definition = content.partition(":")
    if not separator and re.fullmatch(r"[\w-]+", content):
        return content, None, ()
    key, _, listed = definition.partition("=")
    values = [word.strip() for word in listed.split(",")]
    if not label or not key or not all(values):
        raise ArgumentTypeError(
            f"'{content}' is not of the form LABEL:KEY=VALUE,VALUE,... such as lightcuts:error=0.04,0.02 (before a "
            "scene's name, write --sweep all)"
        )
    values = [_value(key, word) for word in values]
    if len(set(values)) < len(values):
        raise ArgumentTypeError(f"'{content}' has a value twice")
    return label, key, tuple(values)


def _value(key, word):
    if key not in EFFORTS:
        return command_line.value(word)
    try:
        return EFFORTS[key](word)
    except ArgumentTypeError as error:
        raise ArgumentTypeError(f"{key}: {error}") from None


def default_grid(name, samples):
    """Return what an integrator is swept over unless it is said, a dict from parameter to values; with `samples` also
    over samples per pixel."""
    key, values = DEFAULTS.get(name, DEFAULT)
    return {key: values[1::2], "spp": DEFAULT_SAMPLES} if samples and key not in EFFORTS else {key: values}


def settings(integrators, sweeps, spp, time, samples=True):
    """Return all settings, a dict from label to a list.

    `integrators` maps labels to names and parameters; `sweeps` are what `sweep` returned for each option; `spp` and
    `time` are the efforts of what is not swept over one. Several parameters of one label make a grid. Once there is any
    sweep, labels without one have the default of their integrator; where that is all that is swept, `samples` is true,
    and there is neither `spp` nor `time`, it is also over samples per pixel. Raises UsageError for labels that do not
    exist and parameters that are given twice.
    """
    samples = samples and not spp and not time and all(key is None for _, key, _ in sweeps)
    grids = {label: {} for label in integrators}
    for label, key, values in sweeps:
        if label not in grids and not (label == "all" and key is None):
            raise UsageError(f"--sweep {label}: no such label; there are {', '.join(integrators)}")
        if key is not None and key in grids[label]:
            raise UsageError(f"--sweep {label}:{key}: given twice; write all values in one list")
        if key is not None:
            grids[label][key] = values
    found = {}
    for label, (name, parameters) in integrators.items():
        grid = grids[label]
        if sweeps and not grid:
            grid = default_grid(name, samples)
        _check_grid(label, grid, parameters)
        found[label] = [
            _setting(label, name, parameters, spp, time, dict(zip(grid, values, strict=True)))
            for values in product(*grid.values())
        ]
    check_file_names([setting for of in found.values() for setting in of])
    return found


def _check_grid(label, grid, parameters):
    if all(key in grid for key in EFFORTS):
        raise UsageError(f"--sweep {label}: over spp or time, not both")
    for key in grid:
        if key in parameters:
            raise UsageError(f"--param {label}.{key} fixes what --sweep {label}:{key} varies")


def _setting(label, name, parameters, spp, time, swept):
    own = {key: value for key, value in swept.items() if key not in EFFORTS}
    if any(key in swept for key in EFFORTS):
        spp, time = swept.get("spp"), swept.get("time")
    elif not spp and not time:
        spp = DEFAULT_SPP
    return Setting(label, name, parameters | own, spp, time, swept)


def check_file_names(found):
    """Raise UsageError if files of two settings would have the same name (in any case of letters)."""
    names = {}
    for setting in found:
        other = names.setdefault(setting.file_name.lower(), setting)
        if other is not setting:
            raise UsageError(f"'{other.title}' and '{setting.title}' would have files of the same name")


def order(found, seeds):
    """Return all runs, a list of (setting, seed), in the order in which they are made. Each seed begins with another
    label, so that none always follows the same one."""
    runs = []
    for turn, seed in enumerate(seeds):
        columns = list(found.values())
        start = turn % len(columns)
        for row in zip_longest(*columns[start:], *columns[:start]):
            runs += [(setting, seed) for setting in row if setting is not None]
    return runs
