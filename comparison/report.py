"""The table, `results.json` and `report.html` of a comparison.

`results.json` has the keys

command, created, seed, variant   the command line, the time (ISO 8601, UTC), what was asked for
versions, machine                 of the software (mitsuba, drjit, ...); processor, cores, memory in bytes, system
metrics                           epsilon and trimmed fraction of the relative errors (see metrics.py)
scenes                            a list, one entry a scene:
    scene, name, hash             file, short name, hash of scene file, parameters and all files that it refers to
    reference                     how it was made ("spp", "integrator", ...) and its "noise" (null if not known);
                                  absent where every render has a reference of its own ("vpl_output")
    renders                       a list, one entry an integrator: see worker.run for the measurements, and "errors",
                                  see metrics.compare (absent without a reference)
    aovs                          with --aovs: from channel to its "scale", the values at the ends of the logarithmic
                                  false colours, and "files", from label to PNG file
    error, traceback              instead, where the scene, or in a render where that integrator, failed
"""

import base64
import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path

import jinja2

from . import images, metrics
from .command_line import versions

COLUMNS = (
    "integrator", "time [s]", "cold [s]", "passes", "spp", "rel. L1", "RMSE", "relMSE", "trimmed", "bias",
    "rays", "bounds", "memory",
)  # fmt: skip
EXPLANATION = (
    "time: of the passes in the image; cold: the first pass, compilation included. rel. L1: sum |x - r| / sum r; "
    f"relMSE: mean (x - r)² / (r² + {metrics.EPSILON:g} mean(r)²); trimmed: the same without the worst "
    f"{metrics.TRIMMED:.1%} of the pixels; bias: of the mean. The reference's own noise is taken off squared errors; "
    "< marks errors below that noise, and gives the noise. rays, bounds: shadow rays and upper bounds computed, "
    "per pixel sample. memory: peak, MB."
)


def describe(command, options, scenes):
    """Return the content of `results.json` for the results (dicts) of some scenes."""
    return {
        "command": command,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": options.seed,
        "variant": options.mode,
        "versions": versions() | {"python": platform.python_version()},
        "machine": _machine(),
        "metrics": {"epsilon": metrics.EPSILON, "trimmed": metrics.TRIMMED},
        "scenes": scenes,
    }


def rows(scene):
    """Return the rows of a scene's table: lists of text, as many as `COLUMNS`, or (label, message) for a failure."""
    return [_row(render) for render in scene["renders"]]


def table(scene):
    """Return a scene's results as a table in plain text."""
    if "error" in scene:
        return f"{scene['name']}: FAILED: {scene['error']}"
    whole = [list(COLUMNS)] + [row for row in rows(scene) if len(row) > 2]
    widths = [max(map(len, column)) for column in zip(*whole, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in whole]
    lines += [f"{label}: FAILED: {message}" for label, message in filter(lambda row: len(row) == 2, rows(scene))]
    return "\n".join([f"{scene['name']}, reference: {reference_text(scene)}", *lines])


def reference_text(scene):
    """Say in a few words what a scene's images were compared with."""
    reference = scene.get("reference")
    if reference is None:
        return "vpl, with the same virtual lights"
    text = ", ".join(
        f"{reference[key]}{unit}" for key, unit in (("integrator", ""), ("spp", " spp")) if key in reference
    )
    if reference["noise"]:
        text += f" (noise: rel. L1 {reference['noise']['relative_l1']:.2%}, relMSE {reference['noise']['relmse']:.2g})"
    return text or "an image of unknown origin"


def write(folder, results, pictures):
    """Write `results.json` and `report.html` to a folder. `pictures` maps names of scenes to (title -> PNG file); they
    are embedded in the report."""
    folder = Path(folder)
    with images.replacing(folder / "results.json") as file:
        file.write_text(json.dumps(results, indent=1))
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    page = environment.get_template("report.html.jinja").render(
        results=results,
        columns=COLUMNS,
        explanation=EXPLANATION,
        rows=rows,
        reference_text=reference_text,
        embedded=_embedded,
        pictures={name: {title: _embedded(file) for title, file in of.items()} for name, of in pictures.items()},
        error_range=[f"{value:.0%}" for value in images.ERROR_RANGE],
        false_colours=", ".join(f"rgb{tuple(map(int, stop))}" for stop in images.FALSE_COLOURS),
    )
    with images.replacing(folder / "report.html") as file:
        file.write_text(page)


def _row(render):
    if "error" in render:
        return [render["label"], render["error"]]
    errors = render.get("errors")
    cells = [
        render["label"],
        f"{render['seconds']:.2f}",
        f"{render['cold_seconds']:.2f}",
        str(render["passes"]),
        str(render["spp"]),
        *(
            _error(errors, *column)
            for column in (("relative_l1", ".2%"), ("rmse", ".3g"), ("relmse", ".3g"), ("relmse_trimmed", ".3g"))
        ),
        f"{errors['bias']:+.2%}" if errors else "n/a",
        *("n/a" if render[key] is None else f"{render[key]:.0f}" for key in ("rays_per_sample", "bounds_per_sample")),
        f"{render['peak_memory_bytes'] / 1e6:.0f}",
    ]
    if errors and errors["bad_pixels"]:
        cells[0] += f" ({errors['bad_pixels']} pixels not finite)"
    return cells


def _error(errors, name, style):
    """Format an error, or "< noise" where it is below the reference's noise."""
    if not errors:
        return "n/a"
    if name in errors["below_noise"]:
        return f"< {errors['noise'][name]:{style}}"
    return f"{errors[name]:{style}}"


def _embedded(file):
    return "data:image/png;base64," + base64.b64encode(Path(file).read_bytes()).decode()


def _machine():
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # not Linux, or an architecture that has no names there
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": platform.platform(),
    }
