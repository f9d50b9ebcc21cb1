"""From camera rays to gather points: through mirrors, glass and masks to the first surface that a light can reach.

Every camera ray ends in at most one gather point.  Where a surface has both a delta and a smooth lobe (plastic, masks)
one of the two is followed, chosen by their reflectances, with the matching weight; at the last surface that can be
gathered both are.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import add_at, channel_mean, download, finite_or_zero, ones, upload, upload_limit
from ..core.morton import morton_order
from ..core.registry import RegistryTable
from ..core.sampling import derived_seed, independent_sampler
from ..lights.emitters import Emitters, registered_shapes
from ..lights.perturbed import perturbed_shapes

# Neither side of a choice between a delta and a smooth lobe gets less than this unless it carries nothing.
_LEAST_PROBABILITY = 0.05
# Cells along each axis of the curve that orders gather points, as a power of two
_CURVE_BITS = 10


@dataclass(frozen=True)
class SceneTraits:
    """Abilities of the surfaces of a scene, found once, so that what no surface needs is left out of the kernels.

    ``perturbed``: registry indices of shapes whose material shades with a normal of its own (bump and normal maps);
    ``open_shapes``: registry indices of shapes that light may pass unscattered, None for all;
    ``open_scene``: a scene of those shapes alone, None where ``open_shapes`` is None or empty;
    ``nearest_hits``: whether a shadow ray looks for its nearest hit as a path does.  On spheres of more than some
    hundred units, Mitsuba's test for any hit reports the surface at the origin of a ray more often.
    """

    delta: bool
    null: bool
    smooth: bool
    glossy: bool
    transmissive: bool
    perturbed: tuple
    open_shapes: tuple | None
    open_scene: object | None
    nearest_hits: bool = False

    def is_null(self, shape):
        """Whether light may pass a shape (a pointer array) unscattered."""
        return mi.Bool(True) if self.open_shapes is None else shape_in(shape, self.open_shapes)


def shape_in(shape, indices: tuple):
    """Whether shapes (a pointer array) are among those with the given registry indices."""
    return RegistryTable(indices, 1).at(shape) == 1


@dataclass
class GatherPoints:
    """Points to be shaded, in Morton order of their positions or in the order of their camera rays.

    ``si``: surface interactions (evaluated); ``ray``: index of the camera ray that each belongs to; ``weight``: what
    radiance leaving the point contributes to that ray; ``depth``: edges from the camera to the point.
    """

    si: object
    ray: object
    weight: object
    depth: object

    @property
    def count(self) -> int:
        return dr.width(self.ray)

    def places(self, most: int) -> np.ndarray:
        """Positions of at most so many of them, evenly from first to last, (n, 3) float32."""
        count = min(self.count, most)
        index = upload(mi.UInt32, np.arange(count, dtype=np.int64) * self.count // max(count, 1))
        return download(dr.gather(mi.Point3f, self.si.p, index))

    def select(self, index) -> GatherPoints:
        """The points picked by an index array, as lazy gathers."""
        return GatherPoints(*(dr.gather(type(x), x, index) for x in (self.si, self.ray, self.weight, self.depth)))


@dataclass
class CameraPaths:
    """Result of following camera rays.

    ``emission``, ``valid``: per camera ray, radiance of emitters seen directly and whether it met anything.
    """

    emission: object
    valid: object
    points: GatherPoints


def scene_traits(scene) -> SceneTraits:
    """Union of the flags of all BSDFs; scenes with instances are taken to have all of them."""
    flags, open_shapes, instances = 0, {}, False
    for index, shape in registered_shapes(scene):
        bsdf = shape.bsdf()
        if bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
            open_shapes[index] = shape
        flags |= int(bsdf.flags()) if bsdf is not None else ~0
        if shape.class_name() in ("Instance", "ShapeGroup"):
            flags, instances = ~0, True

    def have(flag):
        return bool(flags & int(flag))

    kinds = mi.BSDFFlags
    transmissive = have(int(kinds.DiffuseTransmission) | int(kinds.GlossyTransmission))
    lobes = (have(kind) for kind in (kinds.Delta, kinds.Null, kinds.Smooth, kinds.Glossy))
    if instances or not open_shapes:
        return SceneTraits(*lobes, transmissive, perturbed_shapes(scene), None if instances else (), None)
    open_scene = mi.load_dict({"type": "scene", **{f"open_{index}": shape for index, shape in open_shapes.items()}})
    return SceneTraits(*lobes, transmissive, perturbed_shapes(scene), tuple(open_shapes), open_scene)


def refuse_media(scene) -> None:
    """Raise a ValueError that names the first shape that bounds a participating medium."""
    for number, shape in enumerate(scene.shapes()):
        if shape.is_medium_transition():
            raise ValueError(
                f'shape {number} ("{shape.id()}", {shape.class_name()}) bounds a participating medium; '
                "many-light integrators support surfaces only"
            )


def _follow_delta(si, bsdf, flags, both, sample1, sample2, choice):
    """Choose between the delta and the smooth lobes of a surface, or take ``both``.

    Returns (delta side taken, smooth side taken, direction, weight of the delta side, eta, weight of the smooth side).
    """
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Delta
    sample, weight = bsdf.sample(context, si, sample1, sample2)
    weight = finite_or_zero(mi.unpolarized_spectrum(weight))
    # Materials that do not heed the mask sample any lobe: those samples are not delta and count for nothing here
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
    """Radiance that emitters send from ``si`` back along the ray that found it: area emitters or the environment."""
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


def _wave(scene, emitters: Emitters, traits: SceneTraits, random, ray, throughput, depth, limits, skip, active):
    """One edge of the camera paths: emission met, gather points found, rays that go on.  Evaluated in one kernel.

    ``skip``: None, or a function that finds the first surface beyond all emitters, which then stay invisible.
    """
    max_depth, rr_depth = limits
    if skip is None:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 1, active=active)
    else:
        si = skip(scene, ray, True, active).compute_surface_interaction(ray, mi.RayFlags.All, active)
    hit = active & si.is_valid()
    emission = dr.zeros(mi.UnpolarizedSpectrum, dr.width(ray.d))
    if skip is None:
        emission = throughput * emitted_towards(emitters, si, active)

    bsdf = si.bsdf(ray)
    flags = bsdf.flags()
    goes_on, stays, smooth_weight = mi.Bool(False), mi.Bool(True), mi.Float(1)
    direction, following, eta = mi.Vector3f(0, 0, 1), mi.UnpolarizedSpectrum(0), mi.Float(1)
    if traits.delta:
        # Where the next surface cannot be gathered any more, both sides are taken: neither costs a gather point more
        both = depth + 1 == max_depth
        goes_on, stays, direction, following, eta, smooth_weight = _follow_delta(si, bsdf, flags, both, *random[:3])
    gathered = hit & mi.has_flag(flags, mi.BSDFFlags.Smooth) & stays & (depth < max_depth)
    weight = throughput * smooth_weight
    if traits.delta:
        following *= throughput
        survival = dr.minimum(dr.max(following) * dr.square(eta), 0.95)
        roulette = depth >= rr_depth
        goes_on &= hit & (depth < max_depth) & dr.any(following > 0) & (~roulette | (random[3] < survival))
        following = dr.select(roulette, following / survival, following)
    next_ray = si.spawn_ray(direction)
    # Fields that are the same everywhere have one entry: widened, because points are gathered and scattered by index
    si = dr.select(gathered, si, dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d)))
    dr.eval(emission, hit, gathered, si, weight, goes_on, next_ray.o, next_ray.d, following)
    return emission, hit, (gathered, si, weight), (goes_on, next_ray, following)


def follow_camera_rays(
    scene, emitters, traits, sampler, seed, ray, active, max_depth, rr_depth, skip=None, along_curve=True
):
    """Trace camera rays to their gather points, which are returned along a Morton curve, or in the rays' order.

    ``ray``: a wavefront of camera rays, of which those not ``active`` give nothing; ``max_depth``, ``rr_depth`` as in
    Mitsuba's ``path`` (math.inf: no limit); ``skip``: with ``hide_emitters``, the integrator's method that looks past
    area emitters, applied to camera rays only.
    """
    count = dr.width(ray.d)
    ray.time += dr.zeros(mi.Float, count)
    ray.maxt += dr.zeros(mi.Float, count)
    lane = dr.arange(mi.UInt32, count)
    active = mi.Bool(active) & (lane < dr.opaque(mi.UInt32, count))
    limits = (upload_limit(max_depth), dr.opaque(mi.UInt32, rr_depth))
    throughput, depth = ones(count), 1
    found = None
    while True:
        random = (sampler.next_1d(), sampler.next_2d(), sampler.next_1d(), sampler.next_1d()) if traits.delta else None
        # Opaque, so that the second wave, where there is one, is the same kernel as the first
        dr.make_opaque(ray, active, throughput, random)
        emitted, hit, gathered, going = _wave(
            scene, emitters, traits, random, ray, throughput, dr.opaque(mi.UInt32, depth), limits, skip, active
        )
        skip = None
        if found is None:
            emission, valid = emitted, hit
            mask, si, weight = gathered
            found = (mask, si, weight, dr.full(mi.UInt32, 1, count))
            dr.eval(found)
        else:
            add_at(emission, emitted, lane)
            # Rays that went on beside a gather point find no other
            for target, value in zip(found, (*gathered, mi.UInt32(depth)), strict=True):
                dr.scatter(target, value, lane, gathered[0])
        if not traits.delta:
            break
        onward = dr.compress(going[0])
        if len(onward) == 0:
            break
        lane, throughput = (dr.gather(type(x), x, onward) for x in (lane, going[2]))
        time = dr.gather(mi.Float, ray.time, onward)
        ray = mi.Ray3f(*(dr.gather(type(x), x, onward) for x in (going[1].o, going[1].d)), time)
        ray.maxt = dr.full(mi.Float, dr.largest(mi.Float), len(onward))
        depth, active = depth + 1, dr.full(mi.Bool, True, len(onward))
        sampler = independent_sampler(derived_seed(seed, 3, depth), len(onward))
    return CameraPaths(emission, valid, _collect(*found, along_curve))


def _collect(mask, si, weight, depth, along_curve: bool) -> GatherPoints:
    """Compact the lanes that hold a gather point, and put them in Morton order if that is asked for."""
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
    """Layout of camera rays in the image: ``samples`` of a pixel follow each other, ``width`` pixels make a row.

    ``known``: whether that is so, or every ray counts as a pixel because nothing better is known.
    """

    width: int
    samples: int
    known: bool = True
