"""IlluminationCut against ``lightcuts`` and against shadow rays alone: the tables of [IC] section 4 for our scenes.

    ./run -- python benchmarks/illuminationcut.py [--scenes NAME ...] [--parts table tight samples lights rays public]

table    [IC] table 1: ``lightcuts`` at 1%, and both forms of ``illuminationcut`` with the ``error`` of equal RMSE,
         found by search; same VPLs, same clamping, warm, 512 wide, 1 sample per pixel.
tight    [IC] table 3: the same at the RMSE of ``lightcuts`` at 0.1%, with unlimited cuts.
samples  [IC] table 6: the same with 9 samples per pixel.
lights   [IC] figure 5 and table 5: render time from 50 k to 1.2 M VPLs, and peak memory at 1600×1200.
rays     shadow rays per second of ``shade``, against the same rays traced alone in a batch.
public   settings of the public C++ code in the Cornell box, in CPU seconds of all threads.

Errors are relative to the sum of all lights at a random subset of points. Times are medians of three interleaved runs.
"render" starts after the shared work: lights, light trees and gather points.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import geometric_mean

import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from vpl.core.arrays import download, upload  # noqa: E402
from vpl.core.stages import Stage  # noqa: E402
from vpl.cuts.product_cuts import BoundCounter, Pairs, find_pairs  # noqa: E402
from vpl.points.point_clusters import PointClusters  # noqa: E402
from vpl.transport.contribution import contribution, shadow_ray  # noqa: E402
from vpl.transport.evaluation import sum_all_lights  # noqa: E402

NAMES = (*scenes.NAMES, "glossy")
DEPTH, VPLS, WIDTH, SUBSET, RUNS = 6, 200_000, 512, 4000, 3
# Maximum number of search steps for an RMSE, and relative tolerance
_TRIES, _NEAR = 4, 0.03


@dataclass
class Found:
    """Result of a render: seconds of ``shade``; per pixel: normalised RMSE, relative L1, rays, bounds."""

    seconds: float
    rmse: float
    relative: float
    rays: float
    bounds: float
    stages: dict


class Problem:
    """Lights and gather points of a scene, and exact radiance at a random subset of points."""

    def __init__(self, name: str, samples: int = 1, **settings):
        self.settings = {"max_depth": DEPTH, "vpl_count": VPLS} | settings
        self.scene = scenes.load(name, WIDTH)
        plugin, rays = self.plugin("lightcuts"), scenes.camera_rays(self.scene, 0, samples)
        self.prepared, self.preprocessing = scenes.timed(lambda: plugin.prepare(self.scene, *rays))
        self.points = self.prepared.paths.points.count
        self.exact, self.mean = [], 0.0
        for number, job in enumerate(self.prepared.jobs):
            share = max(round(SUBSET * job.batch.count / self.points), min(job.batch.count, 64))
            rows = np.random.default_rng(number).choice(job.batch.count, min(share, job.batch.count), replace=False)
            part = job.batch.select(upload(mi.UInt32, np.sort(rows)))
            exact = download(sum_all_lights(job.transport, part)[0])
            self.exact.append((np.sort(rows), exact))
            direct = download(job.direct)[np.sort(rows)]
            self.mean += float((exact + direct).mean()) * job.batch.count / self.points

    def plugin(self, kind: str, **more):
        """Plugin with the settings shared by all methods."""
        return mi.load_dict({"type": kind, **self.settings, **more})

    def shade(self, plugin) -> Found:
        """Shade all points with a plugin and compare the subset."""
        shaded, seconds = scenes.timed(lambda: [plugin.shade(job) for job in self.prepared.jobs])
        square = absolute = rays = bounds = 0.0
        stages: dict = {}
        for job, part, (rows, exact) in zip(self.prepared.jobs, shaded, self.exact, strict=True):
            difference = download(part.radiance)[rows] - exact
            share = job.batch.count / self.points
            square += share * float((difference**2).mean())
            absolute += share * float(np.abs(difference).mean())
            rays += float(download(part.shadow_rays).sum(dtype=np.float64))
            bounds += float(download(part.upper_bounds).sum(dtype=np.float64))
            for stage, spent in part.seconds.items():
                stages[stage] = stages.get(stage, 0.0) + spent
        rmse = np.sqrt(square) / self.mean
        return Found(seconds, rmse, absolute / self.mean, rays / self.points, bounds / self.points, stages)

    def error_for(self, rmse: float, error: float, **more) -> float:
        """Search the ``error`` of ``illuminationcut`` for an RMSE, to a few percent; ``error``: first guess."""
        for _ in range(_TRIES):
            reached = self.shade(self.plugin("illuminationcut", error=error, **more)).rmse
            if abs(reached / rmse - 1) < _NEAR:
                break
            # The RMSE is roughly proportional to the 0.6th power of the error
            error *= float(np.clip((rmse / reached) ** (1 / 0.6), 0.2, 5))
        return error


def equal_quality(title: str, names, samples: int, lightcuts_error: float, **settings) -> Iterator[dict]:
    """Print the table of ``lightcuts`` and both forms of ``illuminationcut`` at its RMSE."""
    print(f"\n## {title} (width {WIDTH}, {samples} sample(s) per pixel, {VPLS} VPLs, max_depth {DEPTH}, warm)")
    print("scene | method | error | preprocessing s | render s | rays/px | RMSE | relative L1 | bounds/px | speedup")
    speedups: dict = {"all": [], "adaptive": []}
    rows: dict = {}
    for name in names:
        problem = Problem(name, samples, **settings)
        methods = {"lightcuts": problem.plugin("lightcuts", error=lightcuts_error)}
        target = problem.shade(methods["lightcuts"]).rmse
        errors = {"lightcuts": lightcuts_error}
        for visibility in speedups:
            errors[visibility] = problem.error_for(target, 2 * lightcuts_error, visibility=visibility)
            methods[visibility] = problem.plugin("illuminationcut", visibility=visibility, error=errors[visibility])
        runs: dict = {label: [] for label in methods}
        for _ in range(RUNS):
            for label, plugin in methods.items():
                runs[label].append(problem.shade(plugin))
        middle = {label: sorted(found, key=lambda one: one.seconds)[RUNS // 2] for label, found in runs.items()}
        rows[name] = {}
        for label, found in middle.items():
            speedup = middle["lightcuts"].seconds / found.seconds
            rows[name][label] = {
                "error": errors[label], "seconds": found.seconds, "rays": found.rays, "bounds": found.bounds,
                "rmse": found.rmse, "relative_l1": found.relative, "speedup": speedup,
            }  # fmt: skip
            if label in speedups:
                speedups[label].append(speedup)
            print(
                f"{name} | {label} | {100 * errors[label]:.2g}% | {problem.preprocessing:.2f} | {found.seconds:.2f} | "
                f"{found.rays:.0f} | {found.rmse:.4f} | {100 * found.relative:.2f}% | {found.bounds:.0f} | "
                f"{speedup:.1f}",
                flush=True,
            )
        yield rows
    for visibility, values in speedups.items() if rows else ():
        print(f"geometric mean of the speedups, visibility={visibility}: {geometric_mean(values):.2f}")


def ray_rates(names) -> Iterator[dict]:
    """Part "rays"."""
    rows = {}
    print("\n## shadow rays per second: all of shade, error 1.5%, against the rays of its pairs alone")
    print("scene | rays, M | whole, M/s | alone, M/s | share")
    for name in names:
        problem = Problem(name)
        plugin, rays, whole, alone = problem.plugin("illuminationcut"), 0.0, 0.0, 0.0
        for job in problem.prepared.jobs:
            plugin.shade(job)
            shaded, spent = scenes.timed(lambda: plugin.shade(job))  # noqa: B023
            count = float(download(shaded.shadow_rays).sum(dtype=np.float64))
            rays, whole, alone = rays + count, whole + spent, alone + count * _seconds_alone(plugin, job)
        rate, bare = rays / whole / 1e6, rays / alone / 1e6
        rows[name] = {"illuminationcut": {"rays_per_second": rate}, "rays alone": {"rays_per_second": bare}}
        print(f"{name} | {rays / 1e6:.1f} | {rate:.1f} | {bare:.1f} | {100 * rate / bare:.0f}%", flush=True)
        yield rows


def _seconds_alone(plugin, job, most: int = 1 << 22) -> float:
    """Seconds per shadow ray of some million expanded pairs of a job, traced alone, grouped by light kind."""
    clusters = PointClusters(job.batch)
    bound = dr.opaque(mi.Float, plugin.error * job.mean)
    seconds = count = 0.0
    for group in job.lights.groups:
        accept = lambda points, lights, value, index: value <= bound  # noqa: E731
        counter = BoundCounter(clusters, False)
        found = list(find_pairs(clusters, job.lights, group, accept, counter))
        if not found:
            continue
        pairs = Pairs.join(found)
        points = download(pairs.points)
        # A random subset of the pairs, with points in the order of the point tree
        chosen = np.random.default_rng(0).permutation(len(points))
        chosen = chosen[: np.searchsorted(np.cumsum(clusters.tree.count[points[chosen]], dtype=np.int64), most)]
        chosen = chosen[np.argsort(clusters.tree.first[points[chosen]], kind="stable")]
        length = clusters.tree.count[points[chosen]].astype(np.int64)
        within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
        row = upload(mi.UInt32, np.repeat(clusters.tree.first[points[chosen]], length) + within)
        light, _ = group.representatives(upload(mi.UInt32, np.repeat(download(pairs.lights)[chosen], length)))
        surface = clusters.batch.surfaces_at(row)
        active = dr.any(contribution(group.kind, surface, light, job.lights.smallest_distance) > 0)
        ray = shadow_ray(group.kind, surface.interaction, light)
        dr.eval(ray, active)
        rays = dr.gather(mi.Ray3f, ray, dr.compress(active))
        dr.eval(rays)
        scenes.timed(lambda: job.transport.scene.ray_test(rays))  # noqa: B023
        seconds += scenes.timed(lambda: job.transport.scene.ray_test(rays))[1]  # noqa: B023
        count += dr.width(rays.d)
    return seconds / max(count, 1)


def many_lights(names) -> Iterator[dict]:
    """Part "lights"."""
    rows = {}
    print("\n## render time and number of VPLs (width 512, illuminationcut at its default error)")
    print("scene | VPLs | trees s | render s, all | render s, adaptive")
    for name in names:
        for count in (50_000, 200_000, 600_000, 1_200_000):
            scene = scenes.load(name, WIDTH)
            seconds = []
            for visibility in ("all", "adaptive"):
                settings = {"max_depth": DEPTH, "vpl_count": count, "visibility": visibility}
                plugin = mi.load_dict({"type": "illuminationcut", **settings})
                prepared = plugin.prepare(scene, *scenes.camera_rays(scene, 0))
                runs = [
                    scenes.timed(lambda: [plugin.shade(job) for job in prepared.jobs])[1]  # noqa: B023
                    for _ in range(RUNS + 1)
                ]
                seconds.append(float(np.median(runs[1:])))
            tree = prepared.clock.seconds[Stage.TREE]
            rows[f"{name}, {count}"] = {"tree_seconds": tree} | {
                visibility: {"seconds": one} for visibility, one in zip(("all", "adaptive"), seconds, strict=True)
            }
            print(f"{name} | {count} | {tree:.2f} | {seconds[0]:.2f} | {seconds[1]:.2f}", flush=True)
        yield rows
    print("\n## peak memory above the scene, 1600×1200, 1.2 M VPLs, 1 sample per pixel")
    for name in names:
        command = [sys.executable, __file__, "--memory-of", name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(f"{name}: {done.stdout.strip()}", flush=True)
        words = done.stdout.split()
        rows[f"{name}, 1600×1200"] = {words[k]: {"memory": float(words[k + 1])} for k in range(0, len(words), 3)}
        yield rows


def memory_of(name: str) -> None:
    """Print the growth of this process's peak memory during the render of a large image with many lights."""
    scene = mi.load_file(str(scenes.scene_file(name)), resx=1600, resy=1200)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for visibility in ("all", "adaptive"):
        settings = {"max_depth": DEPTH, "vpl_count": 1_200_000, "visibility": visibility}
        dr.eval(mi.render(scene, integrator=mi.load_dict({"type": "illuminationcut", **settings}), spp=1))
        dr.sync_thread()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"{visibility} {(peak - before) / 2**20:.2f} GiB", end="  ")
    print()


