"""Sensitivity of ``manylights`` to the constants of its cost model: each one halved and doubled.

    python benchmarks/cost_model.py                                         all constants, five scenes, an hour
    python benchmarks/cost_model.py --constants shared ray_cost --passes 6  two constants

Prints variance × CPU seconds over that with the default value, scene by scene, with geometric means.  Below 1: the
other value is better.  "=": all images are the same, so the constant decides nothing there.  The row "default" repeats
the defaults and shows the spread of the times.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from statistics import geometric_mean

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from benchmarks.rivals import DEPTH, trimmed_variance  # noqa: E402
from comparison.command_line import positive  # noqa: E402
from vpl.split.cost_model import CostModel  # noqa: E402

# Rooms with one and with many emitters, noisy and smooth indirect light
NAMES = ("kitchen", "staircase2", "veach_ajar", "everything8003", "living_room")
FACTORS = (0.5, 2.0)
# Parts of the definition of the error, and constants of denoised images
FIXED = (
    "trimmed", "black", "shared", "pilot_share", "small_pilot", "c_per_spacing", "root_from", "most_pilot_rays",
    "spread", "noise_of_lights", "chosen_ray_cost", "samples_power", "emitter_samples_from",
)  # fmt: skip
# Of a pixel, relative to the mean of the image: twice the rounding of sums over threads is far below
LARGEST_DIFFERENCE = 1e-4


class Measured:
    """Images of a scene with a cost model, their CPU seconds."""

    def __init__(self, scene, model: CostModel, spp: int, passes: int):
        self.images, self.seconds = [], []
        integrator = mi.load_dict({"type": "manylights", "max_depth": DEPTH})
        integrator.cost_model = model
        for seed in range(passes + 1):
            render = partial(mi.render, scene, integrator=integrator, spp=spp, seed=seed)
            image, spent = scenes.timed(render, time.process_time)
            # The first render compiles
            if seed:
                self.images.append(np.array(image, np.float64)[..., :3])
                self.seconds.append(spent)

    def product(self, scale: np.ndarray) -> float:
        """Relative variance between images × median CPU seconds."""
        return trimmed_variance(self.images, scale) * float(np.median(self.seconds))


def ratios_of(name: str, constants: list[str], options) -> dict:
    """Variance × time with each constant times FACTORS over that with the defaults; None where the images are the same.

    The key "default" repeats the defaults: its ratio shows the spread of the times.
    """
    scene, default, found = scenes.load(name, options.width), CostModel(), {}
    # The first renders of a process are slower: memory is new
    Measured(scene, default, options.spp, 1)
    usual = Measured(scene, default, options.spp, options.passes)
    mean = np.mean(usual.images, axis=0)
    scale = mean**2 + default.black * mean.mean() ** 2
    for constant in ["default", *constants]:
        pair = []
        for factor in FACTORS:
            changed = {} if constant == "default" else {constant: scaled(default, constant, factor)}
            other = Measured(scene, replace(default, **changed), options.spp, options.passes)
            difference = max(np.abs(x - y).max() for x, y in zip(usual.images, other.images, strict=True))
            is_same = difference <= LARGEST_DIFFERENCE * mean.mean() and constant != "default"
            pair.append(None if is_same else float(other.product(scale) / usual.product(scale)))
        found[constant] = pair
        print(
            f"{name:16s}{constant:24s}" + "".join(f"{'=' if x is None else f'{x:.2f}':>8s}" for x in pair), flush=True
        )
    return found


def scaled(model: CostModel, name: str, factor: float):
    """A constant times a factor, at most its largest valid value; integers stay integers of at least 1."""
    value, most = getattr(model, name) * factor, {one.name: one.metadata["most"] for one in fields(model)}[name]
    return max(round(value), 1) if isinstance(getattr(model, name), int) else min(value, most)


def row_of(pair: list) -> dict:
    """Row of a result file, of the ratios with half and double the value; 1 where the images are the same."""
    return {name: {"product_ratio": ratio or 1.0} for name, ratio in zip(("half", "double"), pair, strict=True)}


def main() -> None:
    """Measure the constants that are asked for."""
    names = [one.name for one in fields(CostModel) if one.name not in FIXED]
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--constants", nargs="+", default=names, choices=names, metavar="NAME")
    parser.add_argument("--scenes", nargs="+", default=list(NAMES), metavar="NAME")
    parser.add_argument("--width", type=positive(int), default=128, help="width in pixels (default: 128)")
    parser.add_argument("--spp", type=positive(int), default=64, help="samples per pixel (default: 64)")
    parser.add_argument("--passes", type=positive(int), default=4, help="images with each value (default: 4)")
    results.add_json_option(parser)
    options = results.parse(parser)
    available = scenes.available(options.scenes)
    if not available:
        parser.error("--scenes names no scene that is present")
    # One scene at a time, because kernels hold the code of all scenes that are alive
    found = {name: ratios_of(name, options.constants, options) for name in available}
    rows: dict = {}
    print(f"\n{'geometric means':24s}" + "".join(f"{'× ' + format(factor, 'g'):>8s}" for factor in FACTORS))
    for constant in ["default", *options.constants]:
        pairs = [of_scene[constant] for of_scene in found.values()]
        means = [geometric_mean([pair[k] or 1.0 for pair in pairs]) for k in range(len(FACTORS))]
        print(f"{constant:24s}" + "".join(f"{mean:8.2f}" for mean in means))
        rows[constant] = row_of(means) | {name: row_of(of_scene[constant]) for name, of_scene in found.items()}
    if options.json:
        settings = {"width": options.width, "samples": options.spp, "passes": options.passes, "scenes": list(found)}
        results.write_results(options.json, "cost_model", settings, rows)


if __name__ == "__main__":
    main()
