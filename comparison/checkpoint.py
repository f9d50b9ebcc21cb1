"""Checkpoints: files with the passes of an unfinished render, from which another process continues.

Sums are in double precision: an interruption does not change the final image.
"""

import hashlib
import json
import zipfile
import zlib
from dataclasses import asdict
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import images
from .occasional import OccasionalWriter
from .single_pass import Pass

SUFFIX = ".checkpoint.npz"
CHECKPOINT_SECONDS = 10.0
# Prefixes of the names of arrays
_ESTIMATE, _DECISIONS = "estimate.", "decisions."
_FIRST = "first_sum"  # array of `Passes.first_sum`
# Exceptions of NumPy, zipfile and zlib for a file that is damaged, or is no archive of arrays
_UNREADABLE = (
    OSError, ValueError, KeyError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def file_of(image):
    """Return the path of the checkpoint of an image file."""
    return Path(image).with_suffix(SUFFIX)


class Checkpoint:
    """Checkpoint file of a render, which continues from it if `resume`. `made_by`: everything that the image depends on
    except the number and sizes of passes, a dict for JSON. The checkpoint of another render is refused. `stays`:
    whether the file stays after the end of a render, until `remove`, which the caller calls once the image is
    written."""

    def __init__(self, path, made_by, resume=True, stays=False):
        self.path, self._made_by, self._resume, self._stays = Path(path), made_by, resume, stays
        self._passes, self._kept, self._saved = None, None, None
        self._writer = OccasionalWriter("The checkpoint", CHECKPOINT_SECONDS)

    def restore(self, passes):
        """Add the passes of the file, if it exists, to the empty `Passes`; return their seconds. Raises ValueError with
        the name of the file for a damaged or altered checkpoint, and for the checkpoint of another render."""
        self._passes = passes
        if not self.path.is_file():
            return 0.0
        if not self._resume:
            mi.Log(mi.LogLevel.Warn, f"'{self.path}', which --resume continues from, will be replaced.")
            return 0.0
        described, arrays = self._read()
        other = [name for name in self._made_by if described["made_by"].get(name) != self._made_by[name]]
        if other:
            raise ValueError(f"'{self.path}' is of a render with another {other[0]}; delete it to begin anew")
        passes.channels, passes.sum = described["channels"], arrays["sum"]
        # A render without a denoiser keeps no halves
        passes.first_sum = arrays.get(_FIRST)
        passes.passes = [Pass(**one) for one in described["passes"]]
        passes.estimate.state, passes.decisions = (_below(prefix, arrays) for prefix in (_ESTIMATE, _DECISIONS))
        return described["seconds"]

    def _read(self):
        """Return the description and the arrays of the file."""
        try:
            with open(self.path, "rb") as opened, np.load(opened) as file:
                arrays = {name: file[name] for name in file.files}
            text, digest = arrays.pop("described").item(), arrays.pop("digest").item()
            if digest != _digest(text, arrays):
                raise ValueError("its content has been altered")
            return json.loads(text), {name: array if array.ndim else array.item() for name, array in arrays.items()}
        except _UNREADABLE as error:
            reason = f"it has no entry {error}" if isinstance(error, KeyError) else error
            raise ValueError(
                f"'{self.path}' is no checkpoint that can be read ({reason}); delete it to begin anew"
            ) from None

    def keep(self, seconds):
        """Take the state after a pass, `seconds` after the start; write the file from time to time."""
        passes = self._passes
        # A snapshot, as another thread may save it while a pass is added
        described = {
            "made_by": self._made_by,
            "seconds": seconds,
            "channels": passes.channels,
            "passes": list(passes.passes),
        }
        estimate = {_ESTIMATE + name: value for name, value in passes.estimate.state.items()}
        decisions = {_DECISIONS + name: value for name, value in passes.decisions.items()}
        halves = {_FIRST: passes.first_sum} if passes.has_halves else {}
        self._kept = described, {"sum": passes.sum, **halves, **estimate, **decisions}
        self._writer.offer(self.save)

    def save(self):
        """Write the file if there are new passes. Raises OSError with the name of the file if that fails; an earlier
        file is then unchanged."""
        kept = self._kept
        if kept is self._saved:
            return
        described, arrays = kept
        text = json.dumps(described, default=_plain)
        with images.replacing(self.path) as temporary:
            np.savez(temporary, described=np.array(text), digest=np.array(_digest(text, arrays)), **arrays)
        self._saved = kept

    def leave(self):
        """Write the passes so far to the file; return whether that succeeded. A failure is logged, as the passes are
        not lost."""
        return self._writer.write(self.save)

    def finish(self):
        """End a render that has reached a limit and made its image: remove the file, unless it stays."""
        if not self._stays:
            self.remove()

    def remove(self):
        """Remove the file, as the image is safe. A failure is logged, as the image is not lost."""
        self._saved = None
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            mi.Log(mi.LogLevel.Warn, f"The checkpoint could not be removed: {error}")


def _below(prefix, arrays):
    """Return the arrays whose names have a prefix, by the rest of the name."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _digest(text, arrays):
    """Return the SHA-256 (hexadecimal) of the description, and of names, types, shapes and values of the arrays."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _plain(value):
    """Return a `Pass` or a number of NumPy in a type that JSON has."""
    return asdict(value) if isinstance(value, Pass) else value.item()
