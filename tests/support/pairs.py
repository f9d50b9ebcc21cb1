"""Gather points and virtual lights made of arrays, and the contribution of their pairs in double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np

from vpl.core.arrays import upload
from vpl.lights.light_set import LightGroup, LightSet, light_tree
from vpl.lights.virtual_lights import DeviceLights, VirtualLights
from vpl.points.bsdf_proxies import MaterialProxy
from vpl.points.surfaces import Batch, LambertianSurface

CLAMP = 0.05  # of oriented lights


def unit(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def exact(kind, position, normal, albedo, peak, exponent, axis, lights, clamp):
    """Mean contribution of every light at every point, (points, lights) float64, for a BSDF equal to its proxy."""
    if kind in ("directional", "environment"):
        to_light = np.broadcast_to(-lights.direction.astype(np.float64), (len(position), lights.count, 3))
        factor = np.ones(to_light.shape[:2])
    else:
        offset = lights.position[None].astype(np.float64) - position[:, None]
        distance = np.linalg.norm(offset, axis=2)
        to_light = offset / np.maximum(distance, 1e-300)[..., None]
        emission = -np.sum(to_light * lights.direction[None], axis=2)
        factor = 1 / np.maximum(distance, clamp if kind == "oriented" else 0) ** 2
        if kind == "oriented":
            factor = factor * np.maximum(emission, 0)
        elif kind == "spot":
            factor = factor * (emission >= np.cos(lights.cone[None, :, 0].astype(np.float64)))
    cosine = np.maximum(np.sum(to_light * normal[:, None], axis=2), 0)
    mirror = np.maximum(np.sum(to_light * axis[:, None], axis=2), 0)
    lobe = (mirror ** exponent[:, None]) * (cosine > 0)
    material = albedo[:, None] * cosine[..., None] + peak[:, None] * lobe[..., None]
    return factor * np.mean(material * lights.intensity[None], axis=2)


def scene_of(kind, rng, spread, count=64):
    position = rng.uniform(-1, 1, (count, 3)) * spread
    direction = unit(rng, count) * 0.3 + [0, 0, 1]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cone = np.stack([rng.uniform(0.2, 0.9, count), np.full(count, 0.1)], axis=1)
    where = None if kind in ("directional", "environment") else position
    return VirtualLights.of(kind, where, direction, rng.uniform(0, 1, (count, 3)) ** 4 + 1e-6, 0, cone)


def lit_by(lights: VirtualLights, seed=5, max_depth=9):
    """A set of lights of one kind."""
    group = LightGroup(lights.kind, DeviceLights(lights), light_tree(lights, seed))
    return LightSet([group], CLAMP if lights.kind == "oriented" else 0.0, max_depth, 0, 0, {})


def vectors(array_type, values):
    return array_type(*(upload(mi.Float, values[:, k]) for k in range(3)))


def batch_of(position, normal, peak=None, no_cosine=None):
    """Lambertian points made of arrays; ``peak``, (n,), adds lobes of this height to the proxies."""
    count, rng = len(position), np.random.default_rng(0)
    albedo = vectors(mi.Color3f, rng.uniform(0.05, 0.3, (count, 3)))
    interaction = dr.zeros(mi.Interaction3f, count)
    interaction.p, interaction.n = vectors(mi.Point3f, position), vectors(mi.Normal3f, normal)
    shading = vectors(mi.Normal3f, normal)
    surfaces = LambertianSurface(interaction, dr.full(mi.UInt32, 1, count), shading, albedo)
    no = dr.full(mi.Bool, False, count)
    proxy = MaterialProxy(albedo, None, None, None, no, no, False, False)
    if peak is not None:
        proxy.peak = mi.Color3f(upload(mi.Float, peak)) * mi.Color3f(1, 0.5, 0.2)
        proxy.exponent, proxy.glossy = upload(mi.Float, 10 ** rng.uniform(0, 2, count)), True
        proxy.axis = vectors(mi.Vector3f, unit(rng, count))
    if no_cosine is not None:
        proxy.no_cosine, proxy.without_cosines = upload(mi.UInt32, no_cosine) == 1, True
    dr.eval(surfaces.interaction, surfaces.depth, surfaces.normal, surfaces.albedo, shading, vars(proxy))
    return Batch(dr.arange(mi.UInt32, count), surfaces, shading, proxy)


def prepared(scene, seed=0, size=32, **more):
    """Return the plugin and its jobs for one sample per pixel."""
    plugin = mi.load_dict({"type": "lightcuts", "vpl_count": 3000, "max_depth": 5, **more})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, size * size)
    index = dr.arange(mi.UInt32, size * size)
    position = mi.Point2f((mi.Float(index % size) + 0.5) / size, (mi.Float(index // size) + 0.5) / size)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    return plugin, plugin.prepare(scene, sampler, mi.Ray3f(ray)).jobs
