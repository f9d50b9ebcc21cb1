"""``matrixrecovery`` against ``mdlightcuts`` and ``lightslice``, and the effect of its steps.

    ./run -- python benchmarks/matrixrecovery.py [--scenes NAME ...] [--parts table steps pictures]

table     [MSR] Table 1: shadow rays, sampling rate, columns, time by stage and error. The further methods use the
          parameter of equal mean absolute pixel error, and the parameter of equal rays. break-even: additional cost of
          a shadow ray that would equalize the times.
cost      the same at equal error in scenes/veils.xml with an increasing number of veils, which make shadow rays
          expensive. Runs on request only, independent of --scenes.
steps     [MSR] figure 8: error and rays without single steps, and with separation of light as in the paper.
pictures  [MSR] figure 7: the matrices of a slice of each scene, as PNG files below --out (needs matplotlib).

``lightslice`` uses 256 slices and 2048 shared columns, or 512 and 8192, whichever takes fewer rays: half the rays of
its defaults, which suit larger images. Four samples per pixel, 256 wide, 200,000 VPLs, max_depth 6. Errors are pixel
errors relative to the image mean, including direct light, against the sum of all lights at all samples of a random
subset. Rates refer to all entries. Times are medians of three interleaved warm runs, after the shared work (lights,
light trees, gather points).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import geometric_mean
from unittest.mock import patch

import mitsuba as mi

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

from benchmarks import results, scenes  # noqa: E402
from benchmarks.baselines import QUALITY, VPLS, Found, Problem  # noqa: E402
from benchmarks.separated_light import light_of_entries  # noqa: E402
from comparison.command_line import positive  # noqa: E402
from comparison.images import replacing  # noqa: E402
from vpl.core.stages import Stage  # noqa: E402
from vpl.matrix import recovery  # noqa: E402

METHOD = "matrixrecovery"
# Property sets for images of this size; the set with the fewest rays at equal error is used
OTHERS: dict = {
    "mdlightcuts": [{}],
    "lightslice": [{"slices": 256, "shared_columns": 2048}, {"slices": 512, "shared_columns": 8192}],
}
SAMPLES = 4
# Points with exact sums for pictures, which show no errors
_FEW_POINTS = 400
NAMES = ("cornell", "kitchen", "sponza_crytek", "dining_room", "bistro_interior")
VEILS, VEILS_DEPTH = (0, 8, 16, 32), 80
STEPS = {
    "all": {},
    "no prediction": {"steps": "separation,correction,largest"},
    "no separation": {"steps": "nearest,linear,bayes,largest"},
    "no correction": {"steps": "nearest,linear,bayes,separation,largest"},
    "largest predicted": {"steps": "nearest,linear,bayes,separation,correction"},
    "no columns split": {"alpha": 1.0},
    "light separated": {},
    "nearest only": {"steps": "nearest,separation,correction,largest"},
    "linear only": {"steps": "linear,separation,correction,largest"},
    "bayes only": {"steps": "bayes,separation,correction,largest"},
}


def _rate(found: Found, pixels: int) -> float:
    """Shadow rays divided by matrix entries."""
    return found.rays * pixels / found.counts["entries"]


def table(names, options) -> Iterator[dict]:
    """Part "table"."""
    rows: dict = {}
    print(f"\n## equal error and equal rays ({SAMPLES} samples a pixel, width {options.width}, {VPLS} VPLs, warm)")
    print("scene | method | s | rays/px | rate | columns | mean absolute | RMSE | fewer rays | faster | break-even, ns")
    ratios: dict = {}
    for name in names:
        problem = Problem(name, SAMPLES, options.width, options.points)
        found = problem.interleaved(_equal_plugins(problem, ("error", "rays")))
        ours = found[METHOD]
        rows[name] = _equal_error_row(found, problem)
        for label, one in found.items():
            _show(name, label, one, ours, problem)
            if "equal error" in label:
                method = label.split(",")[0]
                pair = (one.rays / ours.rays, one.seconds / ours.seconds)
                ratios.setdefault(method, []).append(pair)
        yield rows
    for method, pairs in ratios.items():
        rays, seconds = (geometric_mean(values) for values in zip(*pairs, strict=True))
        print(f"geometric means over {method}: {rays:.2f} times fewer rays, {seconds:.2f} times faster")


def _equal_error_row(found: dict, problem: Problem) -> dict:
    """Row of a result file: our method, and the others at equal error."""
    ours, row = found[METHOD], {}
    for label, one in found.items():
        if label != METHOD and "equal error" not in label:
            continue
        numbers = {name: float(getattr(one, name)) for name in ("seconds", "rays", "absolute", "rmse")}
        if label == METHOD:
            numbers |= {"rate": _rate(one, problem.pixels), "columns": one.cut / SAMPLES}
        else:
            numbers |= {"fewer_rays": one.rays / ours.rays, "speedup": one.seconds / ours.seconds}
            numbers["not_reached"] = one.misses(ours.absolute)
        row[label.split(",")[0]] = numbers
    return row


def _equal_plugins(problem: Problem, measures) -> dict:
    """Return label -> plugin: our method, and further methods with the parameter of equal error or equal rays."""
    plugins = {METHOD: problem.plugin(METHOD)}
    ours = problem.shade(plugins[METHOD])
    for other in OTHERS:
        tried = [(more, *problem.quality_for(other, ours.absolute, **more)) for more in OTHERS[other]]
        more, at_error, _ = min(tried, key=lambda one: one[2].rays)
        for measure in measures:
            value = at_error if measure == "error" else problem.quality_for(other, ours.rays, measure, **more)[0]
            label = f"{other}, equal {measure}: {QUALITY[other].show(value)} {more or ''}"
            plugins[label] = problem.plugin(other, **{QUALITY[other].name: value}, **more)
    return plugins


def costs(_, options) -> Iterator[dict]:
    """Part "cost"."""
    rows: dict = {}
    print(f"\n## more and more expensive rays ({SAMPLES} samples a pixel, width {options.width}, {VPLS} VPLs, warm)")
    print("veils | method | s | rays/px | mean absolute | RMSE | ns a ray, all in all | fewer rays | faster")
    for veils in VEILS:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "veils.xml"
            command = ["scenes/veils.py", "--veils", str(veils), "--output", str(file)]
            subprocess.run([sys.executable, *command], cwd=scenes.PROJECT, check=True)
            size = {"resx": options.width, "resy": scenes.height("veils", options.width)}
            scene = mi.load_file(str(file), **size)
        problem = Problem("veils", SAMPLES, options.width, options.points, VEILS_DEPTH, scene)
        found = problem.interleaved(_equal_plugins(problem, ("error",)))
        ours = found[METHOD]
        rows[veils] = _equal_error_row(found, problem)
        for label, one in found.items():
            each = 1e9 * one.seconds / (one.rays * problem.pixels)
            print(
                f"{veils} | {label} | {one.seconds:.2f} | {one.rays:.1f} | {100 * one.absolute:.2f}% | "
                f"{one.rmse:.4f} | {each:.0f} | {one.rays / ours.rays:.1f} | {one.seconds / ours.seconds:.2f}",
                flush=True,
            )
        yield rows


def _show(name: str, label: str, one: Found, ours: Found, problem: Problem) -> None:
    """Print a row of the table."""
    rate, columns = "", f"{one.cut / SAMPLES:.0f}"
    if label == METHOD:
        rate = f"{100 * _rate(one, problem.pixels):.1f}%"
    saved, spent = one.rays - ours.rays, ours.seconds - one.seconds
    break_even = f"{1e9 * spent / (saved * problem.pixels):.0f}" if saved > 0 and spent > 0 else ""
    print(
        f"{name} | {label} | {one.seconds:.2f} | {one.rays:.1f} | {rate} | {columns} | {100 * one.absolute:.2f}% | "
        f"{one.rmse:.4f} | {one.rays / ours.rays:.1f} | {one.seconds / ours.seconds:.2f} | {break_even}",
        flush=True,
    )
    if label == METHOD:
        stages = ", ".join(f"{stage} {spent:.2f}" for stage, spent in one.stages.items())
        share = (one.stages[Stage.PREDICTION] + one.stages[Stage.SEPARATION]) / one.seconds
        print(f"  stages: {stages}; prediction and separation {100 * share:.0f}%; counted: {one.counts}", flush=True)


def steps(names, options) -> Iterator[dict]:
    """Part "steps"."""
    rows: dict = {label: {} for label in STEPS}
    print(f"\n## steps left out ({SAMPLES} samples a pixel, width {options.width}, {VPLS} VPLs)")
    print("scene | steps | rays/px | rate | mean absolute | RMSE")
    for name in names:
        problem = Problem(name, SAMPLES, options.width, options.points)
        for label, settings in STEPS.items():
            weight = light_of_entries if label == "light separated" else recovery.whole_entries
            with patch.object(recovery, "whole_entries", weight):
                found = problem.shade(problem.plugin(METHOD, **settings))
            rate = 100 * _rate(found, problem.pixels)
            rows[label][name] = {"absolute": float(found.absolute), "rays": found.rays, "rmse": float(found.rmse)}
            print(
                f"{name} | {label} | {found.rays:.1f} | {rate:.1f}% | {100 * found.absolute:.2f}% | {found.rmse:.4f}",
                flush=True,
            )
        yield rows


def pictures(names, options) -> Iterator[dict]:
    """Part "pictures", without rows."""
    from benchmarks.matrix_pictures import draw_slice

    options.out.mkdir(parents=True, exist_ok=True)
    for name in names:
        problem = Problem(name, SAMPLES, options.width, _FEW_POINTS)
        plugin = problem.plugin(METHOD)
        job = max(problem.prepared.jobs, key=lambda one: one.share)
        file = options.out / f"{name}_slice{options.slice}.png"
        with replacing(file) as temporary:
            draw_slice(plugin, job, options.slice, temporary, {"scene": name, "VPLs": VPLS, "seed": 0})
        print(file, flush=True)
    yield from ()


def main() -> None:
    """Parse the command line and run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(NAMES), choices=scenes.NAMES)
    parts = {"table": table, "cost": costs, "steps": steps, "pictures": pictures}
    usual = [part for part in parts if part != "cost"]
    results.add_options(parser, parts, usual)
    parser.add_argument("--width", type=positive(int), default=256, help="width in pixels (default: 256)")
    parser.add_argument(
        "--points", type=positive(int), default=8000, help="gather points with exact sums (default: 8000)"
    )
    parser.add_argument("--slice", type=int, default=20, help="number of the slice in part pictures (default: 20)")
    parser.add_argument(
        "--out", type=Path, default=Path("matrices"), help="output folder of part pictures (default: matrices)"
    )
    options = results.parse(parser)
    if options.json and options.parts == ["pictures"]:
        parser.error("--json: part pictures has no rows")
    names = scenes.available(options.scenes)
    settings = {"vpl_count": VPLS, "width": options.width, "samples": SAMPLES, "points": options.points}
    runs = {part: partial(function, names, options) for part, function in parts.items()}
    results.run_parts(options, runs, settings)


if __name__ == "__main__":
    main()
