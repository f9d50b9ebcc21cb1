"""Pilot: a few whole paths for the density of virtual lights, the brightness of the image and the relative variance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, upload
from ..core.sampling import derived_seed
from ..lights.emission import bounding_box
from .arrival_octree import ArrivalOctree
from .camera_rays import trace_camera_rays
from .cost_model import CostModel
from .gather_vertices import GatherVertices, SecondVertices
from .line_sampling import LineSampler
from .path_state import Gathering
from .path_tracer import Traced
from .roulette import OutgoingRadiance
from .view import Stream, View, ViewLights

# Emitter samples at the first scattering vertex of a path of the pilot: two tell how much they differ
PILOT_SAMPLES = 2


@dataclass(frozen=True)
class Arrivals:
    """Second vertices with a minorant, of paths with a minorant at the first vertex.

    ``position``, ``normal`` (n, 3): on the side of arrival; ``weight`` (n,) float64: contribution per irradiance;
    ``radiance`` (n,) float64: radiance of the path from the vertex.
    """

    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    radiance: np.ndarray


@dataclass(frozen=True)
class Onward:
    """Second vertices: ``position``, ``normal`` (m, 3); (m,): ``path`` of each vertex; ``throughput`` up to the vertex;
    ``sent``: radiance sent back; ``edges`` beyond the vertex."""

    position: np.ndarray
    normal: np.ndarray
    path: np.ndarray
    throughput: np.ndarray
    sent: np.ndarray
    edges: np.ndarray


@dataclass(frozen=True)
class Pilot:
    """Paths in pairs of neighbouring samples, usually of the same pixel.

    ``pixel``, ``radiance`` (n,): of each path, with one emitter sample at each vertex; ``seen`` (n,): emission on the
    first edge; ``difference`` (n,): half of the difference that the choice between two emitter samples at the first
    scattering vertex makes to the radiance; ``alone`` (n,): as ``radiance``, but with the weight of a single emitter
    sample beside the BSDF; ``relayed`` (n,): part of the radiance by way of relays, see :mod:`vpl.split.relays`;
    ``refracted`` (n,): emission that paths met behind glass, see :class:`vpl.split.path_state.Path`;
    ``indirect`` (n,): part of the radiance through arrivals.  Values may be negative if virtual
    lights carry a part.  ``vertices``: positions and normals (k, 3) of first and second vertices; ``size``: width of
    the image and number of pixels; ``scene``; ``seed`` of the octree.
    """

    arrivals: Arrivals
    onward: Onward
    vertices: tuple[np.ndarray, np.ndarray]
    pixel: np.ndarray
    radiance: np.ndarray
    seen: np.ndarray
    difference: np.ndarray
    alone: np.ndarray
    relayed: np.ndarray
    refracted: np.ndarray
    indirect: np.ndarray
    size: tuple[int, int]
    scene: mi.Scene
    seed: int
    model: CostModel

    @classmethod
    def trace(cls, view: View, lights: ViewLights) -> Pilot:
        """Trace pairs of paths over the whole image, always the same paths, without the light carried by ``lights``."""
        lane = pilot_lanes(view)
        traced = trace_camera_rays(
            view, upload(mi.UInt32, lane), view.settings(lights, Gathering.AT_FIRST), Stream.PILOT
        )
        return cls.of(traced, view, view.rays.pixel_of(lane))

    @classmethod
    def of(cls, traced: Traced, view: View, pixel: np.ndarray) -> Pilot:
        """The pilot of traced paths in the pixels ``pixel`` (n,) of a view."""
        radiance, noise = single_sample_radiance(traced), traced.noise
        seen, difference = finite(noise.seen), finite(noise.difference)
        relayed, refracted = finite(noise.relayed), finite(noise.refracted)
        both = finite(channel_mean(traced.radiance))
        alone = both + finite(noise.alone_excess)
        edges = download(traced.edges).astype(np.int64)
        arrivals, onward, indirect = _second_vertices(traced.gathered.second, both, edges)
        first, facing = _first_vertices(traced.gathered.first)
        vertices = np.concatenate([first, arrivals.position]), np.concatenate([facing, arrivals.normal])
        size, seed = (view.width, view.pixels), derived_seed(view.seed, Stream.OCTREE)
        return cls(
            arrivals, onward, vertices, pixel, radiance, seen, difference, alone, relayed, refracted, indirect, size,
            view.scene, seed, view.model,
        )  # fmt: skip

    @cached_property
    def line_sampler(self) -> LineSampler:
        """Lines near the arrivals, drawn by their radiance: lights matter where visible and bright.  All passes of a
        render share the octree."""
        arrivals, generator = self.arrivals, np.random.default_rng(self.seed)
        octree = ArrivalOctree(
            arrivals.position, arrivals.normal, arrivals.weight, *_cube_around(self.scene), generator
        )
        octree.choose_by_radiance(arrivals.radiance)
        return LineSampler(octree)

    @cached_property
    def outgoing(self) -> tuple[OutgoingRadiance, np.ndarray]:
        """Radiance that surfaces send back, and the radiance that it predicts for each vertex of ``onward``: for
        Russian roulette in all passes of a render."""
        onward = self.onward
        return OutgoingRadiance.learned(onward.position, onward.normal, onward.sent, self.model)

    @property
    def brightness(self) -> np.ndarray:
        """Mean radiance around each path, (n,), estimated from the remaining paths."""
        return self._of_others[0]

    @cached_property
    def direct(self) -> np.ndarray:
        """Radiance (n,) without emission on first edges and without the part through arrivals."""
        return self.radiance - self.seen - self.indirect

    def nearby(self, values: np.ndarray) -> np.ndarray:
        """Mean of the paths' ``values`` (n,) around each pixel of the image, (pixels,)."""
        return pixel_means(values, self.pixel, *self.size, self._of_others[1])

    @cached_property
    def unseen(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean radiance without emission on first edges: (around each path, (n,), estimated from the remaining paths;
        around each pixel, (pixels,)).

        The means reach beyond single pixels: with the emission of a small lamp, pixels beside it would count as bright.
        """
        values = self._of_both - self.seen
        means, priors = means_of_others(values, self.pixel, *self.size, self.model)
        return means, pixel_means(values, self.pixel, *self.size, priors)

    @cached_property
    def _of_others(self) -> tuple[np.ndarray, list[float]]:
        return means_of_others(self._of_both, self.pixel, *self.size, self.model)

    @property
    def _of_both(self) -> np.ndarray:
        """Radiance (n,) with both emitter samples at the first scattering vertex."""
        return self.radiance - self.difference


def pilot_lanes(view: View) -> np.ndarray:
    """Indices (n,) of the camera rays of a pilot: pairs over the whole image."""
    return view.groups(view.model.pilot_size(view.planned_count), 2)


def single_sample_radiance(traced: Traced) -> np.ndarray:
    """Radiance of the paths of a pilot with the first emitter sample at each vertex alone, mean over channels (n,),
    float64; 0 where it is not finite.

    The traced radiance is the mean of that with either sample, with the weights of two samples beside those of the
    BSDF.
    """
    return finite(channel_mean(traced.radiance) + traced.noise.difference)


def finite(values: mi.Float) -> np.ndarray:
    """``values`` in double precision, (n,), 0 where they are not finite."""
    return np.nan_to_num(download(values).astype(np.float64), posinf=0, neginf=0)


def _second_vertices(second: SecondVertices, radiance: np.ndarray, edges: np.ndarray):
    """(Arrivals, second vertices, radiance (n,) through arrivals) of paths."""
    position, normal, weight, throughput, before = (download(x) for x in vars(second).values())
    beyond = np.maximum(radiance - np.nan_to_num(before), 0)
    known = np.isfinite(position).all(1)
    onward = (throughput > 0) & np.isfinite(throughput) & known
    path, throughput = np.flatnonzero(onward), throughput[onward].astype(np.float64)
    onward = Onward(position[onward], normal[onward], path, throughput, beyond[path] / throughput, edges[path] - 1)
    arrived = (weight > 0) & np.isfinite(weight) & known
    indirect = np.where(arrived, beyond, 0)
    arrivals = Arrivals(position[arrived], normal[arrived], weight[arrived].astype(np.float64), indirect[arrived])
    return arrivals, onward, indirect


def _first_vertices(first: GatherVertices) -> tuple[np.ndarray, np.ndarray]:
    """Positions and normals (n, 3) of first gather vertices."""
    position, facing, depth = (download(x) for x in (first.position, first.normal, first.depth))
    seen = (depth > 0) & np.isfinite(position).all(1)
    return position[seen], facing[seen]


def _cube_around(scene) -> tuple[np.ndarray, float]:
    """(Lower corner, size) of a cube around the surfaces of a scene, world units."""
    box = bounding_box(scene)
    low, extent = np.array(box.min, np.float64), np.array(box.extents(), np.float64)
    # A little larger, so no surface lies on the sides of the cube
    size = 1.001 * max(float(extent.max()), np.finfo(np.float32).tiny)
    return low + 0.5 * (extent - size), size


# ---------------------- Relative variance ----------------------


def relative_variance(values: np.ndarray, brightness: np.ndarray, model: CostModel) -> float:
    """Variance of a path, from the ``values`` (n,) of pairs, over the squared ``brightness`` (n,).

    Leaves out the largest errors and adds a constant to the brightness, as the error of the comparison does.
    """
    error = np.sort(relative_errors(values, brightness, model))
    return float(np.mean(error[: len(error) - model.left_out(len(error))])) if len(error) else 0.0


def relative_errors(values: np.ndarray, brightness: np.ndarray, model: CostModel) -> np.ndarray:
    """Estimates (n // 2,) of the variance of a path over the squared ``brightness`` (n,), one from each pair of the
    ``values`` (n,)."""
    count = len(values) // 2
    first, second = values[: 2 * count].astype(np.float64).reshape(-1, 2).T
    return 0.5 * (first - second) ** 2 / error_scale(brightness, model)[: 2 * count : 2] ** 2


def kept_of_both(before: np.ndarray, after: np.ndarray, model: CostModel) -> np.ndarray:
    """Indices of two arrays of errors (n,) of the same pairs, without the pairs that hold the largest errors."""
    return np.argsort(np.maximum(before, after))[: len(before) - model.left_out(len(before))]


def error_scale(brightness: np.ndarray, model: CostModel) -> np.ndarray:
    """Denominator of relative errors (n,) for a ``brightness`` (n,) of the image."""
    level = np.sqrt(brightness**2 + model.black * np.mean(brightness) ** 2)
    return np.maximum(level, np.finfo(np.float64).tiny ** 0.5)


# ---------------------- Means around pixels ----------------------
#
# The image is divided into four blocks, each block into four again, down to single pixels. The mean of a block combines
# the values of the block with the mean of the larger block. The weight of the larger block is a number of values, and
# grows with the variance of the values.


def means_of_others(
    values: np.ndarray, at: np.ndarray, width: int, count: int, model: CostModel
) -> tuple[np.ndarray, list[float]]:
    """Mean around each of ``values`` (n,), in pairs, without the value itself and its neighbour.

    ``at``: pixel of each value, of ``count`` pixels in rows of ``width``.  Returns (means (n,), for each size of blocks
    the equivalent number of values of the mean of the larger block).
    """
    number = len(values)
    beside = np.arange(number) ^ 1
    rest = max(number - 2, 1)
    others = (np.sum(values) - values - values[beside]) / rest if number > 2 else np.full(number, np.mean(values))
    priors = []
    for (down, across), block in _divisions(at, width, count):
        # The relative variance of n values is below n
        priors.append(min(relative_variance(values, others, model), number) / model.brightness_spread)
        inside, total = _sums(block, values, down * across)
        both = block == block[beside]
        total, inside = total[block] - values - both * values[beside], inside[block] - 1 - both
        others = _mean(total, inside, priors[-1], others)
    return others, priors


def pixel_means(values: np.ndarray, at: np.ndarray, width: int, count: int, priors: list[float]) -> np.ndarray:
    """Mean of ``values`` (n,) at the pixels ``at`` (n,) around each of ``count`` pixels in rows of ``width``: (count,).

    ``priors``: see :func:`means_of_others`.
    """
    grid = np.full((1, 1), np.mean(values))
    for ((down, across), block), prior in zip(_divisions(at, width, count), priors, strict=True):
        inside, total = _sums(block, values, down * across)
        around = grid.repeat(2, 0).repeat(2, 1)[:down, :across].reshape(-1)
        grid = _mean(total, inside, prior, around).reshape(down, across)
    return grid.reshape(-1)[:count]


def _divisions(at: np.ndarray, width: int, count: int) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """((Blocks down, blocks across), block of each of the pixels ``at``), from four blocks to one for each pixel."""
    height = -(-count // width)
    side = 1 << (max(width, height) - 1).bit_length()
    while side > 1:
        side //= 2
        down, across = -(-height // side), -(-width // side)
        yield (down, across), at // width // side * across + at % width // side


def _sums(block: np.ndarray, values: np.ndarray, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """(Number, sum) of the values in each block."""
    return np.bincount(block, minlength=blocks), np.bincount(block, values, blocks)


def _mean(total, number, prior: float, around):
    """Means of ``number`` values with the sum ``total`` and of ``prior`` values with the mean ``around``."""
    whole = number + prior
    return np.where(whole > 0, total + prior * around, around) / np.where(whole > 0, whole, 1)
