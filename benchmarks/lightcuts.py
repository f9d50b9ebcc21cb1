"""Lightcuts against the sum of all lights, against bare shadow rays, and against ``path``.

    ./run -- python benchmarks/lightcuts.py [--scenes NAME ...] [--parts brute rays cold path]

brute  same VPLs, one run: time and error of ``lightcuts`` at 1% against plugin ``vpl``, evaluated at a fixed random
       subset of points and extrapolated to the time of all points.
rays   shadow rays per second of the whole cut evaluation, against the same rays traced alone in a batch.
cold   first render in a new process with an empty kernel cache, against ``path``.
path   ``lightcuts`` and ``mdlightcuts`` against ``path`` at equal time by compare.py, with a report in output/path.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import geometric_mean

import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import compare  # noqa: E402
import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from comparison.command_line import positive  # noqa: E402
from vpl.core.arrays import download, upload  # noqa: E402
from vpl.core.stages import Stage  # noqa: E402
from vpl.cuts.light_cuts import collect_cuts, limited_cuts  # noqa: E402
from vpl.transport.contribution import contribution, shadow_ray  # noqa: E402
from vpl.transport.evaluation import sum_all_lights  # noqa: E402

DEPTH, VPLS, SUBSET = 6, 200_000, 4000
# Stages that the sum of all lights also needs
COMMON_STAGES = (Stage.SCENE, Stage.GATHER, Stage.TRACE, Stage.DIRECT, Stage.PROBE)


def lightcuts(**more):
    """Plugin with the settings shared by all parts."""
    return mi.load_dict({"type": "lightcuts", "max_depth": DEPTH, "vpl_count": VPLS, "error": 0.01, **more})


def brute_force(names) -> Iterator[dict]:
    """Part "brute"."""
    print(f"\n## lightcuts, error 1%, against all VPLs (width 256, {VPLS} VPLs, max_depth {DEPTH}, warm)")
    print("scene | VPLs | lightcuts s | of it tree | rays/px | bounds/px | cut | rel. L1 | all VPLs s | ratio")
    ratios, rows = [], {}
    for name in names:
        scene, plugin = scenes.load(name), lightcuts()
        for _ in range(2):
            scenes.timed(lambda: mi.render(scene, integrator=plugin, spp=1, seed=0))  # noqa: B023
        seconds = []
        for _ in range(3):
            seconds.append(scenes.timed(lambda: mi.render(scene, integrator=plugin, spp=1, seed=0))[1])  # noqa: B023
        found, ours = plugin.statistics, float(np.median(seconds))
        error, brute = _error_and_brute_seconds(scene, plugin)
        common = sum(found["seconds"].get(stage, 0) for stage in COMMON_STAGES)
        points = found["gather_points"]
        ratios.append((common + brute) / ours)
        counts = {"rays": "shadow_rays", "bounds": "bound_computations", "cut": "cut_size"}
        rows[name] = {
            "lightcuts": {"seconds": ours, "tree_seconds": found["seconds"]["tree"], "relative_l1": error}
            | {short: found[long] / points for short, long in counts.items()},
            "vpl": {"seconds": common + brute},
            "lights": sum(found["lights"].values()),
            "speedup": ratios[-1],
        }
        print(
            f"{name} | {sum(found['lights'].values())} | {ours:.2f} | {found['seconds']['tree']:.2f} | "
            f"{found['shadow_rays'] / points:.0f} | {found['bound_computations'] / points:.0f} | "
            f"{found['cut_size'] / points:.0f} | {100 * error:.2f}% | {common + brute:.0f} | {ratios[-1]:.0f}",
            flush=True,
        )
        yield rows
    if ratios:
        print(f"geometric mean of the ratios: {geometric_mean(ratios):.0f}")


def _error_and_brute_seconds(scene, plugin):
    """Relative L1 of ``lightcuts`` on a fixed random subset, and extrapolated seconds of the sum of all lights."""
    prepared = plugin.prepare(scene, *scenes.camera_rays(scene, 0))
    points = prepared.paths.points.count
    difference = total = seconds = 0.0
    for number, job in enumerate(prepared.jobs):
        radiance = download(plugin.shade(job).radiance)
        share = max(round(SUBSET * job.batch.count / points), min(job.batch.count, 64))
        rows = np.sort(np.random.default_rng(number).choice(job.batch.count, min(share, job.batch.count), False))
        part = job.batch.select(upload(mi.UInt32, rows))
        few = job.batch.select(upload(mi.UInt32, rows[:16]))
        sum_all_lights(job.transport, few)  # warm-up: compiles the kernel
        (exact, _), spent = scenes.timed(lambda: sum_all_lights(job.transport, part))  # noqa: B023
        exact, direct = download(exact), download(job.direct)[rows]
        scale = job.batch.count / len(rows)
        seconds += spent * scale
        difference += np.abs(radiance[rows] - exact).sum() * scale
        total += (exact + direct).sum() * scale
    return difference / total, seconds


def ray_rates(names) -> Iterator[dict]:
    """Part "rays"."""
    rows = {}
    print("\n## shadow rays per second: the whole cut evaluation (estimate, cut, shading, rays) against the rays alone")
    print("scene | rays, M | whole, M/s | alone, M/s | share")
    for name in names:
        scene, plugin = scenes.load(name), lightcuts()
        prepared = plugin.prepare(scene, *scenes.camera_rays(scene, 0))
        rays = whole = alone = 0.0
        for job in prepared.jobs:
            plugin.shade(job)
            shaded, spent = scenes.timed(lambda: plugin.shade(job))  # noqa: B023
            rays += float(download(shaded.shadow_rays).sum(dtype=np.int64))
            whole += spent
            alone += _seconds_alone(plugin, job) * float(download(shaded.shadow_rays).sum(dtype=np.int64))
        rate, bare = rays / whole / 1e6, rays / alone / 1e6
        rows[name] = {"lightcuts": {"rays_per_second": rate}, "rays alone": {"rays_per_second": bare}}
        print(f"{name} | {rays / 1e6:.1f} | {rate:.1f} | {bare:.1f} | {100 * rate / bare:.0f}%", flush=True)
        yield rows


def _seconds_alone(plugin, job) -> float:
    """Seconds per shadow ray of a job's cuts, traced alone in a batch."""
    threshold = dr.full(mi.Float, plugin.error * job.mean, job.batch.count)
    threshold, sizes = limited_cuts(job.lights, job.batch, threshold, plugin.max_cut)
    seconds = count = 0.0
    for chunk in collect_cuts(job.lights, job.batch, threshold, sizes):
        light, _ = chunk.group.representatives(chunk.nodes)
        surface, kind = chunk.batch.surfaces_at(chunk.rows), chunk.group.kind
        active = dr.any(contribution(kind, surface, light, job.lights.smallest_distance) > 0)
        ray = shadow_ray(kind, surface.interaction, light)
        dr.eval(ray, active)
        lanes = dr.compress(active)
        rays = dr.gather(mi.Ray3f, ray, lanes)
        dr.eval(rays)
        scene = job.transport.scene
        scenes.timed(lambda: scene.ray_test(rays))  # noqa: B023
        _, spent = scenes.timed(lambda: scene.ray_test(rays))  # noqa: B023
        seconds += spent
        count += len(lanes)
    return seconds / max(count, 1)


