"""Random views of scenes, to test settings beyond the scenes' own cameras."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import scenes
from vpl.core.arrays import download

# In median distances of the surfaces visible to the scene's camera: maximum distance of a new camera from its surface
# (at most half of the free distance), and minimum distance from its target, which may be occluded
_STEP, _NEAREST = 0.15, 0.3


def move_cameras(scene, number: int) -> None:
    """Move all cameras to a random position near a surface visible to the first camera, facing another visible point.

    Deterministic for a ``number``. Raises RuntimeError if the first camera sees too little.
    """
    origin, target = _place(scene, number)
    for sensor in scene.sensors():
        parameters = mi.traverse(sensor)
        up = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)[:3, 1]
        view = mi.ScalarTransform4f().look_at(origin.tolist(), target.tolist(), up.tolist())
        parameters["to_world"] = type(parameters["to_world"])(view)
        parameters.update()


def _place(scene, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return position and target of a camera, (3,) each."""
    _, ray = scenes.camera_rays(scene, number)
    si = scene.ray_intersect(ray)
    away = si.spawn_ray(si.n * dr.mulsign(mi.Float(1), -dr.dot(si.n, ray.d)))
    distance, free = download(si.t), download(scene.ray_intersect(away).t)
    place, normal = download(si.p), download(away.d)
    seen = np.flatnonzero(np.isfinite(distance))
    if len(seen) == 0:
        raise RuntimeError("the camera of the scene sees no surface")
    typical = np.median(distance[seen])
    for start, end in np.random.default_rng(number).choice(seen, (1000, 2)):
        origin = place[start] + min(_STEP * typical, 0.5 * free[start]) * normal[start]
        if np.linalg.norm(place[end] - origin) > _NEAREST * typical:
            return origin, place[end]
    raise RuntimeError("the camera of the scene sees only surfaces too close to each other for another view")
