"""`manylights` against `path`: variance × time, raw and denoised, first renders, memory, and how sets of lights differ.

    python benchmarks/manylights.py                                      all parts, all scenes
    python benchmarks/manylights.py --parts product --scenes kitchen     some
    python benchmarks/manylights.py --parts product --views 2            from other cameras, at random

Parts, each with both integrators in turn in one run, and with the better of the samplers `independent` and
`multijitter` for each:

- ``product``: variance between passes, relative to the squared reference (where there is none, the mean of all passes)
  plus a hundredth of its squared mean, without the worst 0.1% of the pixels; times seconds it tells the time for an
  error, however long one renders.  Bias: excess of the mean over that of `path`, with its standard error.  Sets: how
  much the mean of the image differs from pass to pass, each with lights of its own.
- ``denoised``: error of one pass through Open Image Denoise against the reference, its noise taken off; the time of
  `path` for the same error, from passes of growing size.
- ``timed``: variance × time of images that `manylights.render` ends after so many ``--seconds``, first passes included,
  with the sampler `independent`; so many images as ``--passes`` says, with seeds of their own.
- ``lights``: variance × time of `manylights` with fewer and more light paths than it chooses.
- ``cold``: seconds of the first render, 16 samples a pixel, with an empty kernel cache, and peak memory, whole process.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import scenes  # noqa: E402
from benchmarks.views import move_cameras  # noqa: E402
from comparison.render import render  # noqa: E402
from vpl.split import balance, decision  # noqa: E402

NAMES = (*scenes.NAMES, "classroom", "hall")
KINDS, SAMPLERS = ("path", "manylights"), ("independent", "multijitter")
PARTS = ("product", "timed", "denoised", "lights", "cold")
# Light paths, as multiples of what is chosen
SWEEP = (1 / 4, 1 / 2, 1, 2, 4)
DEPTH, TRIMMED, COLD_SPP = 6, 0.001, 16
# Samples of one pass, at most: it bounds memory
LARGEST_PASS = 1 << 24
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


def load(name: str, width: int):
    """A scene with a sensor for each of SAMPLERS.

    One scene for all: kernels hold the code of all scenes that are alive, and are recorded at every render.
    """
    gc.collect()
    file = scenes.scene_file(name)
    mi.file_resolver().prepend(str(file.parent))
    text = file.read_text()
    sensor = re.search(r"<sensor.*?</sensor>", text, re.DOTALL).group()
    other = sensor.replace('<sampler type="independent"', f'<sampler type="{SAMPLERS[1]}"')
    # Names may be there once
    other = re.sub(r' id="[^"]*"', "", other)
    text = text.replace(sensor, f"{sensor}\n{other}")
    return mi.load_string(text, resx=str(width), resy=str(scenes.height(name, width)))


@contextmanager
def light_paths_times(factor: float):
    """`manylights` with so many times the light paths that it chooses, as long as the block lasts."""

    def scaled(*arguments):
        chosen = balance.balance(*arguments)
        return replace(chosen, light_paths=round(factor * chosen.light_paths))

    with mock.patch.object(decision, "balance", scaled):
        yield


class Rival:
    """One integrator with one sampler on one scene: its passes, of about the same time; ``light_paths``: as a multiple
    of what it chooses."""

    def __init__(self, name: str, scene, kind: str, sampler: str, width: int, seconds: float, light_paths: float = 1):
        self.kind, self.sampler, self.images, self.seconds, self.light_paths = kind, sampler, [], [], light_paths
        self.scene, self.sensor = scene, SAMPLERS.index(sampler)
        self.integrator = mi.load_dict({"type": kind, "max_depth": DEPTH})
        # What a pass costs besides its samples is known from two sizes
        most = int((LARGEST_PASS / (width * scenes.height(name, width))) ** 0.5)
        side, times = min(8, most), []
        for self.spp in (16, 16, side**2, side**2):
            times.append(self.render(0)[1])
        each = max(times[-1] - times[1], 0.1 * times[-1]) / max(side**2 - 16, 1)
        wanted = side**2 + (seconds - times[-1]) / each
        if sampler == "multijitter":
            # Squares, as it has them
            self.spp = min(max(round(max(wanted, 16) ** 0.5), 4), most) ** 2
        else:
            self.spp = min(max(round(wanted), 16), most**2)
        self.render(0)

    def render(self, seed: int):
        """(An image, float64, and its seconds)."""
        with light_paths_times(self.light_paths):
            image, seconds = scenes.timed(
                lambda: mi.render(self.scene, sensor=self.sensor, integrator=self.integrator, spp=self.spp, seed=seed)
            )
        return np.array(image, np.float64)[..., :3], seconds

    def measure(self, seed: int) -> None:
        """One more pass."""
        image, seconds = self.render(seed)
        self.images.append(image)
        self.seconds.append(seconds)

    def product(self, scale: np.ndarray) -> float:
        """Variance × seconds of a pass."""
        error = np.var(self.images, axis=0, ddof=1) / scale
        error = np.sort(error.mean(-1).ravel())
        return error[: int(len(error) * (1 - TRIMMED))].mean() * float(np.median(self.seconds))

    def mean(self) -> tuple[float, float]:
        """(Mean of the image, its standard error)."""
        means = [image.mean() for image in self.images]
        return float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(len(means)))


class Timed(Rival):
    """One integrator on one scene, whose images end by time."""

    def __init__(self, scene, kind: str, seconds: float):
        self.kind, self.images, self.seconds, self._wanted = kind, [], [], seconds
        self._scene, self.integrator = scene, mi.load_dict({"type": kind, "max_depth": DEPTH})

    def render(self, seed: int):
        """(An image, float64, and its seconds)."""
        # A render has a seed for each of its passes
        image, took = render(self._scene, self.integrator, time=self._wanted, seed=1000 * seed)
        self.spp = took.spp
        return np.array(image, np.float64)[..., :3], took.seconds


def measure_in_turn(rivals: list[Rival], passes: int) -> None:
    """So many passes more of each, one after the other."""
    for number in range(passes):
        for rival in rivals:
            rival.measure(100 + number)


def reference_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The reference of a scene, 256 pixels wide, and its standard error."""
    bitmap = mi.Bitmap(str(scenes.reference_file(name)))
    names, values = [field.name for field in bitmap.struct_()], np.array(bitmap, np.float64)
    truth, noise = ([names.index(prefix + channel) for channel in "RGB"] for prefix in ("", "se."))
    return values[..., truth], values[..., noise]


