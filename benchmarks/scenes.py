"""Scenes of the benchmarks: those of this project, and external scenes if their folder is present."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from comparison.images import planes_of
from comparison.scene_files import SceneFile

PROJECT = Path(__file__).resolve().parent.parent
SHARED = PROJECT.parent / "shared"
REFERENCES, REFERENCE_WIDTH = SHARED / "references", 256
NAMES = (
    "cornell", "kitchen", "sponza_crytek", "staircase2", "living_room", "dining_room", "bistro_interior",
    "veach_ajar", "everything8003",
)  # fmt: skip


def scene_file(name: str) -> Path:
    """XML file of a scene; FileNotFoundError with the reason if it is absent."""
    own = PROJECT / "scenes" / f"{name}.xml"
    if own.exists():
        return own
    path = SHARED / "scenes" / name / "scene.xml"
    if not path.exists():
        raise FileNotFoundError(f"{path} is absent: external scenes are not part of this project")
    return path


def reference_file(name: str) -> Path | None:
    """Path-traced reference of a scene at a width of 256, None if absent."""
    path = REFERENCES / f"{name}.exr"
    return path if path.exists() else None


def reference_at(name: str, width: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The reference of a scene and its standard error, (height, width, 3), None without one of this ``width``."""
    file = reference_file(name)
    if file is None or width != REFERENCE_WIDTH:
        return None
    values, names = planes_of(mi.Bitmap(str(file)))
    truth, noise = ([names.index(prefix + channel) for channel in "RGB"] for prefix in ("", "se."))
    return tuple(values[..., which].astype(np.float64) for which in (truth, noise))


def scale_of_truth(truth: np.ndarray) -> np.ndarray:
    """Denominator of relative squared errors."""
    return truth**2 + 0.01 * truth.mean() ** 2


@functools.cache
def size_of(name: str) -> tuple[int, int]:
    """Width and height of the image in a scene's file, in pixels."""
    return SceneFile(scene_file(name)).size


def height(name: str, width: int) -> int:
    """Height of a scene's image for a width in pixels."""
    own_width, own_height = size_of(name)
    return round(own_height * width / own_width)


def load(name: str, width: int = 256):
    """Load a scene with a width in pixels."""
    return mi.load_file(str(scene_file(name)), resx=width, resy=height(name, width))


def available(names) -> list[str]:
    """Return the names with existing files; print the missing ones with the reason."""
    found = []
    for name in names:
        try:
            scene_file(name)
            found.append(name)
        except FileNotFoundError as reason:
            print(f"skipped {name}: {reason}")
    return found


def camera_rays(scene, seed: int, samples: int = 1):
    """Sampler and camera rays as in ``mi.render`` with a box filter, ``samples`` per pixel."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(samples)
    sampler.seed(seed, int(width * height * samples))
    index = dr.arange(mi.UInt32, int(width * height * samples)) // samples
    pixel = mi.Point2f(mi.Float(index % int(width)), mi.Float(index // int(width)))
    position = (pixel + sampler.next_2d()) / mi.Vector2f(float(width), float(height))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    return sampler, mi.Ray3f(ray)


def timed(function, clock=time.perf_counter):
    """Return (result, seconds by ``clock``) of a call; the device is idle before and after."""
    dr.sync_thread()
    start = clock()
    result = function()
    dr.eval(result)
    dr.sync_thread()
    return result, clock() - start


def numbers_of(code: str, cache: str, count: int, *arguments) -> list[float]:
    """The last ``count`` numbers that Python ``code`` prints in a new process, with the compiled kernels in the folder
    ``cache``; ``arguments`` of the process."""
    environment = os.environ | {"DRJIT_CACHE_DIR": cache, "PYTHONPATH": str(PROJECT)}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return [float(number) for number in output.split()[-count:]]
