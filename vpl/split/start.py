"""Start of a pass: the pilot, the emitter sampler that learned from the pilot, and kinds of virtual lights to compare.

The passes of a render may share a start.  Larger passes learn the emitters again, by more rays.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import upload
from ..core.sampling import derived_seed
from .camera_rays import CameraRays
from .chosen_pilot import chosen_pilot
from .emitter_samples import EmitterSamples, retained_fraction
from .emitters.base import EmitterSampler
from .emitters.cell_choice import learning_rays
from .local_c import LocalC
from .path_state import Gathering
from .pilot import PILOT_SAMPLES, Pilot, pilot_lanes, single_sample_radiance
from .plan import Evidence, Option
from .relays import Relays
from .view import Stream, View, ViewLights


@dataclass(frozen=True)
class Start:
    """Knowledge at the beginning of a pass: the ``pilot``; the sampler of ``emitters``, after learning from the pilot
    if ``learned``; ``options``: kinds of lights to compare, empty if ``refusal`` holds a reason against lights.

    ``effects`` of more emitter samples, with and without virtual lights that represent emitters; ``paths``: number of
    camera rays that sized the learning; ``seed`` of the first pass; ``relays``: targets of paths, or None; ``later``:
    samplers of emitters by the size of passes, see :meth:`emitters_for`; ``known``: see
    :class:`vpl.split.plan.Evidence`.
    """

    pilot: Pilot
    emitters: EmitterSampler
    learned: bool
    options: list[Option]
    refusal: str
    effects: dict[bool, EmitterSamples]
    paths: int
    seed: int
    relays: Relays | None = None
    later: dict[int, EmitterSampler] = field(default_factory=dict)
    known: dict = field(default_factory=dict)

    @property
    def measured(self) -> int:
        """Number of options that are measured."""
        return sum(option.residual is not None for option in self.options)

    def emitters_for(self, paths: int) -> EmitterSampler:
        """The sampler for a pass of ``paths`` camera rays: large passes learn again from the same pilot, by more rays.

        Sizes are rounded to powers of four, and each power has a sampler of its own, so that a pass is independent of
        the other passes.
        """
        power = round(np.log2(max(paths / self.paths, 1)) / 2)
        rays = learning_rays(self.paths * 4**power, is_later=True)
        if power == 0 or not self.learned or rays <= learning_rays(self.paths):
            return self.emitters
        # The smallest power with as many rays, the number of which is limited
        while learning_rays(self.paths * 4 ** (power - 1), is_later=True) == rays:
            power -= 1
        if power not in self.later:
            emitters = self.emitters.copy()
            emitters.learn(*self.pilot.vertices, rays, derived_seed(self.seed, Stream.LEARNING, power))
            self.later[power] = emitters
        return self.later[power]


def make_start(view: View, virtual_lights: bool) -> Start:
    """Trace the pilot of a view, and learn from it.  ``virtual_lights``: whether virtual lights are allowed."""
    model = view.model
    if model.most_emitter_samples > 1 and view.learning_count >= model.emitter_samples_from * view.pixels:
        view = replace(view, direct_samples=dr.opaque(mi.UInt32, PILOT_SAMPLES, view.pixels))
    (view, pilot, learned), refusal = chosen_pilot(view), _refusal(view, virtual_lights)
    # Single samples, and samples that never differ, tell nothing
    fraction = retained_fraction(view) if pilot.difference.any() else 1.0
    effect = EmitterSamples.of(pilot, pilot, fraction)
    options, effects = [], {False: effect, True: effect}
    if not refusal:
        options, carried = _options(view, pilot)
        if carried is not None:
            effects[True] = EmitterSamples.of(pilot, carried, fraction)
    return Start(pilot, view.emitters, learned, options, refusal, effects, view.learning_count, view.seed, view.relays)


def evidence_of(view: View, start: Start) -> Evidence:
    """Measurements of the pilot of a start for the size of a view."""
    pilot, emitters = start.pilot, _may_carry_emitters(view)
    return Evidence(
        pilot.radiance, pilot.seen, pilot.direct, pilot.brightness, view.count, view.samples, emitters, view.model,
        start.known, view.plain_from,
    )  # fmt: skip


def _may_carry_emitters(view: View) -> bool:
    return view.emitters.lights is not None and view.rules.max_depth > 1


def _refusal(view: View, virtual_lights: bool) -> str:
    """Reason against virtual lights, independent of the pilot; an empty string if lights are possible."""
    if not virtual_lights:
        return "virtual_lights is off"
    if view.rules.max_depth <= 2 and not _may_carry_emitters(view):
        return "no light is indirect at this max_depth"
    return ""


def _options(view: View, pilot: Pilot) -> tuple[list[Option], Pilot | None]:
    """(Kinds of virtual lights that are possible; pilot where virtual lights represent emitters, None if they may
    not)."""
    if not _may_carry_emitters(view):
        return _with_surfaces(view, pilot, ViewLights()), None
    emitters = ViewLights(emitters=view.light_set([]), emitters_c=view.emitters_c)
    traced = Pilot.trace(view, emitters)
    only_emitters = Option(False, True, traced.radiance, traced.indirect)
    options = [only_emitters, *_with_surfaces(view, pilot, ViewLights()), *_with_surfaces(view, traced, emitters)]
    return options, traced


def _with_surfaces(view: View, traced: Pilot, lights: ViewLights) -> list[Option]:
    """The option of lights on surfaces, if there is indirect light, beside ``lights`` for emitters; ``traced``: pilot
    without lights on surfaces.

    The option is measured for the first pass in which its lights may pay, and until then keeps the pilot's rays, but
    not the view.
    """
    if view.rules.max_depth <= 2 or not traced.indirect.any():
        return []
    # The distance between lights is not known yet. With c = 0 lights carry the most
    with_surfaces = replace(lights, surfaces=view.light_set([]), c=LocalC.constant(0.0))
    settings = view.settings(with_surfaces, Gathering.AT_FIRST)
    rays = CameraRays.of(view, upload(mi.UInt32, pilot_lanes(view)))
    # Otherwise the rays would keep those of the view
    dr.eval(rays.ray, rays.active, rays.importance, rays.direct_samples, rays.places)
    measured = partial(rays.trace, view.scene, view.emitters, derived_seed(view.seed, Stream.PILOT), settings)

    def residual():
        return single_sample_radiance(measured())

    return [Option(True, lights.emitters is not None, traced.radiance, traced.indirect, residual)]
