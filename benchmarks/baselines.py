"""``mdlightcuts`` and ``lightslice`` against ``lightcuts`` on every sample, and against the sum of all lights.

    ./run -- python benchmarks/baselines.py [--scenes NAME ...] [--parts curve samples slices growth memory]

curve    errors against the sum of all lights for a range of quality parameters, with 1 and 9 samples per pixel.
samples  16 samples per pixel: ``lightcuts`` at 1% on every sample, and the further methods with the parameter of equal
         mean absolute pixel error, found by search. The closest one, marked as "not reached", if all have a larger
         error; the speed-up is then an upper bound.
slices   the same for ``lightslice`` with 1 sample per pixel at four times the width: an equal number of gather points.
growth   ``mdlightcuts`` at a fixed ``error`` with 1, 4, 16 and 64 samples per pixel.
memory   peak memory of ``lightslice`` at 1600×1200 with 600,000 VPLs and 800 columns, above that of the loaded scene.

Errors are pixel errors against the sum of all lights at all samples of a random subset of pixels. Methods share lights
and gather points; warm, 256 wide. Times are medians of three interleaved runs (curve: second runs) and start after the
shared work ("shared"): lights, light trees and gather points.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import geometric_mean

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from comparison.command_line import positive  # noqa: E402
from vpl.core.arrays import download, upload  # noqa: E402
from vpl.transport.evaluation import sum_all_lights  # noqa: E402

DEPTH, VPLS, RUNS = 6, 200_000, 3
# Maximum number of search steps for an error, and relative tolerance
_TRIES, _NEAR = 5, 0.03


@dataclass(frozen=True)
class Quality:
    """Quality parameter of a method with a first guess and limits; the error is roughly proportional to its
    ``power``-th power."""

    name: str
    guess: float
    least: float
    most: float
    power: float

    def show(self, value: float) -> str:
        """Format a value for tables."""
        return f"{self.name} {value:.2g}" if self.name == "error" else f"{self.name} {value}"

    def rounded(self, value: float):
        """Clip a value to the limits and convert it to the property's type."""
        value = min(max(value, self.least), self.most)
        return value if self.name == "error" else round(value)


QUALITY = {
    "lightcuts": Quality("error", 0.01, 1e-4, 0.5, 0.6),
    "mdlightcuts": Quality("error", 0.01, 1e-4, 0.5, 0.6),
    "lightslice": Quality("columns", 200, 8, 1600, -0.9),
}


@dataclass
class Found:
    """Result of a run: seconds of ``shade``; pixel RMSE and mean absolute error relative to the image mean; shadow rays
    and clusters or pairs per pixel; stages and counters of the method."""

    seconds: float
    rmse: float
    absolute: float
    rays: float
    cut: float
    stages: dict
    counts: dict

    def misses(self, wanted: float) -> bool:
        """Whether the mean absolute error is above a ``wanted`` one, which the search did not reach."""
        return bool(self.absolute > wanted * (1 + _NEAR))


