"""Render a scene with any integrator, Mitsuba's or this project's: what the `mitsuba` command cannot do, as it finds no
plugins written in Python. Options that both have mean the same.

    manylights scenes/hall.xml --time 60 -o hall.exr
    manylights scenes/hall.xml --integrator lightcuts --param error=0.02 --spp 16 -o hall.exr

Unless one is chosen, the integrator is `manylights`, in place of the scene's where that estimates the same image as
`path`; a scene that names another integrator, such as one of this project's, keeps it. So does one that contains a
participating medium. `-i scene` keeps the scene's integrator in any case.

An image ends by itself: with --spp samples per pixel, after --time seconds, or when the relative standard error of 95%
of the pixels is below --error, whichever comes first. It is rendered in passes of about two seconds, or of about ten
where starting one takes long, whose average is written at the end, about every ten seconds, and after Ctrl-C. The first
pass has the seed that was given, pass k a hash of that and k; see comparison/rendering.py. An EXR file gets all
channels, and how it was made as metadata; a PNG file is tone-mapped. With --denoise an EXR file FILE.exr gets a
denoised one, FILE.denoised.exr, beside it; a PNG file shows the denoised image.

With --workers passes are rendered by several processes or machines, see docs/cluster.md. Several scenes, --frames with
{frame} in the values of -D, and --sensor all make many images, one after the other; what fails is told, the others are
rendered. --resume goes on from the checkpoint of an image that was not finished.
With `-p keep_lights=true` frames and sensors of a scene that stays as it is share their virtual lights.

In Python, `manylights.render(scene, error=0.02)` does the same, and `import manylights` registers the plugins, for the
variant that is set and each that will be.

Exit status: 0; 1 if rendering failed; 2 for a command that makes no sense; 130 after Ctrl-C.
"""
# ruff: noqa: E402 (what is imported is found to be this project's before)

import argparse
import sys
import traceback
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path


def require_own(*packages):
    """Raise ImportError where Python finds something else, such as a module beside a user's script, by the name of a
    package of this project."""
    for package in packages:
        own, found = Path(__file__).resolve().parent / package, find_spec(package)
        if found and found.origin and Path(found.origin).resolve().parent != own:
            raise ImportError(
                f"the package '{package}' of manylights, {own}, is hidden by {found.origin}: rename that, or make it "
                "part of a package"
            )


require_own("comparison", "integrators", "vpl")

import mitsuba as mi

import integrators  # noqa: F401 (registers the plugins)
from comparison import batch, command_line
from comparison.cluster.connection import connected, workers
from comparison.command_line import UsageError, parameter, positive
from comparison.denoising import import_oidn
from comparison.images import check_extension, write
from comparison.one_image import INTERRUPTED, Failed, Image, LazyScene
from comparison.render import Took, render
from comparison.scene_files import SceneFile
from comparison.threads import avoid_single_thread

avoid_single_thread()

__all__ = ["Took", "main", "render", "write"]
DEFAULT, OWN = "manylights", "scene"  # the integrator to render with, and what stands for the scene's own
SAME_IMAGE = ("path", "prb", "volpath", "volpathmis")  # without participating media, all of them estimate what it does


def parse(arguments):
    """Parse the command line; return its options. Exits with status 2 and a message if it makes no sense."""
    parser = argparse.ArgumentParser(
        prog="manylights", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("scenes", metavar="SCENE", nargs="+", type=Path, help="scene files (XML)")
    add("-o", "--output", type=Path, metavar="FILE",
        help=".exr or .png, in which {scene}, {frame} and {sensor} are replaced where there are several images, or a "
             "folder (default: the scene's name, with .exr)")  # fmt: skip
    add("--sensor", type=batch.sensor, default=0, metavar="INDEX", help="sensor to render with, or 'all' (default: 0)")
    add("--frames", type=batch.frames, metavar="FIRST..LAST",
        help="render an image for each number, which replaces {frame} in the values of -D and in --output")  # fmt: skip
    add("-i", "--integrator", metavar="NAME",
        help="integrator that replaces the scene's, keeping its max_depth, rr_depth and hide_emitters; 'scene' is the "
             "scene's own (default: manylights where the scene has path, or one that estimates the same, or none; "
             "else the scene's own)")  # fmt: skip
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
        help="samples per pixel of one pass (default: as many as take two to ten seconds; with --workers, what the "
             "image alone decides)")  # fmt: skip
    add("--workers", type=workers, metavar="N|ADDRESS",
        help="render passes on N processes, or on the workers of the Dask scheduler at an address such as "
             "tcp://HOST:8786 (pip install 'manylights[cluster]'; docs/cluster.md)")  # fmt: skip
    add("--resume", action="store_true",
        help="go on from FILE.checkpoint.npz, if it is there, which this option and --workers leave beside an image "
             "that is not finished")  # fmt: skip
    add("--exposure", type=float, metavar="STOPS",
        help="scale PNG images by 2^STOPS (default: bring the 95th percentile of the brightness to 0.8)")  # fmt: skip
    command_line.add_common_options(parser)
    options = parser.parse_args(arguments)
    if options.output and not options.output.is_dir():
        try:
            check_extension(options.output)
        except ValueError as error:
            parser.error(str(error))
    return options


