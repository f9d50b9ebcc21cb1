"""Render a scene with any integrator, Mitsuba's or this project's: what the `mitsuba` command cannot do, as it finds no
plugins written in Python. Options that both have mean the same.

    manylights scenes/hall.xml --integrator lightcuts --param error=0.02 --spp 16 -o hall.exr

An image ends by itself: with --spp samples per pixel, after --time seconds, or when the relative standard error of 95%
of the pixels is below --error, whichever comes first. It is rendered in passes of about two seconds, whose average is
written at the end, every ten seconds, and after Ctrl-C. The first pass has the seed that was given, pass k a hash of
that and k; see comparison/rendering.py. An EXR file gets all channels, and how it was made as metadata; a PNG file is
tone-mapped. With --denoise an EXR file FILE.exr gets a denoised one, FILE.denoised.exr, beside it; a PNG file shows the
denoised image.

In Python, `manylights.render(scene, error=0.02)` does the same.

Exit status: 0; 1 if rendering failed; 2 for a command that makes no sense; 130 after Ctrl-C.
"""

import argparse
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from comparison import command_line, images
from comparison.command_line import UsageError, parameter, positive
from comparison.denoising import import_oidn
from comparison.interruption import Deadline
from comparison.render import Took, render
from comparison.scene_files import SceneFile

__all__ = ["Took", "main", "render"]
CHECKPOINT_SECONDS = 10.0


