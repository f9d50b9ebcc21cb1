"""The pilot of a start, and how its paths find emitters: what the emitter sampler has learned, whether shadow rays pass
glass, and whether paths go to relays.

A pilot with more of these is kept where variance × cost is less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.sampling import derived_seed
from .cost_model import CostModel
from .emitters.cell_choice import learning_rays
from .pilot import Pilot, kept_of_both, relative_errors, relative_variance
from .relays_found import find_relays
from .view import Stream, View, ViewLights

# Shadow rays that take the time of a path: about as many as it has edges
_RAYS_OF_PATH = 4
# Largest fraction of the noise of refracted light that remains with the samples of the BSDF: shadow rays through panes
# leave less than a fifth, and those through lenses and bottles may find nothing
_LEFT = 0.5


def chosen_pilot(view: View) -> tuple[View, Pilot, bool]:
    """(View with the emitter sampler and the relays to use, its pilot, whether the sampler learned).

    Light by way of glass is found by shadow rays that pass the glass or by relays, whichever leaves less variance ×
    cost.  Shadow rays find light behind large panes, and relays leave less noise of lamps in globes.
    """
    pilot, learned = learning_pilot(view)
    refracting, of_glass, learned_again = through_glass(view, pilot, learned)
    if of_glass is not pilot and not _makes_noise(of_glass, of_glass.relayed):
        return refracting, of_glass, learned_again
    relayed, of_relays = with_relays(view, pilot)
    if of_glass is pilot:
        return relayed, of_relays, learned
    by_relays, by_glass = unseen_errors(of_relays, of_glass)
    if of_relays is pilot or is_less(view.model.glass_cost * by_glass, view.model.relay_cost * by_relays, view.model):
        return refracting, of_glass, learned_again
    return relayed, of_relays, learned


def learning_pilot(view: View) -> tuple[Pilot, bool]:
    """Trace the pilot, train the emitter sampler on the pilot, and trace the pilot again if the sampler learned:
    (pilot, whether the sampler keeps what it learned).

    The sampler forgets if the second pilot has the greater variance × cost: small shadows and gloss can mislead the
    sampler.  Emission that is seen directly does not count: no sampler of emitters changes its variance.  If the
    difference is within the standard error, as it may be in small pilots, the sampler keeps what it learned, because
    learning pays in most scenes.
    """
    pilot = Pilot.trace(view, ViewLights())
    rays, seed = learning_rays(view.learning_count), derived_seed(view.seed, Stream.LEARNING)
    if not view.emitters.learn(*pilot.vertices, rays, seed):
        return pilot, False
    again = Pilot.trace(view, ViewLights())
    before, after = unseen_errors(pilot, again)
    cost = view.model.learned_sky_cost if view.emitters.learns_sky else view.model.learned_cost
    if is_certain_rise(before, cost * after, view.model):
        view.emitters.forget()
        return pilot, False
    return again, True


def through_glass(view: View, pilot: Pilot, learned: bool) -> tuple[View, Pilot, bool]:
    """The view with shadow rays that pass glass, its pilot, and whether its emitter sampler learned, if these shadow
    rays find the light that makes the noise, and do not raise variance × cost by more than a standard error; otherwise
    the arguments.

    They are tried if light that glass refracts makes a part of the noise.
    """
    if not _makes_noise(pilot, pilot.refracted):
        return view, pilot, learned
    refracting = replace(view, emitters=view.emitters.through_glass())
    again, learned_again = learning_pilot(refracting)
    # A few paths make much of the noise that such shadow rays remove, so a small pilot may miss what they gain
    before, after = unseen_errors(pilot, again)
    rises = is_certain_rise(before, view.model.glass_cost * after, view.model)
    noise, left = (whole - rest for whole, rest in (_noise_without(x, x.refracted) for x in (pilot, again)))
    return (view, pilot, learned) if rises or left > _LEFT * noise else (refracting, again, learned_again)


def with_relays(view: View, pilot: Pilot) -> tuple[View, Pilot]:
    """The view with the relays of its scene, and its pilot, if samples of relays lower variance × cost; otherwise the
    arguments.

    Relays are looked for if light by way of glass and mirrors makes a part of the noise.
    """
    if not _makes_noise(pilot, pilot.relayed):
        return view, pilot
    relays = find_relays(view, pilot, learning_rays(view.learning_count) // _RAYS_OF_PATH)
    if relays is None:
        return view, pilot
    relayed = replace(view, relays=relays)
    again = Pilot.trace(relayed, ViewLights())
    before, after = unseen_errors(pilot, again)
    return (relayed, again) if is_less(view.model.relay_cost * after, before, view.model) else (view, pilot)


def _makes_noise(pilot: Pilot, part: np.ndarray) -> bool:
    """Whether a ``part`` (n,) of the radiance of a pilot makes a part of its noise."""
    if not part.any():
        return False
    noise, rest = _noise_without(pilot, part)
    return noise - rest > pilot.model.relayed_noise * noise


def _noise_without(pilot: Pilot, part: np.ndarray) -> list[float]:
    """Relative variances of the paths of a pilot: of all light but emission that is seen directly, and also without a
    ``part`` (n,) of it."""
    unseen = pilot.radiance - pilot.seen
    return [relative_variance(x, pilot.brightness, pilot.model) for x in (unseen, unseen - part)]


def unseen_errors(*pilots: Pilot) -> list[np.ndarray]:
    """Relative errors (n // 2,) of pilots with the same camera rays, without emission that is seen directly, over the
    brightness of the first."""
    first = pilots[0]
    return [relative_errors(x.radiance - x.seen, first.brightness, first.model) for x in pilots]


def is_certain_rise(before: np.ndarray, after: np.ndarray, model: CostModel) -> bool:
    """Whether the mean of ``after`` (n,) exceeds that of ``before`` (n,) by more than a standard error, without the
    pairs that hold the largest values."""
    kept = kept_of_both(before, after, model)
    rise = after[kept] - before[kept]
    return len(rise) > 1 and bool(rise.mean() > rise.std(ddof=1) / len(rise) ** 0.5)


def is_less(one: np.ndarray, other: np.ndarray, model: CostModel) -> bool:
    """Whether the mean of ``one`` (n,) is below that of ``other`` (n,), without the pairs that hold the largest
    values."""
    kept = kept_of_both(one, other, model)
    return bool(np.mean(one[kept]) < np.mean(other[kept]))
