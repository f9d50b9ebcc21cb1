"""``adaptivedirect`` against its reference method, against the sum over all lights, and against Mitsuba.

    ./run -- python benchmarks/adaptivedirect.py [--scenes NAME ...] [--parts table paper lights cold]

table   direct light (``max_depth`` 2) of each scene with equal stopping rules: seconds, shadow rays per pixel and
        relMSE of ``adaptivedirect`` and ``unoccludeddirect``; time at equal relMSE of the latter, ``lights="all"``,
        ``direct`` and ``path``.
paper   the same for the method as printed in the paper (benchmarks/printed_passes.py).
lights  the hall with 100 to 100 000 lights: seconds to equal error.
cold    first render in a new process with an empty kernel cache.

Images are rendered with 64 camera rays a pixel (256 by ``direct`` and ``path``) from a multijitter sampler, and
compared, where they see no emitter, with the mean of four renders by ``adaptivedirect`` at 1.5%, whose own noise is
taken off: path-traced references of these scenes are noisier than what they would judge (10% a pixel after 2048 samples
in the kitchen). Where this noise hides an error, marked by <, times at equal relMSE are unknown. That the mean of
``adaptivedirect`` is that of ``direct`` is tested (tests/integrators/test_adaptivedirect.py). Variance falls as
1 / time, so a method's time for another error is its own time, scaled; ``all`` is stopped after 15 seconds.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from statistics import geometric_mean
from typing import NamedTuple

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from benchmarks.printed_passes import as_printed  # noqa: E402
from comparison import machine, references  # noqa: E402
from comparison.command_line import positive  # noqa: E402
from comparison.metrics import compare, detection_threshold  # noqa: E402
from comparison.scene_files import SceneFile  # noqa: E402

NAMES = (
    "kitchen_lamps", "kitchen_windows", "forest_lights", "concourse", "everything8003", "bistro_interior", "staircase2",
    "living_room",
)  # fmt: skip
AGAINST = ("unoccluded", "all", "direct", "path")
RAYS, REFERENCE_ERROR, REFERENCE_RENDERS = 64, 0.015, 4
PRINTED = "adaptivedirect, printed"
# Files that determine an image by ``adaptivedirect``
SOURCES = ("vpl/**/*.py", "integrators/*.py")
METRIC = "relmse_trimmed"


class Raced(NamedTuple):
    """Seconds, relMSE without the largest 0.1%, and shadow rays per pixel of an integrator; ``hidden``: whether the
    noise of the reference exceeds the error, which is then that noise."""

    seconds: float
    relmse: float
    rays: float
    hidden: bool

    @classmethod
    def of(cls, runs: list) -> Raced:
        """Median seconds and mean errors and rays of (seconds, errors as of ``metrics.compare``, rays)."""
        seconds, errors, rays = zip(*runs, strict=True)
        # Single errors, corrected for the noise, may be 0 where the mean is not
        error = float(np.mean([one[METRIC] for one in errors]))
        noise = float(np.mean([detection_threshold(METRIC, one["noise"]) for one in errors]))
        return cls(float(np.median(seconds)), max(error, noise), float(np.mean(rays)), error <= noise)

    def times_of(self, other: Raced) -> float | None:
        """Seconds of ``other`` over the own ones at equal error; None if the noise hides one of the errors."""
        if self.hidden or other.hidden:
            return None
        return other.seconds * other.relmse / (self.seconds * self.relmse)

    def __str__(self) -> str:
        return f"{self.seconds:.2f}, {self.rays:.0f}, {'< ' if self.hidden else ''}{self.relmse:.5f}"


class Problem:
    """Scene with its reference; renders with times and errors."""

    def __init__(self, name: str, width: int):
        path, height = str(scenes.scene_file(name)), scenes.height(name, width)
        defines = {"max_depth": "2", "resx": str(width), "resy": str(height)}
        self.pixels = width * height
        file = SceneFile(path, defines)
        file.set_sampler("multijitter")
        # An image by other sources does not judge these
        made_by = f"{file.fingerprint()[:16]}-{machine.sources(SOURCES)}"
        cached = references.default_cache() / f"direct-{name}-{made_by}.exr"
        self.scene = file.load()
        if not cached.exists():
            self._make_reference(cached)
        self.reference = references.read(cached)
        # Exclude emitters: errors at their edges, a thousand times brighter than the surroundings, dominate otherwise
        shown = np.array(mi.render(self.scene, integrator=plugin("path", max_depth=1), spp=256, seed=0))
        self.lit = shown[..., :3].max(-1) == 0

    def _make_reference(self, file: Path) -> None:
        """Write the mean of independent renders and its standard error."""
        batches, fine = references.Batches(), plugin("adaptivedirect", error=REFERENCE_ERROR, max_passes=30)
        for seed in range(1000, 1000 + REFERENCE_RENDERS):
            image = np.array(mi.render(self.scene, integrator=fine, spp=RAYS, seed=seed), np.float64)
            batches = batches.with_batch(image[..., :3], RAYS)
        file.parent.mkdir(parents=True, exist_ok=True)
        batches.write(file, {"integrator": "adaptivedirect", "error": REFERENCE_ERROR, **machine.software()})

    def errors(self, image) -> dict:
        """Errors as of ``metrics.compare``, over pixels without emitters, corrected for the reference's noise."""
        known = self.reference
        parts = (x[self.lit][None] for x in (np.array(image, np.float64)[..., :3], known.image, known.standard_error))
        return compare(*parts)

    def race(self, ours: str, methods: dict) -> dict:
        """Render with {label: (plugin, properties, samples)}; runs of ``ours`` are interleaved and come last. Returns
        {label: :class:`Raced`}."""
        for kind, more, samples in methods.values():
            # Kernels of Mitsuba's integrators depend on the number of samples
            few = samples if kind in ("direct", "path") else 2
            usual = plugin(kind, **{k: v for k, v in more.items() if k != "error"})
            with method(kind):
                mi.render(self.scene, integrator=usual, spp=few)
        found = {label: [] for label in methods}
        others = [label for label in methods if label != ours]
        turns = [x for k, other in enumerate(others) for x in ((ours, other) if k % 2 == 0 else (other,))]
        for number, label in enumerate([*turns, ours]):
            kind, more, samples = methods[label]
            integrator = plugin(kind, **more)
            with method(kind):
                image, seconds = scenes.timed(
                    lambda: mi.render(self.scene, integrator=integrator, spp=samples, seed=number)  # noqa: B023
                )
            rays = getattr(integrator, "statistics", {}).get("shadow_rays", 0) / self.pixels
            found[label].append((seconds, self.errors(image), rays))
        return {label: Raced.of(runs) for label, runs in found.items()}


