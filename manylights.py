"""Render a scene with any integrator, Mitsuba's or this project's: what the `mitsuba` command cannot do, as it finds no
plugins written in Python. Options that both have mean the same.

    manylights scenes/hall.xml --time 60 -o hall.exr
    manylights scenes/hall.xml --integrator lightcuts --param error=0.02 --spp 16 -o hall.exr

Unless one is chosen, the integrator is `manylights`, in place of the scene's where that estimates the same image as
`path`; a scene that names another integrator, such as one of this project's, keeps it. So does one that contains a
participating medium. `-i scene` keeps the scene's integrator in any case.

An image ends by itself: with --spp samples per pixel, after --time seconds, or when the relative standard error of 95%
of the pixels is below --error, whichever comes first. It is rendered in passes of about two seconds, whose average is
written at the end, every ten seconds, and after Ctrl-C. The first pass has the seed that was given, pass k a hash of
that and k; see comparison/rendering.py. An EXR file gets all channels, and how it was made as metadata; a PNG file is
tone-mapped. With --denoise an EXR file FILE.exr gets a denoised one, FILE.denoised.exr, beside it; a PNG file shows the
denoised image.

In Python, `manylights.render(scene, error=0.02)` does the same, and `import manylights` registers the plugins, for the
variant that is set and each that will be.

Exit status: 0; 1 if rendering failed; 2 for a command that makes no sense; 130 after Ctrl-C.
"""
# ruff: noqa: E402 (what is imported is found to be this project's before)

import argparse
import sys
import time
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
import numpy as np
from tqdm import tqdm

import integrators  # noqa: F401 (registers the plugins)
from comparison import command_line, images
from comparison.command_line import UsageError, parameter, positive
from comparison.denoising import import_oidn
from comparison.interruption import Deadline
from comparison.render import Took, render
from comparison.scene_files import SceneFile

__all__ = ["Took", "main", "render"]
CHECKPOINT_SECONDS = 10.0
DEFAULT, OWN = "manylights", "scene"  # the integrator to render with, and what stands for the scene's own
SAME_IMAGE = ("path", "prb", "volpath", "volpathmis")  # without participating media, all of them estimate what it does


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
    """Return the scene, and which integrator it is rendered with, for metadata: its name, its parameters, and the name
    of the one of the scene that it replaces by default (None if it does not). Raises UsageError for what does not
    exist."""
    command_line.check_scene(options.scene)
    folder = options.output.absolute().parent
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
    described = {"integrator": name, "parameters": file.integrator[1], "replaced": replaced}
    scene = file.load(options.threads)
    if not 0 <= options.sensor < len(scene.sensors()):
        raise UsageError(f"no sensor {options.sensor}: the scene has {len(scene.sensors())}")
    return scene, described


def chosen_integrator(asked, file):
    """Return the name of the integrator to render a `SceneFile` with. `asked`: what `--integrator` says, None without.
    Raises UsageError where there is none."""
    own = file.integrator[0]
    if asked not in (None, OWN):
        return asked
    replaceable = own is None or (own in SAME_IMAGE and not file.has_media)
    if asked is None and replaceable and command_line.is_supported(mi.variant()):
        return DEFAULT
    if own is None:
        raise UsageError(f"{file.path} has no integrator; choose one with --integrator")
    return own


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
    scene, integrator = load(options)
    if options.verbose:
        mi.set_log_level(mi.LogLevel.Info)
    name = integrator["integrator"]
    if integrator["replaced"]:
        name += f" in place of {integrator['replaced']}"
        mi.Log(mi.LogLevel.Info, f"The integrator is {name}; with -i {OWN} it would be the scene's.")
    output = Output(options, {
        "scene": str(options.scene),
        **integrator,
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
