"""Emitters that are no shapes and no environment: rows of point, spot and directional emitters, and the others."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from ..core.compilation import unrecorded
from ..core.parameters import constant_rgb, matrix_of, numbers, parameters_of

# Relative difference of two lengths, or cosine of two axes, that rounding and angles with few digits can make
_ROUNDING = 1e-3


def lights_nothing(emitter) -> bool:
    """Whether Mitsuba's ``path`` can neither hit nor sample an emitter."""
    is_delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
    return emitter.class_name() == "DirectionalArea" or (is_delta and emitter.sampling_weight() == 0)


@unrecorded()
def read_unbound(scene, group_of: Callable, known: list[mi.Emitter]) -> tuple[list, list, list, list]:
    """Rows of point emitters (position, intensity, group), of spot emitters (position, direction, intensity, cut-off
    and beam angle in radians, group) and of directional emitters (direction, irradiance, group), and (class name,
    emitter) of the remaining ones that are not ``known``.

    ``group_of``: number of the group of an emitter.
    """
    points, spots, suns, others = [], [], [], []
    for emitter in scene.emitters():
        name = emitter.class_name()
        if emitter.is_environment() or name == "AreaLight" or lights_nothing(emitter):
            continue
        parameters = parameters_of(emitter)
        intensity = constant_rgb(parameters, "irradiance" if name == "DirectionalEmitter" else "intensity")
        if name == "PointLight" and intensity is not None:
            points.append([*numbers(parameters["position"]), *intensity, group_of(emitter)])
        elif name == "SpotLight" and (spot := _round_spot(parameters, intensity)):
            spots.append([*spot, group_of(emitter)])
        elif name == "DirectionalEmitter" and intensity is not None:
            suns.append([*_directional(parameters, intensity), group_of(emitter)])
        elif not any(emitter is one for one in known):
            others.append((name, emitter))
    return points, spots, suns, others


def _round_spot(parameters, intensity) -> list | None:
    """The row of a spot emitter, without the group; None for a texture, and if the scale of the frame makes the cone
    oval, as it does in Mitsuba."""
    if intensity is None or "texture.value" not in parameters:
        return None
    matrix = matrix_of(parameters["to_world"])[:3]
    products = matrix[:, :3].T @ matrix[:, :3]
    square = products[2, 2]
    if np.abs(products - square * np.eye(3)).max() > _ROUNDING * square:
        return None
    cone = np.deg2rad([*numbers(parameters["cutoff_angle"]), *numbers(parameters["beam_width"])])
    return [*matrix[:, 3], *(matrix[:, 2] / square**0.5), *intensity, *cone]


def _directional(parameters, intensity) -> list:
    axis = matrix_of(parameters["to_world"], (2,))[:3, 0]
    length = np.linalg.norm(axis)
    # Mitsuba 3.9.1 does not normalise the direction, so that cosines have the scale of the frame
    return [*(axis / length), *(length * np.array(intensity))]
