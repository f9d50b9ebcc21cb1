"""Emitters that have an extent, turned into virtual lights as the many-light papers do (``direct="vpl"``)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, finite_or_zero, spectrum_to_rgb
from ..core.sampling import Choice, independent_sampler, stratified
from .emission import bounding_sphere
from .emitters import Emitters
from .virtual_lights import VirtualLights


def area_lights(emitters: Emitters, count: int, seed: int) -> VirtualLights:
    """``count`` points on area emitters as oriented lights, chosen by power and then by area."""
    area = emitters.area
    choice = Choice(area.power)
    sampler = independent_sampler(seed, count)
    row = choice.row(stratified(sampler, count, 0, count))
    ps = area.on_shape("sample_position", row, mi.Float(0), sampler.next_2d(), mi.Bool(True))
    intensity = spectrum_to_rgb(area.emitted_in_front(row, ps)) / (ps.pdf * choice.probability(row) * count)
    return VirtualLights.of("oriented", download(ps.p), download(ps.n), download(intensity))


def environment_lights(scene, emitters: Emitters, count: int, seed: int) -> VirtualLights:
    """``count`` directions towards the environment as lights at infinity, by its own importance sampling."""
    sampler = independent_sampler(seed, count)
    reference = dr.zeros(mi.Interaction3f, count)
    reference.p = mi.Point3f(bounding_sphere(scene).center)
    ds, weight = emitters.environment.sample_direction(reference, sampler.next_2d())
    irradiance = dr.zeros(mi.Color3f, count) + spectrum_to_rgb(finite_or_zero(mi.unpolarized_spectrum(weight))) / count
    return VirtualLights.of("environment", None, download(-ds.d), download(irradiance))


def lights_of_emitters(scene, emitters: Emitters, count: int, seed: int) -> list[VirtualLights]:
    """Area emitters and the environment as ``count`` virtual lights each.

    Raises a ValueError naming the first emitter that has no such form.
    """
    for name, _ in emitters.others:
        raise ValueError(f'emitter of type "{name}" cannot become virtual lights: use direct="nee" with this scene')
    lights = []
    if np.any(emitters.area.power > 0):
        lights.append(area_lights(emitters, count, seed))
    if emitters.environment is not None:
        lights.append(environment_lights(scene, emitters, count, seed))
    return lights