def scale_of(name: str, images: list, width: int, view: int = 0) -> np.ndarray:
    """What squared errors are relative to."""
    known = scenes.reference_file(name) and width == 256 and not view
    truth = reference_of(name)[0] if known else np.mean(images, axis=0)
    return truth**2 + 0.01 * truth.mean() ** 2


def product(names, width: int, seconds: float, passes: int, views: int) -> None:
    """Print variance × time of all, and the ratio; from the cameras of the scenes, or from so many other ``views``."""
    print(f"product, {width} wide, {passes} passes of about {seconds:g} s; variance × time, with samples of a pass")
    print(f"{'scene':18s} {'path':>22s} {'manylights':>22s}   ratio   bias                sets")
    numbers = range(1, views + 1) if views else (0,)
    ratios = [product_of(name, width, seconds, passes, view) for name in names for view in numbers]
    print(f"geometric mean {scenes.geometric_mean(ratios):.2f}, worst {min(ratios):.2f}")


def product_of(name: str, width: int, seconds: float, passes: int, view: int) -> float:
    """Print variance × time of a scene, from another camera where ``view`` is not 0: the ratio."""
    scene = load(name, width)
    if view:
        move_cameras(scene, view)
    rivals = [Rival(name, scene, kind, sampler, width, seconds) for kind in KINDS for sampler in SAMPLERS]
    measure_in_turn(rivals, passes)
    scale = scale_of(name, [image for rival in rivals for image in rival.images], width, view)
    best = {kind: min((r for r in rivals if r.kind == kind), key=lambda r: r.product(scale)) for kind in KINDS}
    values = [best[kind].product(scale) for kind in KINDS]
    ratio = values[0] / values[1]
    (ours, error), (theirs, their_error) = best["manylights"].mean(), best["path"].mean()
    sets = np.std([image.mean() for image in best["manylights"].images], ddof=1) / ours
    columns = [
        f"{value:.4g} ({best[kind].spp}, {best[kind].sampler[:5]})" for value, kind in zip(values, KINDS, strict=True)
    ]
    label = f"{name} {view}" if view else name
    excess, uncertain = ours / theirs - 1, np.hypot(error / ours, their_error / theirs)
    print(
        f"{label:18s} {columns[0]:>22s} {columns[1]:>22s} {ratio:7.2f}   {excess:+.2%} ± {uncertain:.2%}"
        f"{sets:12.2%}   {best['manylights'].integrator.statistics.get('balance')}",
        flush=True,
    )
    return ratio


def timed(names, width: int, seconds: float, passes: int) -> None:
    """Print variance × time of images that end by time, and the ratio."""
    print(f"timed, {width} wide, {passes} images of {seconds:g} s; variance × time, with samples of an image")
    ratios = []
    for name in names:
        scene = load(name, width)
        rivals = [Timed(scene, kind, seconds) for kind in KINDS]
        measure_in_turn(rivals, passes)
        scale = scale_of(name, [image for rival in rivals for image in rival.images], width)
        theirs, ours = (rival.product(scale) for rival in rivals)
        ratios.append(theirs / ours)
        columns = (f"{value:.4g} ({rival.spp})" for value, rival in zip((theirs, ours), rivals, strict=True))
        print(f"{name:18s}" + "".join(f"{column:>22s}" for column in columns) + f"{ratios[-1]:8.2f}", flush=True)
    print(f"geometric mean {scenes.geometric_mean(ratios):.2f}, worst {min(ratios):.2f}")


