"""From camera rays to gather points: through mirrors, glass and masks to the first surface with a smooth BSDF lobe.

Every camera ray has at most one gather point.  At a surface with delta and smooth lobes (plastic, masks) the path
continues with one of the two, chosen in proportion to reflectance and weighted by the inverse probability.  At the last
surface that may be gathered, it continues with both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, channel_mean, download, finite_or_zero, ones, upload
from ..core.interactions import Interactions
from ..core.loops import recorded_once
from ..core.materials import Materials
from ..core.morton import morton_order
from ..core.path_limits import PathLimits
from ..core.registry import RegistryTable
from ..core.sampling import derived_seed, independent_sampler
from ..core.shapes import SceneShapes, scene_of
from ..lights.emitters import Emitters
from ..lights.perturbed import perturbed_shapes
from .alpha import opaque_rays

# Least probability of the delta and of the smooth lobes, unless their reflectance is zero
_LEAST_PROBABILITY = 0.05
# Bits per axis of the Morton codes that order gather points
_CURVE_BITS = 10


@dataclass(frozen=True)
class SceneTraits:
    """Capabilities of a scene's surfaces, as kernels omit code for absent ones, and their geometry.

    ``delta``, ``null``, ``smooth``, ``glossy``, ``transmissive``: whether any BSDF has such a lobe; ``perturbed``:
    registry indices of shapes with bump or normal maps; ``open_shapes``: registry indices of shapes that transmit light
    unscattered, and of instances of groups with such shapes; ``open_scene``: a scene of the open shapes alone,
    None if there are none, if a group has one, and on CUDA, where a kernel can trace rays in one scene only;
    ``materials`` of all surfaces; ``interactions`` of rays with surfaces; ``nearest_hits``: whether a shadow ray
    searches its nearest hit, as a path does.  On spheres of more than some hundred units, Mitsuba's test for any hit
    reports the surface at the origin of a ray more often.
    """

    delta: bool
    null: bool
    smooth: bool
    glossy: bool
    transmissive: bool
    perturbed: tuple[int, ...]
    open_shapes: tuple[int, ...]
    open_scene: mi.Scene | None
    materials: Materials
    interactions: Interactions
    nearest_hits: bool = False

    def is_null(self, hit):
        """Whether the shapes of preliminary intersections may transmit light unscattered.

        On the CPU, an intersection with an instance has no shape, so any shape of an open group may have been hit.
        """
        table = RegistryTable(self.open_shapes, 1)
        return (table.at(hit.shape) == 1) | (table.at(hit.instance) == 1)

    @cached_property
    def open_materials(self) -> Materials:
        """The materials that transmit light unscattered."""
        return self.materials.having(mi.BSDFFlags.Null)

    def transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Fraction of light that passes surfaces unscattered; 0 where a lane is not ``active``."""
        share = self.open_materials.call(si.bsdf(), _transmission, si, active=active)
        return finite_or_zero(mi.unpolarized_spectrum(share))


def _transmission(bsdf, si, active):
    return bsdf.eval_null_transmission(si, active)


def shape_in(shape, indices: tuple[int, ...]):
    """Whether shapes (a pointer array) have one of the given registry indices."""
    return RegistryTable(indices, 1).at(shape) == 1


