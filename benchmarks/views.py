"""Views of scenes that nobody chose, by cameras at random: what suits a scene's own picture has to suit them, too."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import scenes
from vpl.core.arrays import download

# Distance of a camera from a surface, of half of the way to the next at most, and from the place that it is turned to,
# which may be hidden, at least; in median distances of what the scene's own camera sees
_STEP, _NEAREST = 0.15, 0.3


def move_cameras(scene, number: int) -> None:
    """Move all cameras of a scene to one place before a surface that the first of them sees, and turn them towards
    another place that this one sees; the same for the same ``number``.  RuntimeError where it sees too little."""
    origin, target = _place(scene, number)
    for sensor in scene.sensors():
        parameters = mi.traverse(sensor)
        up = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)[:3, 1]
        view = mi.ScalarTransform4f().look_at(origin.tolist(), target.tolist(), up.tolist())
        parameters["to_world"] = type(parameters["to_world"])(view)
        parameters.update()


def _place(scene, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a camera stands and what it looks at, (3,) each."""
    _, ray = scenes.camera_rays(scene, number)
    si = scene.ray_intersect(ray)
    away = si.spawn_ray(si.n * dr.mulsign(mi.Float(1), -dr.dot(si.n, ray.d)))
    distance, free = download(si.t), download(scene.ray_intersect(away).t)
    place, normal = download(si.p), download(away.d)
    seen = np.flatnonzero(np.isfinite(distance))
    if len(seen) == 0:
        raise RuntimeError("the camera of the scene sees no surface that another could look at")
    typical = np.median(distance[seen])
    for start, end in np.random.default_rng(number).choice(seen, (1000, 2)):
        origin = place[start] + min(_STEP * typical, 0.5 * free[start]) * normal[start]
        if np.linalg.norm(place[end] - origin) > _NEAREST * typical:
            return origin, place[end]
    raise RuntimeError("the camera of the scene sees nothing that is far enough from the rest")
