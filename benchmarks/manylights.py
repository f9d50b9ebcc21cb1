"""``manylights`` against ``path``: variance × time, raw and denoised, first renders, memory, spread between light sets.

    python benchmarks/manylights.py                                      all parts, all scenes
    python benchmarks/manylights.py --parts product --scenes kitchen     one part, one scene
    python benchmarks/manylights.py --parts product --views 2            from two random cameras of each scene

Each part runs both integrators in turn, ``path`` with the better of the samplers ``independent`` and ``multijitter``,
in ``product`` also ``manylights``.

- ``product``: variance between passes × seconds of a pass.  Variance is relative to the squared reference (without
  reference: mean of all passes) plus a hundredth of its squared mean, without the worst 0.1% of the pixels.  The
  product is proportional to the time for a given error.  Bias: excess of the mean over that of ``path``, with its
  standard error.  Plain: the ratio of the variances of all pixels.  Sets: spread of the mean of the image between
  passes, each of which has its own light set.
- ``denoised``: error of ``--passes`` denoised images, and the time of ``path`` for equal error, see
  :mod:`benchmarks.denoised`.  Without ``--scenes``, of the scenes with a reference.
- ``timed``: variance × time of ``--passes`` images of ``--seconds``.  Those of ``manylights`` are ended by
  ``manylights.render``, with their pilots and first passes, and have its own stratified samples.  Those of ``path``
  have its better sampler in a single pass, which stratifies best.  Kernels are compiled before.
- ``cost``: CPU seconds of a sample over those of ``path``, see :mod:`benchmarks.sample_cost`; alone and without
  ``--scenes``, also in scenes where virtual lights gain little.
- ``classes``: shares of classes of light in the variance, see :mod:`benchmarks.noise_classes`.
- ``lights``: variance × time of ``manylights`` with fewer and more light paths than it chooses.
- ``cold``: seconds and peak memory of the first render of a process, 16 samples per pixel, with an empty kernel cache;
  seconds with the kernels of another scene.
"""

from __future__ import annotations

import argparse
import functools
import shutil
import sys
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from statistics import geometric_mean

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import denoised, noise_classes, results, sample_cost, scenes  # noqa: E402
from benchmarks.rivals import DEPTH, KINDS, SAMPLERS, Rival, Timed, Whole, load, measure_in_turn  # noqa: E402
from benchmarks.views import move_cameras  # noqa: E402
from comparison.command_line import positive  # noqa: E402