@dataclass
class GatherPoints:
    """Points to shade, in Morton order of their positions or in the order of their camera rays.

    ``si``: surface interactions (evaluated); ``ray``: index of the camera ray; ``weight``: throughput from the point to
    the camera; ``depth``: edges from the camera to the point.
    """

    si: mi.SurfaceInteraction3f
    ray: mi.UInt32
    weight: mi.UnpolarizedSpectrum
    depth: mi.UInt32

    @property
    def count(self) -> int:
        return dr.width(self.ray)

    def places(self, most: int) -> np.ndarray:
        """Positions of at most ``most`` points at equal index steps, (n, 3) float32."""
        count = min(self.count, most)
        index = upload(mi.UInt32, np.arange(count, dtype=np.int64) * self.count // max(count, 1))
        return download(dr.gather(mi.Point3f, self.si.p, index))

    def select(self, index) -> GatherPoints:
        """Points at the indices ``index``, as lazy gathers."""
        return GatherPoints(*(dr.gather(type(x), x, index) for x in (self.si, self.ray, self.weight, self.depth)))


@dataclass
class CameraPaths:
    """Result of following camera rays.

    ``emission``: per camera ray, radiance of directly visible emitters; ``valid``: whether the ray is opaque in the
    film's alpha; without the sky, see ``integrators.gathering.CameraPass``.
    """

    emission: mi.UnpolarizedSpectrum
    valid: mi.Bool
    points: GatherPoints


def scene_traits(scene) -> SceneTraits:
    """The traits of a scene as it is now."""
    flags, open_shapes, shapes = 0, {}, SceneShapes.of(scene)
    for index, shape in shapes.of_hits:
        found = int(shape.bsdf().flags())
        if found & int(mi.BSDFFlags.Null):
            open_shapes[index] = shape
        flags |= found

    def have(flag):
        return bool(flags & int(flag))

    kinds = mi.BSDFFlags
    transmissive = have(int(kinds.DiffuseTransmission) | int(kinds.GlossyTransmission))
    lobes = (have(kind) for kind in (kinds.Delta, kinds.Null, kinds.Smooth, kinds.Glossy))
    open_groups = shapes.groups_with(open_shapes)
    open_instances, open_scene = [index for one in open_groups for index, _ in one.instances], None
    if open_shapes and not open_groups and dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        open_scene = scene_of([*open_shapes.values()])
    listed = *open_shapes, *open_instances
    return SceneTraits(
        *lobes, transmissive, perturbed_shapes(shapes), listed, open_scene, Materials.of(shapes),
        Interactions(scene, shapes),
    )  # fmt: skip


def refuse_media(scene) -> None:
    """Raise a ValueError with the name of the first shape that bounds a participating medium."""
    for number, (_, shape) in enumerate(SceneShapes.of(scene).of_hits):
        if shape.is_medium_transition():
            raise ValueError(
                f'shape {number} ("{shape.id()}", {shape.class_name()}) bounds a participating medium; '
                "many-light integrators support surfaces only"
            )


def _follow_delta(si, bsdf, flags, both, sample1, sample2, choice):
    """Choose between the delta and the smooth lobes of a surface, or follow ``both``.

    Returns (whether delta lobes are followed, whether smooth lobes are followed, direction and weight of the delta
    sample, relative index of refraction, weight of the smooth lobes).
    """
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Delta
    sample, weight = bsdf.sample(context, si, sample1, sample2)
    weight = finite_or_zero(mi.unpolarized_spectrum(weight))
    # Materials that ignore the type mask may sample smooth lobes; those samples have no weight here
    weight &= mi.has_flag(flags, mi.BSDFFlags.Delta) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    delta_level = channel_mean(weight)
    opaque = 1 - channel_mean(mi.unpolarized_spectrum(bsdf.eval_null_transmission(si)))
    smooth_level = channel_mean(finite_or_zero(mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si)))) * opaque
    smooth = mi.has_flag(flags, mi.BSDFFlags.Smooth) & (opaque > 0)
    probability = dr.clip(delta_level / (delta_level + smooth_level), _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
    probability = dr.select(delta_level > 0, dr.select(smooth, probability, 1), 0)
    followed = dr.select(both, delta_level > 0, choice < probability)
    delta_share, smooth_share = dr.select(both, 1, probability), dr.select(both, 1, 1 - probability)
    return (
        followed, both | ~followed, si.to_world(sample.wo), weight / delta_share, sample.eta, dr.rcp(smooth_share),
    )  # fmt: skip


def emitted_towards(emitters: Emitters, si, active=True):
    """Radiance emitted from ``si`` against the ray's direction, by area emitters or the environment emitter."""
    emission = dr.zeros(mi.UnpolarizedSpectrum, dr.width(si.wi))
    if emitters.area.count:
        row = emitters.area.row(si, active & si.is_valid())
        shown = active & (row > 0)
        emission = emitters.area.emitted(row - 1, si, shown) & shown
    if emitters.environment is not None:
        shown = active & ~si.is_valid()
        sky = finite_or_zero(mi.unpolarized_spectrum(emitters.environment.eval(si, shown)))
        emission = dr.select(shown, sky, emission)
    return emission


def _surfaces(traits: SceneTraits, ray, coherent, hides: bool, active):
    """The nearest surfaces on rays; ``hides``: whether rays pass area emitters."""
    return _behind_emitters(traits, ray, active) if hides else traits.interactions.meet(ray, active, coherent)


@recorded_once
@dr.syntax
def _behind_emitters(traits: SceneTraits, ray, active):
    """The nearest surfaces on rays that are no emitters: `path` of Mitsuba 3.9.1 counts the distances from the last
    emitter as distances from the camera, so that spheres, disks and cylinders behind emitters have wrong positions."""
    ray, going = mi.Ray3f(ray), mi.Bool(active)
    found = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
    while dr.hint(going, exclude=[traits]):
        si = traits.interactions.meet(ray, going, mi.Bool(True))
        found = dr.select(going, si, found)
        going &= si.is_valid() & si.shape.is_emitter()
        ray = dr.select(going, si.spawn_ray(ray.d), ray)
    return found


def _wave(
    emitters: Emitters, traits: SceneTraits, random, ray, throughput, eta, depth, limits: PathLimits, hides: bool,
    active,
):  # fmt: skip
    """One edge of the camera paths, evaluated in one kernel.

    ``hides``: whether emitters are hidden; ``eta``: product of the relative indices of refraction of the edges before.
    Returns emission, hit mask, mask of hits that may be passed unscattered, (gather mask, surface interaction, weight),
    (mask, ray, throughput, product of the indices) of continuing paths.
    """
    si = _surfaces(traits, ray, depth == 1, hides, active)
    hit = active & si.is_valid()
    emission = dr.zeros(mi.UnpolarizedSpectrum, dr.width(ray.d))
    if not hides:
        emission = throughput * emitted_towards(emitters, si, active)

    bsdf = si.bsdf(ray)
    flags = bsdf.flags()
    goes_on, stays, smooth_weight = mi.Bool(False), mi.Bool(True), mi.Float(1)
    direction, following = mi.Vector3f(0, 0, 1), mi.UnpolarizedSpectrum(0)
    if traits.delta:
        # The next surface is too deep to gather, so following both costs no additional gather point
        both = depth + 1 == limits.max_depth
        goes_on, stays, direction, following, own, smooth_weight = _follow_delta(si, bsdf, flags, both, *random[:3])
        eta = eta * own
    gathered = hit & mi.has_flag(flags, mi.BSDFFlags.Smooth) & stays & (depth < limits.max_depth)
    weight = throughput * smooth_weight
    if traits.delta:
        following *= throughput
        survival = limits.survival(following, eta, depth)
        goes_on &= hit & (depth < limits.max_depth) & dr.any(following > 0) & (random[3] < survival)
        following /= survival
    next_ray = si.spawn_ray(direction)
    # Widen uniform fields, which have a single entry, because points are gathered and scattered by index
    si = dr.select(gathered, si, dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d)))
    passable = hit & mi.has_flag(flags, mi.BSDFFlags.Null) if traits.null else mi.Bool(False)
    dr.eval(emission, hit, passable, gathered, si, weight, goes_on, next_ray.o, next_ray.d, following, eta)
    return emission, hit, passable, (gathered, si, weight), (goes_on, next_ray, following, eta)


