"""Camera rays of a view, traced by :mod:`vpl.split.path_tracer`."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sampling import derived_seed, independent_sampler
from .contributions import LayerSums
from .emitters.base import EmitterSampler
from .lattice import Lattice
from .path_tracer import Traced, trace_paths
from .pixel_rays import PixelRays, RayNumbers
from .view import FirstEdge, PathSettings, Stream, View


@dataclass(frozen=True)
class CameraRays:
    """Some camera rays of a view.

    ``ray``; ``active``; ``importance`` of radiance, for Russian roulette; ``places`` in pixels; ``rays`` of all pixels.
    """

    ray: mi.Ray3f
    active: mi.Bool
    importance: mi.Float
    places: RayNumbers
    rays: PixelRays

    @classmethod
    def of(cls, view: View, lane: mi.UInt32) -> CameraRays:
        """The rays with the indices ``lane``."""
        ray, places = view.ray, view.rays.places(lane)
        part = mi.Ray3f(*(dr.gather(type(x), x, lane) for x in (ray.o, ray.d, ray.time)))
        # All numbers of rays, and counted and chosen lanes, use the same kernel
        dr.eval(lane, places)
        importance = dr.gather(mi.Float, view.importance, places.pixel)
        return cls(part, dr.gather(mi.Bool, view.active, lane), importance, places, view.rays)

    def trace(
        self, scene, emitters: EmitterSampler, seed: int, settings: PathSettings, sums: LayerSums | None = None
    ) -> Traced:
        """Trace paths from the camera; ``sums`` by layer."""
        edge = FirstEdge.of_camera(self.ray, self.importance, self.active)
        continued = self.rays.continued
        # The seed of a part of the image depends on the part, and passes have other parts
        of_lattice = derived_seed(continued.seed, Stream.IMAGE) if continued else derived_seed(seed, 0)
        lattice = Lattice(self.places, self.rays.sizes, of_lattice, self.rays.earlier)
        sampler = independent_sampler(derived_seed(seed, 1), dr.width(self.places.pixel))
        return trace_paths(scene, emitters, edge, lattice, sampler, settings, sums)


def trace_camera_rays(
    view: View, lane: mi.UInt32, settings: PathSettings, *stream: int, sums: LayerSums | None = None
) -> Traced:
    """Trace the camera rays ``lane`` of a view; ``stream``: of random numbers; ``sums`` by layer."""
    seed = derived_seed(view.seed, *stream)
    return CameraRays.of(view, lane).trace(view.scene, view.emitters, seed, settings, sums)