NAMES = (*scenes.NAMES, "classroom", "hall")
# Scenes where virtual lights gain little: leaves, equal emitters, gloss, masks, lamps in glass, no noise
HARD = ("foliage", "lamp_grid", "glossy", "veils", "globes", "furnace")
# Parts that measure the variance between passes
BETWEEN = ("product", "timed", "classes", "lights")
PARTS = ("product", "timed", "denoised", "cost", "classes", "lights", "cold")
# Light paths, as multiples of the chosen number
SWEEP = (1 / 4, 1 / 2, 1, 2, 4)
COLD_SPP = 16
# Scene whose kernels are in the cache when another scene is new, and the one for cornell itself
BEFORE, BEFORE_ITSELF = "cornell", "glossy"
_COLD = """
import resource, sys, time
start = time.perf_counter()
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr, integrators
from benchmarks import scenes
scene = scenes.load(sys.argv[2], int(sys.argv[3]))
begin = time.perf_counter()
plugin = mi.load_dict({"type": sys.argv[1], "max_depth": 6})
image = mi.render(scene, integrator=plugin, spp=int(sys.argv[4]))
dr.eval(image); dr.sync_thread()
print(time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


def scale_of(name: str, images: list, width: int, view: int = 0) -> np.ndarray:
    """What squared errors are relative to."""
    known = None if view else scenes.reference_at(name, width)
    return scenes.scale_of_truth(known[0] if known else np.mean(images, axis=0))


def product(names, width: int, seconds: float, passes: int, views: int) -> Iterator[dict]:
    """Print variance × time and the ratio, from the cameras of the scenes or from ``views`` random cameras of each."""
    print(f"product, {width} wide, {passes} passes of about {seconds:g} s; variance × time, with samples of a pass")
    print(f"{'scene':18s} {'path':>22s} {'manylights':>22s}   ratio   plain   bias                sets")
    rows = {}
    for name in names:
        for view in range(1, views + 1) if views else (0,):
            rows[f"{name} {view}" if view else name] = product_of(name, width, seconds, passes, view)
            yield rows
    print_mean(rows)


def print_mean(rows: dict, speedup: str = "speedup", of: str = "") -> None:
    """Print the geometric mean and the least of the speedups, a key of the rows; ``of``: description."""
    ratios = [row[speedup] for row in rows.values()]
    if ratios:
        print(f"{of}geometric mean {geometric_mean(ratios):.2f}, worst {min(ratios):.2f}")


def best_of(rivals: list, scale: np.ndarray) -> dict:
    """The rival with the least variance × time of each integrator, by name."""
    return {kind: min((r for r in rivals if r.kind == kind), key=lambda r: r.product(scale)) for kind in KINDS}


def outcome(best: dict, scale: np.ndarray) -> tuple[dict, list[str]]:
    """(Row of the result file, columns for print) of the best rivals."""
    values = {kind: float(best[kind].product(scale)) for kind in KINDS}
    row = {kind: {"product": values[kind], "samples": best[kind].samples} for kind in KINDS}
    columns = [f"{values[kind]:.4g} ({best[kind].samples}, {best[kind].sampler[:5]})" for kind in KINDS]
    return row | {"speedup": values["path"] / values["manylights"]}, columns


def product_of(name: str, width: int, seconds: float, passes: int, view: int) -> dict:
    """Print variance × time of a scene, from a random camera where ``view`` is not 0; returns the row."""
    scene = load(name, width)
    if view:
        move_cameras(scene, view)
    rivals = [Rival(name, scene, kind, sampler, width, seconds) for kind in KINDS for sampler in SAMPLERS]
    measure_in_turn(rivals, passes)
    scale = scale_of(name, [image for rival in rivals for image in rival.images], width, view)
    best = best_of(rivals, scale)
    row, columns = outcome(best, scale)
    plain = best["path"].product(scale, 0) / best["manylights"].product(scale, 0)
    (ours, error), (theirs, their_error) = best["manylights"].mean(), best["path"].mean()
    sets = np.std([image.mean() for image in best["manylights"].images], ddof=1) / ours
    label = f"{name} {view}" if view else name
    excess, uncertain = ours / theirs - 1, np.hypot(error / ours, their_error / theirs)
    print(
        f"{label:18s} {columns[0]:>22s} {columns[1]:>22s} {row['speedup']:7.2f} {plain:7.2f}   "
        f"{excess:+.2%} ± {uncertain:.2%}{sets:12.2%}   {best['manylights'].integrator.statistics.get('plan')}",
        flush=True,
    )
    more = {
        "plain_speedup": plain,
        "bias": excess,
        "bias_deviation": uncertain,
        "set_deviation": sets,
    }
    return row | {quantity: float(value) for quantity, value in more.items()}


def timed(names, width: int, seconds: float, passes: int) -> Iterator[dict]:
    """Print variance × time of images of equal time, and the ratio."""
    print(f"timed, {width} wide, {passes} images of {seconds:g} s; variance × time, with samples of an image")
    rows = {}
    for name in names:
        rows[name] = timed_of(name, width, seconds, passes)
        yield rows
    print_mean(rows)


def timed_of(name: str, width: int, seconds: float, passes: int) -> dict:
    """Print variance × time of images of equal time of a scene; returns the row.

    A function of its own, whose end frees the scene: kernels hold the code of all scenes that are alive.
    """
    scene = load(name, width)
    rivals = [Whole(name, scene, "path", sampler, width, seconds) for sampler in SAMPLERS]
    # manylights stratifies the samples of this sampler
    rivals.append(Timed(scene, "manylights", "independent", seconds))
    measure_in_turn(rivals, passes)
    scale = scale_of(name, [image for rival in rivals for image in rival.images], width)
    row, columns = outcome(best_of(rivals, scale), scale)
    for rival in rivals[: len(SAMPLERS)]:
        row[rival.sampler] = {"product": float(rival.product(scale)), "samples": rival.samples}
    print(f"{name:18s}" + "".join(f"{column:>22s}" for column in columns) + f"{row['speedup']:8.2f}", flush=True)
    return row


def with_references(names: list[str]) -> list[str]:
    """The scenes with a reference; prints the others."""
    missing = [name for name in names if scenes.reference_file(name) is None]
    print(f"skipped without a reference: {', '.join(missing) or 'none'}")
    return [name for name in names if name not in missing]


def denoised_part(names, width: int, seconds: float, passes: int) -> Iterator[dict]:
    """Print the denoised errors, and the time of ``path`` for those of ``manylights`` over their time."""
    rows: dict = {}
    for rows in denoised.compare(names, width, seconds, passes):
        yield rows
    print_mean(rows)
    print_mean(rows, "independent_speedup", "with the sampler independent: ")


def lights(names, width: int, seconds: float, passes: int) -> Iterator[dict]:
    """Print variance × time with fewer and more light paths than chosen, over that with the chosen number."""
    rows = {}
    print(f"lights, {width} wide: variance × time with so many times the light paths, over that with those chosen")
    print(" " * 16 + "".join(f"{factor:8.2g}" for factor in SWEEP))
    for name in names:
        scene = load(name, width)
        rivals = [Rival(name, scene, "manylights", "multijitter", width, seconds, factor) for factor in SWEEP]
        measure_in_turn(rivals, passes)
        scale = scale_of(name, [image for rival in rivals for image in rival.images], width)
        products = np.array([rival.product(scale) for rival in rivals])
        chosen = SWEEP.index(1)
        number = rivals[chosen].integrator.statistics.get("light_paths", 0)
        ratios = "".join(f"{ratio:8.2f}" for ratio in products / products[chosen])
        print(f"{name:16s}{ratios}   chosen: {number} for {rivals[chosen].spp} samples", flush=True)
        rows[name] = {"light_paths": number, "samples": rivals[chosen].spp} | {
            f"times {Fraction(factor)}": {"product_ratio": float(value)}
            for factor, value in zip(SWEEP, products / products[chosen], strict=True)
            if factor != 1
        }
        yield rows


def cold(names, width: int) -> Iterator[dict]:
    """Print seconds and peak memory of first renders of a process with an empty kernel cache, and seconds with the
    kernels of another scene."""
    rows = {}
    print(f"cold, {width} wide, {COLD_SPP} samples: seconds of the first render, peak GiB; seconds after another scene")
    for name in names:
        before = BEFORE_ITSELF if name == BEFORE else BEFORE
        rows[name] = {}
        for kind in KINDS:
            with tempfile.TemporaryDirectory() as cache:
                seconds, memory = first_render(kind, name, width, cache)
            with tempfile.TemporaryDirectory() as cache:
                shutil.copytree(cache_after(kind, before, width).name, cache, dirs_exist_ok=True)
                later, _ = first_render(kind, name, width, cache)
            rows[name][kind] = {"seconds": seconds, "memory": memory, "new_scene_seconds": later}
        theirs, ours = (rows[name][kind] for kind in KINDS)
        columns = [
            f"{kind} {row['seconds']:5.1f} s, {row['memory']:.2f}; {row['new_scene_seconds']:5.1f} s"
            for kind, row in rows[name].items()
        ]
        states = {"seconds": "empty cache", "new_scene_seconds": "new scene"}
        above = [state for key, state in states.items() if ours[key] > 2 * theirs[key] + 1]
        within = f"  above 2 × path + 1 s: {', '.join(above)}" if above else ""
        print(f"{name:16s} {'; '.join(columns)}{within}", flush=True)
        yield rows


@functools.cache
def cache_after(kind: str, name: str, width: int) -> tempfile.TemporaryDirectory:
    """Kernel cache after the first render of a scene."""
    folder = tempfile.TemporaryDirectory()
    first_render(kind, name, width, folder.name)
    return folder


def first_render(kind: str, name: str, width: int, cache: str) -> tuple[float, float]:
    """(Seconds, peak GiB) of the first render of a scene in a new process, with the kernels in the folder ``cache``."""
    seconds, memory = scenes.numbers_of(_COLD, cache, 2, kind, name, width, COLD_SPP)
    return seconds, memory


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    results.add_options(parser, PARTS)
    parser.add_argument("--scenes", nargs="+", metavar="NAME")
    parser.add_argument("--width", type=positive(int), default=256, metavar="PIXELS")
    parser.add_argument(
        "--seconds", type=positive(float), default=2.5, help="of one pass, or image, about (default: 2.5)"
    )
    parser.add_argument("--passes", type=positive(int), default=6, help="of each (default: 6)")
    parser.add_argument("--views", type=int, default=0, help="how many other cameras the product is of (default: none)")
    options = results.parse(parser)
    between = [part for part in options.parts if part in BETWEEN]
    least = 2 if between else 1
    if options.passes < least:
        of_parts = f" for {', '.join(between)}" if between else ""
        parser.error(f"--passes is {options.passes}: allowed are {least} and above{of_parts}")
    if options.views < 0:
        parser.error(f"--views is {options.views}: allowed are 0 and above")
    usual = (*NAMES, *HARD) if options.parts == ["cost"] else NAMES
    names = scenes.available(options.scenes or usual)
    width, seconds, passes = options.width, options.seconds, options.passes
    parts = {
        "product": lambda: product(names, width, seconds, passes, options.views),
        "timed": lambda: timed(names, width, seconds, passes),
        "denoised": lambda: denoised_part(names if options.scenes else with_references(names), width, seconds, passes),
        "cost": lambda: sample_cost.cost(names, width, passes),
        "classes": lambda: noise_classes.classes(names, width, passes),
        "lights": lambda: lights(names, width, seconds, passes),
        "cold": lambda: cold(names, width),
    }
    settings = {"width": width, "seconds": seconds, "passes": passes, "max_depth": DEPTH}
    results.run_parts(options, parts, settings)


if __name__ == "__main__":
    main()