def follow_camera_rays(
    emitters, traits, sampler, seed, ray, active, max_depth, rr_depth, hides=False, along_curve=True
):
    """Trace camera rays to their gather points: :class:`CameraPaths`.

    ``ray``: a wavefront of camera rays; inactive rays return zero; ``max_depth``, ``rr_depth``: defined by Mitsuba's
    ``path`` (math.inf: no limit); ``hides``: whether the first edge passes area emitters; ``along_curve``: whether to
    sort points along a Morton curve instead of by ray.
    """
    count = dr.width(ray.d)
    ray.time += dr.zeros(mi.Float, count)
    ray.maxt += dr.zeros(mi.Float, count)
    lane = dr.arange(mi.UInt32, count)
    active = mi.Bool(active) & (lane < dr.opaque(mi.UInt32, count))
    limits = PathLimits.of(max_depth, rr_depth)
    throughput, eta, depth = ones(count), dr.ones(mi.Float, count), 1
    found = None
    while True:
        random = (sampler.next_1d(), sampler.next_2d(), sampler.next_1d(), sampler.next_1d()) if traits.delta else None
        # Opaque: the waves of all depths share one kernel
        dr.make_opaque(ray, active, throughput, eta, random)
        emitted, hit, passable, gathered, going = _wave(
            emitters, traits, random, ray, throughput, eta, dr.opaque(mi.UInt32, depth), limits, hides, active
        )
        if found is None:
            emission, valid = emitted, hit
            if traits.null:
                _open_masks(traits, ray, hides, limits, derived_seed(seed, 4), valid, passable)
            mask, si, weight = gathered
            found = (mask, si, weight, dr.full(mi.UInt32, 1, count))
            dr.eval(found)
        else:
            add_at(emission, emitted, lane)
            # A ray that continued beside a gather point finds no second one
            for target, value in zip(found, (*gathered, mi.UInt32(depth)), strict=True):
                dr.scatter(target, value, lane, gathered[0])
        hides = False
        if not traits.delta:
            break
        onward = dr.compress(going[0])
        if len(onward) == 0:
            break
        lane, throughput, eta = (dr.gather(type(x), x, onward) for x in (lane, *going[2:]))
        time = dr.gather(mi.Float, ray.time, onward)
        ray = mi.Ray3f(*(dr.gather(type(x), x, onward) for x in (going[1].o, going[1].d)), time)
        ray.maxt = dr.full(mi.Float, dr.largest(mi.Float), len(onward))
        depth, active = depth + 1, dr.full(mi.Bool, True, len(onward))
        sampler = independent_sampler(derived_seed(seed, 3, depth), len(onward))
    return CameraPaths(emission, valid, _collect(*found, along_curve))