def plugin(name: str, **more):
    """Integrator for direct light."""
    return mi.load_dict({"type": name.split(",")[0], **more})


def method(name: str):
    """Context in which the plugin of this name renders by the intended method."""
    return as_printed() if name == PRINTED else nullcontext()


def table(names, options) -> Iterator[dict]:
    """Part "table"."""
    rows: dict = {}
    print(f"\n## at the same rule, error {100 * options.error:g}%, {RAYS} camera rays, width {options.width}, warm")
    print(
        "scene | adaptive: s, rays/px, relMSE | unoccluded: s, rays/px, relMSE | faster | fewer rays | at equal relMSE:"
        " unoccluded | all | direct | path"
    )
    methods = {
        "adaptive": ("adaptivedirect", {"error": options.error}, RAYS),
        "unoccluded": ("unoccludeddirect", {"error": options.error}, RAYS),
        "all": ("adaptivedirect", {"error": options.error, "lights": "all", "time": 15.0}, RAYS),
        "direct": ("direct", {"emitter_samples": 1, "bsdf_samples": 1}, options.spp),
        "path": ("path", {"max_depth": 2}, options.spp),
    }
    chosen = {label: method for label, method in methods.items() if label in ("adaptive", *options.against)}
    ratios = {label: [] for label in ("faster", "fewer", *AGAINST)}
    for name in names:
        found = Problem(name, options.width).race("adaptive", chosen)
        ours = found["adaptive"]
        times = {label: ours.times_of(one) for label, one in found.items()}
        slower = {label: value for label, value in times.items() if value is not None}
        rows[name] = {label: _row(one, slower.get(label)) for label, one in found.items()}
        if other := found.get("unoccluded"):
            slower |= {"faster": other.seconds / ours.seconds, "fewer": other.rays / ours.rays}
            rows[name]["same rule"] = {"speedup": slower["faster"], "fewer_rays": slower["fewer"]}
        for label in ratios.keys() & slower.keys():
            ratios[label].append(slower[label])
        columns = [str(found.get(label, "-")) for label in ("adaptive", "unoccluded")]
        columns += [f"{slower[label]:.1f}" if label in slower else "-" for label in ratios]
        print(f"{name} | {' | '.join(columns)}", flush=True)
        yield rows
    means = {label: f"{geometric_mean(values):.1f}" for label, values in ratios.items() if values}
    print("geometric means:", ", ".join(f"{label} {value}" for label, value in means.items()))


