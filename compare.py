"""Compare integrators on scenes with equal seeds and references; each run has its own process.

    python compare.py scenes/hall.xml --integrators path,manylights --time 20 --reference path:4096
    python compare.py scenes/cornell.xml --integrators path,lightcuts,illuminationcut --reference path:auto --sweep
    python compare.py scenes/cornell.xml --integrators coarse=lightcuts,fine=lightcuts \\
        --param coarse.error=0.02 --param fine.error=0.005 --spp 4 --reference vpl
    python compare.py --demo

Prints tables and writes to the output folder `report.html` (self-contained), `results.json` (documented in
comparison/results.schema.json), and for each scene and setting the image (`SCENE.SETTING.exr`, with metadata, and
`.png`), the error map (`SCENE.SETTING.error.png`), and with `--aovs` further channels in false colours.

--sweep renders each integrator with several values of its quality parameter and several seeds. The report then contains
curves of error against time and against shadow rays, and costs at equal error.

Times are wall-clock seconds of rendering. Warm-up passes compile the kernels and are not part of an image. The first
pass of an integrator starts with an empty kernel cache; its cold time is reported separately. With --cold each image
starts with an empty kernel cache and includes compilation. Runs of the integrators are interleaved.
comparison/metrics.py defines the errors.

Ctrl-C writes a report of the finished runs; --resume continues, also after a crash.

Exit status: 0: success; 1: a run failed (the report covers the others); 2: invalid command line; 3: --check found a
lower speed-up; 130: Ctrl-C.
"""

import argparse
import re
import shlex
import signal
import sys
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

MISSING = "the package '{}' is missing; pip install 'manylights[compare]' brings it"
OPTIONAL = ("flip_evaluator", "matplotlib", "scipy")  # imported after the options are parsed: --help does not need them

try:
    from comparison import baseline, command_line, machine, metrics, references, report, sweeps, tables, worker
    from comparison.cluster.connection import connected, workers
    from comparison.command_line import UsageError, parameter, positive
    from comparison.denoising import for_denoising, import_oidn
    from comparison.pictures import REFERENCE
    from comparison.progress import Progress
    from comparison.runs import Runs, locked
    from comparison.scene_comparison import SceneComparison
    from comparison.scene_files import short_name
except ModuleNotFoundError as missing:
    sys.exit(f"compare: {MISSING.format(missing.name)}")

ROOT = Path(__file__).resolve().parent
PACKAGED = ROOT / "comparison" / "scenes"  # location of the demo scenes in a wheel
SCENES = PACKAGED if PACKAGED.is_dir() else ROOT / "scenes"
SWEEP_SEEDS = 3  # minimum for a useful confidence interval
DEMO = [
    str(SCENES / "hall.xml"), "--integrators", "path,manylights", "--time", "30",
    "--reference", str(SCENES / "hall_reference.exr"),
]  # fmt: skip


def _name() -> str:
    """Name of this command as invoked."""
    called = Path(sys.argv[0]).stem
    return called if called == "manylights-compare" else "compare.py"


