"""Emitters chosen by what a pilot's vertices see of them, place by place.

Space is divided into cubes, and the vertices in a cube by the way that they face: a site.  Sites in which the pilot's
paths had vertices learn which emitters light them: from some of their vertices one ray goes to every emitter, and to
every region of the environment (:mod:`vpl.direct.environment_regions`), so that a room that sees the sky through a
window aims there.  A share of the samples is kept for Mitsuba's own choice, which is all that other sites have.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, finite_or_zero, upload, upload_vectors
from ..core.sampling import RowChoice, independent_sampler
from ..direct.environment_regions import regions_of
from .sites import Sites

# Regions of the environment, and columns of the table that they are made from
_REGIONS, _COLUMNS = 256, 512
# Share of the samples for which emitters have the probability that they have in Mitsuba
_UNIFORM_SHARE = 0.3
# Rays from a site to each emitter and region; how many of them all sites may have together
_RAYS_EACH, _MOST_RAYS = 2, 1 << 20
# Rays that a site's average visibility counts for
_PRIOR = 0.5


class LearnedEmitters:
    """The choice of emitters by site; before :meth:`learn`, every emitter has the same probability everywhere, or
    that of its ``sampling_weight``."""

    def __init__(self, scene):
        self._scene, self._emitters, self._count = scene, scene.emitters_dr(), len(scene.emitters())
        # Emitters with a weight of 0 are never sampled, as in Mitsuba
        weight = np.array([emitter.sampling_weight() for emitter in scene.emitters()])
        self._environment = scene.environment()
        of_environment = np.array([emitter.is_environment() for emitter in scene.emitters()])
        self._environment_number = int(of_environment.argmax()) if self._environment is not None else -1
        self._regions = None
        if weight[of_environment].any():
            self._regions = regions_of(self._environment, _REGIONS, _COLUMNS)
        self._sources = self._count + (self._regions.count if self._regions else 0)
        registry = download(dr.reinterpret_array(mi.UInt32, self._emitters))
        numbers = np.zeros(registry.max() + 2, np.int64)
        numbers[registry] = np.arange(self._count)
        self._number_of = upload(mi.UInt32, numbers)
        self._alike = np.zeros(self._sources)
        self._alike[: self._count] = weight / weight.sum()
        # What regions cannot tell apart, the environment's own sampling may
        self._both = self._regions is not None and not self._regions.fine
        if self._regions and not self._both:
            light = np.maximum(self._regions.irradiance, 0)
            light = light / light.sum() if light.sum() > 0 else np.full(len(light), 1 / len(light))
            self._alike[self._count :] = self._alike[self._environment_number] * light
            self._alike[self._environment_number] = 0
        self._never = np.flatnonzero(self._alike[: self._count] == 0)
        self.forget()

    def _use(self, probability: np.ndarray) -> None:
        """``probability`` (sites, sources) float64 of each source; rows sum to 1."""
        self._choice = RowChoice(probability.ravel(), np.full(len(probability), self._sources))

    # ---------------------- Learning ----------------------

    def forget(self) -> None:
        """Know nothing of any place."""
        self._sites = Sites.none()
        # Twice, because arrays of one entry make other kernels
        self._use(np.stack([self._alike, self._alike]))

    def learn(self, position: np.ndarray, normal: np.ndarray, rays: int, seed: int) -> bool:
        """Learn from vertices, (n, 3) each, with about so many rays at most: whether anything was learned."""
        each = _RAYS_EACH * self._sources
        most = min(rays, _MOST_RAYS) // each
        if most < 1 or len(position) == 0:
            return False
        self._sites, site = Sites.around(position, normal, most)
        size = np.bincount(site)[1:]
        order, sites = np.argsort(site, kind="stable"), len(size)
        first = upload(mi.UInt32, np.cumsum(size) - size)
        lane = dr.arange(mi.UInt32, sites * each)
        row = lane // dr.opaque(mi.UInt32, each)
        source = lane // _RAYS_EACH % dr.opaque(mi.UInt32, self._sources)
        sampler = independent_sampler(seed, len(lane))
        number = mi.UInt32(sampler.next_1d() * mi.Float(dr.gather(mi.UInt32, upload(mi.UInt32, size), row)))
        vertex = dr.gather(mi.UInt32, first, row) + number
        unoccluded, seen = self._looks(*(upload_vectors(mi.Point3f, x[order]) for x in (position, normal)), vertex,
                                       source, sampler)  # fmt: skip
        unoccluded, seen = (
            download(x).astype(np.float64).reshape(sites, self._sources, _RAYS_EACH) for x in (unoccluded, seen)
        )
        self._use(self._shares(unoccluded, seen))
        return True

    def _looks(self, positions, normals, vertex, source, sampler):
        """(Irradiance that a source would give a vertex by one sample if nothing was between, whether nothing is)."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(vertex))
        si.p, si.n = dr.gather(mi.Point3f, positions, vertex), mi.Normal3f(dr.gather(mi.Point3f, normals, vertex))
        si.sh_frame = mi.Frame3f(si.n)
        direction, weight, _, _, ray = self._draw(si, source, sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
        light = channel_mean(weight) * dr.maximum(dr.dot(direction, si.n), 0)
        seen = dr.select((light > 0) & ~self._scene.ray_test(ray, light > 0), mi.Float(1), 0)
        dr.eval(light, seen)
        return light, seen

    def _shares(self, unoccluded: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Probabilities (sites + 1, sources) by root mean squares of what arrived; first where nothing is known."""
        possible = np.nan_to_num(unoccluded, posinf=0) ** 2
        possible[:, self._never] = 0
        if self._both:
            # Its regions stand for the environment
            possible[:, self._environment_number] = 0
        found = possible * seen
        visible = found.sum((1, 2)) / np.maximum(possible.sum((1, 2)), np.finfo(np.float64).tiny)
        power = (found + _PRIOR / _RAYS_EACH * visible[:, None, None] * possible).mean(2) ** 0.5
        total = power.sum(1, keepdims=True)
        learned = np.where(total > 0, power / np.maximum(total, np.finfo(np.float64).tiny), self._alike)
        return np.concatenate([self._alike[None], (1 - _UNIFORM_SHARE) * learned + _UNIFORM_SHARE * self._alike])

    # ---------------------- Sampling ----------------------

    def site(self, si, side):
        """The site of a vertex; ``side``: see :func:`vpl.split.floors.side_of`."""
        return self._sites.at(si.p, si.sh_frame.n * side)

    def _row(self, site):
        """Where the row of a site begins in the table of probabilities."""
        return site * (self._sources + 1)

    def _draw(self, si, source, member, place, active):
        """A direction to each source: (direction, radiance over density, density of the direction, whether the source
        is a point or a direction, shadow ray)."""
        of_emitter = active & (source < self._count)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, dr.minimum(source, self._count - 1))
        ds, weight = emitter.sample_direction(si, place, of_emitter)
        weight = finite_or_zero(mi.unpolarized_spectrum(weight)) & of_emitter
        # Emitters that are infinitely far away have a place outside of the scene's box, which may be too small: Mitsuba
        # 3.9.1 leaves rectangles out of it
        far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        ray = dr.select(far, si.spawn_ray(ds.d), si.spawn_ray_to(ds.p))
        direction, density, delta = ds.d, ds.pdf, ds.delta & of_emitter
        if self._regions:
            of_region = active & ~of_emitter
            region = dr.select(of_region, source - self._count, 0)
            away, arriving, region_density = self._regions.sample(region, member, place, of_region)
            direction = dr.select(of_region, away, direction)
            weight = dr.select(of_region, arriving, weight)
            density = dr.select(of_region, region_density, density)
            ray = dr.select(of_region, si.spawn_ray(direction), ray)
        return direction, weight, density, delta, ray

    def sample(self, si, site, chosen, member, place, active):
        """A direction to an emitter: (direction, visible radiance over density, density per solid angle, whether the
        emitter is a point or a direction)."""
        row = self._choice.draw(site, chosen, active)
        source, probability = row - self._row(site), self._choice.probability(row, active)
        direction, weight, density, delta, ray = self._draw(si, source, member, place, active)
        whole = density * probability
        if self._both:
            # What both the emitter and its regions may draw has the sum of their densities
            of_environment = active & ((source >= self._count) | (source == self._environment_number))
            both = self._environment_density(si, site, direction, of_environment)
            whole = dr.select(of_environment, both, whole)
        weight *= density / whole
        arrives = active & (dr.max(weight) > 0) & (whole > 0)
        blocked = self._scene.ray_test(ray, arrives)
        return direction, dr.select(arrives & ~blocked, weight, 0), whole, delta

    def _environment_density(self, si, site, direction, active):
        """Density with which a direction to the environment is drawn."""
        region, density = self._regions.find(direction, active)
        first = self._row(site)
        density *= self._choice.probability(first + self._count + region, active)
        if self._both:
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d = direction
            by_emitter = self._choice.probability(first + self._environment_number, active)
            density += self._environment.pdf_direction(si, ds, active) * by_emitter
        return density

    def met(self, vertex, site, ray, si, has_density, active):
        """Radiance that a ray from ``vertex`` met at ``si``, and the density with which :meth:`sample` would have drawn
        it there."""
        origin = dr.zeros(mi.Interaction3f)
        origin.p = vertex
        ds = mi.DirectionSample3f(self._scene, si, origin)
        emitter = si.emitter(self._scene, active)
        emitted = finite_or_zero(mi.unpolarized_spectrum(emitter.eval(si, active))) & active
        wanted = active & has_density & (emitter != None)  # noqa: E711
        number = dr.gather(mi.UInt32, self._number_of, dr.reinterpret_array(mi.UInt32, emitter), wanted)
        near = wanted & si.is_valid()
        probability = self._choice.probability(self._row(site) + number, near)
        density = emitter.pdf_direction(origin, ds, near) * probability
        if self._regions:
            # A branch: few packets of paths hold one that has left the scene
            density = dr.if_stmt(
                (origin, site, ray.d, density),
                wanted & ~si.is_valid(),
                lambda origin, site, direction, density: self._environment_density(origin, site, direction, True),
                lambda origin, site, direction, density: density,
            )
        return emitted, density
