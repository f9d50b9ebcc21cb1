"""Result files: the numbers of one part of a benchmark, from which docs/tables.py fills the tables of the documents."""

from __future__ import annotations

import json
import math
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from comparison import machine
from comparison.images import replacing

ROOT = Path(__file__).resolve().parents[1]
DIGITS = 6
CHANGED_SOURCES = ("status", "--porcelain", "-uno", "--", ".", ":!docs", ":!*.md")
# Quantities that a row may hold, with their units
UNITS = {
    "absolute": "mean absolute error of pixels, fraction of the mean of the image",
    "bias": "excess of the mean over that of `path` or of the reference, fraction",
    "bias_deviation": "standard error of the bias, fraction",
    "bounds": "upper bounds computed per pixel",
    "columns": "columns of the light matrix per slice",
    "cost": "sum of cluster sizes, relative to the root of the tree",
    "cost_ratio": "CPU seconds over those of `path`",
    "cpu_seconds": "s of processor time, all threads",
    "cut": "clusters or pairs per pixel",
    "depth": "levels of the tree",
    "edges": "mean number of edges of a path",
    "error": "property `error`",
    "fall": "factor by which the error falls where samples double",
    "fewer_rays": "shadow rays of the other method over those of this one, at equal error",
    "gathered_seconds": "s for clusters and cuts",
    "hidden": "whether the noise of the reference exceeds the error",
    "independent_speedup": "as speedup, over path with the sampler independent",
    "light_paths": "light paths of a render",
    "light_share": "fraction of the mean of the image",
    "lights": "number of lights",
    "load_seconds": "s",
    "loss": "mean squared error of an image, over its squared target plus a hundredth of the squared mean",
    "memory": "GiB at the peak, above the loaded scene where `path` has none",
    "new_scene_seconds": "s of the first render with the compiled kernels of another scene",
    "not_reached": "whether the error of the other method was not reached, so that ratios are bounds",
    "plain_speedup": "as speedup, by the variances of all pixels",
    "product": "relative variance times s",
    "product_ratio": "product over that with the chosen value",
    "rate": "shadow rays over matrix entries",
    "rays": "shadow rays per pixel",
    "rays_per_second": "million shadow rays per s",
    "relative_l1": "mean absolute error of gather points, fraction of the mean of the image",
    "relmse": "relative mean squared error, without the largest 0.1%",
    "rmse": "root mean square error, fraction of the mean of the image",
    "samples": "samples per pixel",
    "second_seconds": "s of the second render of a process",
    "seconds": "s",
    "set_deviation": "standard deviation of the mean between sets of lights, fraction",
    "shared_seconds": "s for lights, trees and gather points",
    "slowdown": "seconds over those with one sample per pixel",
    "speedup": "time of the other method over that of this one, at equal error",
    "start_seconds": "s for pilot, lights and trees",
    "steps": "steps of an optimiser",
    "traced_seconds": "s for the traced part",
    "tree_seconds": "s",
    "variance": "relative variance of a pixel",
    "variance_share": "fraction of the sum over classes",
}


def add_options(parser, parts, usual=None) -> None:
    """Add the options ``--parts``, some of ``parts`` and by default the ``usual`` ones or all, and ``--json FILE``."""
    parser.add_argument("--parts", nargs="+", default=list(usual or parts), choices=list(parts))
    add_json_option(parser)