_COLD = """
import mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
import integrators
from benchmarks import scenes
scene = scenes.load({name!r})
integrator = mi.load_dict({plugin!r})
print(scenes.timed(lambda: mi.render(scene, integrator=integrator, spp=1, seed=0))[1])
"""


def cold_starts(names) -> Iterator[dict]:
    """Part "cold"."""
    rows = {}
    print("\n## first render in a fresh process with an empty kernel cache (1 sample a pixel; loading not counted)")
    print("scene | lightcuts s | path s | ratio")
    for name in names:
        seconds = {}
        for plugin in ("lightcuts", "path"):
            runs = []
            for _ in range(3):
                with tempfile.TemporaryDirectory() as cache:
                    code = _COLD.format(name=name, plugin={"type": plugin, "max_depth": DEPTH})
                    runs += scenes.numbers_of(code, cache, 1)
            seconds[plugin] = float(np.median(runs))
        rows[name] = {plugin: {"seconds": spent} for plugin, spent in seconds.items()}
        ratio = seconds["lightcuts"] / seconds["path"]
        print(f"{name} | {seconds['lightcuts']:.1f} | {seconds['path']:.1f} | {ratio:.2f}", flush=True)
        yield rows


def against_path(names, budget: float) -> Iterator[dict]:
    """Part "path": what compare.py prints for the scenes that have a reference."""
    files = [str(scenes.scene_file(name)) for name in names if scenes.reference_file(name)]
    if not files:
        return
    status = compare.main(
        [
            *files, "--integrators", "path,lightcuts,mdlightcuts", "--param", "mdlightcuts.error=0.02",
            "--sampler", "multijitter", "--max-depth", str(DEPTH), "--time", f"{budget:g}",
            "--reference", str(scenes.REFERENCES), "--out", "output/path",
        ]
    )  # fmt: skip
    if status:
        # The folder may hold the results of an earlier comparison
        raise SystemExit(status)
    yield _compared_rows(json.loads(Path("output/path/results.json").read_text()))


def _compared_rows(found: dict) -> dict:
    """Rows of the results of compare.py: error, bias and samples of each integrator, and times at equal error."""
    rows = {}
    for scene in found["scenes"]:
        outcomes = found["summary"]["scenes"][scene["name"]]
        samples = {one["label"]: one["spp"] for one in scene["renders"]}
        rows[scene["name"]] = row = {}
        for label, one in outcomes.items():
            row[label] = {"relmse": one["measured"], "bias": one["bias"], "hidden": one["hidden"]}
            row[label] |= {"samples": samples[label], "seconds": one["seconds"]}
        if time := outcomes["mdlightcuts"]["time"]:
            row["speedup"] = 1 / time["value"]
    return rows


def main() -> None:
    """Parse the command line and run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(scenes.NAMES), choices=scenes.NAMES)
    results.add_options(parser, ["brute", "rays", "cold", "path"])
    parser.add_argument("--time", type=positive(float), default=10.0, help="seconds of part path (default: 10)")
    options = results.parse(parser)
    names = scenes.available(options.scenes)
    parts = {
        "brute": lambda: brute_force(names),
        "rays": lambda: ray_rates(names),
        "cold": lambda: cold_starts([name for name in ("kitchen", "everything8003") if name in names]),
        "path": lambda: against_path(names, options.time),
    }
    settings = {"max_depth": DEPTH, "vpl_count": VPLS, "width": 256}
    results.run_parts(options, parts, settings)


if __name__ == "__main__":
    main()
