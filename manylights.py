"""Render scenes with any integrator, including plugins in Python, which the `mitsuba` command cannot load.
Options that the two commands share have the same meaning.

    manylights scenes/hall.xml --time 60 -o hall.exr
    manylights scenes/hall.xml --integrator lightcuts --param error=0.02 --spp 16 -o hall.exr

The default integrator is `manylights`, in place of a scene's `path` or of an integrator with the same expectation. A
scene with another integrator, or with a participating medium, keeps its integrator; `-i scene` keeps it in any case.
Variants that the integrator does not support are refused.

The first limit that is reached ends an image: --spp samples per pixel, --time seconds, or a relative standard error of
at most --error in 95% of the pixels. The command prints the limit, and warns if an --error was not reached. With
--time, passes take two to five seconds, or five times their start if that is longer; those of `manylights` take about
ten. The average of the passes is written about every ten seconds, at the end, and after Ctrl-C. The first pass has the
seed --seed, pass k a hash of the seed and k. An EXR file has all channels; a PNG file is tone-mapped; both have
metadata about the render. With --denoise, FILE.exr is joined by FILE.denoised.exr, and a PNG file shows the denoised
image.

--workers renders passes on several processes or machines (docs/cluster.md). Several scenes, --frames with {frame} in
the values of -D, and --sensor all make several images in turn; a failure is reported and does not stop the rest.
--resume continues from the checkpoint of an unfinished image. With `-p keep_lights=true`, frames and sensors of an
unchanged scene share virtual lights.

In Python: `manylights.render(scene, error=0.02)`. `import manylights` registers the plugins for the current variant and
all later ones.

Exit status: 0 for success; 1 if rendering failed; 2 for an invalid command line; 130 after Ctrl-C.
"""
# ruff: noqa: E402 (the check of the packages comes before their import)

import argparse
import sys
import traceback
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path


def require_own(*packages):
    """Raise ImportError if another module, such as a file beside the user's script, hides a package of this project."""
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
from comparison.denoising import QUALITIES, for_denoising, import_oidn
from comparison.features import FEATURES
from comparison.images import check_exposure, check_extension, write
from comparison.interruption import interruptions_kept
from comparison.one_image import INTERRUPTED, Failed, Image, LazyScene
from comparison.render import Took, render
from comparison.scene_files import SceneFile
from comparison.threads import avoid_single_thread
from vpl.split.contributions import LENGTHS

avoid_single_thread()

__all__ = ["Took", "main", "render", "write"]
DEFAULT, OWN = "manylights", "scene"  # the default of --integrator, and the value that keeps the scene's integrator
SAME_IMAGE = ("path", "prb", "volpath", "volpathmis")  # have the expectation of DEFAULT, without participating media


def layer_names(text):
    """Return the distinct names of layers in a comma-separated list, as a tuple; for `type` of argparse."""
    names = tuple(name.strip() for name in text.split(","))
    if not set(names) <= {*FEATURES, *LENGTHS} or len(set(names)) < len(names):
        known = ", ".join([*FEATURES, *LENGTHS])
        raise argparse.ArgumentTypeError(f"must be a list of distinct names out of {known}, got '{text}'")
    return names


def _parser():
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="manylights", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("scenes", metavar="SCENE", nargs="+", type=Path, help="scene files (XML)")
    add("-o", "--output", type=Path, metavar="FILE",
        help=".exr or .png file, or a folder; {scene}, {frame} and {sensor} are replaced for several images (default: "
             "the scene's name with .exr)")  # fmt: skip
    add("--sensor", type=batch.sensor, default=0, metavar="INDEX", help="sensor to render with, or 'all' (default: 0)")
    add("--frames", type=batch.frames, metavar="FIRST..LAST",
        help="render an image for each number; it replaces {frame} in the values of -D and in --output")  # fmt: skip
    add("-i", "--integrator", metavar="NAME",
        help="integrator in place of the scene's, with its max_depth, rr_depth and hide_emitters; 'scene' keeps the "
             "scene's (default: manylights for a scene with path, an integrator of the same expectation, or none; "
             "otherwise the scene's)")  # fmt: skip
    add("-p", "--param", action="append", type=parameter, default=[], metavar="KEY=VALUE",
        help="parameter of the integrator, such as error=0.02; repeat for more")  # fmt: skip
    add("--spp", type=positive(int), metavar="N",
        help="maximum samples per pixel (default: the scene's unless --time or --error is given)")  # fmt: skip
    add(
        "--time",
        type=positive(float),
        metavar="SECONDS",
        help="maximum seconds; there is at least one pass",
    )
    add("--error", type=positive(float), metavar="FRACTION",
        help="end when 95%% of the pixels have at most this relative standard error, such as 0.02, estimated from the "
             "variance between passes")  # fmt: skip
    add("--denoise", action="store_true",
        help="denoise by Open Image Denoise at twice the resolution, with a multiple of four samples per pixel (pip "
             "install 'manylights[denoise]')")  # fmt: skip
    add("--denoise-quality", choices=QUALITIES,
        help="with --denoise: network, from best to quickest (default: the network that leaves the least error, as a "
             "quick one leaves time for samples)")  # fmt: skip
    add("--layers", type=layer_names, default=(), metavar="NAMES",
        help=f"layers of EXR files, separated by commas: {', '.join(FEATURES)}, of the first surface that is neither "
             f"mirror nor glass, as the denoiser gets them; {', '.join(LENGTHS)}, the light of paths with one, two, "
             "and more edges (manylights only)")  # fmt: skip
    add("--light-groups", metavar="GROUPS",
        help="layers with the light of groups of emitters, by patterns of their ids or classes, such as "
             "'lamps=lamp*,bulb; sky=env' (manylights only)")  # fmt: skip
    add("-s", "--seed", type=command_line.seed, default=0, metavar="N", help="seed (default: 0)")
    add("--pass-spp", type=positive(int), metavar="N",
        help="samples per pixel of a pass (default: by the size of the image; with --time, for passes of two to ten "
             "seconds)")  # fmt: skip
    add("--workers", type=workers, metavar="N|ADDRESS",
        help="render passes on N local processes, or on the workers of a Dask scheduler such as tcp://HOST:8786 (pip "
             "install 'manylights[cluster]'; docs/cluster.md)")  # fmt: skip
    add("--resume", action="store_true",
        help="continue from FILE.checkpoint.npz if it exists; this option and --workers leave it beside an unfinished "
             "image")  # fmt: skip
    add("--exposure", type=float, metavar="STOPS",
        help="scale PNG images by 2^STOPS (default: bring the 95th percentile of the brightness to 0.8)")  # fmt: skip
    command_line.add_common_options(parser)
    return parser


