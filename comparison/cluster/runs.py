"""Runs of a comparison on the workers of a pool; the counterpart of `comparison.worker`.

A worker makes one run at a time, in a new process, as `comparison.worker` does. Images are returned as files.
"""

from collections import defaultdict
from pathlib import Path

from ..command_line import failure
from ..images import replacing
from ..worker import TICK
from . import worker
from .pool import Task
from .scene_travel import bundle

# Entries of a result with paths and settings of this machine, not of the worker
OWN = ("label", "scene", "output", "denoised_output", "vpl_folder", "kernel_cache", "run", "threads")


class DistributedRuns:
    """Runs that workers begin in advance, and whose results are then requested in sequence."""

    def __init__(self, pool):
        self._pool, self._waiting = pool, []
        self._results = defaultdict(list)  # a list for each run, as two labels may share a run
        pool.sources.append(self)

    def expect(self, job, scene_file):
        """Begin a `worker.Job` on an unchanged `SceneFile` in advance."""
        kernels = f"{scene_file.name}.{job.label}"
        arguments = (bundle(scene_file), job, None if job.cold else kernels)
        self._waiting.append(Task(self, job.run, worker.run_job, arguments))

    def run(self, job, tick=lambda: None):
        """Return the result of an expected job, as `comparison.worker.run` does, with the dict `machine`, which names
        the worker. Raises ClusterError without workers."""
        while not self._results[job.run]:
            self._pool.wait(TICK)
            tick()
        found = self._results[job.run].pop(0)
        own = {key: getattr(job, key) for key in OWN}
        if isinstance(found, Exception):
            return vars(job) | {"load_average": 0.0, "error": str(found), "traceback": ""}
        result, files = found
        try:
            for key, content in files.items():
                with replacing(Path(own[key])) as temporary:
                    temporary.write_bytes(content)
        except OSError as error:
            return result | own | failure(error)
        return result | own

    # --- For the pool ---

    def next_task(self, queued):
        """Return the next run, None after the last one."""
        return self._waiting.pop(0) if self._waiting else None

    def done(self, run, result, address):
        """Take the result of a run."""
        self._results[run].append(result)

    def failed(self, run, error):
        """Take the error of a failed run."""
        self._results[run].append(error)
