"""Make the gallery: every scene of scenes/ by `path` and by `manylights` at equal time, and a reference.

    ./run -- python docs/gallery.py                               # all scenes
    ./run -- python docs/gallery.py --scenes foliage lamp_grid    # two scenes; the others stay

Renders references by `manylights`, or by `adaptivedirect` for scenes with direct light alone, and keeps the references
in output/gallery. Compares by compare.py. Writes docs/gallery.md and the pictures in docs/gallery/.
"""

import argparse
import json
import shutil
import sys
import time
from pathlib import Path

import mitsuba as mi

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import compare  # noqa: E402  (the project's own, whatever folder this is called from)
from comparison import command_line, images, references, tables  # noqa: E402
from comparison.pictures import REFERENCE  # noqa: E402
from comparison.rendering import Progressive  # noqa: E402
from comparison.scene_files import SceneFile  # noqa: E402
from comparison.single_pass import pass_seed  # noqa: E402

SCENES, WORK, PAGE = ROOT / "scenes", ROOT / "output" / "gallery", ROOT / "docs" / "gallery.md"
PICTURES = PAGE.with_suffix("")
INTEGRATORS = ("path", "manylights")
WIDTH, BATCH, QUALITY = 256, 64, 85
# Samples per pixel of a pass: two seconds on an idle machine. Passes by time would be small on a busy one
PASS = 32
# `max_depth` of scenes with direct light alone, and the error of a pass of such a reference
DIRECT, FINE = 2, 0.02
# Smallest excess of a time over the other time in a warning
UNEQUAL = 0.1
BUSY = "The machine ran other programs, too: do not compare numbers of samples. "
INTRODUCTION = """\
[README](../README.md) · [front page](index.md) · gallery

# Gallery

Every scene of [scenes/](../scenes/README.md) by `path` and by `manylights` at equal time ({seconds:g} seconds), and \
the reference. On the site, drag across a picture to compare two images. Images are {width} pixels wide, not \
denoised. Below each image are its samples per pixel and its error: the mean absolute difference from the \
reference over the mean of the reference. References are by `manylights`, and by `adaptivedirect` in scenes of \
direct light alone, with other seeds. Their noise is a part of each error.

{doubts}One image shows noise, not speed: [results](results.md) has times at equal error. \
`./run -- python docs/gallery.py` renders all images again.
"""


def make_reference(name, seconds):
    """Write output/gallery/references/NAME.exr, from at least two batches of samples, unless the file exists."""
    file = WORK / "references" / f"{name}.exr"
    if file.exists():
        return
    scene = SceneFile(SCENES / f"{name}.xml")
    scene.set_width(WIDTH)
    direct = scene.integrator[1]["max_depth"] == DIRECT
    integrator, more = ("adaptivedirect", {"error": FINE}) if direct else ("manylights", {})
    scene.set_integrator(integrator, more)
    progressive, batches = Progressive(scene.load(), references.SEED), references.Batches()
    end = time.monotonic() + seconds
    while batches.count < 2 or time.monotonic() < end:
        progressive.restart()
        progressive.render(BATCH, pass_seed(references.SEED, batches.count))
        batches = batches.with_batch(images.colour(progressive.image, progressive.channels), progressive.spp)
    batches.write(file, {"integrator": integrator, "scene": name, "seed": references.SEED})


def convert(source, target):
    """Write a PNG file of compare.py as a small JPEG."""
    bitmap = mi.Bitmap(images.read_png(source))
    bitmap.write(str(target), mi.Bitmap.FileFormat.JPEG, QUALITY)


def rows(scene, introduced):
    """Section of a scene of results.json: a table of three pictures with samples and errors, and warnings."""
    name, found = scene["name"], {one["integrator"]: one for one in scene["renders"]}
    errors = {label: found[label]["errors"]["relative_l1"] for label in INTEGRATORS}
    cells = []
    for label in INTEGRATORS:
        cells.append(f"{found[label]['spp']} samples, {float(f'{100 * errors[label]:.2g}'):g}%")
    labels = [*INTEGRATORS, REFERENCE]
    pictures = [f"![{name} by {label}](gallery/{name}.{label}.jpg)" for label in labels]
    cells.append(f"{scene['reference']['spp']} samples")
    titles = [f"`{label}`" for label in INTEGRATORS] + [REFERENCE]
    lines = [titles, ["---"] * 3, pictures, cells]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    without_budgets = scene | {"renders": [one | {"budget": None} for one in scene["renders"]]}
    warnings = tables.scene_warnings(without_budgets) + unequal_times(found)
    doubts = "".join(f"\n{sentence}\n" for sentence in warnings)
    return f"## {name}\n\n{introduced[name]}\n\n{table}\n{doubts}"


def unequal_times(found):
    """Sentence about the ratio of times, in a list; empty where times are equal."""
    short, long = sorted(found.values(), key=lambda one: one["seconds"])
    ratio = long["seconds"] / short["seconds"]
    if ratio <= 1 + UNEQUAL:
        return []
    return [f"Not at equal time: `{long['integrator']}` took {ratio:.2f} times as long as `{short['integrator']}`."]


def described():
    """Lights and purpose of each scene, from scenes/README.md."""
    lines = (SCENES / "README.md").read_text().splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("| [")]
    return {cell[0][1:].partition("]")[0]: f"{cell[1][0].upper()}{cell[1][1:]}. For: {cell[2]}." for cell in cells}


def sections_of(page):
    """Sections of the page by the name of the scene; the introduction has no name."""
    introduction, *others = page.split("\n## ")
    return {"": introduction} | {one.partition("\n")[0]: f"## {one}" for one in others}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="time of an image (default: 30)")
    parser.add_argument("--reference-seconds", type=float, default=150.0, help="time of a reference (default: 150)")
    known = sorted(path.stem for path in SCENES.glob("*.xml"))
    parser.add_argument("--scenes", nargs="+", choices=known, metavar="NAME", help="scenes to render (default: all)")
    options = parser.parse_args()
    names = sorted(set(options.scenes or known))
    command_line.set_variant("llvm_ad_rgb")
    (WORK / "references").mkdir(parents=True, exist_ok=True)
    for name in names:
        make_reference(name, options.reference_seconds)
    status = compare.main([
        *(str(SCENES / f"{name}.xml") for name in names), "-i", ",".join(INTEGRATORS), "--time", str(options.seconds),
        "--pass-spp", str(PASS), "--width", str(WIDTH), "-r", str(WORK / "references"), "-o", str(WORK), "--resume",
    ])  # fmt: skip
    if status:
        return status
    results = json.loads((WORK / "results.json").read_text())
    if not options.scenes:
        shutil.rmtree(PICTURES, ignore_errors=True)
    PICTURES.mkdir(exist_ok=True)
    for name in names:
        for label in (*INTEGRATORS, REFERENCE):
            convert(WORK / f"{name}.{label}.png", PICTURES / f"{name}.{label}.jpg")
    introduced = described()
    renders = [one for scene in results["scenes"] for one in scene["renders"]]
    doubts = BUSY if tables.load_warnings(renders, results["machine"]["cores"]) else ""
    introduction = INTRODUCTION.format(seconds=options.seconds, width=WIDTH, doubts=doubts)
    kept = sections_of(PAGE.read_text()) if options.scenes else {"": introduction}
    kept |= {scene["name"]: rows(scene, introduced) for scene in results["scenes"]}
    PAGE.write_text("\n".join(kept[name] for name in sorted(kept)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
