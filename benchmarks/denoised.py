"""Denoised error of ``manylights`` and of ``path``, and the time that ``path`` takes for that of ``manylights``.

``manylights.render`` ends the images of ``manylights`` by time, with their pilots and first passes; those of ``path``
are single passes, which stratify best, or the mean of several where memory limits a pass: with the sampler
``independent`` and a better one, denoised as usual, and with the better one at twice the resolution, as
``manylights.render`` denoises.  Times include albedo, normal and denoiser.  Kernels are compiled before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks import scenes
from benchmarks.rivals import KINDS, SAMPLERS, TRIMMED, Rival, Timed, load, measure_in_turn
from comparison.convergence import box_mean
from comparison.denoising import FALL, Denoiser
from comparison.fine_film import PARTS

# Seconds of each of the two renders of a reference, over those of an image
REFERENCE_TIMES = 3
# Seeds of these renders, in units of the benchmark's seeds
REFERENCE_SEEDS = 1, 2


@dataclass(frozen=True)
class Truth:
    """Two estimates of the exact image, (height, width, 3): with independent noise, so that the product of the
    deviations from both is the squared error in the mean; or a single one twice, with its standard error ``noise``."""

    first: np.ndarray
    second: np.ndarray
    noise: np.ndarray | float = 0.0

    @classmethod
    def of(cls, name: str, scene, seconds: float, width: int) -> Truth:
        """The reference of a scene, or without one for this ``width``, two renders by ``manylights`` of at least
        ``seconds`` each."""
        known = scenes.reference_at(name, width)
        if known:
            truth, noise = known
            return cls(truth, truth, noise)
        rendered = Timed(scene, "manylights", "independent", REFERENCE_TIMES * seconds)
        return cls(*(rendered.render(seed)[0] for seed in REFERENCE_SEEDS))

    @property
    def scale(self) -> np.ndarray:
        """Denominator of relative squared errors. Two references are smoothed over 5 × 5 pixels: their noise would
        raise the errors, because it is in the numerator as well."""
        if self.first is self.second:
            return scenes.scale_of_truth(self.first)
        mean = 0.5 * (self.first + self.second)
        return scenes.scale_of_truth(np.stack([box_mean(mean[..., channel]) for channel in range(3)], axis=-1))

    def error(self, images: list) -> float:
        """Relative squared error of images, without the pixels of the least and the largest ones."""
        squares = [(image - self.first) * (image - self.second) - self.noise**2 for image in images]
        error = np.sort((np.mean(squares, axis=0) / self.scale).mean(-1).ravel())
        return float(error[int(TRIMMED * error.size) : int((1 - TRIMMED) * error.size)].mean())


class Several(Rival):
    """Images of ``path`` of about ``seconds``: means of as few passes as memory allows."""

    def __init__(self, name: str, scene, sampler: str, width: int, seconds: float, parts: int):
        super().__init__(name, scene, "path", sampler, width, seconds, parts=parts)
        self.count = max(round(seconds / self.pass_seconds), 1)

    def measure(self, seed: int) -> None:
        """Render and keep one more image."""
        passes = [self.render(1000 * seed + number) for number in range(self.count)]
        self.images.append(np.mean([image for image, _ in passes], axis=0))
        self.seconds.append(sum(spent for _, spent in passes))


def compare(names, width: int, seconds: float, passes: int) -> dict:
    """Print the rows of all scenes; returns them by name."""
    print(f"denoised, {width} wide, images of {seconds:g} s: error, samples; time of `path` for equal error over that")
    print("of manylights, with the sampler `independent` and the usual denoising, and with the best of three ways")
    return {name: compare_one(name, width, seconds, passes) for name in names}


def _warm_denoiser(scene, seconds: float, parts: int) -> Denoiser:
    """A denoiser that has denoised an image, after another one that compiled; see :class:`Denoiser`."""
    denoiser = [Denoiser(scene, time_limit=seconds, parts=parts) for _ in range(2)][-1]
    denoiser.denoise_fine(denoiser.features["albedo"], ["R", "G", "B"])
    return denoiser


def compare_one(name: str, width: int, seconds: float, passes: int) -> dict:
    """Print the denoised errors of a scene, and the relative times of ``path`` for equal error; returns the row."""
    scene = load(name, width)
    denoisers = {parts: _warm_denoiser(scene, seconds, parts) for parts in (1, PARTS)}
    ways = [*((sampler, 1) for sampler in SAMPLERS), (SAMPLERS[-1], PARTS)]
    of_way = [denoisers[parts] for _, parts in ways]
    fixed = [one.seconds for one in of_way]
    rivals = [
        Several(name, scene, sampler, width, seconds - spent, parts)
        for (sampler, parts), spent in zip(ways, fixed, strict=True)
    ]
    # manylights stratifies the samples of this sampler
    rivals.append(Timed(scene, "manylights", "independent", seconds, denoise=True, denoised=True))
    measure_in_turn(rivals, passes)
    truth = Truth.of(name, scene, seconds, width)
    clean = [
        [one.denoise_fine(image, ["R", "G", "B"]) for image in rival.images]
        for one, rival in zip(of_way, rivals, strict=False)
    ]
    errors = [truth.error(images) for images in (*clean, rivals[-1].images)]
    times = [float(np.median(rival.seconds)) + spent for rival, spent in zip(rivals, (*fixed, 0.0), strict=True)]
    points = list(zip(errors, times, strict=True))
    *theirs, (ours, our_time) = points
    # The denoiser works once
    ratios = [
        ((whole - spent) * (max(error, 1e-9) / max(ours, 1e-9)) ** (np.log(2) / np.log(FALL)) + spent) / our_time
        for (error, whole), spent in zip(theirs, fixed, strict=True)
    ]
    columns = "".join(
        f"  {rival.kind} ({rival.sampler[:5]}{', fine' if rival.parts > 1 else ''}) {error:.5f} "
        f"({rival.spp * rival.count * rival.parts**2}, {whole:.2f} s)"
        for rival, (error, whole) in zip(rivals, points, strict=True)
    )
    doubt = "" if min(errors) > 0 else "  an error is below the noise of the reference"
    print(f"{name:16s}{columns}  {ratios[0]:7.2f} {min(ratios):7.2f}{doubt}", flush=True)
    best = theirs[int(np.argmin(ratios))]
    row = {
        kind: {"relmse": error, "seconds": spent}
        for kind, (error, spent) in zip(KINDS, (best, points[-1]), strict=True)
    }
    return row | {"independent_speedup": float(ratios[0]), "speedup": float(min(ratios))}
