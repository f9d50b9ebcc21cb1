"""Runs of a comparison on the workers of a pool; the counterpart of `comparison.worker`.

A worker makes one run at a time, in a new process, as `comparison.worker` does. Images are returned as files, written
and saved as soon as a run is finished: runs may be finished long before their results are requested.
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
    """Runs that workers begin in advance, and whose results are then requested in sequence. `save` is called with each
    successful result; set it before the first run."""

    def __init__(self, pool):
        self._pool, self._waiting, self.save = pool, [], lambda result: None
        # A list for each run, as two labels may share a run; results by run and label
        self._jobs, self._results = defaultdict(list), {}
        pool.sources.append(self)

    def expect(self, job, scene_file):
        """Begin a `worker.Job` on an unchanged `SceneFile` in advance."""
        kernels = f"{scene_file.name}.{job.label}"
        arguments = (bundle(scene_file), job, None if job.cold else kernels)
        self._waiting.append(Task(self, job.run, worker.run_job, arguments))
        self._jobs[job.run].append(job)

    def run(self, job, tick=lambda: None):
        """Return the result of an expected job, as `comparison.worker.run` does, with the dict `machine`, which names
        the worker. Raises ClusterError without workers."""
        while (job.run, job.label) not in self._results:
            self._pool.wait(TICK)
            tick()
        return self._results.pop((job.run, job.label))

    # --- For the pool ---

    def next_task(self, queued):
        """Return the next run, None after the last one."""
        return self._waiting.pop(0) if self._waiting else None

    def done(self, run, result, address):
        """Write the images of a run, and save its result."""
        job, (result, files) = self._jobs[run].pop(0), result
        result |= {key: getattr(job, key) for key in OWN}
        try:
            for key, content in files.items():
                with replacing(Path(result[key])) as temporary:
                    temporary.write_bytes(content)
            if "error" not in result:
                self.save(result)
        except OSError as error:
            result |= failure(error)
        self._results[run, job.label] = result

    def failed(self, run, error):
        """Take the error of a failed run."""
        job = self._jobs[run].pop(0)
        self._results[run, job.label] = vars(job) | {"load_average": 0.0, "error": str(error), "traceback": ""}
