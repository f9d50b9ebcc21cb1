"""The runs of a comparison on the workers of a pool, in the place of `comparison.worker`.

A worker makes one run at a time, in a process of its own, as this machine would. Images come back as files.
"""

from collections import defaultdict
from pathlib import Path

from ..command_line import failure
from ..images import replacing
from ..worker import TICK
from . import worker
from .pool import Task
from .scene_travel import bundle

# Of the result of a run: where things are for us, not for the worker
OWN = ("label", "scene", "output", "denoised_output", "vpl_folder", "kernel_cache", "run", "threads")


class DistributedRuns:
    """Runs that workers begin with as soon as they are expected, and that are asked for one by one."""

    def __init__(self, pool):
        self._pool, self._waiting = pool, []
        self._results = defaultdict(list)  # of each run: two labels may have the same
        pool.sources.append(self)

    def expect(self, job, scene_file):
        """A `worker.Job` on a `SceneFile` (as it is in its file) is going to be asked for."""
        kernels = f"{scene_file.name}.{job.label}"
        arguments = (bundle(scene_file), job, None if job.cold else kernels)
        self._waiting.append(Task(self, job.run, worker.run_job, arguments))

    def run(self, job, tick=lambda: None):
        """Return the result of an expected job, as `comparison.worker.run`, with `machine`: a dict that names the one
        that made it. Raises ClusterError where there are no workers."""
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
        """Return the next run, None if there is none left."""
        return self._waiting.pop(0) if self._waiting else None

    def done(self, run, result, address):
        """A run has been made."""
        self._results[run].append(result)

    def failed(self, run, error):
        """A run could not be made."""
        self._results[run].append(error)
