"""Integrators that compete on a scene: passes or images of equal time, or images that end by time."""

from __future__ import annotations

import gc
import re
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import mitsuba as mi
import numpy as np

from benchmarks import scenes
from comparison.fine_film import fine_film
from comparison.render import render
from vpl.direct.environment_regions import forget_regions
from vpl.split import estimator

KINDS, SAMPLERS = ("path", "manylights"), ("independent", "multijitter")
# Fraction of the pixels with the largest errors that averages leave out
DEPTH, TRIMMED = 6, 0.001
# Largest number of samples of a pass: bounds memory
LARGEST_PASS = 1 << 24
# Of the passes that tell the cost of a sample and compile the kernels: not 0, for which `multijitter` has a kernel of
# its own, so that the first measured pass would compile another one
CALIBRATION_SEED = 1


def load(name: str, width: int):
    """Load a scene with a sensor for each of SAMPLERS.

    A single scene, because kernels hold the code of all scenes that are alive.
    """
    gc.collect()
    file = scenes.scene_file(name)
    mi.file_resolver().prepend(str(file.parent))
    text = file.read_text()
    sensor = re.search(r"<sensor.*?</sensor>", text, re.DOTALL).group()
    other = sensor.replace('<sampler type="independent"', f'<sampler type="{SAMPLERS[1]}"')
    # Identifiers and names of objects must be unique
    other = re.sub(r' id="[^"]*"', "", re.sub(r'(<sensor[^>]*) name="[^"]*"', r"\1", other))
    text = text.replace(sensor, f"{sensor}\n{other}")
    return mi.load_string(text, resx=str(width), resy=str(scenes.height(name, width)))


@contextmanager
def light_paths_times(factor: float):
    """While the block runs, ``manylights`` traces ``factor`` times the light paths that it chooses."""
    choose = estimator.choose

    def scaled(*arguments):
        chosen = choose(*arguments)
        return replace(chosen, light_paths=round(factor * chosen.light_paths))

    with mock.patch.object(estimator, "choose", scaled):
        yield


def trimmed_variance(images: list, scale: np.ndarray, trimmed: float = TRIMMED) -> float:
    """Variance between images over ``scale``, without the fraction ``trimmed`` of pixels with the largest errors."""
    error = np.sort((np.var(images, axis=0, ddof=1) / scale).mean(-1).ravel())
    return float(error[: int(len(error) * (1 - trimmed))].mean())


class Rival:
    """Passes of one integrator with one sampler on one scene, of about ``seconds`` each; ``light_paths``: factor on the
    chosen number; ``more``: properties of ``manylights``; ``parts``: of the film, see :mod:`comparison.fine_film`.
    ``spp``: samples of a pixel of the film; ``pass_seconds``: of a pass; ``count`` of them in an image.
    """

    count = parts = 1

    def __init__(
        self, name: str, scene, kind: str, sampler: str, width: int, seconds: float, light_paths: float = 1,
        parts: int = 1, **more
    ):  # fmt: skip
        self.parts, width = parts, parts * width
        self.kind, self.sampler, self.images, self.seconds, self.light_paths = kind, sampler, [], [], light_paths
        self.scene, self.sensor, self._image_seconds = scene, SAMPLERS.index(sampler), seconds
        more = more if kind == "manylights" else {}
        self.integrator = mi.load_dict({"type": kind, "max_depth": DEPTH, **more})
        # Two sizes separate the cost of samples from the fixed cost of a pass
        most = int((LARGEST_PASS / (width * scenes.height(name, width))) ** 0.5)
        few, side, times = 16 // parts**2, min(8 // parts, most), []
        for self.spp in (few, few, side**2, side**2):
            times.append(self.render(CALIBRATION_SEED)[1])
        each = max(times[-1] - times[1], 0.1 * times[-1]) / max(side**2 - few, 1)
        wanted = side**2 + (seconds - times[-1]) / each
        if sampler == "multijitter":
            # Mitsuba rounds the samples of this sampler to squares
            self.spp = min(max(round(max(wanted, few) ** 0.5), round(few**0.5)), most) ** 2
        else:
            self.spp = min(max(round(wanted), few), most**2)
        self.pass_seconds = self.render(CALIBRATION_SEED)[1]

    def render(self, seed: int):
        """Render: (image in the resolution of the film, float64; seconds)."""
        with light_paths_times(self.light_paths), fine_film(self.scene.sensors()[self.sensor], self.parts):
            image, seconds = scenes.timed(
                lambda: mi.render(self.scene, sensor=self.sensor, integrator=self.integrator, spp=self.spp, seed=seed)
            )
        return np.array(image, np.float64)[..., :3], seconds

    def measure(self, seed: int) -> None:
        """Render and keep one more pass."""
        image, seconds = self.render(seed)
        self.images.append(image)
        self.seconds.append(seconds)

    @property
    def samples(self) -> int:
        """Samples of a pixel of an image."""
        return self.spp * self.count * self.parts**2

    def product(self, scale: np.ndarray, trimmed: float = TRIMMED) -> float:
        """Variance × seconds of an image, without the fraction ``trimmed`` of the pixels with the largest errors."""
        return trimmed_variance(self.images, scale, trimmed) * float(np.median(self.seconds))

    def mean(self) -> tuple[float, float]:
        """Mean of the image over passes, and its standard error."""
        means = [image.mean() for image in self.images]
        return float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(len(means)))