class Problem:
    """Lights and gather points of a scene, and exact radiance of a subset of pixels with ``points`` samples in total.

    ``scene``: a loaded scene; by default the scene is loaded by its name.
    """

    def __init__(self, name: str, samples: int, width: int, points: int, max_depth: int = DEPTH, scene=None):
        self.settings = {"max_depth": max_depth, "vpl_count": VPLS}
        self.scene, self.samples = scene or scenes.load(name, width), samples
        self.pixels = width * scenes.height(name, width)
        rays = scenes.camera_rays(self.scene, 0, samples)
        plugin = self.plugin("lightcuts")
        self.prepared, self.shared = scenes.timed(lambda: plugin.prepare(self.scene, *rays))
        pixels = np.random.default_rng(0).permutation(self.pixels)[: points // samples]
        self._place = np.full(self.pixels, -1)
        self._place[pixels] = np.arange(len(pixels))
        self._chosen = [self._rows_of(job) for job in self.prepared.jobs]
        self._exact = sum(
            self._of_pixels(job, rows, download(sum_all_lights(job.transport, part)[0]))
            for job, rows, part in self._chosen
        )
        direct = sum(self._of_pixels(job, rows, download(job.direct)[rows]) for job, rows, _ in self._chosen)
        self.mean = float((self._exact + direct).mean())

    def plugin(self, kind: str, **more):
        """Plugin with the settings shared by all methods."""
        return mi.load_dict({"type": kind, **self.settings, **more})

    def _rows_of(self, job):
        rows = np.flatnonzero(self._place[download(job.ray) // self.samples] >= 0)
        return job, rows, job.batch.select(upload(mi.UInt32, rows))

    def _of_pixels(self, job, rows, radiance) -> np.ndarray:
        """Sum the contributions of points to the compared pixels, (pixels, 3)."""
        place = self._place[download(job.ray)[rows] // self.samples]
        total = np.zeros((self._place.max() + 1, 3))
        np.add.at(total, place, radiance.astype(np.float64) * download(job.weight)[rows] / self.samples)
        return total

    def shade(self, plugin) -> Found:
        """Shade all points with a plugin and compare the selected pixels."""
        shaded, seconds = scenes.timed(lambda: [plugin.shade(job) for job in self.prepared.jobs])
        values, rays, cut, stages, counts = 0, 0.0, 0.0, {}, {}
        for (job, rows, _), part in zip(self._chosen, shaded, strict=True):
            values += self._of_pixels(job, rows, download(part.radiance)[rows])
            rays += float(download(part.shadow_rays).sum(dtype=np.float64)) / self.pixels
            cut += float(download(part.cut_size).sum(dtype=np.float64)) / self.pixels
            for total, more in ((stages, part.seconds), (counts, part.counts)):
                for name, number in more.items():
                    total[name] = total.get(name, 0) + number
        difference = values - self._exact
        rmse, absolute = np.sqrt((difference**2).mean()), np.abs(difference).mean()
        return Found(seconds, rmse / self.mean, absolute / self.mean, rays, cut, stages, counts)

    def quality_for(self, method: str, wanted: float, measure: str = "absolute", **more):
        """Search the parameter of a method for a mean absolute error or a number of ``rays``; return the closest value
        and its run, which may miss what is wanted, by a limit of the parameter or of the search.

        ``more``: further properties.
        """
        quality = QUALITY[method]
        power = quality.power if measure == "absolute" else -np.sign(quality.power)
        value, tried = quality.rounded(quality.guess), []
        for _ in range(_TRIES):
            found = self.shade(self.plugin(method, **{quality.name: value}, **more))
            reached = getattr(found, measure)
            tried.append((abs(np.log(reached / wanted)), value, found))
            if tried[-1][0] < _NEAR:
                break
            step = float(np.clip((wanted / reached) ** (1 / power), 0.2, 5))
            value = quality.rounded(value * step)
            if any(value == before for _, before, _ in tried):
                break
        return min(tried, key=lambda one: one[:2])[1:]

    def interleaved(self, plugins: dict) -> dict:
        """Median run of each plugin, interleaved and warm."""
        runs: dict = {name: [] for name in plugins}
        for _ in range(RUNS):
            for name, plugin in plugins.items():
                runs[name].append(self.shade(plugin))
        return {name: _median(found) for name, found in runs.items()}


def _median(runs: list[Found]) -> Found:
    return sorted(runs, key=lambda one: one.seconds)[len(runs) // 2]


def curves(names, options) -> Iterator[dict]:
    """Part "curve"."""
    rows = {}
    print(
        f"\n## error against the sum of all lights (width {options.width}, {VPLS} VPLs, max_depth {DEPTH}, no max_cut)"
    )
    print("scene | samples | method | parameter: RMSE, mean absolute error, rays/px, s")
    for name in names:
        for samples in (1, 9):
            problem = Problem(name, samples, options.width, options.points)
            for method, quality in QUALITY.items():
                shown, more = [], {"max_cut": 0} if quality.name == "error" else {}
                for factor in (0.25, 0.5, 1, 2):
                    value = quality.rounded(quality.guess * factor ** -np.sign(quality.power))
                    plugin = problem.plugin(method, **{quality.name: value}, **more)
                    problem.shade(plugin)
                    found = problem.shade(plugin)
                    rows[f"{name}, {samples} samples, {method}, {quality.show(value)}"] = _numbers(found)
                    shown.append(
                        f"{quality.show(value)}: {found.rmse:.4f}, {100 * found.absolute:.2f}%, {found.rays:.0f}, "
                        f"{found.seconds:.2f}"
                    )
                print(f"{name} | {samples} | {method} | {' | '.join(shown)}", flush=True)
        yield rows


def _numbers(found: Found) -> dict:
    """Quantities of a run, for a result file."""
    names = ("seconds", "rmse", "absolute", "rays", "cut")
    return {name: float(getattr(found, name)) for name in names}


def equal_errors(names, width: int, samples: int, points: int, methods) -> Iterator[dict]:
    """A table of ``lightcuts`` at 1% and of other methods at its mean absolute error."""
    print(f"\n## {samples} samples a pixel, equal mean absolute error (width {width}, {VPLS} VPLs, warm)")
    print(
        "scene | shared s | method | render s | rays/px | lights, clusters or pairs/px | RMSE | mean absolute | speedup"
    )
    speedups: dict = {method: [] for method in methods}
    rows: dict = {}
    for name in names:
        problem = Problem(name, samples, width, points)
        target = problem.shade(problem.plugin("lightcuts")).absolute
        chosen = {"lightcuts": 0.01} | {method: problem.quality_for(method, target)[0] for method in methods}
        plugins = {one: problem.plugin(one, **{QUALITY[one].name: value}) for one, value in chosen.items()}
        middle = problem.interleaved(plugins)
        rows[name] = {"shared_seconds": problem.shared}
        for one, found in middle.items():
            speedup = middle["lightcuts"].seconds / found.seconds
            quality, missed = {QUALITY[one].name: chosen[one]}, found.misses(target)
            rows[name][one] = _numbers(found) | quality | {"speedup": speedup, "not_reached": missed}
            print(
                f"{name} | {problem.shared:.2f} | {one}, {QUALITY[one].show(chosen[one])} | {found.seconds:.2f} | "
                f"{found.rays:.0f} | {found.cut:.0f} | {found.rmse:.4f} | {100 * found.absolute:.2f}% | {speedup:.1f}"
                f"{' at most: error not reached' if missed else ''}",
                flush=True,
            )
            if one in methods:
                speedups[one].append(speedup)
                print(
                    "  stages:", ", ".join(f"{stage} {spent:.2f}" for stage, spent in found.stages.items()), flush=True
                )
        yield rows
    for method, found in speedups.items() if rows else ():
        bound = "at most " if any(row[method]["not_reached"] for row in rows.values()) else ""
        print(f"geometric mean of the speedups of {method}: {bound}{geometric_mean(found):.2f}")


def many_samples(names, options) -> Iterator[dict]:
    """Part "samples"."""
    return equal_errors(names, options.width, options.samples, options.points, ("mdlightcuts", "lightslice"))


def slices(names, options) -> Iterator[dict]:
    """Part "slices"."""
    return equal_errors(names, 4 * options.width, 1, options.points, ("lightslice",))


def growth(names, options) -> Iterator[dict]:
    """Part "growth"."""
    rows: dict = {}
    print(f"\n## mdlightcuts at 1% with more samples a pixel (width {options.width}, {VPLS} VPLs, warm)")
    print("scene | 1 sample: s, rays/px | 4: times as long, rays/px | 16 | 64")
    for name in names:
        base, shown = 0.0, []
        for samples in (1, 4, 16, 64):
            problem = Problem(name, samples, options.width, options.points)
            plugin = problem.plugin("mdlightcuts")
            problem.shade(plugin)
            found = _median([problem.shade(plugin) for _ in range(RUNS)])
            base = base or found.seconds
            rows[f"{name}, {samples}"] = {
                "seconds": found.seconds, "slowdown": found.seconds / base, "rays": found.rays,
            }  # fmt: skip
            time = f"{found.seconds:.2f}" if samples == 1 else f"{found.seconds / base:.1f}"
            shown.append(f"{time}, {found.rays:.0f}")
        print(f"{name} | {' | '.join(shown)}", flush=True)
        yield rows


def memory(names, options) -> Iterator[dict]:
    """Part "memory": every scene in a process of its own, which tells the most memory that it ever had."""
    rows = {}
    print("\n## lightslice at 1600×1200, 600 000 VPLs, 800 columns")
    print("scene | peak above the loaded scene, GiB | peak, GiB | render s")
    for name in names:
        context = multiprocessing.get_context("spawn")
        with context.Pool(1) as pool:
            before, after, seconds = pool.apply(_render_large, (name,))
        rows[name] = {"memory": (after - before) / 2**20, "seconds": seconds}
        print(f"{name} | {(after - before) / 2**20:.2f} | {after / 2**20:.2f} | {seconds:.1f}", flush=True)
        yield rows


def _render_large(name: str):
    """(peak memory after loading, peak memory after rendering, both in KiB, seconds)"""
    scene = mi.load_file(str(scenes.scene_file(name)), resx=1600, resy=1200)
    plugin = mi.load_dict({"type": "lightslice", "max_depth": DEPTH, "vpl_count": 600_000, "columns": 800})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _, seconds = scenes.timed(lambda: mi.render(scene, integrator=plugin, spp=1))
    return before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, seconds


def main() -> None:
    """Parse the command line and run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(scenes.NAMES), choices=scenes.NAMES)
    results.add_options(parser, ["curve", "samples", "slices", "growth", "memory"])
    parser.add_argument("--width", type=positive(int), default=256, help="pixels (default: 256)")
    parser.add_argument(
        "--samples", type=positive(int), default=16, help="samples a pixel of part samples (default: 16)"
    )
    parser.add_argument(
        "--points", type=positive(int), default=8000, help="where all lights are summed (default: 8000)"
    )
    options = results.parse(parser)
    names = scenes.available(options.scenes)
    parts = {"curve": curves, "samples": many_samples, "slices": slices, "growth": growth, "memory": memory}
    settings = {"max_depth": DEPTH, "vpl_count": VPLS, "width": options.width, "points": options.points, "runs": RUNS}
    runs = {part: partial(function, names, options) for part, function in parts.items()}
    results.run_parts(options, runs, settings)


if __name__ == "__main__":
    main()
