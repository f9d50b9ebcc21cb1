"""Emitter samplers: rays that leave the emitters, the first edge of every light path.

One sampler serves point and spot emitters, one area emitters, one directional emitters; the environment emitter and
every further emitter have their own. Inside a sampler, stratified numbers choose an emitter in proportion to its power.

Emitter samplers have ``power``, (n,) float64, averaged over channels, ``delta``, and a method ``sample``.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import download, finite_or_zero, rgb_to_spectrum, upload
from ..core.meshes import positions_of
from ..core.parameters import matrix_of, parameters_of
from ..core.sampling import Choice, independent_sampler
from .emitters import Emitters
from .focus import Focus
from .virtual_lights import VirtualLights, spot_falloff

# Samples of the power of an emitter, which sets probabilities alone
_SAMPLES = 4096


def solid_angle_radiance(emitter, center, count: int = _SAMPLES) -> float:
    """Integral of an emitter's radiance over all directions at ``center``, averaged over channels.

    ``count``: number of samples.
    """
    sampler = independent_sampler(0, count)
    reference = dr.zeros(mi.Interaction3f, count)
    reference.p = mi.Point3f(center)
    _, weight = emitter.sample_direction(reference, sampler.next_2d())
    return float(download(finite_or_zero(weight)).mean(dtype=np.float64))


def other_power(emitter, bounding_sphere) -> float:
    """Power of any emitter, estimated by Mitsuba's sampling routines and averaged over channels."""
    if emitter.is_environment():
        return solid_angle_radiance(emitter, bounding_sphere.center) * np.pi * bounding_sphere.radius**2
    sampler = independent_sampler(0, _SAMPLES)
    _, weight = emitter.sample_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    return float(download(finite_or_zero(weight)).mean(dtype=np.float64))


def bounding_box(scene):
    """Bounding box of the scene, including rectangles that Mitsuba 3.9.1 merged: merged rectangles have no valid box.

    Raises a ValueError for an unmerged shape without a valid box: its transformation is not finite.
    """
    box = scene.bbox()
    for shape in scene.shapes():
        if shape.is_mesh() and shape.vertex_count() and not shape.bbox().valid():
            vertices = positions_of(shape)
            if vertices is None:
                raise ValueError(f'the shape "{shape.id()}" has no bounding box: its size must be finite')
            box.expand(mi.ScalarPoint3f(vertices.min(0)))
            box.expand(mi.ScalarPoint3f(vertices.max(0)))
    return box


def bounding_sphere(scene):
    """Sphere around the scene's box.

    Raises a ValueError if the scene's size is not finite.
    """
    box = bounding_box(scene)
    sphere = box.bounding_sphere()
    if len(scene.shapes()) and not np.isfinite(float(sphere.radius)):
        raise ValueError(f"the scene extends from {box.min} to {box.max}: its size must be finite")
    return sphere


def _power_of_omni(lights: VirtualLights) -> np.ndarray:
    """Power of point and spot emitters (n,) float64, of a spot within its whole cone."""
    solid_angle = 2 * np.pi * (1 - np.cos(lights.cone[:, 0].astype(np.float64)))
    return lights.intensity.mean(1, dtype=np.float64) * solid_angle


class OmniSampler:
    """Rays from point and spot emitters."""

    # Whether scattered rays never hit these emitters: only next-event estimation reaches them
    delta = True

    def __init__(self, lights: VirtualLights, power: np.ndarray):
        self.power = power
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


class AreaSampler:
    """Rays from area emitters, with a uniform position and a cosine-distributed direction."""

    delta = False

    def __init__(self, area):
        self._area = area
        self.power = area.power
        self._choice = Choice(self.power)

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        row = self._choice.row(stratified)
        ps = self._area.sample_position(row, mi.Float(0), position_sample, mi.Bool(True))
        direction = mi.Frame3f(ps.n).to_world(mi.warp.square_to_cosine_hemisphere(direction_sample))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(row))
        si.p, si.n = ps.p, ps.n
        radiance = self._area.emitted_in_front(row, ps)
        return si.spawn_ray(direction), radiance * dr.pi / (ps.pdf * self._choice.probability(row))


