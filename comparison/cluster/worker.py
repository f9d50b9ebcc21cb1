"""Code of a worker. Between passes a worker keeps scenes and compiled kernels.

A worker renders one pass at a time, for any number of Dask threads, as Mitsuba uses all cores for a pass.
"""

import platform
import threading
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

from distributed import get_worker

from .. import machine, single_pass
from ..command_line import explain, set_variant
from ..worker import run
from .compatibility import identity
from .scene_travel import Store

KEPT_SCENES = 2
_LOCK = threading.Lock()
_SCENES = OrderedDict()  # (scene, shared starts) by key of the bundle, most recently used last
_THREADS = None


class RenderError(Exception):
    """A pass failed on a worker, for the reason in the one-line message."""


class Interrupted(Exception):
    """A pass was not finished, because of Ctrl-C or the end of the worker."""


def begin(threads=None):
    """Set the number of threads of tasks (None: all cores); return the identity of this worker."""
    global _THREADS
    _THREADS = threads
    return identity()


def add_file(hash, content, dask_worker):
    """Add a file to the store of a worker, which `Client.run` passes."""
    Store(dask_worker.local_directory).add(hash, content)


def render_pass(bundle, sensor, spp, seed, first):
    """Render a pass of the scene of a `SceneBundle`; return a `PassImage`.

    `first`: see `single_pass.render_pass`. Raises FilesMissing for missing files, Interrupted for an unfinished pass,
    and RenderError for other errors.
    """
    with _LOCK:
        path = Store(get_worker().local_directory).place(bundle)
        try:
            scene, starts = _scene(bundle, path)
            shared = starts.setdefault((sensor, first), single_pass.SharedStart())
            image = single_pass.render_pass(scene, sensor, scene.integrator(), spp, seed, first, shared)
        except Exception as error:
            # Exceptions of Mitsuba and Dr.Jit may be impossible to unpickle on the client
            raise RenderError(explain(error)) from None
        if scene.integrator().should_stop():
            raise Interrupted
        return image


def _scene(bundle, path):
    set_variant(bundle.variant)
    if bundle.key not in _SCENES:
        while len(_SCENES) >= KEPT_SCENES:
            _SCENES.popitem(last=False)
        _SCENES[bundle.key] = bundle.make(path).load(_THREADS), {}
    _SCENES.move_to_end(bundle.key)
    return _SCENES[bundle.key]


def run_job(bundle, job, kernels):
    """Make a run of a comparison, a `comparison.worker.Job`, with the kernel cache in the folder `kernels` (None: an
    empty one). Return the result, and a dict from "output" and "denoised_output" to the content of the files."""
    with _LOCK:
        folder = Path(get_worker().local_directory)
        scene = Store(folder).place(bundle)
        files = {key: folder / f"{key}.exr" for key in ("output", "denoised_output") if getattr(job, key)}
        cache = str(folder / "kernels" / kernels) if kernels else None
        places = {key: str(file) for key, file in files.items()}
        result = run(replace(job, scene=scene, kernel_cache=cache, threads=job.threads or _THREADS, **places))
        result["machine"] = {"name": platform.node(), "worker": get_worker().address, **machine.identity()}
        return result, {} if "error" in result else {key: file.read_bytes() for key, file in files.items()}
