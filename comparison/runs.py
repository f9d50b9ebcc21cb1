"""Finished runs on disk, so that an interrupted comparison can resume.

The key of a run covers everything that its image and time depend on: job, scene with all referenced files, software
versions, sources of this project, and machine. A run's image is written first; then the result file, which marks the
run as finished, is moved into place.
"""

import fcntl
import hashlib
import json
import shutil
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from . import images
from .command_line import UsageError

FOLDER = "runs"
IRRELEVANT = ("label", "output", "run", "scene", "kernel_cache", "vpl_folder", "denoised_output")  # paths and names


class Runs:
    """Finished runs of an output folder owned by this process. `made_by` (a dict): dependencies of all runs besides job
    and scene."""

    def __init__(self, out, made_by):
        self.folder, self._made_by = Path(out) / FOLDER, made_by
        self.kernels = self.folder / "kernels"
        self.folder.mkdir(parents=True, exist_ok=True)
        # Remnants of a killed comparison
        self.remove_kernels()
        for folder in (out, self.folder):
            images.remove_abandoned(folder)

    def key(self, job, scene_hash):
        """Return the key of a run: 32 hexadecimal digits."""
        described = {key: value for key, value in asdict(job).items() if key not in IRRELEVANT}
        described |= {"with_vpl": job.vpl_folder is not None, "denoised": job.denoised_output is not None}
        described |= {"hash": scene_hash, **self._made_by}
        return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:32]

    def find(self, job):
        """Return the result of the run `job.run`, None if it is unfinished or its images are missing."""
        try:
            result = json.loads(self._file(job.run).read_text())
        except FileNotFoundError:
            return None
        except ValueError:  # truncated by a full disk, or edited: repeat the run
            return None
        # Another setting may have overwritten the image since
        if _run_of(job.output) != job.run or (result["vpl_output"] and not Path(result["vpl_output"]).is_file()):
            return None
        if job.denoised_output and _run_of(job.denoised_output) != job.run:
            return None
        files = {"output": job.output, "denoised_output": job.denoised_output}
        return result | files | {"label": job.label, "scene": job.scene}

    def save(self, result):
        """Save the result of a successful run."""
        with images.replacing(self._file(result["run"])) as temporary:
            temporary.write_text(json.dumps(result, indent=1))

    def remove_kernels(self):
        """Remove the folder `kernels` of compiled kernels, one subfolder per label."""
        shutil.rmtree(self.kernels, ignore_errors=True)

    def _file(self, key):
        return self.folder / f"{key}.json"


def _run_of(file):
    """Return the run that wrote an EXR file, None if unknown."""
    try:
        return images.read_exr_metadata(file).get("run")
    except (OSError, RuntimeError, ValueError):
        return None


@contextmanager
def locked(file, complaint=None):
    """Hold a lock on a file, whose existence has no meaning. Waits for the lock; with a `complaint`, raises UsageError
    instead."""
    with open(file, "w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (fcntl.LOCK_NB if complaint else 0))
        except BlockingIOError:
            raise UsageError(complaint) from None
        yield
