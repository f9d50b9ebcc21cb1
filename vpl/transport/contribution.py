"""Contribution of a virtual light to a gather point, and the visibility of the light: the only place for both.

Opaque surfaces block.  Null surfaces (masks, thin glass) let light pass unscattered: the transmission dims the light of
oriented and environment lights, and each null surface counts as an edge of the path, as in Mitsuba's ``path``.  Null
surfaces block point lights, spots and directional emitters, because ``path`` counts no path through null surfaces, and
surface lights, because ``manylights`` traces the passing light.

Shadow rays of ``manylights`` to emitters pass null surfaces in the same way (:mod:`vpl.split.emitters.base`).

The modules of :mod:`vpl.direct` sample the remaining emitters and trace separate shadow rays.  Every surface blocks the
separate shadow rays, and BSDF samples find the light through masks and glass, as in ``path``.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.arrays import finite_or_zero, rgb_to_spectrum
from ..lights.virtual_lights import AT_INFINITY, Light, geometry
from .carried_share import carried_share


def contribution(kind: str, surface, light: Light, smallest_distance, active=True):
    """Radiance that leaves a surface due to an unoccluded light: BSDF × cosine × geometry × intensity.

    ``surface``: see :mod:`vpl.points.surfaces`, Lambertian for surface lights (contribution multiplied by w);
    ``smallest_distance``: the clamp of oriented lights.  Infinite and NaN values count as zero.
    """
    to_light, factor = geometry(kind, surface.interaction.p, light, smallest_distance)
    if kind == "surface":
        cosine = dr.maximum(dr.dot(surface.normal, to_light), 0)
        factor *= carried_share(dr.square(light.c), cosine * factor)
    active = active & (factor > 0)
    reflected = surface.reflected(to_light, active)
    return finite_or_zero(reflected * rgb_to_spectrum(light.intensity) * factor) & active


def shadow_ray(kind: str, interaction, light):
    """Ray from a surface to just before a light; endless for lights at infinity.

    It ends above the surface of a surface light by the uncertainty of the light's position.
    """
    if kind in AT_INFINITY:
        return interaction.spawn_ray(-light.direction)
    if kind == "surface":
        return interaction.spawn_ray_to(light.position + light.uncertainty * light.direction)
    return interaction.spawn_ray_to(light.position)


def transmittance(scene, traits, kind: str, ray, most, active):
    """Fraction of light reaching the ray's origin: 0 or 1, or a spectrum for partly transparent surfaces.

    ``most``: surfaces that it may pass, UInt32.  Lanes that are not ``active`` give 0.
    """
    if not traits.null or kind in ("point", "spot", "surface", "directional"):
        return unblocked(scene, traits, ray, active)
    return passage(scene, traits, ray, most, active)[0]


def has_end(ray: mi.Ray3f) -> mi.Bool:
    """Whether each shadow ray ends at a point; those to emitters at infinity do not."""
    return dr.isfinite(ray.maxt) & (ray.maxt < dr.largest(mi.Float))


def unblocked(scene, traits, ray, active):
    """1 where no surface blocks the ray, 0 elsewhere and in lanes that are not ``active``."""
    if traits.nearest_hits:
        blocked = scene.ray_intersect_preliminary(ray, active=active).is_valid()
    else:
        blocked = scene.ray_test(ray, active)
    return mi.Float(1) & active & ~blocked


def passage(scene, traits, ray, most, active, open_to=True):
    """Fraction of light reaching the ray's origin, and the number of null surfaces on the way, UInt32.

    ``most``: surfaces that it may pass, UInt32; ``open_to``: lanes whose light may pass null surfaces.  Lanes that are
    not ``active`` give 0.
    """
    passed = unblocked(scene, traits, ray, active)
    through = active & (passed == 0) & (most > 0) & open_to
    if traits.open_scene is not None:
        # Few blocked rays meet an open surface at all, and a scene of only open surfaces is tested quickly
        through &= traits.open_scene.ray_test(ray, through)
    share, crossings = _through_null_surfaces(scene, traits, ray, most, through)
    return passed + share, crossings


@dr.syntax
def _through_null_surfaces(scene, traits, ray, most, active):
    """Walk from surface to surface while surfaces let light pass unscattered, past ``most`` surfaces: (fraction of the
    light, number of surfaces passed)."""
    ray, left = mi.Ray3f(ray), mi.UInt32(most)
    active, ends = mi.Bool(active), has_end(ray)
    end = ray(dr.select(ends, ray.maxt, 0))
    passed = dr.select(active, mi.UnpolarizedSpectrum(1), 0)
    while dr.hint(active, exclude=[traits, ends, end]):
        hit = scene.ray_intersect_preliminary(ray, active=active)
        # Surfaces are usually opaque: only the remaining surfaces need a full intersection record
        crossed = active & hit.is_valid() & (left > 0) & traits.is_null(hit)
        passed = dr.select(active & hit.is_valid() & ~crossed, 0, passed)
        si = traits.interactions.at(hit, ray, crossed)
        passed = dr.select(crossed, passed * traits.transmission(si, crossed), passed)
        active = crossed & dr.any(passed > 0)
        left -= dr.select(crossed, mi.UInt32(1), 0)
        # Mitsuba moves the origin off the surface: a ray of the old direction and length would pass the end
        onward = dr.select(ends, si.spawn_ray_to(end), si.spawn_ray(ray.d))
        onward.maxt = dr.select(dr.dot(onward.d, ray.d) > 0, onward.maxt, 0)
        ray = dr.select(active, onward, ray)
    return passed, most - left
