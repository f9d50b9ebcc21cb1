"""Loss against time of an optimisation with gradients: images by ``prb``, ``path`` or ``manylights``.

    python benchmarks/gradients.py                                    all scenes, 16 and 64 samples
    python benchmarks/gradients.py --scenes cornell --seconds 10      ten seconds for each optimisation

Every reflectance and every radiance of a scene, constant or bitmap, gets an unknown factor.  The factors start at 0.5,
and Adam brings the image back to that of the scene, where all factors are 1.  In each step one of the integrators
renders the image, with 16 or 64 samples; "no lights" is ``manylights`` without virtual lights.  The derivatives are
always those of ``prb`` with ``--adjoint`` samples.

The table shows the loss after an eighth, a quarter, a half and all of the time: the squared difference of images over
the squared target plus a hundredth of its squared mean.  Both images of that loss are by ``path`` with the same seed,
so most of their noise cancels.  They are rendered while the clock stands still.  Kernels are compiled before.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks import results, scenes  # noqa: E402
from comparison.command_line import positive  # noqa: E402

NAMES = ("cornell", "kitchen", "staircase2", "veach_ajar")
# What renders the images, by the name in the table
PRIMALS = {
    "prb": {"type": "prb"},
    "path": {"type": "path"},
    "manylights": {"type": "manylights"},
    "no lights": {"type": "manylights", "virtual_lights": False},
}
SAMPLES = (16, 64)
DEPTH = 6
PARTS = ("loss",)
# Parts of the time after which the loss is taken
MOMENTS = (1 / 8, 1 / 4, 1 / 2, 1)
START, RATE = 0.5, 0.02
# Factors keep reflectances physical, and above zero
LEAST, MOST, LARGEST_REFLECTANCE = 0.05, 2.0, 0.98
_REFLECTANCES, _RADIANCES = ("reflectance.value", "reflectance.data"), ("radiance.value", "radiance.data")
# Seed of the target, far from those of the steps
_SEED = 1 << 20


class Problem:
    """A scene whose factors are to be found from its image.

    ``originals``: parameters by name; ``limits``: largest factors of these; ``target``: the image of the scene.
    """

    def __init__(self, name: str, width: int, spp: int):
        self.scene, self._spp = scenes.load(name, width), spp
        self.parameters = mi.traverse(self.scene)
        keys = [key for key, _ in self.parameters if key.endswith((*_REFLECTANCES, *_RADIANCES))]
        self.originals = {key: type(self.parameters[key])(self.parameters[key]) for key in keys}
        self.limits = {key: self._limit(key) for key in self.originals}
        self._judge = mi.load_dict({"type": "path", "max_depth": DEPTH})
        self.target = self._image()
        self._weight = dr.rcp(dr.square(self.target) + 0.01 * dr.square(dr.mean(self.target, axis=None)))

    def _limit(self, key: str) -> float:
        if key.endswith(_RADIANCES):
            return MOST
        largest = float(dr.max(dr.ravel(self.originals[key]))[0])
        return max(1.0, LARGEST_REFLECTANCE / max(largest, LARGEST_REFLECTANCE / MOST))

    def _image(self):
        image = mi.render(self.scene, integrator=self._judge, spp=self._spp, seed=_SEED)
        dr.eval(image)
        return image

    def apply(self, factors) -> None:
        """Set the parameters to the original values times ``factors``."""
        for key, original in self.originals.items():
            self.parameters[key] = original * factors[key]
        self.parameters.update()

    def loss(self, image):
        """Relative squared error of an image."""
        return dr.mean(dr.square(image - self.target) * self._weight, axis=None)

    def true_loss(self) -> float:
        """Loss of the present parameters, without most of the noise."""
        with dr.suspend_grad():
            return float(self.loss(self._image()).array[0])


class Optimisation:
    """Adam, with images of ``spp`` samples by the integrator ``PRIMALS[primal]`` and derivatives by ``prb``."""

    def __init__(self, problem: Problem, primal: str, spp: int, adjoint_spp: int):
        self._problem, self._spp, self._adjoint_spp = problem, spp, adjoint_spp
        kinds = (PRIMALS[primal], {"type": "prb"})
        self._primal, self._adjoint = (mi.load_dict(kind | {"max_depth": DEPTH}) for kind in kinds)
        self._factors = mi.ad.Adam(lr=RATE, params={key: mi.Float(START) for key in problem.originals})
        self.steps, self.seconds = 0, 0.0

    def step(self) -> None:
        """Move the factors once, and count the step and its time."""
        begin = time.perf_counter()
        problem, seed = self._problem, 2 * self.steps
        problem.apply(self._factors)
        image = mi.render(problem.scene, integrator=self._primal, spp=self._spp, seed=seed)
        dr.enable_grad(image)
        dr.backward(problem.loss(image))
        self._adjoint.render_backward(
            problem.scene, problem.parameters, dr.grad(image), seed=seed + 1, spp=self._adjoint_spp
        )
        dr.backward_to(*self._factors.values())
        self._factors.step()
        for key, limit in problem.limits.items():
            self._factors[key] = dr.clip(self._factors[key], LEAST, limit)
        dr.eval(self._factors)
        dr.sync_thread()
        self.steps += 1
        self.seconds += time.perf_counter() - begin

    def loss(self) -> float:
        """Loss of the present factors."""
        self._problem.apply(self._factors)
        return self._problem.true_loss()


def optimised(problem: Problem, primal: str, spp: int, adjoint_spp: int, seconds: float) -> dict:
    """Optimise for some seconds; returns the row: {moment: loss}, the number of steps."""
    Optimisation(problem, primal, spp, adjoint_spp).step()
    found = Optimisation(problem, primal, spp, adjoint_spp)
    row = {}
    for moment in MOMENTS:
        while found.seconds < moment * seconds:
            found.step()
        row[f"{moment:g} of the time"] = {"loss": found.loss(), "seconds": found.seconds, "steps": found.steps}
    return row


def compare(names, width: int, seconds: float, target_spp: int, adjoint_spp: int) -> Iterator[dict]:
    """Print the losses of each scene, integrator and number of samples, with the steps taken."""
    print(f"loss, {width} wide, {seconds:g} s for each optimisation, derivatives with {adjoint_spp} samples")
    print(f"{'scene':16s}{'image by':>12s}{'samples':>9s}{'steps':>7s}", end="")
    print("".join(f"{moment * seconds:>10.3g} s" for moment in MOMENTS))
    rows = {}
    for name in names:
        problem = Problem(name, width, target_spp)
        for spp in SAMPLES:
            for primal in PRIMALS:
                row = optimised(problem, primal, spp, adjoint_spp, seconds)
                losses = "".join(f"{one['loss']:12.3g}" for one in row.values())
                steps = max(one["steps"] for one in row.values())
                print(f"{name:16s}{primal:>12s}{spp:9d}{steps:7d}{losses}", flush=True)
                rows[f"{name}, {primal}, {spp} samples"] = row
        yield rows


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    results.add_options(parser, PARTS)
    parser.add_argument("--scenes", nargs="+", default=NAMES, metavar="NAME")
    parser.add_argument("--width", type=positive(int), default=128, metavar="PIXELS")
    parser.add_argument("--seconds", type=positive(float), default=30, help="of each optimisation (default: 30)")
    parser.add_argument(
        "--target", type=positive(int), default=256, metavar="SPP", help="samples of the target (default: 256)"
    )
    parser.add_argument(
        "--adjoint", type=positive(int), default=16, metavar="SPP", help="of the derivatives (default: 16)"
    )
    options = results.parse(parser)
    names = scenes.available(options.scenes)
    settings = {
        "width": options.width, "seconds": options.seconds, "max_depth": DEPTH, "target_samples": options.target,
        "adjoint_samples": options.adjoint,
    }  # fmt: skip
    measured = partial(compare, names, options.width, options.seconds, options.target, options.adjoint)
    results.run_parts(options, {PARTS[0]: measured}, settings)


if __name__ == "__main__":
    main()
