"""Rays that leave the emitters: the first edge of every light path.

Emitters are taken group by group (point and spot, area, directional, and each of the others by itself); every group
gets paths in proportion to its power, and inside a group an emitter is chosen by power with stratified numbers.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, finite_or_zero, rgb_to_spectrum, upload
from ..core.parameters import parameters_of
from ..core.sampling import Choice, independent_sampler
from .emitters import Emitters
from .virtual_lights import VirtualLights, spot_falloff


def solid_angle_radiance(emitter, center, count: int = 4096) -> float:
    """Integral of an emitter's radiance over all directions as seen from ``center``; mean over channels."""
    sampler = independent_sampler(0, count)
    reference = dr.zeros(mi.Interaction3f, count)
    reference.p = mi.Point3f(center)
    _, weight = emitter.sample_direction(reference, sampler.next_2d())
    return float(download(finite_or_zero(weight)).mean(dtype=np.float64))


def other_power(emitter, bounding_sphere) -> float:
    """Power of an emitter that only its own routines know, estimated from rays that it emits."""
    if emitter.is_environment():
        return solid_angle_radiance(emitter, bounding_sphere.center) * np.pi * bounding_sphere.radius**2
    sampler = independent_sampler(0, 4096)
    _, weight = emitter.sample_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    return float(download(finite_or_zero(weight)).mean(dtype=np.float64))


def bounding_box(scene):
    """The scene's box, with the shapes that Mitsuba 3.9.1 leaves out: rectangles that it merged have no box.

    Raises a ValueError for a shape that was not merged and has no box either: its transformation is not finite.
    """
    box = scene.bbox()
    for shape in scene.shapes():
        if shape.is_mesh() and shape.vertex_count() and not shape.bbox().valid():
            vertices = parameters_of(shape, below=False).get("vertex_positions")
            if vertices is None:
                raise ValueError(f'the shape "{shape.id()}" has no place in space: its size must be finite')
            vertices = np.asarray(vertices).reshape(-1, 3)
            box.expand(mi.ScalarPoint3f(vertices.min(0)))
            box.expand(mi.ScalarPoint3f(vertices.max(0)))
    return box


def bounding_sphere(scene):
    """Sphere around the scene's box: the same one that clamping distances are measured by.

    Raises a ValueError for a scene whose size is not a finite number.
    """
    box = bounding_box(scene)
    sphere = box.bounding_sphere()
    if len(scene.shapes()) and not np.isfinite(float(sphere.radius)):
        raise ValueError(f"the scene reaches from {box.min} to {box.max}: its size must be finite")
    return sphere


