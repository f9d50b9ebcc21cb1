"""Reference images of comparisons, and the standard errors of their pixels.

A path-traced reference is the mean of batches with different seeds; the variance between batches gives its standard
error. A cache folder keeps references by the fingerprint of the scene, and a request for more samples continues them.
To make a reference for distribution, in half precision:

    python -m comparison.references scenes/hall.xml --width 192 --spp 32768 --output scenes/hall_reference.exr
"""

import argparse
import hashlib
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from . import command_line, images
from .rendering import Progressive
from .runs import locked
from .scene_files import SceneFile
from .single_pass import largest_pass, pass_seed

LAYERS = ["R", "G", "B", "se.R", "se.G", "se.B"]
BATCHES = 32  # minimum, for a standard error with a relative error of some 13%
SEED = 2_718_281_828  # an unlikely choice of users, as a reference must not share noise with the images it judges
SAVE_SECONDS = 20.0  # of work that an interruption may lose


@dataclass(frozen=True)
class Wanted:
    """Requested reference, of a `kind`. "path": path-traced with `spp` samples per pixel, or, if `spp` is None, with
    enough samples that its standard error is `fraction` of the smallest error. "file": a `file`, or a folder of files.
    "vpl": rendered by `vpl`."""

    kind: str
    spp: int | None = None
    fraction: float | None = None
    file: Path | None = None

    def file_of(self, name):
        """Return the file for the scene `name`, None for kinds other than "file"."""
        return self.file / f"{name}.exr" if self.file and self.file.is_dir() else self.file


AUTOMATIC_FRACTION = 0.2  # its square, 4%, is the noise in a squared error before correction


def wanted(text):
    """Convert the text of --reference to a `Wanted`; an argparse type."""
    form = f"'{text}' is not of the form path:SPP, path:auto or path:auto:FRACTION"
    kind, _, detail = text.partition(":")
    if text == "vpl":
        return Wanted("vpl")
    if kind == "path":
        spp, _, fraction = detail.partition(":")
        if spp == "auto":
            return Wanted("path", fraction=_fraction(fraction, form) if ":" in detail else AUTOMATIC_FRACTION)
        if not detail.isdecimal() or int(detail) == 0:
            raise argparse.ArgumentTypeError(form)
        return Wanted("path", spp=int(detail))
    if not Path(text).exists():
        raise argparse.ArgumentTypeError(f"'{text}' is neither a file, nor a folder, path:SPP, path:auto or vpl")
    return Wanted("file", file=Path(text))


def _fraction(text, form):
    try:
        fraction = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(form) from None
    if not 0 < fraction < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a fraction between 0 and 1")
    return fraction


@dataclass
class Reference:
    """Reference: `image` and `standard_error`, (height, width, 3) linear colour (the error None if unknown), and
    `description`, a dict of known properties of the render ("integrator", "spp", ...)."""

    image: np.ndarray
    standard_error: np.ndarray | None
    description: dict

    @property
    def size(self):
        """Width and height in pixels."""
        return self.image.shape[1], self.image.shape[0]


