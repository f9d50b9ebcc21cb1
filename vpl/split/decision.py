"""Decision: what a view is followed with, from a pilot of some ten thousand of its paths.

The pilot's paths are followed a second time where emitters were learned from them; where lights may stand for emitters,
with these alone; and with lights on surfaces, by themselves or beside those, where either seems to be best.  They are
always the same paths, and nothing depends on the clock: the same seed decides the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.sampling import derived_seed
from .balance import (
    Balance,
    Evidence,
    Option,
    balance,
    importance,
    judged_by,
    may_pay,
    noise,
    price,
    without_lights,
)
from .irradiance import learn_emitters
from .paths import AT_FIRST
from .pilot import Pilot
from .site_choice import learning_rays
from .view import View
from .view_lights import ViewLights, spaced_lights
from .worth import Worth

# Camera rays of the pilot, at most
_PILOT = 1 << 15
# Cost of a path with emitters that were learned, more of whose shadow rays arrive, next to that of others
_LEARNED_COST = 1.15


@dataclass(frozen=True)
class Decision:
    """The ``balance`` that a ``pilot`` led to, by its ``evidence``, and the ``options`` that were considered."""

    pilot: Pilot
    evidence: Evidence
    balance: Balance
    options: list[Option]

    @classmethod
    def of(cls, view: View, virtual_lights: bool) -> Decision:
        """The decision for a view, whose emitters are learned from the pilot; ``virtual_lights``: whether there may be
        any."""
        pilot = _learning_pilot(view)
        evidence = _evidence(view, pilot)
        refusal = _refusal(view, virtual_lights)
        if refusal:
            return cls(pilot, evidence, without_lights(refusal), [])
        options = _options(view, pilot, evidence)
        return cls(pilot, evidence, balance(evidence, options), options)

    def expected_light(self, lights: ViewLights) -> np.ndarray:
        """Light that ``lights`` are expected to bring to each pixel of the view, (pixels,)."""
        kinds = bool(lights.surfaces), bool(lights.emitters)
        whole = self.pilot.radiance
        left = next(x.expected for x in self.options if (x.surfaces, x.emitters) == kinds)
        return np.maximum(self.pilot.nearby(whole - left), 0)

    def judge(self, view: View) -> float | None:
        """Tell the view what it is worth to follow its paths, which its limits and what is followed from then on go by:
        the multiple of that by which they go on, see :func:`vpl.split.balance.importance`; None where all do."""
        pilot, onward = self.pilot, self.pilot.onward
        if len(onward.path) == 0:
            return None
        worth, expected = Worth.of(onward.position, onward.normal, onward.sent)
        relative = onward.throughput / judged_by(self.evidence.brightness)[onward.path]
        whole = self.evidence.noise(pilot.radiance)
        multiple = importance(relative * expected, relative * onward.sent, onward.edges, len(pilot.radiance), whole)
        if not np.isfinite(multiple):
            return None
        if self.balance.gathers:
            # The less noise there is besides, the more they are worth
            multiple *= (whole / max(self.balance.noise, 1e-9)) ** 0.5
        view.worth = worth
        nearby = pilot.nearby(pilot.radiance)
        view.importance = upload(mi.Float, multiple / judged_by(nearby))
        return multiple


def _learning_pilot(view: View) -> Pilot:
    """The pilot, from which emitters are learned."""
    pilot = _followed(view, ViewLights())
    rays, seed = learning_rays(view.count), derived_seed(view.seed, 6)
    if not learn_emitters(view.scene, view.emission, pilot.vertices, rays, seed):
        return pilot
    brightness, again = pilot.brightness, _followed(view, ViewLights())
    if _LEARNED_COST * noise(again.radiance, brightness) < noise(pilot.radiance, brightness):
        return again
    # Where shadows are small, or gloss is what is noisy, sites may mislead
    view.emission.choice.forget()
    return pilot


def _followed(view: View, lights: ViewLights) -> Pilot:
    """What is found by pairs of paths all over the image, always the same ones, besides light of ``lights``."""
    lane = view.pairs(_PILOT)
    found, vertices, _, arrival = view.follow(upload(mi.UInt32, lane), view.limits(lights, AT_FIRST), 1)
    return Pilot.of(found, vertices, arrival, lane // view.samples, (view.width, view.pixels))


def _refusal(view: View, virtual_lights: bool) -> str:
    """Why there are to be no lights, whatever the pilot found; empty where there may be."""
    if not virtual_lights:
        return "virtual_lights is off"
    if view.perturbed.everywhere:
        return "bump or normal maps are in shape groups"
    if view.rules.max_depth <= 2 and not _may_carry_emitters(view):
        return "no light is indirect at this max_depth"
    return ""


def _may_carry_emitters(view: View) -> bool:
    return view.emission.lights is not None and view.rules.max_depth > 1


def _evidence(view: View, pilot: Pilot) -> Evidence:
    """What is known of the view's noise by the pilot's paths."""
    direct, brightness = pilot.radiance - pilot.indirect, pilot.brightness
    return Evidence(pilot.radiance, direct, brightness, view.count, view.samples, _may_carry_emitters(view))


def _options(view: View, pilot: Pilot, evidence: Evidence) -> list[Option]:
    """Lights that may pay, with what the pilot's paths find besides where that may matter."""
    options, assumed, emitters = [], _with_surfaces(view, pilot, False), None
    if evidence.emitters:
        emitters = view.emitter_lights([])
        left = _followed(view, ViewLights(emitters=emitters))
        options.append(Option(False, True, left.radiance, left.indirect))
        assumed += _with_surfaces(view, left, True)
    # Following can only make an option worse: so the most promising goes first, and another is followed only if it
    # still promises more
    for option in sorted(assumed, key=partial(price, evidence)):
        if may_pay(evidence, option, options):
            # Their distance from each other is not known yet, and with it c: with 0, they carry all that they can
            surfaces = spaced_lights([], 0.0, view.rules.max_depth)
            left = _followed(view, ViewLights(surfaces, emitters if option.emitters else None))
            option = replace(option, left=left.radiance)
        options.append(option)
    return options


def _with_surfaces(view: View, traced: Pilot, emitters: bool) -> list[Option]:
    """Options, one at most, of lights on surfaces beside those that stand for ``emitters``, or without these;
    ``traced``: the pilot without those on surfaces."""
    if view.rules.max_depth <= 2 or not traced.indirect.any():
        return []
    return [Option(True, emitters, traced.radiance, traced.indirect)]
