"""Finding relays: balls around glass and mirrors, and how much light arrives by way of each.

Candidates are balls around the shapes with such a material.  A ball is divided while its halves are smaller together,
as around two lamps of one mesh, or while it looks large from the vertices of the pilot, as a window does.  A few paths
from these vertices find the light that arrives by way of each ball, and the light that arrives otherwise.  Balls with
little light are left out, and all of them where they would seldom be chosen, or where samples of the BSDF often go to
them anyway, as to the panes of a large window.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, upload, upload_vectors
from ..core.meshes import is_hit_as_triangles, surface_of
from ..core.sampling import derived_seed, independent_sampler
from ..core.shapes import INSTANCE, SceneShapes
from .emitters.irradiance import Places
from .paths_from_places import paths_from
from .pilot import Pilot
from .relays import Relays, relays_by
from .view import Stream, View, ViewLights

# Most candidates: each is a step of a loop wherever a path turns. Paths that try each: their light varies by half
_MOST, _TRIED = 32, 256
# Points of a shape by area, fewest and most, which leave gaps of a tenth of a ball; most of all shapes: with more than
# 8192 such shapes, only some are targets
_FEWEST_POINTS, _POINTS, _MOST_POINTS = 8, 256, 1 << 16
# A ball is divided if the squared radii of its halves sum to less than this fraction of its own squared radius. Halves
# of a round shape have more, two lamps less
_DIVIDED = 0.7
# Largest radius of a ball that is not divided, over its distance to the median vertex: then, its cone is a hundredth of
# the sphere
_WIDE = 0.2
# Least part of a relay in the light: a relay with less makes little noise, and takes time wherever a path turns
_LEAST = 0.002
# Largest part of the samples of a diffuse BSDF that go to the kept relays anyway. In four rooms, lamps in glass have
# 0.05 to 0.13; a wall of glass has 0.6, where paths to relays had four times the variance
_MOST_REACH = 0.3
# Least part of the light that comes by relays, in all and as the mean over cells. Lamps in glass in four rooms have 0.8
# and more, staircase2 0.1, where paths to relays gained 4 to 15% in the pilot and took a third more time
_LEAST_PART = 0.2


def find_relays(view: View, pilot: Pilot, rays: int) -> Relays | None:
    """The relays of a scene for the vertices of a pilot, after learning by ``rays`` paths; None where samples of the
    BSDF meet them often, or paths would seldom go to them."""
    places, facing = pilot.vertices
    points = points_of_relays(view.scene)
    if len(points) == 0 or len(places) == 0:
        return None
    materials = view.emitters.traits.materials
    center, radius = balls_around(points, np.median(places, axis=0))
    candidates = Relays(center, radius, np.ones(len(radius)), materials)
    tries = min(_TRIED, rays // candidates.choice.count)
    if tries < 1:
        return None
    light, reach = _tried(candidates, _Look(view, candidates), tries, places, facing, view.seed)
    kept = _worth(light, reach)
    if not light[1:][kept].sum() > _LEAST_PART * light.sum():
        return None
    relays = Relays(center[kept], radius[kept], light[1:][kept], materials)
    seed = derived_seed(view.seed, Stream.RELAYS, 1)
    if not relays.choice.learn(places, facing, rays, seed, _Look(view, relays)):
        return None
    return relays if relays.drawn >= _LEAST_PART else None


def _worth(light: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Indices of the relays to keep, by the results (n + 1,) of :func:`_tried`: relays with much light, first those
    with the most for the samples of a diffuse BSDF that go there."""
    share = light[1:] / max(light.sum(), np.finfo(np.float64).tiny)
    order = np.argsort(-light[1:] / np.maximum(reach[1:], np.finfo(np.float64).tiny), kind="stable")
    kept, left = [], _MOST_REACH
    for number in order[share[order] >= _LEAST]:
        if reach[1 + number] <= left:
            kept.append(number)
            left -= reach[1 + number]
    return np.sort(np.array(kept, int))


def _tried(relays: Relays, look: _Look, tries: int, places: np.ndarray, facing: np.ndarray, seed: int):
    """Means of ``tries`` paths at random vertices, (n + 1,): irradiance by each choice; fraction of the samples of a
    diffuse BSDF in its directions."""
    sources = relays.choice.count
    drawn = np.random.default_rng(seed).integers(len(places), size=sources * tries)
    seen = Places.of_facing(*(upload_vectors(mi.Point3f, rows[drawn]) for rows in (places, facing)))
    source = upload(mi.UInt32, np.repeat(np.arange(sources), tries))
    dr.eval(seen, source)
    with relays.choice.each_source():
        found = look.measured(seen, source, derived_seed(seed, Stream.RELAYS))
    return tuple(x.reshape(sources, tries).mean(1) for x in found)


@dataclass(frozen=True)
class _Found:
    """Irradiance at places, one per lane: ``irradiance`` and ``unoccluded``, its mean over channels, are equal, as the
    light has been traced."""

    irradiance: mi.UnpolarizedSpectrum
    unoccluded: mi.Float