def read(path):
    """Read a reference from an EXR file: colour channels, and optional layers `se.*` of the standard error. Raises
    OSError or RuntimeError for an unreadable file, ValueError for missing colour and for pixels that are not finite."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no reference '{path}'")
    image, channels, metadata = images.read_exr(path)
    colour, error = images.colour(image, channels).astype(np.float64), None
    if any(name.startswith("se.") for name in channels):
        error = images.colour(image, channels, "se.").astype(np.float64)
    bad = sum(int((~np.isfinite(layer)).any(axis=-1).sum()) for layer in (colour, error) if layer is not None)
    if bad:
        raise ValueError(f"the reference '{path}' has {bad} pixels that are not finite")
    return Reference(colour, error, {**metadata, "file": str(path)})


def write(path, image, standard_error, description, half=False):
    """Write a reference for `read`."""
    images.write_exr(path, np.concatenate((image, standard_error), axis=-1), LAYERS, description, half)


def default_cache():
    return Path.home() / ".cache" / "manylights"


def path_traced(scene_file, spp, cache):
    """Return the path-traced reference of a `SceneFile`, with its `max_depth` and at least `spp` samples per pixel,
    from the folder `cache`, where it is started or continued if needed. The `SceneFile` is consumed.

    The key is a hash of all dependencies: the scene with its parameters and files, and the version of Mitsuba. Only one
    process works on a reference at a time. Raises ValueError for an unreadable or altered file in the cache.
    """
    scene_file.set_integrator("path")
    _, parameters = scene_file.integrator
    key = hashlib.sha256(f"{scene_file.fingerprint()} {mi.__version__}".encode()).hexdigest()[:16]
    file = Path(cache) / f"{scene_file.name}-{key}.exr"
    file.parent.mkdir(parents=True, exist_ok=True)
    with locked(file.with_suffix(".lock")):
        images.remove_abandoned(file.parent, file.stem)
        batches = _read_batches(file, scene_file.sampling(0)[0])
        if batches.spp < spp or batches.count < 2:
            described = {"integrator": "path", "scene": scene_file.name, "seed": SEED, **parameters}
            described["mitsuba"] = mi.__version__
            _continue(batches, Progressive(scene_file.load(), SEED), spp, file, described)
    return read(file)


def _read_batches(file, pixels):
    """Return the batches of a kept reference with the given number of pixels, empty if there is no file."""
    if not file.is_file():
        return Batches()
    try:
        batches = Batches.read(file)
        if batches.mean[..., 0].size != pixels:
            raise ValueError(f"it has {batches.mean[..., 0].size} pixels instead of {pixels}")
        return batches
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"the kept reference '{file}' cannot be read ({error}); delete it to make it anew") from error


def _continue(batches, progressive, spp, file, described):
    """Render batches up to `spp` samples per pixel, and at least two batches. Save them from time to time, and after an
    interruption."""
    saved = time.monotonic()
    batch_spp = max(1, min(-(-(spp - batches.spp) // BATCHES), largest_pass(progressive.pixels)))
    try:
        with tqdm(total=spp, initial=batches.spp, desc="reference", unit="spp", disable=None, leave=False) as bar:
            while batches.spp < spp or batches.count < 2:
                progressive.restart()
                progressive.render(batch_spp, pass_seed(progressive.seed, batches.count))
                batches = batches.with_batch(images.colour(progressive.image, progressive.channels), progressive.spp)
                bar.update(progressive.spp)
                if time.monotonic() - saved > SAVE_SECONDS:
                    batches.write(file, described)
                    saved = time.monotonic()
    finally:
        batches.write(file, described)


@dataclass(frozen=True)
class Batches:
    """Mean of batches of samples, (height, width, 3), and the weighted variance between batches by Welford's sums. The
    weight of a batch is its samples per pixel, to which its variance is inversely proportional."""

    spp: int = 0
    count: int = 0
    mean: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0  # sum of squared deviations, weighted by samples per pixel

    def with_batch(self, image, spp):
        """Return the batches with another one of `spp` samples per pixel. Values that are not finite become 0, with a
        warning."""
        if bad := np.count_nonzero(~np.isfinite(image)):
            mi.Log(mi.LogLevel.Warn, f"{bad} value(s) of a reference that are not finite become 0.")
            image = np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)
        difference, total = image - self.mean, self.spp + spp
        mean = self.mean + difference * (spp / total)
        return Batches(total, self.count + 1, mean, self.squares + spp * difference * (image - mean))

    @property
    def standard_error(self):
        """Standard error of the mean, (height, width, 3); requires two batches."""
        return np.sqrt(self.squares / (self.spp * (self.count - 1)))

    def write(self, path, described):
        """Write mean and standard error to an EXR file for `read`; does nothing for fewer than two batches."""
        if self.count < 2:
            return
        write(path, self.mean, self.standard_error, {**described, "spp": self.spp, "batches": self.count})

    @classmethod
    def read(cls, path):
        image, channels, metadata = images.read_exr(path)
        mean, error = images.colour(image, channels), images.colour(image, channels, "se.")
        spp, count = metadata["spp"], metadata["batches"]
        if not (isinstance(spp, int) and isinstance(count, int) and spp >= count >= 2):
            raise ValueError(f"spp must be a whole number of at least batches, and batches of 2, got {spp} and {count}")
        if not (np.isfinite(mean).all() and np.isfinite(error).all() and (error >= 0).all()):
            raise ValueError("its mean and its standard error must be finite, and the latter at least 0")
        return cls(spp, count, mean.astype(np.float64), np.square(error, dtype=np.float64) * spp * (count - 1))


def main(arguments=None):
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m comparison.references", description="Make a path-traced reference."
    )
    parser.add_argument("scene", help="scene file (XML)")
    parser.add_argument(
        "--width",
        type=command_line.positive(int),
        help="width of the image, or of its crop window (default: the scene's)",
    )
    parser.add_argument("--spp", type=command_line.positive(int), required=True, help="samples per pixel")
    parser.add_argument("--cache", type=Path, default=default_cache(), help="default: ~/.cache/manylights")
    parser.add_argument("--output", type=Path, required=True, help="EXR file")
    command_line.add_common_options(parser)
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(arguments)
    options.command = shlex.join(["python", "-m", "comparison.references", *arguments])
    kept = "the cache keeps the samples so far, and the same command goes on"
    return command_line.exit_status("references", lambda: _run(options), lambda: kept, options.verbose)


def _run(options):
    command_line.check_output(options.output)
    command_line.set_variant(options.mode)
    file = SceneFile(options.scene, dict(options.define))
    if options.width:
        file.set_width(options.width)
    reference = path_traced(file, options.spp, options.cache)
    made = {key: value for key, value in reference.description.items() if key not in ("file", "generatedBy")}
    made |= {"command": options.command, **command_line.versions()}
    write(options.output, reference.image, reference.standard_error, made, half=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