class ParallelRays:
    """Rays in given directions through the scene.

    Without a focus, rays cross the bounding sphere uniformly. With a focus, half of them cross the focus uniformly. The
    other half pass it, with equal numbers in every octave of the distance from its centre, because their contribution
    at the focus falls with the squared distance.
    """

    def __init__(self, sphere, focus: Focus | None):
        self._sphere, self._focus = sphere, focus

    def through(self, direction, sample):
        """(Ray in a direction, inverse density of the ray per perpendicular area), from two uniform numbers."""
        frame = mi.Frame3f(direction)
        if self._focus is None:
            disk = mi.warp.square_to_uniform_disk_concentric(sample)
            offset = frame.to_world(mi.Vector3f(disk.x, disk.y, -1)) * mi.Float(self._sphere.radius)
            return mi.Ray3f(mi.Point3f(self._sphere.center) + offset, direction), self.area
        radius, reach = self._focus.radius, self._focus.reach
        octaves = float(np.log(reach / radius))
        inside = sample.x < 0.5
        number = dr.select(inside, 2 * sample.x, 2 * sample.x - 1)
        away = radius * dr.select(inside, dr.sqrt(number), dr.exp(number * octaves))
        sine, cosine = dr.sincos(dr.two_pi * sample.y)
        offset = frame.to_world(mi.Vector3f(away * cosine, away * sine, -reach))
        area = dr.select(inside, 2 * np.pi * radius**2, 4 * np.pi * octaves * dr.square(away))
        return mi.Ray3f(mi.Point3f(*self._focus.center.tolist()) + offset, direction), area

    @property
    def area(self) -> float:
        """Cross-section of the bounding sphere."""
        return np.pi * float(self._sphere.radius) ** 2


class DirectionalSampler:
    """Parallel rays from directional emitters."""

    delta = True

    def __init__(self, suns: VirtualLights, rays: ParallelRays):
        self._rays = rays
        self.power = suns.intensity.mean(1, dtype=np.float64) * rays.area
        self._choice = Choice(self.power)
        self._direction = upload(mi.Float, suns.direction)
        self._irradiance = upload(mi.Float, suns.intensity)

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        row = self._choice.row(stratified)
        direction = dr.gather(mi.Vector3f, self._direction, row)
        irradiance = rgb_to_spectrum(dr.gather(mi.Color3f, self._irradiance, row))
        ray, area = self._rays.through(direction, position_sample)
        return ray, irradiance * area / self._choice.probability(row)


class EnvironmentSampler:
    """Rays from the environment emitter: Mitsuba's importance sampling chooses a direction, then a parallel ray.

    Mitsuba's ``sample_ray`` is not used: for a rotated environment map (Mitsuba 3.9.1) its rays do not cover the
    scene's cross-section, and windows admit several times too much light.
    """

    delta = False

    def __init__(self, environment, sphere, rays: ParallelRays):
        self._environment, self._sphere, self._rays = environment, sphere, rays
        self.power = np.array([other_power(environment, sphere)])

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        center = dr.zeros(mi.Interaction3f, dr.width(stratified))
        center.p = mi.Point3f(self._sphere.center)
        ds, weight = self._environment.sample_direction(center, direction_sample)
        ray, area = self._rays.through(-ds.d, position_sample)
        return ray, finite_or_zero(mi.unpolarized_spectrum(weight)) * area


class OtherSampler:
    """Rays from one emitter, drawn by Mitsuba's sampling routine."""

    def __init__(self, emitter, sphere):
        self._emitter = emitter
        self.delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        self.power = np.array([other_power(emitter, sphere)])
        self._volume = None
        if emitter.class_name() == "SpotLight":
            frame = matrix_of(parameters_of(emitter)["to_world"])[:3, :3]
            self._volume = dr.opaque(mi.Float, abs(np.linalg.det(frame)))

    def sample(self, stratified, position_sample, direction_sample):
        """Ray and weight (power per path)."""
        ray, weight = self._emitter.sample_ray(0.0, stratified, position_sample, direction_sample)
        length = dr.norm(ray.d)
        if self._volume is not None:
            # Mitsuba's density is one of directions in the frame, which a scale of the frame spreads
            weight *= self._volume / (length * dr.square(length))
        return mi.Ray3f(ray.o, ray.d / length), weight


def emitter_samplers(scene, emitters: Emitters, focus: Focus | None = None) -> list:
    """Samplers of all emitters with positive power.  Light from infinity is aimed at the ``focus``, if any."""
    sphere = bounding_sphere(scene)
    rays = ParallelRays(sphere, focus)
    samplers = []
    omni = VirtualLights.concatenate([emitters.points, emitters.spots])
    power = _power_of_omni(omni)
    if power.sum() > 0:
        samplers.append(OmniSampler(omni, power))
    if emitters.area.power.sum() > 0:
        samplers.append(AreaSampler(emitters.area))
    if emitters.directional.count:
        samplers.append(DirectionalSampler(emitters.directional, rays))
    samplers += [OtherSampler(emitter, sphere) for _, emitter in emitters.others]
    if emitters.environment is not None:
        samplers.append(EnvironmentSampler(emitters.environment, sphere, rays))
    return [sampler for sampler in samplers if sampler.power.sum() > 0]
