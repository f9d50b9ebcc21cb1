"""Numbers of emitter samples at the first scattering vertices of paths.

Small emitters, penumbras and the choice among emitters make noise on surfaces that the camera sees.  A further sample
of the emitters there removes a part of this noise and costs a shadow ray, much less than a path.  The pilot takes two
samples at each of these vertices; their difference shows the variance of a sample.  :meth:`EmitterSamples.best` chooses
the numbers with the least predicted variance × cost.

A pixel takes m s samples, rounded, from one to a largest number.  s is the expected difference of two samples, relative
to the brightness of the pixel: for a fixed cost, numbers in proportion to the standard deviation leave the least
variance [Neyman 1934].  s is a mean of absolute values instead, on which single paths have less influence.  The
multiple m is the same in the whole image.

Stratified samples of a pixel remove a part of the noise as well.  :func:`retained_fraction` measures the fraction that
remains, with groups of paths that are stratified like those of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, upload
from ..core.sampling import derived_seed
from .camera_rays import CameraRays
from .cost_model import CostModel
from .pilot import Pilot, error_scale, finite, kept_of_both, means_of_others, pixel_means, relative_errors
from .pixel_rays import RayNumbers
from .view import Stream, View, ViewLights

# Candidate multiples, powers of two at half steps; 0 for one sample everywhere. By one of them, expected differences of
# 0.17 to 124 get the largest number
_MULTIPLES = np.concatenate([[0.0], 2.0 ** np.arange(-3, 7, 0.5)])
# Paths of a group that measures the effect of stratification, and largest number of groups. What 8 paths retain, 64
# nearly retain, too (decisions.md)
_GROUP, _GROUPS = 16, 1024


@dataclass(frozen=True)
class SampleChoice:
    """A ``multiple``, the fraction of the variance of a path that ``remains``, and the ``cost`` of a path."""

    multiple: float
    remains: float
    cost: float


@dataclass(frozen=True)
class EmitterSamples:
    """Effect of more emitter samples in the image of a pilot.

    ``whole``: relative variance of a path due to one sample, not stratified, as if two samples were independent;
    ``removed`` (m,): part of it that each candidate multiple removes; ``added`` (m,): mean number of samples added to a
    path; ``expected`` (pixels,): expected relative difference of two samples; ``fraction``: of the variance that
    stratified samples retain.

    Samples are weighted against the BSDF by their number.  ``whole`` is the variance with the weight of two.  A single
    sample has the weight of one, which leaves another variance.  ``removed`` counts this difference where a vertex
    takes a single sample.
    """

    whole: float
    removed: np.ndarray
    added: np.ndarray
    expected: np.ndarray
    fraction: float
    model: CostModel

    @classmethod
    def of(cls, pilot: Pilot, traced: Pilot, fraction: float) -> EmitterSamples:
        """From the emitter samples of ``traced``, a pilot with the same paths and the lights of the image."""
        model = pilot.model
        relative = np.abs(traced.difference) / error_scale(pilot.brightness, model)
        # Without the path itself and its neighbour: otherwise, the prediction would be too good
        others, priors = means_of_others(relative, pilot.pixel, *pilot.size, model)
        # The largest ones are left out, as in the variance of a path
        kept = np.argsort(relative)[: len(relative) - model.left_out(len(relative))]
        # Twice the mean square of half of the difference
        variance = 2 * relative[kept] ** 2
        weighted_as_two, alone = (relative_errors(x, pilot.brightness, model) for x in (traced.radiance, traced.alone))
        pairs, gain = kept_of_both(weighted_as_two, alone, model), weighted_as_two - alone
        removed, added = np.zeros(len(_MULTIPLES)), np.zeros(len(_MULTIPLES))
        for k, multiple in enumerate(_MULTIPLES):
            number = _numbers(multiple * others, model)
            removed[k], added[k] = np.mean(variance * (1 - 1 / number[kept])), np.mean(number - 1)
            removed[k] += np.mean(gain[pairs] * (number[::2][pairs] == 1))
        expected = pixel_means(relative, pilot.pixel, *pilot.size, priors)
        return cls(float(np.mean(variance)), removed, added, expected, fraction, model)

    def retained(self, samples: int) -> float:
        """Fraction of the variance that so many stratified samples retain."""
        return self.fraction ** min(np.log(max(samples, 1)) / np.log(_GROUP), 1)

    def best(self, variance: float, cost: float, samples: int) -> SampleChoice:
        """The choice with the least variance × cost, in images that are denoised with a power of the variance, for
        paths of a relative ``variance`` and a ``cost``, of which a pixel has so many ``samples``."""
        # All of the noise may be that of emitter samples, but not more. The largest number of samples leaves a part
        least_left = 1 / max(self.model.most_emitter_samples, 2)
        most = max(self.whole, np.max(self.removed) / (1 - least_left))
        of_samples = min(self.retained(samples), variance / most) if most > 0 else 0.0
        left, costs = variance - of_samples * self.removed, cost + self.model.emitter_sample_cost * self.added
        chosen = int(np.argmin(left**self.model.samples_power * costs))
        remains = left[chosen] / variance if variance > 0 else 1.0
        return SampleChoice(float(_MULTIPLES[chosen]), float(remains), float(costs[chosen]))

    def numbers(self, multiple: float) -> np.ndarray:
        """Number of samples in each pixel, (pixels,) uint32."""
        return _numbers(multiple * self.expected, self.model).astype(np.uint32)


def _numbers(wanted: np.ndarray, model: CostModel) -> np.ndarray:
    return np.clip(np.rint(wanted), 1, model.most_emitter_samples)


def retained_fraction(view: View) -> float:
    """Fraction of the variance of the emitter samples at first scattering vertices that stratified samples retain.

    The view has :data:`vpl.split.pilot.PILOT_SAMPLES` samples at these vertices.  Half of their difference has the mean
    0.  The mean square of its sum over a group, over the sum of its mean squares, is 1 for independent samples.
    """
    lane = view.groups(min(_GROUPS * _GROUP, view.model.pilot_size(view.planned_count)), _GROUP)
    # Neighbouring pixels share a group where a pixel has few rays
    places = RayNumbers.of_lanes(dr.arange(mi.UInt32, len(lane)), _GROUP)
    rays = replace(CameraRays.of(view, upload(mi.UInt32, lane)), places=places, sizes=(_GROUP,), cells=1)
    dr.eval(rays.places)
    settings = view.settings(ViewLights())
    traced = rays.trace(view.scene, view.emitters, derived_seed(view.seed, Stream.STRATA), settings)
    difference, radiance = (
        finite(x).reshape(-1, _GROUP) for x in (traced.noise.difference, channel_mean(traced.radiance))
    )
    relative = difference / error_scale(radiance.mean(1), view.model)[:, None]
    together, alone = np.sum(relative, axis=1) ** 2, np.sum(relative**2, axis=1)
    kept = np.argsort(together + alone)[: len(alone) - view.model.left_out(len(alone))]
    whole = np.sum(alone[kept])
    return float(np.clip(np.sum(together[kept]) / whole, 0, 1)) if whole > 0 else 1.0
