"""What runs on a worker. It keeps scenes, and with them compiled kernels, between passes.

A worker renders one pass at a time, whatever the number of its threads in Dask is: Mitsuba uses all cores for one.
"""

import platform
import threading
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

from distributed import get_worker

from .. import machine, rendering
from ..command_line import explain, set_variant
from ..worker import run
from .compatibility import identity
from .scene_travel import Store

KEPT_SCENES = 2
_LOCK = threading.Lock()
_SCENES = OrderedDict()  # of keys of bundles, used last: last
_THREADS = None


class RenderError(Exception):
    """A pass failed on a worker; the message is one line."""


class Interrupted(Exception):
    """A pass was not finished, as the worker heard Ctrl-C or is to end."""


def begin(threads=None):
    """Get ready for tasks, which shall use as many threads (None: all cores); return this worker's identity."""
    global _THREADS
    _THREADS = threads
    return identity()


def add_file(hash, content, dask_worker):
    """Put a file into the store of a worker, which is given by `Client.run`."""
    Store(dask_worker.local_directory).add(hash, content)


def render_pass(bundle, sensor, spp, seed):
    """Render a pass of the scene of a `SceneBundle`; return a `PassImage`. Raises FilesMissing for files that this
    worker lacks, Interrupted for a pass that is not whole, RenderError for anything else."""
    with _LOCK:
        path = Store(get_worker().local_directory).place(bundle)
        try:
            scene = _scene(bundle, path)
            image = rendering.render_pass(scene, sensor, scene.integrator(), spp, seed)
        except Exception as error:
            # Mitsuba's and Dr.Jit's need not be known, nor survive the journey, where they are told.
            raise RenderError(explain(error)) from None
        if scene.integrator().should_stop():
            raise Interrupted
        return image


def _scene(bundle, path):
    set_variant(bundle.variant)
    if bundle.key not in _SCENES:
        while len(_SCENES) >= KEPT_SCENES:
            _SCENES.popitem(last=False)
        _SCENES[bundle.key] = bundle.make(path).load(_THREADS)
    _SCENES.move_to_end(bundle.key)
    return _SCENES[bundle.key]


def run_job(bundle, job, kernels):
    """Make a run of a comparison, a `comparison.worker.Job`, with kernels compiled in a folder of that name (None: a
    fresh one); return its result and its files, a dict from "output" and "denoised_output" to their content."""
    with _LOCK:
        folder = Path(get_worker().local_directory)
        scene = Store(folder).place(bundle)
        files = {key: folder / f"{key}.exr" for key in ("output", "denoised_output") if getattr(job, key)}
        cache = str(folder / "kernels" / kernels) if kernels else None
        places = {key: str(file) for key, file in files.items()}
        result = run(replace(job, scene=scene, kernel_cache=cache, threads=job.threads or _THREADS, **places))
        result["machine"] = {"name": platform.node(), "worker": get_worker().address, **machine.identity()}
        return result, {} if "error" in result else {key: file.read_bytes() for key, file in files.items()}
