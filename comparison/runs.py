"""Finished runs, kept on disk so that a comparison which was interrupted or killed can go on where it stopped.

A run is recognised by all that its image and its seconds depend on: the job, the scene with all files that it names,
the versions of the software, the sources of this project, and the machine. Its image is written first, then, renamed
into place, the file that says that it is finished.
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
NOT_OF_THE_RUN = (
    "label",
    "output",
    "run",
    "scene",
    "kernel_cache",
    "vpl_folder",
    "denoised_output",
)  # where files are, and names


class Runs:
    """The finished runs of an output folder, which is this process's alone. `made_by` is what, besides jobs and scenes,
    they depend on (a dict)."""

    def __init__(self, out, made_by):
        self.folder, self._made_by = Path(out) / FOLDER, made_by
        self.kernels = self.folder / "kernels"
        self.folder.mkdir(parents=True, exist_ok=True)
        # What a comparison that was killed left behind:
        self.forget_kernels()
        for folder in (out, self.folder):
            images.remove_abandoned(folder)

    def key(self, job, scene_hash):
        """Return what a run is recognised by: 32 hexadecimal digits."""
        described = {key: value for key, value in asdict(job).items() if key not in NOT_OF_THE_RUN}
        described |= {"with_vpl": job.vpl_folder is not None, "denoised": job.denoised_output is not None}
        described |= {"hash": scene_hash, **self._made_by}
        return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:32]

    def find(self, job):
        """Return the result of the run `job.run`, or None if it was not finished or its images are no longer there."""
        try:
            result = json.loads(self._file(job.run).read_text())
        except FileNotFoundError:
            return None
        except ValueError:  # a disk that was full, or a hand that edited: the run is made again
            return None
        # Other settings may have written their image to the same place since.
        if _run_of(job.output) != job.run or (result["vpl_output"] and not Path(result["vpl_output"]).is_file()):
            return None
        if job.denoised_output and _run_of(job.denoised_output) != job.run:
            return None
        files = {"output": job.output, "denoised_output": job.denoised_output}
        return result | files | {"label": job.label, "scene": job.scene}

    def save(self, result):
        """Keep the result of a run that went well."""
        with images.replacing(self._file(result["run"])) as temporary:
            temporary.write_text(json.dumps(result, indent=1))

    def forget_kernels(self):
        """Remove compiled kernels; `kernels` is a folder for those of this comparison, each label with its own."""
        shutil.rmtree(self.kernels, ignore_errors=True)

    def _file(self, key):
        return self.folder / f"{key}.json"


def _run_of(file):
    """Return which run wrote an EXR file, None if that cannot be told."""
    try:
        return images.read_exr_metadata(file).get("run")
    except (OSError, RuntimeError, ValueError):
        return None


@contextmanager
def locked(file, complaint=None):
    """Hold a lock, the existence of which is of no importance, on a file. Waits for it, or raises UsageError with the
    `complaint` if one is given."""
    with open(file, "w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (fcntl.LOCK_NB if complaint else 0))
        except BlockingIOError:
            raise UsageError(complaint) from None
        yield
