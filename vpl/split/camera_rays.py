"""Camera rays of a view, traced by :mod:`vpl.split.path_tracer`."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sampling import derived_seed, independent_sampler
from .contributions import LayerSums
from .emitters.base import EmitterSampler
from .lattice import Lattice
from .path_state import FirstEdge, PathSettings
from .path_tracer import Traced, trace_paths
from .pixel_rays import RayNumbers
from .view import View


@dataclass(frozen=True)
class CameraRays:
    """Some camera rays of a view.

    ``ray``; ``active``; ``importance`` of radiance, for Russian roulette; ``direct_samples``: number of emitter samples
    at the first scattering vertex; ``places`` in pixels; ``sizes``: the different numbers of rays of pixels; ``cells``
    of the film in a pixel.
    """

    ray: mi.Ray3f
    active: mi.Bool
    importance: mi.Float
    direct_samples: mi.UInt32
    places: RayNumbers
    sizes: tuple[int, ...]
    cells: int

    @classmethod
    def of(cls, view: View, lane: mi.UInt32) -> CameraRays:
        """The rays with the indices ``lane``."""
        ray, places = view.ray, view.rays.places(lane)
        part = mi.Ray3f(*(dr.gather(type(x), x, lane) for x in (ray.o, ray.d, ray.time)))
        # Of sensors with `far_clip`
        part.maxt = dr.gather(mi.Float, ray.maxt, lane)
        # All numbers of rays, and counted and chosen lanes, use the same kernel
        dr.eval(lane, places)
        importance = dr.gather(mi.Float, view.importance, places.pixel)
        samples = dr.gather(mi.UInt32, view.direct_samples, places.pixel)
        active = dr.gather(mi.Bool, view.active, lane)
        return cls(part, active, importance, samples, places, view.rays.sizes, view.rays.cells)

    def trace(
        self, scene, emitters: EmitterSampler, seed: int, settings: PathSettings, sums: LayerSums | None = None,
        lattice: Lattice | None = None,
    ) -> Traced:  # fmt: skip
        """Trace paths from the camera; ``sums`` by layer; ``lattice``: None for one of these rays alone."""
        of_rays = FirstEdge.plain if settings.plain else FirstEdge.of_camera
        edge = of_rays(self.ray, self.importance, self.active, self.direct_samples)
        if lattice is None:
            lattice = Lattice(self.places, self.sizes, derived_seed(seed, 0), cells=self.cells)
        sampler = independent_sampler(derived_seed(seed, 1), dr.width(self.places.pixel))
        return trace_paths(scene, emitters, edge, lattice, sampler, settings, sums)


def trace_camera_rays(
    view: View, lane: mi.UInt32, settings: PathSettings, *stream: int, sums: LayerSums | None = None,
    goes_on: bool = False,
) -> Traced:  # fmt: skip
    """Trace the camera rays ``lane`` of a view; ``stream``: of random numbers; ``sums`` by layer; ``goes_on``: whether
    the paths continue the lattices of earlier passes, if the rays of the view do."""
    rays, seed, lattice = CameraRays.of(view, lane), derived_seed(view.seed, *stream), None
    if goes_on and view.rays.continued:
        # By the first number of the stream alone: the others are those of parts of the image, which differ in each pass
        shared = derived_seed(view.rays.continued.seed, stream[0])
        lattice = Lattice(rays.places, rays.sizes, shared, view.rays.earlier, rays.cells)
    return rays.trace(view.scene, view.emitters, seed, settings, sums, lattice)
