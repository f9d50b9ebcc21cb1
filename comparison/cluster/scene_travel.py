"""Transfer of scenes to workers, as files with hashes.

A worker uses files in their original place if they have the same content there (a shared file system, or the same
machine), otherwise files from its store, by hash. Files that the store lacks are sent once. Files with a path relative
to the scene keep their relative places; files with an absolute path must exist on the worker.
"""

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from ..images import replacing
from ..scene_files import SceneFile, file_hash
from .scene_names import named_files


class FilesMissing(Exception):
    """Files are missing on a worker; the argument is the list of their hashes."""


@dataclass(frozen=True)
class TravellingFile:
    """File of a scene: absolute `path` on the client; `relative` path below the common folder, None for a file that the
    scene names by an absolute path; `hash` of the content."""

    path: str
    relative: str | None
    hash: str


@dataclass(frozen=True)
class SceneBundle:
    """Everything that a scene depends on: its `files`, the scene file first; `defines` and `changes` of the
    `SceneFile`; and the `variant`."""

    files: tuple
    defines: dict
    changes: tuple
    variant: str

    @property
    def key(self):
        """Hash (hexadecimal) that identifies the scene."""
        content = [(file.relative or file.path, file.hash) for file in self.files]
        return hashlib.sha256(repr((content, self.defines, self.changes, self.variant)).encode()).hexdigest()[:32]

    def make(self, path):
        """Return the `SceneFile`, from the scene file at a path."""
        return SceneFile(path, self.defines, self.changes)


def bundle(scene_file):
    """Return the `SceneBundle` of a `SceneFile`."""
    main = os.path.abspath(scene_file.path)
    named = named_files(main, scene_file.defines) | {main: True}
    folder = os.path.commonpath([os.path.dirname(file) for file, is_relative in named.items() if is_relative])
    files = [
        TravellingFile(file, os.path.relpath(file, folder) if is_relative else None, file_hash(file))
        for file, is_relative in named.items()
    ]
    files.sort(key=lambda file: (file.path != main, file.relative is None, file.path))
    return SceneBundle(tuple(files), scene_file.defines, tuple(scene_file.changes), mi.variant())


class Store:
    """Store of files in the folder of a worker."""

    def __init__(self, folder):
        self._files, self._scenes = Path(folder) / "files", Path(folder) / "scenes"

    def add(self, hash, content):
        """Add a file with the given content (bytes). Raises OSError on a full disk."""
        self._files.mkdir(parents=True, exist_ok=True)
        with replacing(self._files / hash) as temporary:
            temporary.write_bytes(content)

    def place(self, bundle):
        """Return the path of the scene file of a bundle, with all other files in place. Raises FilesMissing for files
        that are neither in their original place nor in the store, and FileNotFoundError for files by an absolute
        path."""
        lacking = [file for file in bundle.files if not is_there(file.path, file.hash)]
        if not lacking:
            return bundle.files[0].path
        for file in lacking:
            if file.relative is None:
                raise FileNotFoundError(
                    f"'{file.path}', which the scene names by its absolute path, is not there on this worker, or is "
                    "another file"
                )
        travelling = [file for file in bundle.files if file.relative is not None]
        missing = [file.hash for file in travelling if not (self._files / file.hash).is_file()]
        if missing:
            raise FilesMissing(missing)
        folder = self._scenes / bundle.key
        for file in travelling:
            place = folder / file.relative
            if not place.exists():
                place.parent.mkdir(parents=True, exist_ok=True)
                _link(self._files / file.hash, place)
        return str(folder / bundle.files[0].relative)


def _link(file, place):
    try:
        os.link(file, place)
    except OSError:  # the file system has no links
        shutil.copyfile(file, place)


def read(bundle, hash):
    """Return the content (bytes) of a file of a bundle. Raises ValueError if the file has changed."""
    path = next(file.path for file in bundle.files if file.hash == hash)
    content = Path(path).read_bytes()
    if hashlib.sha256(content).hexdigest() != hash:
        raise ValueError(f"'{path}' has been changed since the render began")
    return content


def is_there(path, hash):
    """Return whether a path is a file with the given hash."""
    try:
        return file_hash(path) == hash
    except OSError:
        return False
