"""Settings (an integrator with parameters and effort), sweeps of settings, order of runs.

Each setting runs once per seed. Runs are interleaved, so that changes of the machine's load affect all integrators
alike: seed by seed, and within a seed the first setting of each integrator, then the second of each, and so on.
"""

import re
from argparse import ArgumentTypeError
from dataclasses import dataclass, field
from itertools import product, zip_longest

from . import command_line
from .command_line import UsageError

EFFORTS = {"spp": command_line.positive(int), "time": command_line.positive(float)}  # amount of work per image
DEFAULT_SPP = 4  # for sweeps of parameters other than efforts
# Default sweeps: the parameter that trades error for time
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
# ... combined, in the default sweep of all integrators, with samples per pixel: every other value with each of these
DEFAULT_SAMPLES = (1, 4, 16)
DEFAULT = ("spp", (4, 16, 64, 256))  # integrators of Mitsuba, and `manylights`, which adapts itself


@dataclass
class Setting:
    """Point of a curve: `integrator`, named `label`, with `parameters`, for `spp` samples per pixel or `time` seconds
    (the other is None). `swept` holds the swept values, including effort."""

    label: str
    integrator: str
    parameters: dict
    spp: int | None
    time: float | None
    swept: dict = field(default_factory=dict)

    @property
    def name(self):
        """Text that identifies the setting within its label, such as "error=0.02"; may be empty."""
        return ",".join(f"{key}={text(value)}" for key, value in self.swept.items())

    @property
    def title(self):
        return f"{self.label} {self.name}".strip()

    @property
    def file_name(self):
        """Part of file names, unique after `check_file_names`."""
        return re.sub(r"[^\w.,=+-]", "_", ".".join(filter(None, (self.label, self.name))))


def text(value):
    """Format a value as on the command line: a short number, `true`, or text."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.10g}" if isinstance(value, int | float) else str(value)


def sweep(content):
    """Parse `LABEL:KEY=VALUE,VALUE,...` to (label, key, values), `LABEL` or `all` to (text, None, ()); an argparse
    type."""
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
    """Return the default sweep of an integrator, parameter -> values; with `samples` also over samples per pixel."""
    key, values = DEFAULTS.get(name, DEFAULT)
    return {key: values[1::2], "spp": DEFAULT_SAMPLES} if samples and key not in EFFORTS else {key: values}


def settings(integrators, sweeps, spp, time, samples=True):
    """Return all settings, label -> list.

    `integrators`: label -> name and parameters; `sweeps`: results of `sweep`; `spp`, `time`: effort of settings without
    a swept effort. Several parameters of a label form a grid. If there is a sweep, labels without one get the default
    of their integrator. A sweep of defaults alone, without `spp` and `time`, includes samples per pixel if `samples` is
    true. Raises UsageError for unknown labels and repeated parameters.
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
    check_file_names([setting for group in found.values() for setting in group])
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
    """Raise UsageError if files of two settings would have the same name (ignoring case)."""
    names = {}
    for setting in found:
        other = names.setdefault(setting.file_name.lower(), setting)
        if other is not setting:
            raise UsageError(f"'{other.title}' and '{setting.title}' would have files of the same name")


def order(found, seeds):
    """Return all runs (setting, seed) in execution order. The first label rotates with the seed, to vary which label
    precedes which."""
    runs = []
    for turn, seed in enumerate(seeds):
        columns = list(found.values())
        start = turn % len(columns)
        for row in zip_longest(*columns[start:], *columns[:start]):
            runs += [(setting, seed) for setting in row if setting is not None]
    return runs