def denoised(names, width: int, seconds: float, passes: int) -> None:
    """Print the error through the denoiser, and how long `path` takes for that of `manylights`."""
    print(f"denoised, {width} wide: error of a pass; what `path` would take for that of manylights over its time")
    ratios = []
    for name in names:
        if scenes.reference_file(name) is None:
            print(f"skipped {name}: it has no reference")
            continue
        ratios.append(denoised_of(name, width, seconds, passes))
    if ratios:
        print(f"geometric mean {scenes.geometric_mean(ratios):.2f}, worst {min(ratios):.2f}")


def denoised_of(name: str, width: int, seconds: float, passes: int) -> float:
    """Print the errors of a scene through the denoiser, and what `path` would take: over the time of manylights."""
    from comparison.denoising import Denoiser

    scene = load(name, width)
    rivals = [Rival(name, scene, kind, "multijitter", width, seconds) for kind in KINDS]
    measure_in_turn(rivals, passes)
    truth, noise = reference_of(name)
    scale = truth**2 + 0.01 * truth.mean() ** 2
    points = {}
    for rival in rivals:
        denoiser = Denoiser(rival.scene)
        clean = [denoiser.denoise(image, ["R", "G", "B"])[..., :3] for image in rival.images]
        error = np.mean([((image - truth) ** 2 - noise**2) / scale for image in clean], axis=0).mean(-1)
        error = np.sort(error.ravel())[int(TRIMMED * error.size) : int((1 - TRIMMED) * error.size)].mean()
        points[rival.kind] = (error, float(np.median(rival.seconds)) + denoiser.filter_seconds)
    (theirs, their_time), (ours, our_time) = (points[kind] for kind in KINDS)
    # Denoised errors fall by 1.37 where samples double
    ratio = their_time * (max(theirs, 1e-9) / max(ours, 1e-9)) ** (np.log(2) / np.log(1.37)) / our_time
    print(
        f"{name:16s} path {theirs:.5f} ({their_time:.2f} s) manylights {ours:.5f} ({our_time:.2f} s) {ratio:7.2f}",
        flush=True,
    )
    return ratio


def lights(names, width: int, seconds: float, passes: int) -> None:
    """Print variance × time with fewer and more light paths than are chosen, next to that with these."""
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


def cold(names, width: int) -> None:
    """Print first renders with an empty kernel cache, and peak memory, each in a process of its own."""
    print(f"cold, {width} wide, {COLD_SPP} samples: seconds of the first render, peak GiB")
    for name in names:
        found = []
        for kind in KINDS:
            with tempfile.TemporaryDirectory() as cache:
                environment = os.environ | {"DRJIT_CACHE_DIR": cache, "PYTHONPATH": str(scenes.PROJECT)}
                command = [sys.executable, "-c", _COLD, kind, name, str(width), str(COLD_SPP)]
                output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
            found.append([float(value) for value in output.split()[-2:]])
        (theirs, their_memory), (ours, our_memory) = found
        within = "" if ours <= 2 * theirs + 1 else "  above 2 × path + 1 s"
        print(
            f"{name:16s} path {theirs:5.1f} s, {their_memory:.2f}; manylights {ours:5.1f} s, {our_memory:.2f}{within}",
            flush=True,
        )


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--scenes", nargs="+", default=list(NAMES), metavar="NAME")
    parser.add_argument("--width", type=int, default=256, metavar="PIXELS")
    parser.add_argument("--seconds", type=float, default=2.5, help="of one pass, or image, about (default: 2.5)")
    parser.add_argument("--passes", type=int, default=6, help="of each (default: 6)")
    parser.add_argument("--views", type=int, default=0, help="how many other cameras the product is of (default: none)")
    options = parser.parse_args()
    if options.views < 0:
        parser.error(f"--views is {options.views}: allowed are 0 and above")
    names = scenes.available(options.scenes)
    if "product" in options.parts:
        product(names, options.width, options.seconds, options.passes, options.views)
    if "timed" in options.parts:
        timed(names, options.width, options.seconds, options.passes)
    if "denoised" in options.parts:
        denoised(names, 256, options.seconds, options.passes)
    if "lights" in options.parts:
        lights(names, options.width, options.seconds, options.passes)
    if "cold" in options.parts:
        cold(names, options.width)


if __name__ == "__main__":
    main()