class OmniEmission:
    """Rays from point and spot emitters."""

    # Whether no ray that is scattered by chance ever meets these emitters, so that only next-event estimation does
    delta = True

    def __init__(self, points: VirtualLights, spots: VirtualLights):
        lights = VirtualLights.concatenate([points, spots])
        solid_angle = 2 * np.pi * (1 - np.cos(lights.cone[:, 0].astype(np.float64)))
        self.power = lights.intensity.mean(1, dtype=np.float64) * solid_angle
        self._choice = Choice(self.power)
        self._position = upload(mi.Float, lights.position)
        self._axis = upload(mi.Float, lights.direction)
        self._intensity = upload(mi.Float, lights.intensity)
        self._cone = upload(mi.Float, lights.cone)

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (radiant intensity over the density of the ray)."""
        row = self._choice.row(stratified)
        cone = dr.gather(mi.Vector2f, self._cone, row)
        cosine = 1 - direction_sample.x * (1 - dr.cos(cone.x))
        sine, angle = dr.safe_sqrt(1 - dr.square(cosine)), dr.two_pi * direction_sample.y
        local = mi.Vector3f(sine * dr.cos(angle), sine * dr.sin(angle), cosine)
        frame = mi.Frame3f(dr.gather(mi.Normal3f, self._axis, row))
        density = self._choice.probability(row) / (dr.two_pi * (1 - dr.cos(cone.x)))
        intensity = dr.gather(mi.Color3f, self._intensity, row) * spot_falloff(cosine, cone)
        ray = mi.Ray3f(dr.gather(mi.Point3f, self._position, row), frame.to_world(local))
        return ray, rgb_to_spectrum(intensity) / density


class AreaEmission:
    """Rays from area emitters: a point by area, a direction by the cosine."""

    delta = False

    def __init__(self, area):
        self._area = area
        self.power = area.power
        self._choice = Choice(self.power)

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        row = self._choice.row(stratified)
        ps = self._area.on_shape("sample_position", row, mi.Float(0), position_sample, mi.Bool(True))
        direction = mi.Frame3f(ps.n).to_world(mi.warp.square_to_cosine_hemisphere(direction_sample))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(row))
        si.p, si.n = ps.p, ps.n
        radiance = self._area.emitted_in_front(row, ps)
        return si.spawn_ray(direction), radiance * dr.pi / (ps.pdf * self._choice.probability(row))


def _ray_through_sphere(sphere, direction, sample):
    """A ray in a direction through a uniform point of the disk that the bounding sphere shows to it."""
    disk = mi.warp.square_to_uniform_disk_concentric(sample)
    offset = mi.Frame3f(direction).to_world(mi.Vector3f(disk.x, disk.y, -1))
    return mi.Ray3f(mi.Point3f(sphere.center) + offset * mi.Float(sphere.radius), direction)


class DirectionalEmission:
    """Parallel rays through the scene's bounding sphere."""

    delta = True

    def __init__(self, suns: VirtualLights, sphere):
        self._sphere = sphere
        self.power = suns.intensity.mean(1, dtype=np.float64) * np.pi * float(sphere.radius) ** 2
        self._choice = Choice(self.power)
        self._direction = upload(mi.Float, suns.direction)
        self._irradiance = upload(mi.Float, suns.intensity)

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        row = self._choice.row(stratified)
        direction = dr.gather(mi.Vector3f, self._direction, row)
        irradiance = rgb_to_spectrum(dr.gather(mi.Color3f, self._irradiance, row))
        weight = irradiance * (np.pi * float(self._sphere.radius) ** 2) / self._choice.probability(row)
        return _ray_through_sphere(self._sphere, direction, position_sample), weight


class EnvironmentEmission:
    """Rays from the environment: a direction by its own importance sampling, then parallel rays.

    Not by its ``sample_ray``: for a rotated environment map (Mitsuba 3.9.1) the rays of that do not fill the disk that
    the scene shows to them, and several times too much light enters by windows.
    """

    delta = False

    def __init__(self, environment, sphere):
        self._environment, self._sphere = environment, sphere
        self.power = np.array([other_power(environment, sphere)])

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        center = dr.zeros(mi.Interaction3f, dr.width(stratified))
        center.p = mi.Point3f(self._sphere.center)
        ds, weight = self._environment.sample_direction(center, direction_sample)
        weight = finite_or_zero(mi.unpolarized_spectrum(weight)) * (np.pi * float(self._sphere.radius) ** 2)
        return _ray_through_sphere(self._sphere, -ds.d, position_sample), weight


class OtherEmission:
    """Rays from one emitter, by its own sampling routine."""

    def __init__(self, emitter, sphere):
        self._emitter = emitter
        self.delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        self.power = np.array([other_power(emitter, sphere)])

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        ray, weight = self._emitter.sample_ray(0.0, stratified, position_sample, direction_sample)
        return mi.Ray3f(ray.o, ray.d), weight


def emission_groups(scene, emitters: Emitters) -> list:
    """The groups of emitters that radiate at all."""
    sphere = bounding_sphere(scene)
    groups = []
    if emitters.points.count + emitters.spots.count:
        groups.append(OmniEmission(emitters.points, emitters.spots))
    if emitters.area.power.sum() > 0:
        groups.append(AreaEmission(emitters.area))
    if emitters.directional.count:
        groups.append(DirectionalEmission(emitters.directional, sphere))
    groups += [OtherEmission(emitter, sphere) for _, emitter in emitters.others]
    if emitters.environment is not None:
        groups.append(EnvironmentEmission(emitters.environment, sphere))
    return [group for group in groups if group.power.sum() > 0]
