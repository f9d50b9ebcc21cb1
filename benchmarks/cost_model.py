"""Sensitivity of ``manylights`` to the constants of its cost model: each one halved and doubled.

    python benchmarks/cost_model.py                                        all constants, five scenes, an hour
    python benchmarks/cost_model.py --constants shared carried --passes 6  two constants

Prints variance × CPU seconds over that with the default value, scene by scene, with geometric means.  Below 1: the
other value is better.  "=": the images are the same, so the constant decides nothing there.  Each constant renders in
turn with the default, with the same seeds, after a render that compiles its kernels.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from benchmarks.rivals import DEPTH, TRIMMED  # noqa: E402
from vpl.split.cost_model import CostModel  # noqa: E402

# Rooms with one and with many emitters, noisy and smooth indirect light
NAMES = ("kitchen", "staircase2", "veach_ajar", "everything8003", "living_room")
FACTORS = (0.5, 2.0)
# Errors are part of their definition, and the size of a pilot is bounded by its time
FIXED = ("trimmed", "black")
LARGEST_DIFFERENCE = 1e-4


class Measured:
    """Images and CPU seconds of a scene with a cost model."""

    def __init__(self, scene, model: CostModel, spp: int):
        self._scene, self._spp, self.images, self.seconds = scene, spp, [], []
        self._integrator = mi.load_dict({"type": "manylights", "max_depth": DEPTH})
        self._integrator.cost_model = model
        self._render(0)

    def _render(self, seed: int) -> np.ndarray:
        image = mi.render(self._scene, integrator=self._integrator, spp=self._spp, seed=seed)
        return np.array(image, np.float64)[..., :3]

    def add(self, seed: int) -> None:
        """Render one more image."""
        dr.sync_thread()
        start = time.process_time()
        image = self._render(seed)
        self.seconds.append(time.process_time() - start)
        self.images.append(image)

    def product(self, scale: np.ndarray) -> float:
        """Relative variance between images × median CPU seconds."""
        error = np.sort((np.var(self.images, axis=0, ddof=1) / scale).mean(-1).ravel())
        return error[: int(len(error) * (1 - TRIMMED))].mean() * float(np.median(self.seconds))


def ratio(scene, name: str, factor: float, spp: int, passes: int) -> float | None:
    """Variance × time with a constant times ``factor``, over that with the default; None if the images are the same."""
    default = CostModel()
    value = getattr(default, name) * factor
    value = max(round(value), 1) if isinstance(getattr(default, name), int) else value
    rivals = [Measured(scene, model, spp) for model in (default, replace(default, **{name: value}))]
    for seed in range(1, passes + 1):
        for rival in rivals:
            rival.add(seed)
        usual, other = (rival.images[-1] for rival in rivals)
        if seed == 1 and np.abs(usual - other).max() <= LARGEST_DIFFERENCE * usual.mean():
            return None
    mean = np.mean([image for rival in rivals for image in rival.images], axis=0)
    scale = mean**2 + 0.01 * mean.mean() ** 2
    usual, other = (rival.product(scale) for rival in rivals)
    return float(other / usual)


def main() -> None:
    """Measure the constants that are asked for."""
    names = [one.name for one in fields(CostModel) if one.name not in FIXED]
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--constants", nargs="+", default=names, choices=names, metavar="NAME")
    parser.add_argument("--scenes", nargs="+", default=list(NAMES), metavar="NAME")
    parser.add_argument("--width", type=int, default=128, help="width in pixels (default: 128)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel (default: 64)")
    parser.add_argument("--passes", type=int, default=4, help="images with each value (default: 4)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the ratios to a result file")
    options = parser.parse_args()
    available = scenes.available(options.scenes)
    if not available:
        parser.error("--scenes names no scene that is present")
    found = {name: scenes.load(name, options.width) for name in available}
    print(f"{'constant':24s}" + "".join(f"{name[:11]:>24s}" for name in found) + f"{'geometric mean':>20s}")
    rows: dict = {}
    for constant in options.constants:
        columns = {}
        for name, scene in found.items():
            columns[name] = [ratio(scene, constant, factor, options.spp, options.passes) for factor in FACTORS]
        means = [scenes.geometric_mean([pair[k] or 1.0 for pair in columns.values()]) for k in range(len(FACTORS))]
        cells = [" / ".join("=" if x is None else f"{x:.2f}" for x in pair) for pair in (*columns.values(), means)]
        print(f"{constant:24s}" + "".join(f"{cell:>24s}" for cell in cells[:-1]) + f"{cells[-1]:>20s}", flush=True)
        rows[constant] = {
            f"times {factor:g}": {"product_ratio": mean} for factor, mean in zip(FACTORS, means, strict=True)
        }
        if options.json:
            settings = {"width": options.width, "samples": options.spp, "passes": options.passes, "scenes": list(found)}
            results.write_results(options.json, "cost_model", settings, rows)


if __name__ == "__main__":
    main()
