"""Compare integrators on scenes: same scene, same time or same samples, same reference, each in a process of its own.

    python compare.py scenes/hall.xml --integrators path,lightcuts --time 20 --reference path:4096
    python compare.py scenes/cornell.xml --integrators coarse=lightcuts,fine=lightcuts \\
        --param coarse.error=0.02 --param fine.error=0.005 --spp 4 --reference vpl
    python compare.py --demo

Prints a table and writes to the output folder, for each scene and integrator, the image (`SCENE.LABEL.exr`, with how it
was made, and `.png`), its error (`SCENE.LABEL.error.png`) and with `--aovs` its other channels in false colours
(`SCENE.LABEL.CHANNEL.png`), and `results.json` and `report.html` for all of them; comparison/report.py documents the
keys of the former.

Times are wall-clock seconds of rendering alone. The first pass of each process, with an empty kernel cache, is the cold
one and is reported apart; the time budget is for warm passes. comparison/metrics.py defines the errors.

Exit status: 0; 1 if anything failed (what did not is reported all the same); 2 for a command that makes no sense.
"""

import argparse
import re
import shlex
import sys
from pathlib import Path

from comparison import command_line, references, report
from comparison.command_line import UsageError, parameter, positive
from comparison.scene_comparison import SceneComparison

ROOT = Path(__file__).resolve().parent
DEMO = [
    str(ROOT / "scenes" / "hall.xml"), "--integrators", "path,lightcuts", "--time", "30",
    "--reference", str(ROOT / "scenes" / "hall_reference.exr"),
]  # fmt: skip


def parse(arguments):
    """Parse the command line; return its options. Exits with status 2 and a message if it makes no sense."""
    parser = argparse.ArgumentParser(
        prog="compare.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("scenes", nargs="*", metavar="SCENE", help="scene files (XML)")
    add("-i", "--integrators", default="path,lightcuts", metavar="NAME,...",
        help="integrators, each NAME or LABEL=NAME to have one twice (default: path,lightcuts)")  # fmt: skip
    effort = parser.add_mutually_exclusive_group()
    effort.add_argument("--time", type=positive(float), metavar="SECONDS", help="time budget of each (default: 20)")
    effort.add_argument("--spp", type=positive(int), metavar="N", help="samples per pixel of each")
    add("--pass-spp", type=positive(int), metavar="N",
        help="samples per pixel of one pass, which has virtual lights of its own (default: chosen)")  # fmt: skip
    add("-p", "--param", action="append", type=parameter, default=[], metavar="LABEL.KEY=VALUE",
        help="parameter of an integrator, such as lightcuts.error=0.02; repeat for more")  # fmt: skip
    add("--aovs", type=_names, default=[], metavar="NAME,...",
        help="channels to show in false colours, asked of the integrators that know them: shadow_rays, upper_bounds, "
             "cut_size, phase_one (see their docstrings)")  # fmt: skip
    add("-r", "--reference", type=_reference, default="path:1024",
        help="an EXR file, or a folder that holds SCENE.exr, which also gives the width; path:SPP (path traced, kept, "
             "continued); vpl (each image by all of its own virtual lights) (default: path:1024)")  # fmt: skip
    add("--max-depth", type=int, metavar="N", help="longest paths (default: the scene's)")
    add("--width", type=positive(int), metavar="N", help="width of the images (default: the scene's)")
    add("--seed", type=command_line.seed, default=0, metavar="N", help="seed (default: 0)")
    add("--cache", type=Path, default=references.default_cache(), metavar="FOLDER",
        help="where path-traced references are kept (default: ~/.cache/manylights)")  # fmt: skip
    add("-o", "--out", type=Path, metavar="FOLDER", help="output folder (default: output, or output/demo)")
    add("--demo", action="store_true", help="path and lightcuts on scenes/hall.xml, in less than three minutes")
    command_line.add_common_options(parser)

    options = parser.parse_args(DEMO + arguments if "--demo" in arguments else arguments)
    options.out = options.out or Path("output/demo" if options.demo else "output")
    if not options.scenes:
        parser.error("no scene given; try --demo")
    if not options.spp and not options.time:
        options.time = 20.0
    return options


def _names(text):
    """Split a comma-separated list; an argparse type."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _reference(text):
    """Check the text of --reference; an argparse type."""
    kind, _, spp = text.partition(":")
    if kind == "path" and (not spp.isdecimal() or int(spp) == 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form path:SPP")
    if kind not in ("path", "vpl") and not Path(text).exists():
        raise argparse.ArgumentTypeError(f"'{text}' is neither a file, nor a folder, path:SPP or vpl")
    return text


def chosen_integrators(options):
    """Return a dict from label to name and parameters; raises UsageError for what does not exist or fit together."""
    chosen = {}
    for entry in options.integrators.split(","):
        label, _, name = entry.rpartition("=")
        label = label or name
        if not re.fullmatch(r"[\w-]+", label) or label in chosen:
            raise UsageError(
                f"--integrators: '{entry}' is no name of its own; two of a kind are a=lightcuts,b=lightcuts"
            )
        command_line.check_integrator(name)
        chosen[label] = (name, {})
    for key, value in options.param:
        label, _, name = key.partition(".")
        if not name or label not in chosen:
            raise UsageError(f"--param {key}: not of the form LABEL.KEY=VALUE, where LABEL is {' or '.join(chosen)}")
        chosen[label][1][name] = value
    for aov in options.aovs:
        _ask_for(aov, chosen)
    return chosen


def _ask_for(aov, chosen):
    """Add an AOV to the parameters of those chosen integrators that know it; raises UsageError if none does."""
    own = [choice for choice in chosen.values() if choice[0] in command_line.own_integrators()]
    if not own:
        raise UsageError(f"--aovs: only {', '.join(command_line.own_integrators())} have AOVs")
    refusals = [command_line.aov_refusal(name, aov) for name, _ in own]
    if all(refusals):
        raise UsageError(f"--aovs {aov}: {'; '.join(dict.fromkeys(refusals))}")
    for (_, parameters), refusal in zip(own, refusals, strict=True):
        if not refusal:
            given = _names(str(parameters.get("aovs", "")))
            parameters["aovs"] = ",".join(dict.fromkeys([*given, aov]))


def run(options, command):
    """Compare on all scenes, writing the report anew after each; return whether all went well."""
    command_line.set_variant(options.mode)
    integrators = chosen_integrators(options)
    for path in options.scenes:
        command_line.check_scene(path)
    options.out.mkdir(parents=True, exist_ok=True)
    scenes, pictures = [], {}
    for path in options.scenes:
        comparison = SceneComparison(path, options)
        try:
            comparison.run(integrators)
        finally:  # an interruption, too, leaves a report of what there is
            scenes.append(comparison.result)
            pictures[comparison.result["name"]] = comparison.pictures
            report.write(options.out, report.describe(command, options, scenes), pictures)
        print(report.table(comparison.result), end="\n\n", flush=True)
    print(report.EXPLANATION, end="\n\n")
    print(f"report: {options.out / 'report.html'}")
    return not any("error" in part for scene in scenes for part in (scene, *scene["renders"]))


def main(arguments=None):
    """Run the command; return its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parse(arguments)
    command = shlex.join(["compare.py", *arguments])
    return command_line.exit_status(
        "compare", lambda: 0 if run(options, command) else 1, f"what was finished is in {options.out}", options.verbose
    )


if __name__ == "__main__":
    sys.exit(main())