def parse_scene(options):
    """Return the `SceneFile`, and which integrator it is rendered with, for metadata: its name, its parameters, and the
    name of the one of the scene that it replaces by default (None if it does not). Raises UsageError for what does not
    exist."""
    command_line.check_scene(options.scene)
    folder = batch.output(options, 0).absolute().parent
    if not folder.is_dir():
        raise UsageError(f"no folder '{folder}' for the output")
    command_line.set_variant(options.mode)
    file = SceneFile(options.scene, dict(options.define))
    own, name = file.integrator[0], chosen_integrator(options.integrator, file)
    command_line.check_integrator(name)
    if name != own or options.integrator == name:
        file.set_integrator(name, dict(options.param))
    elif options.param:
        file.set_integrator(name, dict(options.param), keep=None)
    replaced = None if options.integrator or name == own else own
    if options.sensor != batch.ALL and options.sensor >= file.sensors:
        raise UsageError(f"no sensor {options.sensor}: the scene has {file.sensors}")
    if options.workers and file.integrator[1].get("keep_lights"):
        raise UsageError("keep_lights is for one process: the lights of a worker would depend on the passes it had")
    return file, {"integrator": name, "parameters": file.integrator[1], "replaced": replaced}


def chosen_integrator(asked, file):
    """Return the name of the integrator to render a `SceneFile` with. `asked`: what `--integrator` says, None without.
    Raises UsageError where there is none."""
    own = file.integrator[0]
    if asked not in (None, OWN):
        return asked
    replaceable = own is None or (own in SAME_IMAGE and not file.has_media)
    if asked is None and replaceable:
        return DEFAULT
    if own is None:
        raise UsageError(f"{file.path} has no integrator; choose one with --integrator")
    return own


def run(options):
    """Render and write all images; return the worst of their exit statuses. Of several, one that fails is told, and the
    others are rendered."""
    if options.denoise:
        import_oidn()
    wanted = batch.images(options)
    several, status = len(wanted) > 1 or options.sensor == batch.ALL, 0
    with ExitStack() as stack:
        images = _images(wanted, options, stack)
        # A time is that of one image after the other
        for image in batch.ahead(images) if options.workers and not options.time else images:
            try:
                found = image.run()
            except Exception as error:
                if not several:
                    raise
                if options.verbose:
                    traceback.print_exc()
                print(f"manylights: {image.path}: {command_line.explain(error)}", file=sys.stderr)
                found = 1
            status = max(status, found)
            if found == INTERRUPTED:
                break
    return status


def _images(wanted, options, stack):
    """Yield the `Image` of each sensor of the scenes of `wanted`, a list of options; workers are let go with the
    `stack`. Raises UsageError where there is no scheduler: no image could be rendered."""
    pool = scene = None
    for one in wanted:
        try:
            file, described = parse_scene(one)
        except Exception as error:
            yield Failed(batch.output(one, 0), error)
            continue
        if options.verbose:
            mi.set_log_level(mi.LogLevel.Info)
        if options.workers and pool is None:  # not before it is known that there is something to render
            pool = stack.enter_context(connected(options.workers, options.threads))
        scene = LazyScene(file, options.threads, scene)
        for sensor in range(file.sensors) if options.sensor == batch.ALL else [options.sensor]:
            try:
                image = Image(one, scene, described, sensor, pool)
            except Exception as error:
                image = Failed(batch.output(one, sensor), error)
            yield image


def main(arguments=None):
    """Run the command; return its exit status."""
    options = parse(arguments)
    return command_line.exit_status("manylights", lambda: run(options), "nothing was written", options.verbose)


if __name__ == "__main__":
    sys.exit(main())