def parse(arguments):
    """Parse the command line; return its options. Exits with status 2 and a message if it makes no sense."""
    parser = argparse.ArgumentParser(
        prog="manylights", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("scene", metavar="SCENE", type=Path, help="scene file (XML)")
    add("-o", "--output", type=Path, metavar="FILE", help=".exr or .png (default: the scene's name, with .exr)")
    add("--sensor", type=int, default=0, metavar="INDEX", help="sensor to render with (default: 0)")
    add("-i", "--integrator", metavar="NAME",
        help="replace the scene's integrator, keeping its max_depth, rr_depth and hide_emitters")  # fmt: skip
    add("-p", "--param", action="append", type=parameter, default=[], metavar="KEY=VALUE",
        help="parameter of the integrator, such as error=0.02; repeat for more")  # fmt: skip
    add("--spp", type=positive(int), metavar="N",
        help="samples per pixel, at most (default: the scene's, unless --time or --error is given)")  # fmt: skip
    add(
        "--time", type=positive(float), metavar="SECONDS", help="seconds of rendering, at most; one pass is always made"
    )
    add("--error", type=positive(float), metavar="FRACTION",
        help="end when 95%% of the pixels have a relative standard error, estimated from the spread of the passes, "
             "below this, such as 0.02")  # fmt: skip
    add("--denoise", action="store_true", help="denoise by Open Image Denoise (pip install 'manylights[denoise]')")
    add("-s", "--seed", type=command_line.seed, default=0, metavar="N", help="seed (default: 0)")
    add("--pass-spp", type=positive(int), metavar="N",
        help="samples per pixel of one pass (default: as many as take two seconds)")  # fmt: skip
    add("--exposure", type=float, metavar="STOPS",
        help="scale PNG images by 2^STOPS (default: bring the 95th percentile of the brightness to 0.8)")  # fmt: skip
    command_line.add_common_options(parser)
    options = parser.parse_args(arguments)
    options.output = options.output or options.scene.with_suffix(".exr")
    if options.output.suffix not in (".exr", ".png"):
        parser.error(f"cannot write '{options.output}': the output must be an .exr or a .png file")
    return options


def load(options):
    """Return the scene and the name and parameters of its integrator; raises UsageError for what does not exist."""
    command_line.check_scene(options.scene)
    folder = options.output.absolute().parent
    if not folder.is_dir():
        raise UsageError(f"no folder '{folder}' for the output")
    command_line.set_variant(options.mode)
    file = SceneFile(options.scene, dict(options.define))
    name = options.integrator or file.integrator[0]
    if name is None:
        raise UsageError(f"{options.scene} has no integrator; choose one with --integrator")
    command_line.check_integrator(name)
    if options.integrator:
        file.set_integrator(name, dict(options.param))
    elif options.param:
        file.set_integrator(name, dict(options.param), keep=None)
    parameters = file.integrator[1]
    scene = file.load(options.threads)
    if not 0 <= options.sensor < len(scene.sensors()):
        raise UsageError(f"no sensor {options.sensor}: the scene has {len(scene.sensors())}")
    return scene, name, parameters


class Output:
    """The file that an image is written to, with what is known of it before it is rendered (`metadata`, a dict)."""

    def __init__(self, options, metadata):
        self._options, self._metadata = options, metadata
        self._image, self._took, self._written = None, None, time.monotonic()

    def keep(self, took, image):
        """Take an image, and write it if that was not done for some time."""
        self._image, self._took = np.array(image), took
        if time.monotonic() - self._written > CHECKPOINT_SECONDS:
            self.write()
            self._written = time.monotonic()

    def end_early(self):
        """Write the last image that was taken, say so, and return the exit status."""
        if self._took is None:
            print("manylights: interrupted before the first pass was finished; nothing was written", file=sys.stderr)
        else:
            self.write()
            done = f"{self._took.spp} samples per pixel to {self._options.output}"
            print(f"manylights: interrupted; wrote {done}", file=sys.stderr)
        return 130

    def write(self):
        """Write the last image that was taken."""
        path, took, image = self._options.output, self._took, self._image
        if path.suffix == ".png":
            rgb = images.colour(image, took.channels)
            exposure = images.automatic_exposure(rgb) if self._options.exposure is None else 2.0**self._options.exposure
            images.write_png(path, images.tone_map(rgb, exposure))
            return
        metadata = self._metadata | {
            "spp": took.spp,
            "passes": took.passes,
            "render_seconds": took.seconds,
            "estimated_error": took.error,
            "ended_by": took.ended_by,
            "statistics": took.statistics,
        }
        if took.raw is not None:
            described = metadata | {"denoise_seconds": took.denoise_seconds}
            images.write_exr(path.with_suffix(".denoised.exr"), image, took.channels, described)
            image = np.array(took.raw)
        images.write_exr(path, image, took.channels, metadata)


def run(options):
    """Load, render and write; return the exit status."""
    begin = time.perf_counter()
    if options.denoise:
        import_oidn()
    scene, name, parameters = load(options)
    if options.verbose:
        mi.set_log_level(mi.LogLevel.Info)
    output = Output(options, {
        "scene": str(options.scene),
        "integrator": name,
        "parameters": parameters,
        "variant": options.mode,
        "seed": options.seed,
        "load_seconds": time.perf_counter() - begin,
        **command_line.versions(),
    })  # fmt: skip
    try:
        image, took = _render(scene, options, output)
    except KeyboardInterrupt:
        return output.end_early()
    output.keep(took, image)
    if took.ended_by == "interruption":
        return output.end_early()
    output.write()
    error = "" if took.error is None else f", error {took.error:.2%}"
    print(f"{options.output}: {name}, {took.spp} samples per pixel, {took.seconds:.2f} s{error}")
    return 0


def _render(scene, options, output):
    """Render with a bar, and write now and then."""
    limited = options.spp or not (options.time or options.error)
    spp = options.spp or (scene.sensors()[options.sensor].sampler().sample_count() if limited else None)
    with tqdm(total=spp, unit="spp", disable=None) as bar, Deadline(output.end_early):

        def progress(took, image):
            bar.set_postfix({} if took.error is None else {"error": f"{took.error:.2%}"}, refresh=False)
            bar.update(took.spp - bar.n)
            output.keep(took, image)

        return render(
            scene, sensor=options.sensor, error=options.error, time=options.time, spp=spp, seed=options.seed,
            denoise=options.denoise, progress=progress, pass_spp=options.pass_spp,
        )  # fmt: skip


def main(arguments=None):
    """Run the command; return its exit status."""
    options = parse(arguments)
    return command_line.exit_status("manylights", lambda: run(options), "nothing was written", options.verbose)


if __name__ == "__main__":
    sys.exit(main())
