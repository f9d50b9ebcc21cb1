"""Pilot: a few whole paths, which tell where virtual lights are wanted and whether they pay."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.arrays import channel_mean, download
from .gather_vertices import Arrival, GatherVertices
from .paths import Found
from .pixel_means import means_of_others, pixel_means


@dataclass
class Arrivals:
    """Second vertices of paths, (n, 3): ``position`` and the ``normal`` of the side that was met; (n,) float64:
    ``weight``, what irradiance there contributes to the image, and ``level``, what the path brought from there."""

    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    level: np.ndarray


@dataclass
class Onward:
    """Second vertices of paths, with a floor or without, (m, 3) each: ``position``, ``normal``; (m,): ``path`` that
    each is of, ``throughput`` with which it arrived, ``sent``: the radiance that it sent back, ``edges`` beyond."""

    position: np.ndarray
    normal: np.ndarray
    path: np.ndarray
    throughput: np.ndarray
    sent: np.ndarray
    edges: np.ndarray


@dataclass
class Pilot:
    """Paths, two next to each other from one pixel, or from two where each has a single sample.  What they found may be
    negative where virtual lights carry a part.

    ``arrivals``: their second vertices, where they have a floor, as their first ones have; ``pixel``, ``radiance``,
    ``indirect`` (n,): the pixel of each path, what it found, and the part that came by way of its second vertex.
    ``vertices``: positions and normals, (m, 3) each, of both; ``onward``: what came by way of all second vertices;
    ``size``: width of the image, and how many pixels it has.
    """

    arrivals: Arrivals
    onward: Onward
    vertices: tuple[np.ndarray, np.ndarray]
    pixel: np.ndarray
    radiance: np.ndarray
    indirect: np.ndarray
    size: tuple[int, int]

    @classmethod
    def of(
        cls, found: Found, vertices: GatherVertices, arrival: Arrival, pixel: np.ndarray, size: tuple[int, int]
    ) -> Pilot:
        """The pilot of some paths of the pixels ``pixel`` in an image of a ``size``."""
        radiance = np.nan_to_num(download(channel_mean(found.radiance)).astype(np.float64), posinf=0, neginf=0)
        position, normal, weight, throughput, before = (download(x) for x in vars(arrival).values())
        beyond, edges = np.maximum(radiance - np.nan_to_num(before), 0), download(found.edges).astype(np.int64)
        onward = (throughput > 0) & np.isfinite(throughput) & np.isfinite(position).all(1)
        path, throughput = np.flatnonzero(onward), throughput[onward].astype(np.float64)
        onward = Onward(position[onward], normal[onward], path, throughput, beyond[path] / throughput, edges[path] - 1)
        arrived = (weight > 0) & np.isfinite(weight) & np.isfinite(position).all(1)
        indirect = np.where(arrived, beyond, 0)
        arrivals = Arrivals(position[arrived], normal[arrived], weight[arrived].astype(np.float64), indirect[arrived])
        first, facing, depth = (download(x) for x in (vertices.position, vertices.normal, vertices.depth))
        seen = (depth > 0) & np.isfinite(first).all(1)
        vertices = tuple(np.concatenate(x) for x in ((first[seen], position[arrived]), (facing[seen], normal[arrived])))
        return cls(arrivals, onward, vertices, pixel, radiance, indirect, size)

    @property
    def brightness(self) -> np.ndarray:
        """Mean radiance around each path, (n,), as the others tell."""
        return self._of_others[0]

    def nearby(self, values: np.ndarray) -> np.ndarray:
        """Mean of the paths' ``values`` around each pixel of the image, (pixels,)."""
        return pixel_means(values, self.pixel, *self.size, self._of_others[1])

    @cached_property
    def _of_others(self) -> tuple[np.ndarray, list[float]]:
        return means_of_others(self.radiance, self.pixel, *self.size)