class Whole(Rival):
    """Images of one integrator of about ``seconds`` each, as :class:`Rival`: a single pass, which stratifies best, or
    the mean of an even number of passes where memory limits a pass."""

    def __init__(self, *arguments, **more):
        super().__init__(*arguments, **more)
        passes = self._image_seconds / self.pass_seconds
        if passes > 1.5:
            # Two halves of equal weight, for the detail of denoised images; Mitsuba rounds the samples of `multijitter`
            # to squares
            self.count = 2 * int(np.ceil(passes / 2))
            self.spp = max(round((self.spp * passes / self.count) ** 0.5), 1) ** 2

    def render_passes(self, seed: int) -> list[tuple[np.ndarray, float]]:
        """Render the passes of an image: (image, seconds) of each."""
        return [self.render(1000 * seed + number) for number in range(self.count)]

    def measure(self, seed: int) -> None:
        """Render and keep one more image."""
        images, seconds = zip(*self.render_passes(seed), strict=True)
        self.images.append(np.mean(images, axis=0))
        self.seconds.append(sum(seconds))


class Timed(Rival):
    """Images of one integrator with one sampler on one scene that end by time.

    ``denoise``: whether the images are denoised, with the time of the denoiser; ``more``: properties of
    ``manylights``.
    """

    def __init__(self, scene, kind: str, sampler: str, seconds: float, denoise: bool = False, **more):
        self.kind, self.sampler, self.images, self.seconds, self._wanted = kind, sampler, [], [], seconds
        self.sensor, self._denoise = SAMPLERS.index(sampler), denoise
        more = more if kind == "manylights" else {}
        self._scene, self.integrator = scene, mi.load_dict({"type": kind, "max_depth": DEPTH, **more})
        # Two passes compile the kernels, and 64 samples those of pixels with different numbers of samples
        render(scene, self.integrator, sensor=self.sensor, spp=8, pass_spp=4)
        if denoise:
            render(scene, self.integrator, sensor=self.sensor, spp=64, denoise=True)

    def render(self, seed: int):
        """Render: (image, float64; seconds)."""
        # A new process would have to make them
        forget_regions()
        # A render has a seed for each of its passes
        image, took = render(
            self._scene, self.integrator, sensor=self.sensor, time=self._wanted, seed=1000 * seed, denoise=self._denoise
        )
        self.spp = took.spp
        return np.array(image, np.float64)[..., :3], took.seconds


def measure_in_turn(rivals: list[Rival], passes: int) -> None:
    """Measure ``passes`` more passes of each rival, in turn."""
    for number in range(passes):
        for rival in rivals:
            rival.measure(100 + number)
