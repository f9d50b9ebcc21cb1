"""BSDF proxies: upper bounds of every gather point's BSDF, found by probing, for error bounds only.

For an outgoing direction at angle θ from the normal and δ from the mirror direction, the proxy is

    BSDF × cos θ  <=  base × cos θ + peak × max(cos δ, 0)^exponent

Probes far from the mirror direction determine the base.  Probes from the mirror direction outwards fit the lobe, wide
enough to contain each of them.  Materials that transmit or perturb the normal are bounded without the receiver's
cosine, by a base that also bounds the BSDF at directions sampled by the material.

The bound is exact for Lambertian points and holds at the probed directions of non-Lambertian points.  Between probes,
narrow lobes at grazing angles can exceed the proxy.  The cut may then contain a cluster that a correct bound would
refine, which increases the error.  No light is lost, because the proxy is positive wherever the material may reflect.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import finite_or_zero, spectrum_to_rgb, upload
from ..core.sampling import independent_sampler
from .camera_paths import GatherPoints, SceneTraits, shape_in

# Largest exponent of a lobe
_SHARPEST = 1e5
# Smallest base as a fraction of the peak: a probe alone must not exclude a direction
_LEAST_BASE = 1e-4
# BSDF samples per point
_MATERIAL_SAMPLES = 8
# Relative deviation from albedo × cosine up to which a BSDF counts as Lambertian
_LAMBERTIAN_TOLERANCE = 1e-5
# Angles in degrees between a probe and the mirror direction, for the base (far) and for the lobe (near)
_FAR_ANGLES, _NEAR_ANGLES = (55.0, 75.0, 100.0), (0.0, 2.0, 4.0, 8.0, 15.0, 25.0, 40.0)
_AZIMUTHS = (0.0, 90.0, 180.0, 270.0)


@dataclass
class MaterialProxy:
    """Proxy parameters per gather point.

    ``base``, ``peak``: RGB; ``exponent``; ``axis``: world space mirror direction; ``no_cosine``: mask of points to
    bound without the receiver's cosine; ``lambertian``: mask of points with the BSDF ``base × cos θ`` at every probe;
    ``glossy``: whether any point of the scene has a lobe; ``without_cosines``: whether ``no_cosine`` can be true.
    ``peak``, ``exponent`` and ``axis`` may be None without lobes.
    """

    base: mi.Color3f
    peak: mi.Color3f | None
    exponent: mi.Float | None
    axis: mi.Vector3f | None
    no_cosine: mi.Bool
    lambertian: mi.Bool
    glossy: bool
    without_cosines: bool

    def select(self, index, active=True) -> MaterialProxy:
        """Fetch the proxies at ``index``, without the fields that the scene does not need."""

        def fetch(value, needed):
            return dr.gather(type(value), value, index, active) if needed else value

        return MaterialProxy(
            fetch(self.base, True),
            fetch(self.peak, self.glossy),
            fetch(self.exponent, self.glossy),
            fetch(self.axis, self.glossy),
            fetch(self.no_cosine, self.without_cosines),
            self.lambertian,
            self.glossy,
            self.without_cosines,
        )


def _probe_table(glossy: bool) -> np.ndarray:
    """Probes as rows (angle, azimuth, is far); a negative angle marks the first probe, along the normal (albedo)."""
    rows = [(-1.0, 0.0, 1.0), (20.0, 30.0, 1.0), (50.0, 200.0, 1.0)]
    if glossy:
        rows += [(angle, azimuth, 1.0) for angle in _FAR_ANGLES for azimuth in _AZIMUTHS]
        rows += [(angle, azimuth, 0.0) for angle in _NEAR_ANGLES for azimuth in (_AZIMUTHS if angle > 0 else (0.0,))]
    return np.array(rows, np.float32) * np.float32([np.pi / 180, np.pi / 180, 1])


@dr.syntax
def probe_materials(points: GatherPoints, traits: SceneTraits) -> MaterialProxy:
    """Probe the BSDF of every gather point, in one kernel with one BSDF call inside a loop."""
    si, bsdf = points.si, points.si.bsdf()
    table = _probe_table(traits.glossy)
    probes, count = upload(mi.Float, table), dr.opaque(mi.UInt32, len(table))
    side = dr.select(mi.Frame3f.cos_theta(si.wi) >= 0, mi.Float(1), mi.Float(-1))
    mirror = mi.reflect(si.wi)
    frame = mi.Frame3f(mirror)
    base, peak, exponent = mi.Color3f(0), mi.Color3f(0), mi.Float(_SHARPEST)
    albedo, deviation = mi.Color3f(0), mi.Float(0)
    k = mi.UInt32(0)
    while k < count:
        probe = dr.gather(mi.Vector3f, probes, k)
        sine, cosine = dr.sincos(probe.x)
        local = mi.Vector3f(sine * dr.cos(probe.y), sine * dr.sin(probe.y), cosine)
        wo = dr.select(probe.x < 0, mi.Vector3f(0, 0, side), frame.to_world(local))
        value = spectrum_to_rgb(finite_or_zero(mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, wo))))
        abs_cos = dr.abs(mi.Frame3f.cos_theta(wo))
        albedo = dr.select(k == 0, value, albedo)
        lambert = albedo * dr.maximum(mi.Frame3f.cos_theta(wo) * side, 0)
        deviation = dr.maximum(deviation, dr.max(dr.abs(value - lambert)))
        far = probe.z > 0
        base = dr.select(far & (abs_cos > 0), dr.maximum(base, value / abs_cos), base)
        excess = dr.select(far, mi.Color3f(0), dr.maximum(value - base * abs_cos, 0))
        # A probe above the lobe either raises the peak or, off the axis, widens the lobe to contain the probe
        level, top = dr.max(excess), dr.max(peak)
        wider = (level > 0) & (level < top) & (cosine > 0) & (cosine < 1)
        exponent = dr.select(wider, dr.minimum(exponent, dr.log(level / top) / dr.log(cosine)), exponent)
        # The limits keep the scale finite; cosines of near probes are above 0.7
        scale = dr.select(level > top, dr.power(dr.maximum(cosine, 0.1), -dr.minimum(exponent, 100)), 1)
        peak = dr.maximum(peak, excess * scale)
        k += 1
    no_cosine = _without_cosine(si, bsdf, traits)
    if dr.hint(needs_no_cosine(traits), mode="scalar"):
        sampled = _largest_sampled_value(si, bsdf, no_cosine)
        base = dr.select(no_cosine, dr.maximum(base + peak, sampled), base)
    base = dr.maximum(base, _LEAST_BASE * (peak + dr.max(base)))
    lambertian = ~no_cosine & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
    lambertian &= deviation <= _LAMBERTIAN_TOLERANCE * dr.max(albedo)
    base = dr.select(lambertian, albedo, base)
    axis = si.to_world(mirror)
    dr.eval(base, peak, exponent, axis, no_cosine, lambertian)
    return MaterialProxy(base, peak, exponent, axis, no_cosine, lambertian, traits.glossy, needs_no_cosine(traits))


@dr.syntax
def _largest_sampled_value(si, bsdf, active):
    """Largest BSDF × cosine in directions sampled by the material, for lobes away from the mirror direction."""
    sampler = independent_sampler(0, dr.width(si.p))
    largest, k = mi.Color3f(0), mi.UInt32(0)
    while k < _MATERIAL_SAMPLES:
        sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active)
        smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Smooth)
        value = spectrum_to_rgb(finite_or_zero(mi.unpolarized_spectrum(weight) * sample.pdf))
        largest = dr.select(smooth, dr.maximum(largest, value), largest)
        k += 1
    return largest


def needs_no_cosine(traits: SceneTraits) -> bool:
    """Whether the scene has materials to bound without the receiver's cosine."""
    return traits.transmissive or len(traits.perturbed) > 0


def _without_cosine(si, bsdf, traits: SceneTraits):
    """Mask of points whose material transmits light or perturbs the shading normal."""
    mask = dr.full(mi.Bool, False, dr.width(si.p))
    if traits.transmissive:
        flags = bsdf.flags()
        mask |= mi.has_flag(flags, mi.BSDFFlags.DiffuseTransmission)
        mask |= mi.has_flag(flags, mi.BSDFFlags.GlossyTransmission)
    if traits.perturbed:
        mask |= shape_in(si.shape, traits.perturbed)
    return mask