def _row(found: Raced, speedup: float | None) -> dict:
    """Quantities of a race and the speed-up, if it is known, for a result file."""
    return found._asdict() | ({} if speedup is None else {"speedup": speedup})


def _ratio_text(ratio: float | None, digits: int) -> str:
    return "-" if ratio is None else f"{ratio:.{digits}f}"


def departures(names, options) -> Iterator[dict]:
    """Part "paper": what the departures from the paper bring."""
    rows: dict = {}
    print("\n## the method as printed, and with what was changed, at the same rule")
    print("scene | ours: s, rays/px, relMSE, bias | as printed: s, rays/px, relMSE, bias | ours at equal relMSE: times")
    for name in names:
        problem = Problem(name, options.width)
        rule = {"error": options.error, "lights": "clusters"}
        methods = {
            "ours": ("adaptivedirect", rule, RAYS),
            "printed": (PRINTED, rule, RAYS),
        }
        found = problem.race("ours", methods)
        bias = {}
        for label, (kind, more, samples) in methods.items():
            with method(kind):
                image = np.array(mi.render(problem.scene, integrator=plugin(kind, **more), spp=samples, seed=7))
            bias[label] = 100 * (image.mean() / problem.reference.image.mean() - 1)
        columns = [f"{found[label]}, {bias[label]:+.2f}%" for label in ("ours", "printed")]
        ratio = found["ours"].times_of(found["printed"])
        rows[name] = {label: one._asdict() | {"bias": bias[label] / 100} for label, one in found.items()}
        rows[name] |= {} if ratio is None else {"speedup": ratio}
        print(f"{name} | {columns[0]} | {columns[1]} | {_ratio_text(ratio, 1)}", flush=True)
        yield rows