def add_json_option(parser) -> None:
    """Add the option ``--json FILE`` to an argument parser."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows of the one part to a result file")


def parse(parser, arguments=None):
    """Parse the command line; end the program with a message, before hours of work, if a result file would have several
    parts or could not be written."""
    options = parser.parse_args(arguments)
    if options.json:
        parts, folder = getattr(options, "parts", [""]), options.json.absolute().parent
        if len(parts) != 1:
            parser.error(f"--json takes one part, --parts names {len(parts)}: {' '.join(parts)}")
        if not folder.is_dir():
            parser.error(f"--json {options.json}: no folder '{folder}'")
        try:
            commit()
        except (OSError, subprocess.CalledProcessError) as error:
            parser.error(f"--json needs the commit of the sources, which git does not tell: {error}")
    return options


def run_parts(options, parts: dict, settings: dict) -> None:
    """Run the functions of ``parts`` that ``options`` name, and write the result file with the ``settings``.

    A function yields its rows so far from time to time, usually after each scene.  They are in ``FILE.partial`` until
    all are there, so that an interrupted run loses nothing and replaces no complete file.
    """
    for part in options.parts:
        write_rows(options.json, part, settings, parts[part]())


def write_rows(path: Path | None, part: str, settings: dict, growing: Iterable[dict]) -> None:
    """Take the ``growing`` rows of a part, see :func:`run_parts`; write them to the result file ``path``, if any."""
    if path is None:
        for _ in growing:
            pass
        return
    partial, made_by = path.with_name(path.name + ".partial"), origin()
    # Of an interrupted run, which would become the result of a run without rows
    partial.unlink(missing_ok=True)
    for rows in growing:
        write_results(partial, part, settings, rows, made_by)
    if partial.exists():
        partial.replace(path)


def origin() -> dict:
    """Command, commit, date and machine of this run."""
    date = datetime.now(UTC).date().isoformat()
    return {"command": command(), "commit": commit(), "date": date, "machine": described_machine()}


def write_results(path, part: str, settings: dict, rows: dict, made_by: dict | None = None) -> None:
    """Write the result file of one part.

    ``rows``: {row: {quantity: number}}, or {row: {method: {quantity: number}}}, where a row is a scene, and the
    quantities are keys of ``UNITS``; ``made_by``: :func:`origin`, by default of now. The file replaces an older one at
    once. Raises ValueError for an unknown quantity or a number that is not finite.
    """
    quantities: set = set()
    rows = {str(name): _checked(row, str(name), quantities) for name, row in rows.items()}
    units = {name: UNITS[name] for name in sorted(quantities)}
    content = {"part": part} | (made_by or origin()) | {"settings": settings, "units": units, "rows": rows}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _checked(row: dict, place: str, quantities: set) -> dict:
    """Round the numbers of a row to ``DIGITS`` digits, and collect its quantities."""
    found = {}
    for name, value in row.items():
        if isinstance(value, dict):
            found[name] = _checked(value, f"{place}: {name}", quantities)
            continue
        if name not in UNITS:
            raise ValueError(f"{place} has the unknown quantity {name!r}; allowed are {', '.join(UNITS)}")
        if not math.isfinite(value):
            raise ValueError(f"{place}: {name} is {value}; allowed are finite numbers")
        quantities.add(name)
        found[name] = value if isinstance(value, int) else float(f"{value:.{DIGITS}g}")
    return found


def command() -> str:
    """The command line of this process, without ``--json FILE``."""
    program, *arguments = sys.argv
    if "--json" in arguments:
        place = arguments.index("--json")
        del arguments[place : place + 2]
    return shlex.join(["./run", "--", "python", os.path.relpath(program, ROOT), *arguments])


def commit() -> str:
    """Short hash of the commit of this project, with ``+changes`` if tracked files other than documents differ."""

    def git(*arguments):
        return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+changes" if git(*CHANGED_SOURCES) else "")


def described_machine() -> dict:
    """Processor, number of cores, and vector width in 32-bit numbers."""
    found = machine.describe()
    return {"processor": found["processor"], "cores": found["cores"], "vector_width": vector_width()}


def vector_width() -> int | None:
    """32-bit numbers in the widest vector register, for which Dr.Jit compiles; None without /proc/cpuinfo."""
    try:
        flags = set(Path("/proc/cpuinfo").read_text().split())
    except OSError:
        return None
    return 16 if "avx512vl" in flags else 8 if "avx" in flags else 4
