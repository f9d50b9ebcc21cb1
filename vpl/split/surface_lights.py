"""Virtual lights drawn on surfaces where paths from the camera arrive, each with what one path from it finds.

Random lines through the cells in which camera paths arrive (:mod:`vpl.split.cells`) meet surfaces at points of known
density.  Each becomes a light: irradiance there, found by next-event estimation and one path, times the floor of its
BSDF.  No path from an emitter is followed, so that nothing needs adjoint BSDFs, corrections for shading normals or rays
that leave emitters, and an environment that lights a room by its windows is met as ``path`` meets it.

Cells are chosen by what a pilot's paths brought to the camera from there: light is wanted where it is seen and bright.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, ones, spectrum_to_rgb, upload, upload_vectors
from ..core.loops import recorded_once
from ..core.sampling import derived_seed, independent_sampler
from ..lights.emission import bounding_box
from ..lights.virtual_lights import VirtualLights
from .cells import Cells, Lines
from .irradiance import Places, irradiance_from_emitters
from .numbers import SpreadNumbers
from .paths import PAST, PLACING, FirstEdge, Limits
from .pilot import Arrivals
from .remainder import follow

# Arrivals of average brightness that a cell is taken to have had, besides its own
_PRIOR = 2.0
# Samples of emitters that a light has where there are many of these
_EMITTER_SAMPLES = 4
# Surfaces that one line meets at most, so that an endless row of hits at one place comes to an end
_MOST_LAYERS = 1024


@dataclass
class SurfaceLights:
    """``lights``: of kind "surface"; ``cells``, ``lines``: what they were drawn by, and how often."""

    lights: VirtualLights
    cells: Cells
    lines: int

    def spacing(self, arrivals: Arrivals) -> float:
        """Typical distance between lights where camera paths arrive, world units."""
        density = self.lines * self.cells.density(arrivals.position, arrivals.normal)
        return float(np.median(1 / np.sqrt(density)))


def surface_lights(scene, emission, arrivals: Arrivals, count: int, limits: Limits, seed: int) -> SurfaceLights:
    """The lights that ``count`` lines meet.  ``limits``: of the paths that find their irradiance."""
    generator = np.random.default_rng(seed)
    box = bounding_box(scene)
    low, extent = np.array(box.min, np.float64), np.array(box.extents(), np.float64)
    # A little larger, so that no surface lies on its sides
    size = 1.001 * max(float(extent.max()), np.finfo(np.float32).tiny)
    cells = Cells(
        arrivals.position, arrivals.normal, arrivals.weight, low + 0.5 * (extent - size), size, generator
    )  # fmt: skip
    cells.choose_by(_importance(cells, arrivals))
    lights = _lights_along(scene, emission, cells.lines(count, generator), limits, derived_seed(seed, 1))
    density = count * cells.density(lights.position, lights.direction)
    with np.errstate(over="ignore"):
        lights.intensity = (lights.intensity / density[:, None]).astype(np.float32)
    # What single precision cannot hold after that is no light either
    return SurfaceLights(lights.without_bad()[0], cells, count)


def _importance(cells: Cells, arrivals: Arrivals) -> np.ndarray:
    """Share of lights that each leaf should have: by its arrivals and the root mean square of what they brought."""
    leaf, size = cells.leaf_of_point, len(cells.leaf_weight)
    number = np.bincount(leaf, minlength=size)
    squared = np.bincount(leaf, arrivals.level**2, size)
    typical = np.mean(arrivals.level**2)
    if not typical > 0:
        return cells.leaf_weight
    return number * np.sqrt((squared + _PRIOR * typical) / (number + _PRIOR))


def _lights_along(scene, emission, lines: Lines, limits: Limits, seed: int) -> VirtualLights:
    """A light wherever a line meets a surface with a floor: their intensities are floor × irradiance, per hit."""
    rays = _rays_to_surfaces(scene, lines)
    if dr.width(rays.o) == 0:
        return VirtualLights.of("surface", [], [], [])
    places, floor = _places_with_floors(scene, emission, rays, limits, derived_seed(seed, 3))
    if places.count == 0:
        return VirtualLights.of("surface", [], [], [])
    irradiance, length = _irradiance(scene, emission, places, limits, seed)
    columns = (places.position, places.normal, spectrum_to_rgb(floor * irradiance), length)
    dr.eval(columns)
    lights = VirtualLights.of("surface", *(download(column) for column in columns))
    lights.facing = download(places.facing)
    return lights.without_bad()[0]


def _rays_to_surfaces(scene, lines: Lines):
    """Rays, one for every surface that a line meets, that begin shortly before it; line by line."""
    origin, direction = (upload_vectors(mi.Point3f, x) for x in (lines.origin, lines.direction))
    direction, length = mi.Vector3f(direction), upload(mi.Float, lines.length)
    lines = origin, direction, length
    # The same kernel counts them and finds them
    number = _meet(scene, lines, dr.zeros(mi.UInt32, len(length)), False, dr.zeros(mi.Point3f, 1), mi.UInt32(0))
    count = int(dr.sum(number)[0])
    if count == 0:
        return dr.zeros(mi.Ray3f, 0)
    starts, line = dr.zeros(mi.Point3f, count), dr.zeros(mi.UInt32, count)
    _meet(scene, lines, dr.prefix_reduce(dr.ReduceOp.Add, number), True, starts, line)
    return mi.Ray3f(starts, dr.gather(mi.Vector3f, direction, line))


@recorded_once
@dr.syntax
def _meet(scene, lines, first, find: bool, starts, line):
    """How many surfaces each of the ``lines`` (origin, direction, length) meets.  Where ``find`` is set, the place
    before each and the number of its line are written to ``starts`` and ``line``, those of a line from ``first`` on."""
    origin, direction, length = lines
    find = dr.opaque(mi.Bool, find)
    dr.make_opaque(first, starts, line)
    place, remaining, number = mi.Point3f(origin), mi.Float(length), dr.zeros(mi.UInt32, dr.width(length))
    this, active = dr.arange(mi.UInt32, dr.width(length)), length > 0
    while dr.hint(active, exclude=[scene, origin, direction, length, first, find, this, starts, line]):
        ray = mi.Ray3f(place, direction, remaining, 0.0, [])
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=active)
        active &= si.is_valid()
        dr.scatter(starts, place, first + number, active & find)
        dr.scatter(line, this, first + number, active & find)
        number += dr.select(active, 1, 0)
        onward = si.spawn_ray(direction)
        place, remaining = dr.select(active, onward.o, place), remaining - si.t
        active &= (remaining > 0) & (number < _MOST_LAYERS)
    dr.eval(number, starts, line)
    return number


def _places_with_floors(scene, emission, rays, limits: Limits, seed: int):
    """Places that rays meet where there is a floor, with normals on the side that was met: (places, floors), evaluated.

    Found by the kernel that follows paths, for another with the code of all materials would take long to compile.
    """
    count = dr.width(rays.o)
    depth, gathering = dr.opaque(mi.UInt32, 2), dr.opaque(mi.UInt32, PLACING)
    limits = replace(limits, max_depth=depth, gathering=gathering, emitters_carried=dr.opaque(mi.Bool, True))
    numbers = SpreadNumbers(dr.arange(mi.UInt32, count), 1, derived_seed(seed, 0))
    sampler = independent_sampler(derived_seed(seed, 1), count)
    _, met, *_ = follow(scene, emission, FirstEdge.of_camera(rays, 1.0, True), numbers, sampler, limits)
    met = met.select(dr.compress((met.depth > 0) & (dr.max(met.weight) > 0)))
    outward = met.flat * dr.mulsign(mi.Float(1), dr.dot(met.flat, met.normal))
    places = Places(met.position, outward, met.normal)
    dr.eval(places)
    return places, met.weight


def _irradiance(scene, emission, places: Places, limits: Limits, seed: int):
    """Irradiance of each place by one path: (unpolarized spectrum, edges of a path that found it)."""
    count = places.count
    site = emission.choice.site(places.position, places.facing) + dr.opaque(mi.UInt32, 0, count)
    sampler = independent_sampler(derived_seed(seed, 0), count)
    # A path that begins with a direction drawn by the cosine
    local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    ray = places.interaction().spawn_ray(mi.Frame3f(places.facing).to_world(local))
    density, draw = local.z * dr.inv_pi, sampler.next_1d()
    dr.eval(site, ray, density, draw)
    # A light is seen by many pixels: where there are many emitters, what it has of one of them would show
    samples = _EMITTER_SAMPLES if emission.lights is not None else 1
    nearest, _ = irradiance_from_emitters(scene, emission, places, site, samples, derived_seed(seed, 2))
    # A direction has a weight of pi, by which roulette lets paths go on: ended by what surfaces leave of it, they would
    # cost lights 7% less and leave 12% more of their noise (kitchen)
    edge = FirstEdge.of(places.position, ray, ones(count) * dr.pi, density, False, PAST, site, 1.0, True)
    numbers = SpreadNumbers(dr.arange(mi.UInt32, count), 1, seed)
    found, *_ = follow(scene, emission, edge, numbers, independent_sampler(derived_seed(seed, 1), count), limits)
    # Gather points further from the camera may use shorter paths only: a light stands for paths of one length, and has
    # the colour of none but these
    level, more = dr.sum(nearest), dr.sum(found.drawn)
    is_nearest = draw * (level + more) < level
    one = dr.select(is_nearest, nearest, found.drawn)
    irradiance = dr.select(level + more > 0, one * (level + more) / dr.sum(one), 0)
    return irradiance, dr.select(is_nearest, mi.UInt32(1), found.length)
