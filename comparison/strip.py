"""Draw a strip of pictures for a paper or a web page from the output of compare.py:

    python compare.py scenes/hall.xml -i path,lightcuts --time 10 -r scenes/hall_reference.exr -o output/strip
    python -m comparison.strip output/strip --scene hall --output docs/equal_time.png

A row per scene shows the image of each integrator (first seed), the common reference if there is one, and relative
errors in false colours, with captions below.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from . import command_line, images, tables
from .command_line import UsageError
from .pictures import REFERENCE

RESOLUTION = 100  # pixels per inch
CAPTION = 0.45  # inches below the pictures


def panels(results, name):
    """Return (file name part, caption) of each panel of the scene `name` in the content of `results.json`. Raises
    UsageError for an unknown scene."""
    scenes = {scene["name"]: scene for scene in results["scenes"]}
    if name is None and len(scenes) == 1:
        (name,) = scenes
    if name not in scenes:
        raise UsageError(f"--scene {name or '(not given)'}: there are {', '.join(scenes)}")
    scene, found = scenes[name], []
    for title, renders in tables.settings(scene).items():
        first = renders[0]
        if "error" in first or "errors" not in first:
            continue
        file = Path(first["output"]).name.removesuffix(".exr").removesuffix(f".seed{first['seed']}")
        error = tables.error([first["errors"]], "relmse_trimmed", ".3g")
        found.append((file, title, f"{tables.number(first['seconds'])} s", error))
    if not found:
        raise UsageError(f"'{name}' has no images with errors")
    reference = [(f"{name}.{REFERENCE}", f"reference\n{_samples(scene['reference'])}")] if "reference" in scene else []
    return [
        *((file, f"{title}\n{seconds}") for file, title, seconds, _ in found),
        *reference,  # absent if each image has its own reference
        *((f"{file}.error", f"error of {title}\ntrimmed relMSE {error}") for file, title, _, error in found),
    ]


def _samples(reference):
    return f"{reference.get('integrator', 'path')}, {reference['spp']} samples a pixel" if "spp" in reference else ""


def draw(pictures, captions):
    """Return pixels (height, width, 3) uint8 of pictures of equal size in a row, with captions below."""
    height, width = pictures[0].shape[:2]
    gap = 4
    total = len(pictures) * (width + gap) - gap
    figure = Figure(figsize=(total / RESOLUTION, height / RESOLUTION + CAPTION), dpi=RESOLUTION)
    canvas = FigureCanvasAgg(figure)
    rows = round(figure.get_figheight() * RESOLUTION)
    for index, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        left = index * (width + gap)
        figure.figimage(picture, left, rows - height)
        figure.text(
            (left + width / 2) / total, (rows - height - 6) / rows, caption, ha="center", va="top", fontsize=8,
            color="#333", linespacing=1.3,
        )  # fmt: skip
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def below(strips):
    """Stack strips of pixels vertically, padded with white to the largest width."""
    width = max(strip.shape[1] for strip in strips)
    return np.concatenate(
        [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0)), constant_values=255) for strip in strips]
    )


def main(arguments=None):
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m comparison.strip", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="output folder of compare.py")
    parser.add_argument("--scene", nargs="+", help="names of scenes (default: the only one)")
    parser.add_argument("--output", type=Path, required=True, help="PNG file")
    options = parser.parse_args(arguments)
    return command_line.exit_status("strip", lambda: _run(options), lambda: "nothing was written", verbose=False)


def _run(options):
    try:
        results = json.loads((options.folder / "results.json").read_text())
    except FileNotFoundError:
        raise UsageError(f"no results.json in '{options.folder}'") from None
    command_line.check_output(options.output)
    command_line.set_variant(results["variant"])
    strips = []
    for name in options.scene or [None]:
        found = panels(results, name)
        pictures = [images.read_png(options.folder / f"{file}.png") for file, _ in found]
        strips.append(draw(pictures, [caption for _, caption in found]))
    made = {key: results[key] for key in ("command", "created")}
    images.write_png(options.output, below(strips), made)
    print(f"{options.output} ({options.output.stat().st_size / 1000:.0f} kB), made by: {results['command']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
