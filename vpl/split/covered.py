"""Directions in which paths leave surfaces with bump or normal maps, where virtual lights carry a part of the light.

Virtual lights carry light in a lobe about an estimate of the perturbed normal, and paths subtract it.  Samples of the
BSDF do not reach every direction of the lobe.  Therefore the directions there are a mixture with one density
(one-sample model, Veach 1997, 9.2.4): samples of the BSDF and cosine-distributed directions about the axis of the lobe.
"""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi

from ..core.materials import Materials
from .path_state import Path, Vertex

# Probability of a cosine-distributed direction
_COSINE_SHARE = 0.1


def evaluated_and_sampled(
    path: Path, vertex: Vertex, materials: Materials, perturbed: Materials | None, toward: mi.Vector3f, chosen, turn
):  # fmt: skip
    """(Value, density) of the BSDFs in the direction ``toward``, and (sample, weight) by the numbers ``chosen`` and
    ``turn``: as Mitsuba's ``eval_pdf_sample``, with the density of the mixture where there is one.

    ``perturbed``: materials with bump or normal maps that have a minorant, None if there are none.
    """
    # A single call for all: each call adds the code of every material to the kernel
    hit, numbers = vertex.hit, (chosen, turn)
    if perturbed is None:
        return materials.call(hit.bsdf, _of_bsdf, hit.si, toward, *numbers, active=vertex.scatters)
    is_mixed = hit.perturbed & (vertex.gathers | (dr.max(dr.abs(path.carried)) > 0))
    share = dr.select(is_mixed, mi.Float(_COSINE_SHARE), 0)
    mixed, axis = partial(_of_mixture, perturbed), hit.si.to_local(hit.lobe.normal)
    return materials.call(hit.bsdf, mixed, hit.si, toward, *numbers, share, axis, active=vertex.scatters)


def _of_bsdf(bsdf, si, toward, chosen, turn, active):
    return bsdf.eval_pdf_sample(mi.BSDFContext(), si, toward, chosen, turn, active)


def _of_mixture(perturbed: Materials, bsdf, si, toward, chosen, turn, share, axis, active):
    """As :func:`_of_bsdf`, with directions about ``axis`` of the probability ``share`` if ``bsdf`` is ``perturbed``."""
    if bsdf not in perturbed:
        return _of_bsdf(bsdf, si, toward, chosen, turn, active)
    by_cosine, of_bsdf = chosen < share, 1 - share
    # One number draws the part of the mixture and, stretched, the lobe of the BSDF
    rest = dr.select(by_cosine, 0, (chosen - share) / of_bsdf)
    value, density, sample, weight = _of_bsdf(bsdf, si, toward, rest, turn, active)

    def mixture(direction, density):
        return of_bsdf * density + share * dr.maximum(dr.dot(axis, direction), 0) * dr.inv_pi

    delta = ~by_cosine & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    weight = dr.select(delta, weight / of_bsdf, weight)
    sample.wo = dr.select(by_cosine, mi.Frame3f(axis).to_world(mi.warp.square_to_cosine_hemisphere(turn)), sample.wo)
    mixed = active & (share > 0) & ~delta
    along, of_direction = bsdf.eval_pdf(mi.BSDFContext(), si, sample.wo, mixed)
    # Samples that the BSDF rejects go nowhere
    of_direction = dr.select(by_cosine | (of_direction > 0), mixture(sample.wo, of_direction), 0)
    sample.pdf = dr.select(mixed, of_direction, sample.pdf)
    sample.eta = dr.select(by_cosine, 1, sample.eta)
    sample.sampled_type = dr.select(by_cosine, mi.UInt32(mi.BSDFFlags.DiffuseReflection), sample.sampled_type)
    weight = dr.select(mixed, dr.select(of_direction > 0, along / of_direction, 0), weight)
    return value, mixture(toward, density), sample, weight