@dataclass(frozen=True)
class _Look:
    """Light that arrives by way of each choice of ``relays`` in a ``view``: see
    :meth:`vpl.split.emitters.cell_choice.CellChoice.learn`."""

    view: View
    relays: Relays

    def __call__(self, places: Places, choice: mi.UInt32, seed: int) -> _Found:
        """Irradiance by a single path in the direction of each ``choice``; beside the BSDF, by emitters, too."""
        level, _ = self._traced(places, choice, seed)
        return _Found(mi.UnpolarizedSpectrum(level), level)

    def measured(self, places: Places, choice: mi.UInt32, seed: int) -> list[np.ndarray]:
        """The same irradiance, and the fraction of the samples of a diffuse BSDF that a choice draws, (n,) float64."""
        found = (download(x).astype(np.float64) for x in self._traced(places, choice, seed))
        return [np.nan_to_num(x, posinf=0, neginf=0) for x in found]

    def _traced(self, places: Places, choice: mi.UInt32, seed: int) -> tuple[mi.Float, mi.Float]:
        view, sampler = self.view, independent_sampler(derived_seed(seed, 0), places.count)
        near, edge, traced = paths_from(
            view.scene, view.emitters, places, choice, self.relays, 1, view.settings(ViewLights()), sampler, seed
        )
        # Light by way of relays belongs to them, all other light to the BSDF, whichever drew the direction
        relayed = traced.noise.relayed
        others = channel_mean(traced.radiance) - relayed + channel_mean(near.irradiance)
        level, reach = dr.abs(dr.select(choice == 0, others, relayed)), edge.throughput[0] * dr.inv_pi
        dr.eval(level, reach)
        return level, reach


# ---------------------- Candidates ----------------------


def points_of_relays(scene) -> np.ndarray:
    """Points (n, 3) on the shapes of a scene that relay light, without instances and emitters."""
    shapes = [
        shape
        for _, shape in SceneShapes.of(scene).own
        if shape.class_name() != INSTANCE and relays_by(int(shape.bsdf().flags())) and not shape.is_emitter()
    ]
    # Mitsuba lists shapes in an order that differs between loads of a scene
    shapes.sort(key=lambda shape: (*np.array(shape.bbox().min), *np.array(shape.bbox().max)))
    shapes = shapes[:: -(-len(shapes) * _FEWEST_POINTS // _MOST_POINTS) or 1]
    each = int(np.clip(_MOST_POINTS // max(len(shapes), 1), _FEWEST_POINTS, _POINTS))
    points = np.concatenate([_points_on(shape, each) for shape in shapes]) if shapes else np.zeros((0, 3))
    return points[np.isfinite(points).all(1)]


def _points_on(shape, count: int) -> np.ndarray:
    """Points (n, 3): on a mesh, ``count`` by area, and about as many corners; on a sphere, as many; of other shapes,
    the corners of the bounding box."""
    generator = np.random.default_rng(0)
    if not is_hit_as_triangles(shape):
        box, directions = shape.bbox(), 2.0 * np.indices((2, 2, 2)).reshape(3, -1).T - 1
        if shape.class_name() == "Sphere":
            directions = generator.normal(size=(count, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            directions = np.concatenate([np.eye(3), -np.eye(3), directions])
        return np.array(box.center()) + directions * 0.5 * np.array(box.extents())
    faces, positions = surface_of(shape)
    positions = positions.astype(np.float64)
    corners = positions[:: max(len(positions) // count, 1)]
    a, b, c = (positions[faces[:, k]] for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if not (len(area) and area[-1] > 0):
        return corners
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    u, v = generator.random((2, count, 1))
    root = np.sqrt(u)
    return np.concatenate([corners, (1 - root) * a[chosen] + root * ((1 - v) * b[chosen] + v * c[chosen])])


def balls_around(points: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 3) and radii (n,) of balls that hold the ``points`` (m, 3), for rays from about ``middle`` (3,)."""
    first = _Ball.around(points)
    # The largest first; numbers decide between equal ones
    heap, done, number = [(-first.radius, 0, first)], [], 0
    while heap:
        ball = heapq.heappop(heap)[-1]
        halves = ball.halves() if len(heap) + len(done) + 1 < _MOST else None
        if not halves or not _pays(ball, halves, middle):
            done.append(ball)
            continue
        for half in halves:
            number += 1
            heapq.heappush(heap, (-half.radius, number, half))
    return np.array([ball.center for ball in done]), np.array([ball.radius for ball in done])


def _pays(ball: _Ball, halves: tuple[_Ball, _Ball], middle: np.ndarray) -> bool:
    """Whether to divide a ball."""
    smaller = sum(half.radius**2 for half in halves) < _DIVIDED * ball.radius**2
    return smaller or ball.radius > _WIDE * np.linalg.norm(ball.center - middle)


@dataclass(frozen=True)
class _Ball:
    """Ball around ``points`` (n, 3)."""

    points: np.ndarray
    center: np.ndarray
    extent: np.ndarray
    radius: float

    @classmethod
    def around(cls, points: np.ndarray) -> _Ball:
        low, high = points.min(0), points.max(0)
        center = 0.5 * (low + high)
        return cls(points, center, high - low, float(np.sqrt(np.max(np.sum((points - center) ** 2, axis=1)))))

    def halves(self) -> tuple[_Ball, _Ball] | None:
        """Balls around the points to either side of the middle of the longest axis; None for a single place."""
        axis = int(np.argmax(self.extent))
        below = self.points[:, axis] < self.center[axis]
        if below.all() or not below.any():
            return None
        return _Ball.around(self.points[below]), _Ball.around(self.points[~below])
