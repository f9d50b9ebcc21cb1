"""Denoised error of ``manylights`` and of ``path``, and the time that ``path`` takes for that of ``manylights``.

``manylights.render`` ends the images of ``manylights`` by time, with their pilots and first passes; those of ``path``
are single passes, which stratify best, or the mean of several where memory limits a pass: with the sampler
``independent`` and a better one, denoised as usual, and with the better one at twice the resolution, as
``manylights.render`` denoises.  Times include albedo, normal and denoiser.  Kernels are compiled before.

The time of ``path`` for another error follows from its error with fewer samples, or from the mean of many scenes,
whichever is less favourable to ``manylights``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from unittest import mock

import numpy as np

from benchmarks import scenes
from benchmarks.rivals import SAMPLERS, TRIMMED, Timed, Whole, load, measure_in_turn
from comparison.convergence import smoothed
from comparison.denoising import FALL, Denoiser
from comparison.detail import LEAST_SAMPLES
from comparison.fine_film import PARTS
from comparison.rendering import Passes
from comparison.single_pass import Pass, PassImage

# Seconds of a render that stands for the truth, over those of an image
REFERENCE_TIMES = 2
# Stands for an error that is below the noise of the reference
LEAST_ERROR = 1e-9
# Seeds of these renders, in units of the benchmark's seeds
REFERENCE_SEEDS = 1, 2


@dataclass(frozen=True)
class Truth:
    """Two estimates of the exact image, (height, width, 3), with independent noise: the product of the deviations from
    both is the squared error in the mean."""

    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(cls, name: str, scene, seconds: float, width: int) -> Truth:
        """The reference of a scene and a render by ``manylights`` of twice the ``seconds`` of an image; without a
        reference of this ``width``, two renders.

        The standard error of a reference cannot stand for a second estimate: it misses rare light as the reference
        does (classroom: relative squares of the standard errors 0.093, of the deviations from two renders 0.18).
        """
        known = scenes.reference_at(name, width)
        rendered = Timed(scene, "manylights", "independent", REFERENCE_TIMES * seconds)
        images = [known[0]] if known else []
        return cls(*images, *(rendered.render(seed)[0] for seed in REFERENCE_SEEDS[len(images) :]))

    @property
    def scale(self) -> np.ndarray:
        """Denominator of relative squared errors, smoothed over 5 × 5 pixels: noise of the truth would raise the
        errors, because it is in the numerator as well."""
        mean = 0.5 * (self.first + self.second)
        return scenes.scale_of_truth(np.stack([smoothed(mean[..., channel]) for channel in range(3)], axis=-1))

    def error(self, images: list) -> float:
        """Relative squared error of images, without the pixels of the least and the largest ones."""
        squares = [(image - self.first) * (image - self.second) for image in images]
        error = np.sort((np.mean(squares, axis=0) / self.scale).mean(-1).ravel())
        return float(error[int(TRIMMED * error.size) : int((1 - TRIMMED) * error.size)].mean())


class Several(Whole):
    """Images of ``path`` of about ``seconds``, as :class:`comparison.rendering.Passes`.

    ``shorter``: an image of fewer samples for each of them, the first of its passes or a pass of a ninth to a quarter
    of the samples; ``doublings``: of the samples of a shorter image up to those of an image.
    """

    def __init__(self, name: str, scene, sampler: str, width: int, seconds: float, parts: int):
        super().__init__(name, scene, "path", sampler, width, seconds, parts=parts)
        self._fewer = self.spp if self.count > 1 else max(int(self.spp**0.5) // 2, 1) ** 2
        self.shorter, self.doublings = [], float(np.log2(self.spp * self.count / self._fewer))

    def measure(self, seed: int) -> None:
        """Render and keep one more image, and a shorter one."""
        rendered = self.render_passes(seed)
        self.images.append(self._passes(*(image for image, _ in rendered)))
        self.seconds.append(sum(spent for _, spent in rendered))
        self.shorter.append(self._passes(rendered[0][0]) if self.count > 1 else self._short_image(seed))

    def _short_image(self, seed: int) -> Passes:
        with mock.patch.object(self, "spp", self._fewer):
            return self._passes(self.render(1000 * seed)[0])

    def _passes(self, *images: np.ndarray) -> Passes:
        return passes_of(self.scene, self.sensor, self.parts, self.spp * self.parts**2, *images)


def passes_of(scene, sensor: int, parts: int, spp: int, *images: np.ndarray) -> Passes:
    """Passes of ``spp`` samples for each pixel, from their ``images`` in the resolution of a film of ``parts``."""
    passes = Passes(0, parts, scene.sensors()[sensor].film().rfilter())
    passes.keeps_halves = True
    for image in images:
        passes.add(PassImage(image, ["R", "G", "B"], Pass(0, spp, 0.0)))
    return passes


@dataclass
class Way:
    """``path`` with one sampler, denoised in one resolution.

    ``images``: of ``path``; ``denoiser`` of the images, which takes ``fixed`` seconds.  Set by :meth:`judge`: ``error``
    of the denoised images; ``fall``: factor by which the error falls where samples double.
    """

    images: Several
    denoiser: Denoiser
    fixed: float
    error: float = 0.0
    fall: float = 0.0

    @property
    def seconds(self) -> float:
        """Seconds of an image and of its denoiser."""
        return float(np.median(self.images.seconds)) + self.fixed

    def judge(self, truth: Truth) -> None:
        """Determine the error and its fall."""
        self.error, short = (
            truth.error([self.denoiser.denoise_passes(image) for image in images])
            for images in (self.images.images, self.images.shorter)
        )
        doublings = self.images.doublings
        self.fall = (short / self.error) ** (1 / doublings) if min(self.error, short, doublings) > 0 else FALL

    def time_for(self, error: float) -> float:
        """Seconds until the ``error``.  The denoiser works once."""
        return (self.seconds - self.fixed) * longer(self.error, error, self.fall) + self.fixed

    def __str__(self) -> str:
        one, fine = self.images, ", fine" if self.images.parts > 1 else ""
        return f"  path ({one.sampler[:5]}{fine}) {self.error:.5f} ({one.samples}, {self.seconds:.2f} s)"


def longer(error: float, goal: float, fall: float) -> float:
    """Factor on the time of an image with some ``error`` for the error ``goal``: by its ``fall`` where samples double,
    or by that of many scenes, whichever makes the factor smaller."""
    # An error that does not fall tells nothing
    exponents = (1 / np.log2(one) for one in (FALL, fall) if one > 1)
    return float(min((max(error, LEAST_ERROR) / max(goal, LEAST_ERROR)) ** exponent for exponent in exponents))


def compare(names, width: int, seconds: float, passes: int) -> Iterator[dict]:
    """Print the rows of all scenes; yields the rows so far by name, after each scene."""
    print(f"denoised, {width} wide, images of {seconds:g} s: error, samples; time of `path` for equal error over that")
    print("of manylights, with the sampler `independent` and the usual denoising, and with the best of three ways")
    rows = {}
    for name in names:
        rows[name] = compare_one(name, width, seconds, passes)
        yield rows


def _warm_denoiser(scene, seconds: float, parts: int) -> Denoiser:
    """A denoiser that has denoised an image of ``seconds``, after another one that compiled and decided; see
    :class:`Denoiser`.  Its images have fewer ``parts`` if the denoiser would take too long otherwise."""
    first = Denoiser(scene, time_limit=seconds, parts=parts)
    denoiser = Denoiser(scene, time_limit=seconds, like=first)
    denoiser.denoise_passes(passes_of(scene, 0, denoiser.parts, LEAST_SAMPLES, *[denoiser.features["albedo"]] * 2))
    return denoiser


def compare_one(name: str, width: int, seconds: float, passes: int) -> dict:
    """Print the denoised errors of a scene, and the relative times of ``path`` for equal error; returns the row."""
    scene = load(name, width)
    usual, fine = (_warm_denoiser(scene, seconds, parts) for parts in (1, PARTS))
    # Each later image adds to the seconds of its denoiser
    chosen = [
        (sampler, one, one.seconds) for sampler, one in (*((one, usual) for one in SAMPLERS), (SAMPLERS[-1], fine))
    ]
    ways = [
        Way(Several(name, scene, sampler, width, seconds - fixed, denoiser.parts), denoiser, fixed)
        for sampler, denoiser, fixed in chosen
    ]
    # manylights stratifies the samples of this sampler
    ours = Timed(scene, "manylights", "independent", seconds, denoise=True, denoised=True)
    measure_in_turn([*(way.images for way in ways), ours], passes)
    truth = Truth.of(name, scene, seconds, width)
    for way in ways:
        way.judge(truth)
    error, took = truth.error(ours.images), float(np.median(ours.seconds))
    ratios = [way.time_for(error) / took for way in ways]
    doubt = "" if min(error, *(way.error for way in ways)) > 0 else "  an error is below the noise of the reference"
    columns = f"{''.join(map(str, ways))}  manylights {error:.5f} ({ours.spp}, {took:.2f} s)"
    print(f"{name:16s}{columns}  {ratios[0]:7.2f} {min(ratios):7.2f}{doubt}", flush=True)
    best = ways[int(np.argmin(ratios))]
    return {
        "path": {"relmse": best.error, "seconds": best.seconds, "fall": best.fall},
        "manylights": {"relmse": error, "seconds": took},
        "independent_speedup": float(ratios[0]), "speedup": float(min(ratios)),
    }  # fmt: skip
