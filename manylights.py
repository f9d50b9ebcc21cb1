"""Render a scene with any integrator, Mitsuba's or this project's: what the `mitsuba` command cannot do, as it finds no
plugins written in Python. Options that both have mean the same.

    manylights scenes/hall.xml --integrator lightcuts --param error=0.02 --spp 16 -o hall.exr

Images are rendered in passes whose average is written at the end, or after Ctrl-C from those that were finished. The
first pass has the seed that was given, pass k a hash of that and k; see comparison/rendering.py. An EXR file gets all
channels, and how it was made as metadata; a PNG file is tone-mapped.

Exit status: 0; 1 if rendering failed; 2 for a command that makes no sense; 130 after Ctrl-C.
"""

import argparse
import signal
import sys
import time
from pathlib import Path

import mitsuba as mi
from tqdm import tqdm

from comparison import command_line, images
from comparison.command_line import UsageError, parameter, positive
from comparison.rendering import Progressive, pass_sizes
from comparison.scene_files import SceneFile


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
    add("--spp", type=positive(int), metavar="N", help="samples per pixel (default: the scene's)")
    add("-s", "--seed", type=command_line.seed, default=0, metavar="N", help="seed (default: 0)")
    add("--pass-spp", type=positive(int), metavar="N",
        help="samples per pixel of one pass (default: as many as make two million in all)")  # fmt: skip
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


class Interruption:
    """While in force, a first Ctrl-C sets `asked`, for the loop over the passes to end; a second one acts at once."""

    asked = False

    def __enter__(self):
        self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_):
        signal.signal(signal.SIGINT, self._before)

    def _ask(self, *_):
        self.asked = True
        signal.signal(signal.SIGINT, self._before)
        print("\nmanylights: stopping; Ctrl-C again to stop at once", file=sys.stderr)


def render(scene, options):
    """Render all passes, or those until Ctrl-C; return a `Progressive` and whether it was interrupted."""
    progressive = Progressive(scene, options.seed, options.sensor)
    spp = options.spp or scene.sensors()[options.sensor].sampler().sample_count()
    sizes = pass_sizes(spp, progressive.pixels, options.pass_spp)
    with tqdm(total=spp, unit="spp", disable=None) as bar, Interruption() as interruption:
        for size in sizes:
            try:
                # Ctrl-C tells Mitsuba, too, to stop, so that pass may be unfinished.
                one = progressive.render(size, accept=lambda: not interruption.asked)
            except KeyboardInterrupt:
                one = None
            if one is None:
                return progressive, True
            bar.update(one.spp)
    return progressive, False


def write(progressive, options, metadata):
    """Write the image to the output file."""
    if options.output.suffix == ".exr":
        images.write_exr(options.output, progressive.image, progressive.channels, metadata)
        return
    rgb = images.colour(progressive.image, progressive.channels)
    exposure = images.automatic_exposure(rgb) if options.exposure is None else 2.0**options.exposure
    images.write_png(options.output, images.tone_map(rgb, exposure))


def run(options):
    """Load, render and write; return the exit status."""
    begin = time.perf_counter()
    scene, name, parameters = load(options)
    load_seconds = time.perf_counter() - begin
    if options.verbose:
        mi.set_log_level(mi.LogLevel.Info)
    progressive, interrupted = render(scene, options)
    if not progressive.passes:
        print("manylights: interrupted before the first pass was finished; nothing was written", file=sys.stderr)
        return 130
    metadata = {
        "scene": str(options.scene),
        "integrator": name,
        "parameters": parameters,
        "variant": options.mode,
        "seed": options.seed,
        "spp": progressive.spp,
        "passes": len(progressive.passes),
        "load_seconds": load_seconds,
        "render_seconds": progressive.seconds,
        **command_line.versions(),
    }
    write(progressive, options, metadata)
    if interrupted:
        print(
            f"manylights: interrupted; wrote {progressive.spp} samples per pixel to {options.output}", file=sys.stderr
        )
        return 130
    print(f"{options.output}: {name}, {progressive.spp} samples per pixel, {progressive.seconds:.2f} s")
    return 0


def main(arguments=None):
    """Run the command; return its exit status."""
    options = parse(arguments)
    return command_line.exit_status("manylights", lambda: run(options), "nothing was written", options.verbose)


if __name__ == "__main__":
    sys.exit(main())