def parse(arguments):
    """Parse the command line and return the options. Exits with status 2 and a message if it is invalid."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.denoise_quality and not options.denoise:
        parser.error("--denoise-quality needs --denoise")
    for name in ("layers", "light_groups"):
        if getattr(options, name) and options.output and options.output.suffix == ".png":
            parser.error(f"--{name.replace('_', '-')} needs an .exr file: a PNG file has no layers")
    # The integrator renders these layers, as parameters; the other layers are separate images
    of_light = ",".join(name for name in options.layers if name in LENGTHS), options.light_groups
    options.light_layers = {name: text for name, text in zip(("layers", "light_groups"), of_light, strict=True) if text}
    options.layers = tuple(name for name in options.layers if name in FEATURES)
    try:
        check_exposure(options.exposure)
        if options.output and not options.output.is_dir():
            check_extension(options.output)
    except ValueError as error:
        parser.error(str(error))
    return options


def parse_scene(options):
    """Return the `SceneFile` with its integrator, and a description for metadata: "integrator", "parameters", and
    "replaced", the name of the scene's integrator if the default replaces it, otherwise None. Raises UsageError for a
    missing scene, folder, variant, integrator or sensor."""
    command_line.check_scene(options.scene)
    command_line.check_output(batch.output(options, 0))
    command_line.set_variant(options.mode)
    file = SceneFile(options.scene, dict(options.define))
    own, name = file.integrator[0], chosen_integrator(options.integrator, file)
    command_line.check_integrator(name)
    parameters = dict(options.param)
    if options.light_layers and name != DEFAULT:
        raise UsageError(
            f"--light-groups and --layers {', '.join(LENGTHS)} need the integrator {DEFAULT}, and this one is {name}"
        )
    parameters |= options.light_layers
    if options.denoise and "denoised" not in file.integrator[1]:
        parameters = for_denoising(name, parameters)
    if name != own or options.integrator == name:
        file.set_integrator(name, parameters)
    elif parameters:
        file.set_integrator(name, parameters, keep=None)
    replaced = None if options.integrator or name == own else own
    if options.sensor != batch.ALL and options.sensor >= file.sensors:
        raise UsageError(f"no sensor {options.sensor}: the scene has {file.sensors}")
    if options.workers and file.integrator[1].get("keep_lights"):
        raise UsageError("keep_lights is for one process: the lights of a worker would depend on the passes it had")
    return file, {"integrator": name, "parameters": file.integrator[1], "replaced": replaced}


def chosen_integrator(asked, file):
    """Return the name of the integrator to render a `SceneFile` with. `asked`: the value of `--integrator`, or None.
    Raises UsageError if the scene has no integrator and none is given."""
    own = file.integrator[0]
    if asked not in (None, OWN):
        return asked
    replaceable = own is None or (own in SAME_IMAGE and not file.has_media)
    if asked is None and replaceable:
        return DEFAULT
    if own is None:
        raise UsageError(f"{file.path} has no integrator; choose one with --integrator")
    return own


def run(options, written):
    """Render and write all images; return the highest exit status. The failure of an image among several is printed,
    and the remaining images are rendered. `written`: a list to which the file of each complete image is added."""
    if options.denoise:
        import_oidn()
    wanted = batch.images(options)
    several, status = len(wanted) > 1 or options.sensor == batch.ALL, 0
    with ExitStack() as stack:
        images = _images(wanted, options, stack)
        # With a time limit, images are rendered in sequence
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
            if found == 0:
                written.append(image.path)
            status = max(status, found)
            if found == INTERRUPTED:
                break
    return status


def _images(wanted, options, stack):
    """Yield an `Image` for each sensor of each scene in `wanted`, a list of options. The `stack` releases the workers.
    Raises UsageError if no scheduler answers."""
    pool = scene = None
    for one in wanted:
        try:
            with interruptions_kept():
                file, described = parse_scene(one)
        except Exception as error:
            yield Failed(batch.output(one, 0), error)
            continue
        if options.verbose:
            mi.set_log_level(mi.LogLevel.Info)
        if options.workers and pool is None:  # after the first scene is parsed
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
    options, written = parse(arguments), []

    def interrupted():
        return f"complete images: {len(written)}, the last one {written[-1]}" if written else "nothing was written"

    return command_line.exit_status("manylights", lambda: run(options, written), interrupted, options.verbose)


if __name__ == "__main__":
    sys.exit(main())