def number_of_lights(options) -> Iterator[dict]:
    """Part "lights"."""
    rows: dict = {}
    print(f"\n## the hall with N lights: error {100 * options.error:g}% (compared with renders of 1% and 64 rays)")
    print("lights | load s | auto: s, rays/px, relMSE | all: s, rays/px, relMSE | time to equal relMSE, all / auto")
    for count in (100, 1000, 10_000, 100_000):
        with tempfile.TemporaryDirectory() as folder:
            file = str(Path(folder) / "hall.xml")
            generator = str(scenes.PROJECT / "scenes" / "hall.py")
            subprocess.run([sys.executable, generator, "--lights", str(count), "--output", file], check=True)
            scene, load = scenes.timed(lambda: mi.load_file(file, resx=options.width, resy=options.width * 9 // 16))  # noqa: B023
        fine = plugin("adaptivedirect", error=0.01, max_passes=40)
        exact = np.mean([np.array(mi.render(scene, integrator=fine, spp=64, seed=k), np.float64) for k in (8, 9)], 0)
        pixels = exact.shape[0] * exact.shape[1]
        found = {}
        for lights in ("auto", "all"):
            if lights == "all" and count > 10_000:
                continue
            integrator = plugin("adaptivedirect", error=options.error, lights=lights)
            mi.render(scene, integrator=integrator, spp=RAYS, seed=1)
            image, seconds = scenes.timed(lambda: mi.render(scene, integrator=integrator, spp=RAYS, seed=0))  # noqa: B023
            rays = integrator.statistics["shadow_rays"] / pixels
            found[lights] = Raced.of([(seconds, compare(np.array(image, np.float64), exact), rays)])
        shown = [str(found.get(lights, "-")) for lights in ("auto", "all")]
        rows[count] = {"load_seconds": load} | {lights: one._asdict() for lights, one in found.items()}
        ratio = found["auto"].times_of(found["all"]) if "all" in found else None
        rows[count] |= {} if ratio is None else {"speedup": ratio}
        print(f"{count} | {load:.1f} | {shown[0]} | {shown[1]} | {_ratio_text(ratio, 2)}", flush=True)
        yield rows


_COLD = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import integrators
from benchmarks import scenes
scene = mi.load_file({file!r}, resx=256, resy=144)
integrator = mi.load_dict({plugin!r})
print(scenes.timed(lambda: mi.render(scene, integrator=integrator, spp=1, seed=0))[1])
print(scenes.timed(lambda: mi.render(scene, integrator=integrator, spp=1, seed=1))[1])
"""


def cold_starts(options) -> Iterator[dict]:
    """Part "cold"."""
    rows: dict = {}
    print("\n## first render in a fresh process with an empty kernel cache, and the second (1 sample a pixel)")
    print("scene | adaptivedirect: first s, second s | path: first s, second s")
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for count in (100, 1000, 10_000):
            files[f"hall, {count} lights"] = str(Path(folder) / f"hall{count}.xml")
            generator = str(scenes.PROJECT / "scenes" / "hall.py")
            command = [sys.executable, generator, "--lights", str(count), "--output", files[f"hall, {count} lights"]]
            subprocess.run(command, check=True)
        for name in scenes.available(["everything8003"]):
            files[name] = str(scenes.scene_file(name))
        for name, file in files.items():
            shown = []
            for kind in ("adaptivedirect", "path"):
                with tempfile.TemporaryDirectory() as cache:
                    code = _COLD.format(file=file, plugin={"type": kind, "max_depth": 2})
                    first, second = scenes.numbers_of(code, cache, 2)
                shown.append(f"{first:.1f}, {second:.1f}")
                rows.setdefault(name, {})[kind] = {"seconds": first, "second_seconds": second}
            print(f"{name} | {shown[0]} | {shown[1]}", flush=True)
            yield rows


def main() -> None:
    """Parse the command line and run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(NAMES), choices=NAMES)
    results.add_options(parser, ["table", "paper", "lights", "cold"])
    parser.add_argument("--against", nargs="+", default=list(AGAINST), choices=AGAINST, help="columns of part table")
    parser.add_argument(
        "--error", type=positive(float), default=0.03, help="the rule of parts table and paper (default: 0.03)"
    )
    parser.add_argument("--width", type=positive(int), default=128, help="pixels (default: 128)")
    parser.add_argument(
        "--spp", type=positive(int), default=256, help="samples a pixel of direct and path (default: 256)"
    )
    options = results.parse(parser)
    names = scenes.available(options.scenes)
    parts = {
        "table": lambda: table(names, options),
        "paper": lambda: departures(names, options),
        "lights": lambda: number_of_lights(options),
        "cold": lambda: cold_starts(options),
    }
    settings = {"error": options.error, "width": options.width, "camera_rays": RAYS, "samples": options.spp}
    results.run_parts(options, parts, settings)


if __name__ == "__main__":
    main()
