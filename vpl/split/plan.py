"""Plan: whether virtual lights pay, the number of lights, and the fineness of the clusters.

An :class:`Option` is a choice of light kinds.  :func:`priced` predicts the variance × cost of an option by the cost
model; :func:`choose` measures the options that may pay, and takes the one with the least product, or no lights.  The
variance is that of the paths.  In images that are denoised, that of the choice of lit vertices and of the lights on
surfaces adds to it: neighbouring pixels share the noise of lights, and a denoiser keeps more of it.  There, the product
has a power of the variance: what a denoiser leaves is in part made at edges, which virtual lights do not change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from .cost_model import CostModel
from .emitter_samples import EmitterSamples, SampleChoice
from .pilot import Pilot, relative_variance
from .view import ViewLights

_FEWEST_RAYS = 1e-9  # for a sample; the largest error of cuts limits the rays
LEAST_VARIANCE = 1e-9  # stands for a relative variance of 0 in ratios


@dataclass(frozen=True)
class Plan:
    """Decision for an image.

    ``light_paths``: number of lines for drawing virtual lights on surfaces, 0 for none; ``emitters``: whether virtual
    lights represent emitters; ``error``: largest expected one of a pair, as a fraction of the pixel; ``vertices``: lit
    vertices per pixel; ``variance``: remaining relative variance of a camera path; ``of_lights``: variance of the
    lights on surfaces and of the choice of lit vertices, in the same unit; ``cost`` of a path with its share of lights
    and cuts; ``rays``: shadow rays of a pixel's cuts; ``reason`` in words.
    """

    light_paths: int
    emitters: bool
    error: float
    vertices: int
    variance: float
    of_lights: float
    cost: float
    rays: float
    reason: str

    @property
    def gathers(self) -> bool:
        """Whether there are virtual lights."""
        return self.emitters or self.light_paths > 0


@dataclass
class Option:
    """Kinds of virtual lights: on ``surfaces``, for ``emitters``, or both.

    Values (n,) of a pilot's paths: ``traced``: radiance without lights on surfaces; ``indirect``: part of ``traced``
    available to lights on surfaces; ``residual``: measured radiance without the part carried by lights on surfaces,
    None if not measured.  ``to_measure`` computes the residual; None if there is nothing to measure.
    """

    surfaces: bool
    emitters: bool
    traced: np.ndarray
    indirect: np.ndarray
    to_measure: Callable[[], np.ndarray] | None = None
    residual: np.ndarray | None = None

    def measure(self) -> None:
        """Compute the residual at the first call."""
        if self.to_measure:
            self.residual, self.to_measure = self.to_measure(), None

    @cached_property
    def expected(self) -> np.ndarray:
        """Expected radiance (n,) without the part carried by virtual lights."""
        return self.traced - self.indirect if self.surfaces else self.traced

    @cached_property
    def concentration(self) -> float:
        """Mean square of the indirect light over the squared mean."""
        total = np.sum(self.indirect)
        return len(self.indirect) * np.sum(self.indirect**2) / total**2 if total else 0.0

    def least(self, evidence: Evidence) -> float:
        """Relative variance of a path if lights carry all that they can: the least that remains."""
        return min(evidence.variance(self.expected), evidence.variance(self.traced))

    def remaining(self, evidence: Evidence) -> float:
        """Relative variance of a path that remains: the measured value, not below :meth:`least`."""
        least = self.least(evidence)
        return least if self.residual is None else max(evidence.variance(self.residual), least)


@dataclass(frozen=True)
class Evidence:
    """Measurements of a pilot for an image of ``paths`` camera paths, ``samples`` for a pixel.

    ``radiance`` (n,) of the pilot's paths, in pairs; ``seen`` (n,): emission on their first edges; ``direct`` (n,):
    without ``seen`` and the part available to lights on surfaces; ``brightness`` (n,) of the image nearby;
    ``emitters``: whether lights may represent many emitters; ``known``: results of :meth:`relative`, which passes with
    the same pilot share; ``plain_from``: the paths of an image without lights are plain from this number on.
    """

    radiance: np.ndarray
    seen: np.ndarray
    direct: np.ndarray
    brightness: np.ndarray
    paths: int
    samples: int
    emitters: bool
    model: CostModel
    known: dict = field(default_factory=dict, repr=False, compare=False)
    plain_from: float = math.inf

    @property
    def plain_alone(self) -> bool:
        """Whether the paths are plain if there are no virtual lights."""
        return self.paths >= self.plain_from

    @property
    def cost_alone(self) -> float:
        """Cost of a path without virtual lights."""
        return self.model.plain_cost if self.plain_alone else 1.0

    @cached_property
    def whole(self) -> float:
        """Relative variance of a path without virtual lights."""
        return self.variance(self.radiance)

    def variance(self, radiance: np.ndarray) -> float:
        """Relative variance of a path with ``radiance`` (n,), where the samples of a pixel are stratified.

        Emitters that are seen directly make noise at their edges in the pixel.  Of it, n stratified samples retain the
        fraction n^-0.5 [Mitchell 1996, "Consequences of stratified sampling in graphics"].  Of the noise of direct
        light they retain more, by the constants ``stratified_power`` and ``stratified_many``.
        """
        edges = self.samples**-0.5
        whole = self.relative(radiance)
        unseen = min(self.relative(radiance, without_seen=True), whole)
        direct = min(self.relative(self.direct), unseen)
        return edges * (whole - unseen) + unseen - (1 - self.retained) * direct

    @property
    def retained(self) -> float:
        """Fraction of the variance of direct light that stratified samples retain, by the constants of the model."""
        retained = self.samples**-self.model.stratified_power
        return max(self.model.stratified_many, retained) if self.emitters else retained

    def relative(self, values: np.ndarray, without_seen: bool = False) -> float:
        """Relative variance of the ``values`` (n,) of paths, or of the values less ``seen``.

        Computed once for each array: sorting the errors of a large pilot takes milliseconds, and each pass compares
        many sizes.
        """
        key = id(values), without_seen, self.model
        if key not in self.known:
            found = relative_variance(values - self.seen if without_seen else values, self.brightness, self.model)
            # With the array: otherwise, another array could get its id
            self.known[key] = values, found
        return self.known[key][1]


@dataclass(frozen=True)
class Decision:
    """A ``plan`` with the ``evidence`` of the ``pilot`` and the ``options`` that were compared; ``effects`` of more
    emitter samples with and without virtual lights that represent emitters."""

    pilot: Pilot
    evidence: Evidence
    plan: Plan
    options: list[Option]
    effects: dict[bool, EmitterSamples]

    @property
    def effect(self) -> EmitterSamples:
        """Effect of more emitter samples with the lights of the plan."""
        return self.effects[self.plan.emitters]

    @cached_property
    def emitter_samples(self) -> SampleChoice:
        """Choice of the numbers of emitter samples."""
        return self._emitter_samples(self.evidence, self.plan)

    def _emitter_samples(self, evidence: Evidence, plan: Plan) -> SampleChoice:
        """Choice of the numbers of emitter samples for another size of the image and its plan.

        Lights are chosen before, with the variance of direct light by constants.  Here it counts at least as much as
        measured.
        """
        effect, variance = self.effects[plan.emitters], _remaining(evidence, plan)
        direct = min(evidence.relative(evidence.direct), variance / evidence.retained)
        variance += max(effect.retained(evidence.samples) - evidence.retained, 0) * direct
        return effect.best(variance, plan.cost, evidence.samples)

    @property
    def variance(self) -> float:
        """Relative variance of a camera path that remains, without that of lights."""
        return _remaining(self.evidence, self.plan) * self.emitter_samples.remains

    def expected_light(self, lights: ViewLights) -> np.ndarray:
        """Expected radiance of ``lights`` in each pixel of the view, (pixels,)."""
        kinds = bool(lights.surfaces), bool(lights.emitters)
        remains = next(x.expected for x in self.options if (x.surfaces, x.emitters) == kinds)
        return np.maximum(self.pilot.nearby(self.pilot.radiance - remains), 0)

    def costs(self, samples: int) -> tuple[float, float, float]:
        """Expected costs of a path of a pass with so many ``samples`` for a pixel: that of the path with its emitter
        samples, and its shares of lights and of cuts.  Larger passes may have virtual lights where this one has none,
        and more samples share the cuts of a pixel.

        Depends on the options measured so far, unlike the plan, so only renders with a limit of time use it.
        """
        evidence, plan = self.evidence, self.plan
        if samples != evidence.samples:
            paths = round(evidence.paths * samples / evidence.samples)
            evidence = replace(evidence, paths=paths, samples=samples)
            plan = choose(evidence, self.options, measures=False)
        paths = self._emitter_samples(evidence, plan).cost
        if not plan.gathers:
            return paths, 0.0, 0.0
        cuts = evidence.model.ray_cost * plan.rays / samples
        return paths - (plan.cost - 1), plan.cost - 1 - cuts, cuts

    def precision(self, samples: int) -> float:
        """Expected inverse of the relative variance of a pixel with ``samples``; ``samples`` for a black image.

        Independent of the random numbers of passes that share the start of an earlier pass, so it may weight them in a
        mean.  The first pass shares its camera rays with the pilot, and no other random numbers.
        """
        variance = self.variance + self.plan.of_lights
        return samples / variance if variance > 0 else float(samples)


def _remaining(evidence: Evidence, plan: Plan) -> float:
    """Relative variance of a path with one emitter sample at each vertex that remains with a plan."""
    return plan.variance if plan.gathers else evidence.whole


def choose(evidence: Evidence, options: list[Option], measures: bool = True) -> Plan:
    """The plan of the option with the least variance × cost; without lights if no option pays.

    ``measures``: whether to measure options that are predicted to pay.  Measuring only raises a price, so the lights
    are independent of the options that were measured for other passes.
    """
    if not options:
        return without_lights("no light comes by way of surfaces that virtual lights could stand for", evidence)
    if evidence.whole == 0:
        return without_lights("nearly all paths of the pilot have no noise", evidence)
    most, found = _most_to_pay(evidence), []
    for product, plan, option in sorted(((*priced(evidence, x), x) for x in options), key=lambda one: one[0]):
        if measures and option.to_measure and product <= min([most, *(other for other, _ in found)]):
            option.measure()
            product, plan = priced(evidence, option)
        found.append((product, plan))
    product, best = min(found, key=lambda one: one[0])
    remains = (best.variance + best.of_lights) / evidence.whole
    if product > most:
        costs = f"virtual lights would cost {best.cost - 1:.2g} times as much as the paths"
        return without_lights(f"{costs} and leave {remains:.0%} of the variance", evidence)
    return replace(best, reason=f"virtual lights remove {1 - remains:.0%} of the variance")


def without_lights(reason: str, evidence: Evidence) -> Plan:
    """The plan of an image without virtual lights."""
    return Plan(0, False, 0.0, 0, 0.0, 0.0, evidence.cost_alone, 0.0, reason)


def _most_to_pay(evidence: Evidence) -> float:
    """Largest price of lights that pay: a multiple of the price of paths alone."""
    # Even if paths alone are plain: lights remove more variance than predicted (decisions.md)
    return evidence.model.pays_below * evidence.whole**evidence.model.denoised_power


def priced(evidence: Evidence, option: Option) -> tuple[float, Plan]:
    """(Price, plan) with the lights of an option.  The price is variance × cost, with a power of the variance in images
    that are denoised."""
    found, plan = _planned(evidence, option, option.remaining(evidence))
    if option.residual is None:
        return found, plan
    # A measured price is not below the price before measuring, so the order of measurements does not matter. It could
    # be below: the numbers of rays, vertices and light paths are not those of the least price
    return max(found, _planned(evidence, option, option.least(evidence))[0]), plan


def _planned(evidence: Evidence, option: Option, rest: float) -> tuple[float, Plan]:
    """(Price, plan) with the lights of an option, where paths leave the relative variance ``rest``."""
    model, paths, samples = evidence.model, evidence.paths, evidence.samples
    cuts = model.emitter_cuts * option.emitters + option.surfaces
    rays, error = _cut_rays(rest, cuts, samples, model)
    # Never 0, because cuts leave a variance
    left, light_paths = rest + cuts * model.cut_variance * samples / rays, 0
    if option.surfaces:
        light_paths = _light_paths(evidence, option, left)
    fixed = (model.fixed_cost + model.light_path_cost * light_paths) / paths
    cost = 1 + cuts * model.ray_cost * rays / samples + fixed
    # The least of (left + vertex variance / share) × (cost + vertex cost × share). The price leaves out the cost of
    # vertices: predicted costs without it are 0.9 to 1.25 times those of renders (decisions.md)
    share = (model.vertex_variance * cost / (model.vertex_cost * left)) ** 0.5
    vertices = max(round(float(np.clip(share, model.least_vertices, 1)) * samples), 1)
    # Where all vertices are lit, none is chosen
    choice, lights = model.vertex_variance * (samples / vertices - 1), 0.0
    if light_paths:
        lights = samples * model.light_variance * _indirect_variance(evidence, option) / light_paths
    plan = Plan(light_paths, option.emitters, error, vertices, left, choice + lights, cost, cuts * rays, "")
    noise = model.noise_of_lights * (choice + model.shared * lights)
    return cost * (left + noise) ** model.denoised_power, plan


def _cut_rays(rest: float, cuts: float, samples: int, model: CostModel) -> tuple[float, float]:
    """(Shadow rays of a pixel's cuts, error of pairs), where paths leave the relative variance ``rest``.

    ``cuts``: variance and rays over those of cuts through surface lights.  For r rays of a sample, the least of
    (rest + cuts × cut variance / r)^power × (1 + cuts × r × cost of a ray), without fixed costs.  It is the positive
    root of cost × rest × r² + (1 - power) × cost × cuts × cut variance × r = power × cut variance.
    """
    power, rest = model.denoised_power, max(rest, LEAST_VARIANCE)
    half = 0.5 * (1 - power) * cuts * model.cut_variance / rest
    squared = power * model.cut_variance / (model.chosen_ray_cost * rest)
    # The root as a fraction, because a difference would cancel for a small rest
    wanted = squared / (half + (half**2 + squared) ** 0.5)
    rays = samples * min(max(wanted, _FEWEST_RAYS), model.most_rays)
    # A cut has some nodes, however few rays are wanted
    error = float(np.clip((rays / model.coarse_rays) ** -model.error_slope, model.finest_error, model.coarsest_error))
    return model.coarse_rays * error ** (-1 / model.error_slope), error


def _indirect_variance(evidence: Evidence, option: Option) -> float:
    """Relative variance of the indirect light of a camera path."""
    return evidence.relative(option.indirect)


def _light_paths(evidence: Evidence, option: Option, left: float) -> int:
    """Number of light paths: the least of (left / samples + shared × light variance / light paths) × cost, within
    limits."""
    model, paths = evidence.model, evidence.paths
    weighted = model.shared * model.light_variance * _indirect_variance(evidence, option)
    balanced = (weighted * evidence.samples * paths / (model.light_path_cost * left)) ** 0.5
    wanted = max(balanced, option.concentration / model.set_error**2)
    wanted = np.clip(wanted, model.least_light_share * paths, model.most_light_share * paths)
    return int(np.clip(wanted, model.fewest_light_paths, model.most_light_paths))