def public_settings() -> Iterator[dict]:
    """Part "public"."""
    print("\n## settings of the public C++ code: Cornell box, 512×512, max_depth 9, 2048 direct and 47 k indirect")
    print("VPLs, distances clamped at 5% of the diagonal; CPU seconds of all threads")
    print("method | light tree | render | rays/px | bounds/px | relative L1 | public code: tree + render, L1")
    rows = {
        "lightcuts": ("lightcuts", {}, (61, 0.0064)),
        "illuminationcut": ("illuminationcut", {"visibility": "all"}, (27, 0.0057)),
        "illuminationcut, adaptive": ("illuminationcut", {"visibility": "adaptive"}, (20.5, 0.0057)),
    }
    # 5% of the diagonal is 8.94 times the mean distance between the lights, 0.0194, which is the unit of clamping
    settings = {"max_depth": 9, "direct": "vpl", "direct_count": 2048, "vpl_count": 47_000, "clamping": 8.94}
    problem = Problem("cornell", 1, **settings)
    measured = {}
    for label, (kind, more, published) in rows.items():
        for error in (0.01, 0.005, 0.0025):
            plugin = problem.plugin(kind, error=error, **more)
            problem.shade(plugin)
            start = time.process_time()
            found = problem.shade(plugin)
            render = time.process_time() - start
            tree = problem.prepared.clock.seconds[Stage.TREE]
            measured[f"{label}, {100 * error:.2g}%"] = {
                "public code": dict(zip(("cpu_seconds", "relative_l1"), published, strict=True)),
                "cpu_seconds": tree + render, "rays": found.rays, "bounds": found.bounds,
                "relative_l1": found.relative,
            }  # fmt: skip
            print(
                f"{label}, {100 * error:.2g}% | {tree:.2f} s | {render:.2f} s | {found.rays:.0f} | "
                f"{found.bounds:.0f} | {100 * found.relative:.2f}% | {published[0]} s, {100 * published[1]:.2f}%",
                flush=True,
            )
            yield measured


def main() -> None:
    """Parse the command line and run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("table", "tight", "samples", "lights", "rays", "public")
    parser.add_argument("--scenes", nargs="+", default=list(NAMES), choices=NAMES)
    results.add_options(parser, parts)
    parser.add_argument("--memory-of", choices=NAMES, help=argparse.SUPPRESS)
    options = results.parse(parser)
    if options.memory_of:
        memory_of(options.memory_of)
        return
    names = scenes.available(options.scenes)
    some = [name for name in ("cornell", "sponza_crytek", "dining_room") if name in names]
    runs = {
        "table": lambda: equal_quality("the RMSE of lightcuts at 1%", names, 1, 0.01),
        "tight": lambda: equal_quality("the RMSE of lightcuts at 0.1%, cuts unlimited", some, 1, 0.001, max_cut=0),
        "samples": lambda: equal_quality("the RMSE of lightcuts at 1%", some, 9, 0.01),
        "lights": lambda: many_lights(some),
        "rays": lambda: ray_rates(names),
        "public": public_settings,
    }
    settings = {"max_depth": DEPTH, "vpl_count": VPLS, "width": WIDTH, "runs": RUNS}
    results.run_parts(options, runs, settings)


if __name__ == "__main__":
    main()