def _open_masks(traits, ray, hides: bool, limits: PathLimits, seed: int, valid, passable) -> None:
    """Clear the mask ``valid`` for the rays that pass unscattered what they meet; ``passable``: those that may."""
    lanes = dr.compress(passable)
    if len(lanes) == 0:
        return
    first = mi.Ray3f(*(dr.gather(type(x), x, lanes) for x in (ray.o, ray.d, ray.time)))
    first.maxt = dr.gather(mi.Float, ray.maxt, lanes)
    si = _surfaces(traits, first, mi.Bool(True), hides, dr.full(mi.Bool, True, len(lanes)))
    dr.scatter(valid, opaque_rays(traits, si, limits, independent_sampler(seed, len(lanes))), lanes)


def _collect(mask, si, weight, depth, along_curve: bool) -> GatherPoints:
    """Compact the lanes with a gather point, in Morton order if ``along_curve``."""
    lanes = dr.compress(mask)
    if len(lanes) and along_curve:
        order = morton_order(download(dr.gather(mi.Point3f, si.p, lanes)), _CURVE_BITS)
        lanes = dr.gather(mi.UInt32, lanes, upload(mi.UInt32, order))
    points = GatherPoints(*(dr.gather(type(x), x, lanes) for x in (si, lanes, weight, depth)))
    points.ray = lanes
    dr.eval(points.si, points.ray, points.weight, points.depth)
    return points


@dataclass
class PixelGrid:
    """Layout of camera rays in the image: rows of ``width`` pixels with ``samples`` consecutive rays each.

    ``known``: false if the layout is unknown and every ray counts as a pixel.
    """

    width: int
    samples: int
    known: bool = True
