"""References: images that others are compared with, and the standard errors of their pixels.

A path-traced reference is the mean of batches of different seeds, whose spread gives its standard error. It is kept in
a cache folder under the fingerprint of its scene, and continued when more samples are asked for later. To make one that
can be given away (in half precision):

    python -m comparison.references scenes/hall.xml --width 192 --spp 32768 --output scenes/hall_reference.exr
"""

import argparse
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from . import command_line, images
from .rendering import Progressive, largest_pass, pass_seed
from .scene_files import SceneFile

LAYERS = ["R", "G", "B", "se.R", "se.G", "se.B"]
BATCHES = 32  # at least, for a standard error that is itself known to some 13%
SEED = 2_718_281_828  # unlike any that people choose: a reference must not share its noise with what it judges
SAVE_SECONDS = 20.0  # how much work an interruption may lose


@dataclass
class Reference:
    """`image` and `standard_error`, (height, width, 3) linear colour (the error None if it is not known), and
    `description`, a dict that says how it was made ("integrator", "spp", ... as far as known)."""

    image: np.ndarray
    standard_error: np.ndarray | None
    description: dict

    @property
    def size(self):
        """Width and height in pixels."""
        return self.image.shape[1], self.image.shape[0]


def read(path):
    """Read a reference from an EXR file: colour channels and, where there are, layers `se.*` with its standard error.
    Raises OSError or RuntimeError if it cannot be read, ValueError if it has no colour."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no reference '{path}'")
    image, channels, metadata = images.read_exr(path)
    has_error = any(name.startswith("se.") for name in channels)
    return Reference(
        images.colour(image, channels).astype(np.float64),
        images.colour(image, channels, "se.").astype(np.float64) if has_error else None,
        {"file": str(path), **metadata},
    )


def write(path, image, standard_error, description, half=False):
    """Write a reference that `read` reads."""
    images.write_exr(path, np.concatenate((image, standard_error), axis=-1), LAYERS, description, half)


def default_cache():
    return Path.home() / ".cache" / "manylights"


def path_traced(scene_file, spp, cache):
    """Return the path-traced reference of a `SceneFile` (which this consumes, and whose `max_depth` it keeps) with at
    least `spp` samples per pixel: from the folder `cache` if it is there, begun or continued there if not."""
    scene_file.set_integrator("path")
    _, parameters = scene_file.integrator
    file = Path(cache) / f"{scene_file.name}-{scene_file.fingerprint()[:16]}.exr"
    batches = Batches.read(file) if file.is_file() else None
    if batches is None or batches.spp < spp:
        file.parent.mkdir(parents=True, exist_ok=True)
        progressive = Progressive(scene_file.load(), SEED)
        if batches is None:
            batches = Batches(max(1, min(-(-spp // BATCHES), largest_pass(progressive.pixels))))
        described = {"integrator": "path", "scene": scene_file.name, "seed": SEED, **parameters}
        _continue(batches, progressive, spp, file, described)
    return read(file)


def _continue(batches, progressive, spp, file, described):
    """Render batches until there are `spp` samples per pixel (and at least two batches), saving them now and then."""
    saved = time.monotonic()
    with tqdm(total=spp, initial=batches.spp, desc="reference", unit="spp", disable=None) as bar:
        while batches.spp < spp or batches.count < 2:
            progressive.restart()
            progressive.render(batches.batch_spp, pass_seed(progressive.seed, batches.count))
            batches.add(images.colour(progressive.image, progressive.channels))
            bar.update(batches.batch_spp)
            if time.monotonic() - saved > SAVE_SECONDS:
                batches.write(file, described)
                saved = time.monotonic()
    batches.write(file, described)


class Batches:
    """The mean of batches of `batch_spp` samples per pixel and its standard error, added to one by one (Welford)."""

    def __init__(self, batch_spp, count=0, mean=0.0, standard_error=0.0):
        self.batch_spp, self.count, self.mean = batch_spp, count, mean
        self._squares = np.square(standard_error) * count * (count - 1)

    @property
    def spp(self):
        return self.batch_spp * self.count

    def add(self, image):
        """Add the image of one more batch, (height, width, 3); pixels that are not finite count as black."""
        image = np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)
        self.count += 1
        difference = image - self.mean
        self.mean = self.mean + difference / self.count
        self._squares = self._squares + difference * (image - self.mean)

    @property
    def standard_error(self):
        """Of the mean, (height, width, 3); needs two batches."""
        return np.sqrt(self._squares / (self.count * (self.count - 1)))

    def write(self, path, described):
        """Write mean and standard error to an EXR file that `read` reads; needs two batches."""
        if self.count < 2:
            return
        write(path, self.mean, self.standard_error, {**described, "spp": self.spp, "batches": self.count})

    @classmethod
    def read(cls, path):
        image, channels, metadata = images.read_exr(path)
        mean, error = images.colour(image, channels), images.colour(image, channels, "se.")
        count = metadata["batches"]
        return cls(metadata["spp"] // count, count, mean.astype(np.float64), error.astype(np.float64))


def main():
    parser = argparse.ArgumentParser(
        prog="python -m comparison.references", description="Make a path-traced reference."
    )
    parser.add_argument("scene", help="scene file (XML)")
    parser.add_argument("--width", type=command_line.positive(int), help="width of the image (default: the scene's)")
    parser.add_argument("--spp", type=command_line.positive(int), required=True, help="samples per pixel")
    parser.add_argument("--cache", type=Path, default=default_cache(), help="default: ~/.cache/manylights")
    parser.add_argument("--output", type=Path, required=True, help="EXR file")
    command_line.add_common_options(parser)
    options = parser.parse_args()
    command_line.set_variant(options.mode)
    file = SceneFile(options.scene, dict(options.define))
    if options.width:
        file.set_width(options.width)
    reference = path_traced(file, options.spp, options.cache)
    made = {key: value for key, value in reference.description.items() if key not in ("file", "generatedBy")}
    made |= {"command": shlex.join(["python", "-m", "comparison.references", *sys.argv[1:]]), **command_line.versions()}
    write(options.output, reference.image, reference.standard_error, made, half=True)


if __name__ == "__main__":
    main()
