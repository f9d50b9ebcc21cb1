"""Relative variance of ``manylights`` by class of light: which contributions make the noise of an image.

Each class is rendered alone: all other contributions of the camera paths are left out, while pilot, decisions and
virtual lights stay those of the whole image.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import scenes
from benchmarks.rivals import DEPTH, trimmed_variance
from comparison.single_pass import SharedStart
from vpl.split import estimator, path_tracer
from vpl.split.contributions import Contributions

# x1, x2: first and second surface with a BSDF that has a density.  NEE: next-event estimation.  BSDF: an emitter that a
# BSDF sample meets, straight or by way of mirrors, glass and masks ("via")
TRACED = ("seen", "x1 NEE", "x1 BSDF", "x1 via", "x2 NEE", "x2 BSDF", "x2 via", "later")
CLASSES = (*TRACED, "gathered")
_LATER, _ALL = TRACED.index("later"), len(TRACED)
SPP = 64


def class_of_met(path) -> mi.UInt32:
    """Class of emission that a path meets."""
    straight = dr.select(path.scattered == 1, mi.UInt32(2), mi.UInt32(5))
    # Glass that shadow rays pass leaves the density of the direction before
    via = path.delta if path.bent is None else path.delta | path.bent
    found = dr.select(via, straight + 1, straight)
    return dr.select(path.scattered == 0, 0, dr.select(path.scattered > 2, _LATER, found))


def class_of_nee(path) -> mi.UInt32:
    """Class of next-event estimation at the vertex that a path has just counted."""
    return dr.select(path.scattered == 1, 1, dr.select(path.scattered == 2, 4, mi.UInt32(_LATER)))


@contextmanager
def single_classes():
    """Within the block, an image has only the class of traced light ``wanted``, and gathered light if ``gathers``.

    Yields an object with these two attributes, which the block may set.
    """
    chosen = SimpleNamespace(wanted=_ALL, gathers=True, now=None, found=None)
    less_carried, lit, trace = path_tracer._less_carried, path_tracer._lit, estimator.trace_camera_rays
    light = estimator.Gatherer.light

    def of_met(path, *others):
        chosen.found = class_of_met(path)
        return less_carried(path, *others)

    def of_nee(path, *others):
        chosen.found = class_of_nee(path)
        return lit(path, *others)

    class Wanted(Contributions):
        def add(self, contribution, *others):
            wanted = (chosen.now == _ALL) | (chosen.found == chosen.now)
            super().add(dr.select(wanted, contribution, 0), *others)

    def trace_image(*arguments, **sums):
        chosen.now = dr.opaque(mi.UInt32, chosen.wanted)
        try:
            return trace(*arguments, **sums)
        finally:
            chosen.now = dr.opaque(mi.UInt32, _ALL)

    def gathered(self, points, weight, found, *others):
        value, counts = light(self, points, weight, found, *others)
        return (value if chosen.gathers else dr.zeros(mi.UnpolarizedSpectrum, dr.width(found))), counts

    chosen.now = dr.opaque(mi.UInt32, _ALL)
    with ExitStack() as patches:
        for place, name, function in (
            (path_tracer, "_less_carried", of_met),
            (path_tracer, "_lit", of_nee),
            (path_tracer, "Contributions", Wanted),
            (estimator, "trace_camera_rays", trace_image),
            (estimator.Gatherer, "light", gathered),
        ):
            patches.enter_context(mock.patch.object(place, name, function))
        yield chosen


def classes(names, width: int, passes: int) -> Iterator[dict]:
    """Print the share of each class in the variance and, in brackets, in the light, in percent."""
    print(f"classes, {width} wide, {SPP} samples, {passes} passes: percent of the variance (of the light)")
    print(" " * 16 + "".join(f"{name:>11s}" for name in CLASSES) + f"{'sum':>10s}{'whole':>10s}")
    rows = {}
    for name in names:
        rows[name] = classes_of(name, width, passes)
        yield rows


def classes_of(name: str, width: int, passes: int) -> dict:
    """Print and return the row of a scene."""
    scene = scenes.load(name, width)
    plugin, shared = mi.load_dict({"type": "manylights", "max_depth": DEPTH}), SharedStart()

    def render(seed: int) -> np.ndarray:
        with plugin.pass_of(shared, shared.start is None):
            return np.array(mi.render(scene, integrator=plugin, spp=SPP, seed=seed), np.float64)[..., :3]

    with single_classes() as chosen:
        images = [render(seed) for seed in range(passes)]
        chosen.gathers, alone = False, []
        for chosen.wanted in (*range(len(TRACED)), _ALL):
            alone.append([render(seed) for seed in range(passes)])
    # Cuts are as fine as the brightness of the whole image demands, so their light is that of the image less the rest
    alone[_ALL] = [image - traced for image, traced in zip(images, alone[_ALL], strict=True)]
    mean = np.mean(images, axis=0)
    scale = mean**2 + 0.01 * mean.mean() ** 2
    found = [trimmed_variance(of_class, scale) for of_class in alone]
    light = [np.mean(of_class) / mean.mean() for of_class in alone]
    total, whole = sum(found), trimmed_variance(images, scale)
    row = "".join(f"{100 * x / total:6.0f} ({100 * y:2.0f})" for x, y in zip(found, light, strict=True))
    print(f"{name:16s}{row}{total:10.4f}{whole:10.4f}", flush=True)
    shares = {
        one: {"variance_share": x / total, "light_share": float(y)}
        for one, x, y in zip(CLASSES, found, light, strict=True)
    }
    return shares | {"whole": {"variance": whole}}
