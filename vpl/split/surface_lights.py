"""Virtual lights on surfaces where camera paths arrive, each with the irradiance found by a single path.

Random lines (:mod:`vpl.split.line_sampling`) meet surfaces (:mod:`vpl.split.line_hits`) with a known density.  Each hit
on a surface with a minorant becomes a light: irradiance × minorant over the density.  The irradiance comes from
next-event estimation and a single path from the light.  No path starts at an emitter, so the method needs no adjoint
BSDFs, no correction for shading normals and no emission sampling.  An environment lights a room through the windows as
in ``path``.

Lines go to cells that sent radiance to a pilot's paths: lights matter where visible and bright.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, spectrum_to_rgb
from ..core.parameters import fingerprint_without_camera
from ..core.sampling import derived_seed, independent_sampler
from ..lights.light_set import ScatteredGroup
from ..lights.virtual_lights import VirtualLights
from .emitters.base import EmitterSampler
from .emitters.irradiance import Places
from .lattice import Lattice
from .line_hits import LineHits, hits_of
from .line_sampling import LineSampler
from .local_c import LocalC
from .path_state import FirstEdge, Gathering, PathSettings
from .path_tracer import trace_paths
from .paths_from_places import paths_from
from .roulette import OutgoingRadiance
from .view import Stream, View, ViewLights

# Emitter samples of a light in scenes of many emitters: with one, a light near a lamp was a bright blotch
_EMITTER_SAMPLES = 4
# Largest number of kept lights over every seed, some 400 bytes each
_MOST_KEPT = 1 << 21


@dataclass(frozen=True)
class SurfaceLights:
    """``lights`` of kind "surface" with their ``c``.

    ``groups``: the positive and the negative parts of their intensities with light trees, empty parts left out.
    """

    lights: VirtualLights
    c: LocalC
    groups: list[ScatteredGroup]


def surface_lights(view: View, sampler: LineSampler, count: int, announce_tree: Callable[[], None]) -> SurfaceLights:
    """The lights at the crossings of ``count`` lines, with trees; calls ``announce_tree`` before building the trees.

    ``sampler``: of lines near the arrivals of a pilot.
    """
    # A path from a light lacks the two edges between camera and light; the expected contribution is unknown, because
    # the path is no camera path
    rules = replace(view.rules, max_depth=view.rules.max_depth - 2, rr_depth=1)
    settings = replace(view, rules=rules, outgoing=OutgoingRadiance.unknown()).settings(ViewLights())
    seed = derived_seed(view.seed, Stream.SURFACE_LIGHTS)
    hits = hits_of(view.scene, sampler.draw(count, derived_seed(seed, 2)), sampler.scene_size, derived_seed(seed, 4))
    c = LocalC.of(sampler.density, count, view.model.c_per_spacing)
    lights = _lights_at(view.scene, view.emitters, hits, c, count, settings, derived_seed(seed, 1))
    parts = _by_sign(lights)
    if parts:
        announce_tree()
    return SurfaceLights(lights, c, [ScatteredGroup.of(part, sign) for part, sign in parts])


def _by_sign(lights: VirtualLights) -> list[tuple[VirtualLights, float]]:
    """Positive and negative parts of intensities as separate lights: (lights, sign), without empty parts.

    Surfaces with a negative reflectance send negative light.  ``path`` adds negative light, and the traced part
    subtracts the share of virtual lights.
    """
    signs = (1, -1) if (lights.intensity < 0).any() else (1,)
    parts = [
        (replace(lights, intensity=np.maximum(sign * lights.intensity, 0)).without_bad()[0], sign) for sign in signs
    ]
    return [(part, sign) for part, sign in parts if part.count]


def _lights_at(
    scene, emitters: EmitterSampler, hits: LineHits, c: LocalC, lines: int, settings: PathSettings, seed: int
) -> VirtualLights:
    """A light at every hit of ``lines`` lines on a surface with a minorant: minorant × irradiance over the density.

    Mitsuba's point at a hit may lie beside the line.  The light lies on the line, where the density of lines is known.
    The irradiance is computed at Mitsuba's point, as in ``path``.
    """
    if hits.count == 0:
        return VirtualLights.of("surface", [], [], [])
    places, minorant, hit = _places_with_minorants(scene, emitters, hits.ray, settings, derived_seed(seed, 3))
    if places.count == 0:
        return VirtualLights.of("surface", [], [], [])
    irradiance, length, group = _irradiance(scene, emitters, places, settings, seed)
    position = dr.gather(mi.Point3f, hits.position, hit)
    sent = spectrum_to_rgb(minorant * irradiance)
    density = c.density.at(position, places.normal)
    squared_c = c.squared_by(density)
    dr.eval(position, sent, length, group, density, squared_c)
    density = lines * c.density.per_area(download(density))
    position, normal, sent, length = (download(x) for x in (position, places.normal, sent, length))
    with np.errstate(over="ignore"):
        intensity = (sent / density[:, None]).astype(np.float32)
    lights = VirtualLights.of("surface", position, normal, intensity, length, facing=download(places.facing))
    lights.uncertainty, lights.group = hits.uncertainty[download(hit)], download(group)
    lights.c = np.sqrt(download(squared_c))
    return lights.select((lights.intensity != 0).any(1))


def _places_with_minorants(scene, emitters, rays, settings: PathSettings, seed: int):
    """(Points of rays on surfaces with a minorant, minorants, indices of the rays), evaluated.

    Normals lie on the side of arrival.

    Uses the kernel of :func:`vpl.split.path_tracer.trace_paths`: a second kernel with the code of every material would
    take long to compile.
    """
    count = dr.width(rays.o)
    depth, gathering = dr.opaque(mi.UInt32, 2), dr.opaque(mi.UInt32, Gathering.PLACING)
    settings = replace(settings, max_depth=depth, gathering=gathering, emitters_carried=dr.opaque(mi.Bool, True))
    lattice = Lattice.of_lanes(dr.arange(mi.UInt32, count), 1, derived_seed(seed, 0))
    sampler = independent_sampler(derived_seed(seed, 1), count)
    edge = FirstEdge.of_camera(rays, 1.0, True, 1)
    met = trace_paths(scene, emitters, edge, lattice, sampler, settings).gathered.first
    index = dr.compress((met.depth > 0) & (dr.max(met.weight) > 0))
    met = met.select(index)
    places = Places(met.position, met.flat, met.normal)
    dr.eval(places)
    return places, met.weight, index


def _irradiance(scene, emitters, places: Places, settings: PathSettings, seed: int):
    """Irradiance of each place by a single path: (unpolarized spectrum, edges of the path, group of the emitter)."""
    count, relays = places.count, settings.relays
    sampler = independent_sampler(derived_seed(seed, 0), count)
    of_relays = relays.cell(places.position, places.facing) if relays else None
    # Many pixels see a light: with few of many emitters, its irradiance would vary visibly
    samples = _EMITTER_SAMPLES if emitters.lights is not None else 1
    near, _, found = paths_from(scene, emitters, places, of_relays, relays, samples, settings, sampler, seed)
    nearest, draw = near.irradiance, sampler.next_1d()
    # A light stands for paths of one length, because gather vertices far from the camera may use short paths only. The
    # irradiance is a single contribution, drawn by its share, with the colour of the contribution
    level, more = dr.sum(dr.abs(nearest)), dr.sum(dr.abs(found.drawn))
    is_nearest = draw * (level + more) < level
    one = dr.select(is_nearest, nearest, found.drawn)
    irradiance = dr.select(level + more > 0, one * (level + more) / dr.sum(dr.abs(one)), 0)
    group = dr.select(is_nearest, near.group, found.group) + dr.opaque(mi.UInt32, 0, count)
    return irradiance, dr.select(is_nearest, near.length, found.length), group


class KeptLights:
    """Surface lights of a single scene at a time, by key: the parameters besides the scene, for example a seed.

    The density is positive on every surface, so the lights serve further cameras without bias, with fewer lights
    outside of the first camera's view.  A scene counts as unchanged while the printed text and the parameters of the
    objects are equal, without sensors and integrator: see :func:`vpl.core.parameters.fingerprint_without_camera`.
    ``most``: largest number of kept lights.
    """

    def __init__(self):
        self.most = _MOST_KEPT
        self._scene: str | None = None
        self._known: dict[tuple, SurfaceLights] = {}

    @property
    def count(self) -> int:
        """Number of lights."""
        return sum(one.lights.count for one in self._known.values())

    def find(self, scene, key: tuple, make: Callable[[], SurfaceLights]) -> SurfaceLights:
        """The lights of a scene and a key: kept ones, or the result of ``make``."""
        found = fingerprint_without_camera(scene)
        if found != self._scene:
            self._scene, self._known = found, {}
        if key in self._known:
            return self._known[key]
        made = make()
        if self.count + made.lights.count <= self.most:
            self._known[key] = made
        return made