def parse(arguments):
    """Parse the command line; return its options. Exits with status 2 and a message if it is invalid."""
    parser = argparse.ArgumentParser(
        prog=_name(), description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("scenes", nargs="*", metavar="SCENE", help="scene files (XML)")
    add("-i", "--integrators", default="path,manylights", metavar="NAME,...",
        help="integrators, each NAME, or LABEL=NAME to use a plugin twice (default: path,manylights); the first "
             "is the base of comparisons")  # fmt: skip
    add("-p", "--param", action="append", type=parameter, default=[], metavar="LABEL.KEY=VALUE",
        help="parameter of an integrator, such as lightcuts.error=0.02; repeatable")  # fmt: skip
    _add_effort(parser)
    _add_reference(parser)
    _add_scene(parser)
    _add_output(parser)
    command_line.add_common_options(parser)

    options = parser.parse_args(DEMO + arguments if "--demo" in arguments else arguments)
    options.out = options.out or Path("output/demo" if options.demo else "output")
    if not options.scenes:
        parser.error("no scene given; try --demo")
    if not options.spp and not options.time and not options.sweep:
        options.time = 20.0
    count = options.seeds or (SWEEP_SEEDS if options.sweep else 1)
    if options.seed + count > 2**32:
        parser.error(f"--seed {options.seed}: too large for {count} seeds")
    options.seeds = list(range(options.seed, options.seed + count))
    return options


def _add_effort(parser):
    effort = parser.add_mutually_exclusive_group()
    effort.add_argument("--time", type=positive(float), metavar="SECONDS",
                        help="time budget of each image, met by a shorter last pass (default: 20, except with "
                             "--sweep)")  # fmt: skip
    effort.add_argument("--spp", type=positive(int), metavar="N",
                        help="samples per pixel of each image (default for sweeps of other parameters: "
                             f"{sweeps.DEFAULT_SPP})")  # fmt: skip
    add = parser.add_argument
    add("--pass-spp", type=positive(int), metavar="N",
        help="samples per pixel of a pass; each pass has new VPLs (default: automatic)")  # fmt: skip
    add("--cold", action="store_true",
        help="start each image with an empty kernel cache and include compilation in its time")  # fmt: skip
    add("--sweep", action="append", type=sweeps.sweep, nargs="?", const=("all", None, ()), default=[],
        metavar="LABEL:KEY=VALUE,...",
        help="sweep a parameter, spp or time, e.g. lightcuts:error=0.04,0.02,0.01 or path:spp=4,16,64; repeatable; "
             "several parameters of a label form a grid. Without argument, with 'all', and for labels without a "
             "sweep: the parameter that trades error for time")  # fmt: skip
    add("--denoise", action="store_true",
        help="also denoise each image by Open Image Denoise, and measure the time (pip install "
             "'manylights[denoise]')")  # fmt: skip
    add("--seeds", type=positive(int), metavar="N",
        help=f"number of seeds, from --seed on (default: 1, with --sweep {SWEEP_SEEDS})")  # fmt: skip
    add("--seed", type=command_line.seed, default=0, metavar="N", help="first seed (default: 0)")


def _add_reference(parser):
    add = parser.add_argument
    add("-r", "--reference", type=references.wanted, default="path:1024",
        help="an EXR file, or a folder with SCENE.exr, which also defines the width; path:SPP (path traced, cached, "
             "continued); path:auto or path:auto:FRACTION (continued until its noise is at most this fraction, by "
             f"default {references.AUTOMATIC_FRACTION:g}, of the smallest measured error); vpl (for each image, the "
             "sum of all its VPLs) (default: path:1024)")  # fmt: skip
    add("--reference-limit", type=positive(int), default=2**17, metavar="SPP",
        help="maximum samples per pixel of path:auto (default: 131072)")  # fmt: skip
    add("--cache", type=Path, default=references.default_cache(), metavar="FOLDER",
        help="cache of path-traced references (default: ~/.cache/manylights)")  # fmt: skip
    add("--metric", choices=metrics.NAMES, default="relmse_trimmed",
        help="error metric of curves, path:auto and --check (default: relmse_trimmed)")  # fmt: skip


def _add_scene(parser):
    add = parser.add_argument
    add("--max-depth", type=int, metavar="N", help="maximum path depth (default: of the scene)")
    add("--width", type=positive(int), metavar="N", help="width of the image, or crop window (default: of the scene)")
    add("--sampler", metavar="PLUGIN",
        help="sampler of the images and references, such as multijitter, by which all integrators stratify "
             "(default: of the scene)")  # fmt: skip
    add("--aovs", type=_names, default=[], metavar="NAME,...",
        help="AOVs to show in false colours, for integrators that support them: shadow_rays, upper_bounds, cut_size, "
             "phase_one (see the integrators' docstrings)")  # fmt: skip


def _add_output(parser):
    add = parser.add_argument
    add("-o", "--out", type=Path, metavar="FOLDER", help="output folder (default: output, or output/demo)")
    add("--resume", action="store_true",
        help="reuse finished runs in the output folder with the same parameters, scene, software and "
             "machine")  # fmt: skip
    add("--check", type=Path, metavar="BASELINE",
        help="an earlier results.json; fail if a speed-up at equal error has fallen since")  # fmt: skip
    add("--check-share", type=_share, default=0.2, metavar="FRACTION",
        help="tolerated fall of a speed-up (default: 0.2)")  # fmt: skip
    add("--workers", type=workers, metavar="N|ADDRESS",
        help="distribute runs to N processes, or to the workers of a Dask scheduler, e.g. tcp://HOST:8786; errors do "
             "not change, times of different machines are not comparable (docs/cluster.md)")  # fmt: skip
    add("--demo", action="store_true", help="path and manylights on scenes/hall.xml, in less than three minutes")


def _names(text):
    """Split a comma-separated list; an argparse type."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _share(text):
    """Convert a fraction from 0 to 1; an argparse type."""
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0 <= number < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a fraction from 0 to 1")
    return number


def chosen_integrators(options):
    """Return label -> (name, parameters); raises UsageError for unknown, ambiguous or incompatible options."""
    chosen = {}
    for entry in options.integrators.split(","):
        label, _, name = entry.strip().rpartition("=")
        label = label or name
        if not re.fullmatch(r"[\w-]+", label) or label in (*chosen, REFERENCE):
            raise UsageError(
                f"--integrators: '{entry}' has no unique label; to use a plugin twice write a=lightcuts,b=lightcuts"
            )
        command_line.check_integrator(name)
        chosen[label] = (name, {})
    for key, value in options.param:
        label, _, name = key.partition(".")
        if not name or label not in chosen:
            raise UsageError(f"--param {key}: not of the form LABEL.KEY=VALUE, where LABEL is {' or '.join(chosen)}")
        chosen[label][1][name] = value
    for aov in options.aovs:
        _request_aov(aov, chosen)
    if options.denoise:
        chosen = {label: (name, for_denoising(name, given)) for label, (name, given) in chosen.items()}
    return chosen


def _request_aov(aov, chosen):
    """Add an AOV to the parameters of all integrators that support it; raises UsageError if none does."""
    supporting = command_line.integrators_with_aovs()
    choices = [choice for choice in chosen.values() if choice[0] in supporting]
    if not choices:
        raise UsageError(f"--aovs: supported only by {', '.join(supporting)}")
    refusals = [command_line.aov_refusal(name, aov) for name, _ in choices]
    if all(refusals):
        raise UsageError(f"--aovs {aov}: {'; '.join(dict.fromkeys(refusals))}")
    for (_, parameters), refusal in zip(choices, refusals, strict=True):
        if not refusal:
            given = _names(str(parameters.get("aovs", "")))
            parameters["aovs"] = ",".join(dict.fromkeys([*given, aov]))


def chosen_settings(options):
    """Return all settings, label -> list; raises UsageError for parameters that an integrator rejects."""
    # A reference by `vpl` uses the same lights and camera rays, so that errors do not depend on the number of samples
    samples = options.reference.kind != "vpl"
    settings = sweeps.settings(chosen_integrators(options), options.sweep, options.spp, options.time, samples)
    for group in settings.values():
        for setting in group:
            command_line.check_parameters(setting.title, setting.integrator, setting.parameters)
    return settings


def check_scenes(paths, reference):
    """Raise UsageError for missing scenes or references, and for two scenes with the same name."""
    names = {}
    if len(paths) > 1 and reference.kind == "file" and not reference.file.is_dir():
        raise UsageError(f"--reference: '{reference.file}' is a single image; for several scenes give a folder")
    for path in paths:
        command_line.check_scene(path)
        name = short_name(path)
        if name in names:
            raise UsageError(f"'{names[name]}' and '{path}' would have output files of the same name, '{name}'")
        names[name] = path
        file = reference.file_of(name)
        if file and not file.is_file():
            raise UsageError(f"--reference: no file '{file}' for the scene '{path}'")


def run(options, command):
    """Compare on all scenes; return the exit status. Raises ModuleNotFoundError if an optional package is missing."""
    for name in OPTIONAL:
        if find_spec(name) is None:
            raise ModuleNotFoundError(MISSING.format(name))
    if options.denoise:
        import_oidn()
    command_line.set_variant(options.mode)
    settings = chosen_settings(options)
    check_scenes(options.scenes, options.reference)
    if options.sampler:
        command_line.check_sampler(options.sampler)
    if options.workers and options.reference.kind == "vpl":
        raise UsageError(
            "--reference vpl shares files between runs and is incompatible with --workers; choose another reference"
        )
    names = map(short_name, options.scenes)
    earlier = baseline.read(options.check, options.metric, names) if options.check else None
    command_line.make_folder(options.out)
    lock = locked(options.out / ".lock", f"another comparison is writing to '{options.out}'")
    with lock, _runner(options) as runner:
        results = _compare(options, settings, command, runner)
    print(tables.EXPLANATION, end="\n\n")
    print(*results["summary"]["sentences"], sep="\n", end="\n\n")
    print(f"report: {options.out / 'report.html'}")
    worse = baseline.check(results, earlier, options.check_share) if earlier else []
    for line in worse:
        print(f"compare: {line}", file=sys.stderr)
    if any("error" in part for scene in results["scenes"] for part in (scene, *scene["renders"])):
        return 1
    return 3 if worse else 0


@contextmanager
def _runner(options):
    """Yield the runner of the block: processes of this machine, or distributed workers."""
    if not options.workers:
        yield worker
        return
    with connected(options.workers, options.threads) as pool:
        from comparison.cluster.runs import DistributedRuns

        yield DistributedRuns(pool)


def _compare(options, settings, command, runner):
    """Make all runs and write the report after each scene; return the content of `results.json`."""
    made_by = {"versions": machine.software(), "machine": machine.identity()}
    store = Runs(options.out, made_by | ({"workers": True} if options.workers else {}))
    progress = Progress(options.scenes, sweeps.order(settings, options.seeds))
    done, sections = [], []
    if options.workers:
        runner.save = store.save
    comparisons = [SceneComparison(path, settings, options, store, progress, runner) for path in options.scenes]
    try:
        for comparison in comparisons:
            complete = False
            try:
                # Announce all scenes at the start, so that no worker is idle during the last runs of a scene
                for one in comparisons if options.workers and not done else [comparison]:
                    one.prepare()
                comparison.run()
                complete = len(done) + 1 == len(options.scenes)
            finally:  # after an interruption, report the finished runs
                progress.skip(comparison.path)
                store.remove_kernels()  # of this scene, to free disk space for pictures and report
                comparison.finish()
                done.append(comparison)
                progress.write(report.text(comparison.result) + "\n")  # first, because a full disk cannot prevent it
                results = report.describe(command, options, [one.result for one in done], complete)
                sections = report.write(options.out, results, [one.pictures for one in done], sections)
        return results
    finally:
        progress.close()
        store.remove_kernels()


def main(arguments=None):
    """Run the command; return its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parse(arguments)
    command = shlex.join([_name(), *arguments])
    return command_line.exit_status(
        "compare",
        lambda: run(options, command),
        lambda: f"finished runs are in {options.out}; --resume continues",
        options.verbose,
    )


def start():
    """Entry point of the process: run the command, and treat SIGTERM as Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())


if __name__ == "__main__":
    start()
