"""Several images by one command: scenes, frames of an animation, all sensors; and the names of their files."""

import argparse
import copy
import re
from collections import deque
from pathlib import Path

from .command_line import UsageError

ALL = "all"  # sensors
MOST_AHEAD = 64  # images that are prepared in advance


def frames(text):
    """Convert `FIRST..LAST`, or numbers separated by commas, to a list of ints; an argparse type."""
    if match := re.fullmatch(r"(\d+)\.\.(\d+)", text):
        found = range(int(match[1]), int(match[2]) + 1)
    else:
        found = [int(number) for number in text.split(",")] if re.fullmatch(r"\d+(,\d+)*", text) else []
    if not found:
        raise argparse.ArgumentTypeError(f"'{text}' is neither FIRST..LAST nor numbers separated by commas")
    return list(found)


def sensor(text):
    """Convert the index of a sensor, or `all`; an argparse type."""
    if text != ALL and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is neither the index of a sensor nor '{ALL}'")
    return text if text == ALL else int(text)


def images(options):
    """Return the options of each scene and frame, with a single `scene`, its `frame` (None without frames), and
    `{frame}` replaced in `define`. Raises UsageError if images would share a file."""
    found = []
    for scene in options.scenes:
        for frame in options.frames or [None]:
            one = copy.copy(options)
            one.scene, one.frame = scene, frame
            if frame is not None:
                one.define = [(key, _fill(f"-D {key}", value, frame=frame)) for key, value in options.define]
            found.append(one)
    if options.output and not options.output.is_dir():
        several = {"scene": len(options.scenes) > 1, "frame": bool(options.frames), "sensor": options.sensor == ALL}
        for name in (name for name in several if several[name] and f"{{{name}" not in str(options.output)):
            raise UsageError(f"--output '{options.output}' would be of several images; put {{{name}}} into it")
    made = {}
    for one in found:
        file = output(one, 0).absolute()
        if file in made:
            raise UsageError(f"'{file}' would be of both {_title(made[file])} and {_title(one)}")
        made[file] = one
    return found


def output(options, sensor):
    """Return the file (Path) of the image of a sensor, for options from `images`. Without an `output` file the name is
    the scene's, with frame and sensor if there may be several; the folder is `output`, or the scene's."""
    if options.output and not options.output.is_dir():
        names = {"scene": options.scene.stem, "frame": options.frame, "sensor": sensor}
        several = len(options.scenes) > 1 or options.frames or options.sensor == ALL
        return Path(_fill("--output", str(options.output), **names)) if several else options.output
    name = options.scene.stem
    if options.frame is not None:
        name += f".{options.frame:0{max(4, len(str(max(options.frames))))}}"
    if options.sensor == ALL:
        name += f".sensor{sensor}"
    return (options.output or options.scene.parent) / f"{name}.exr"


def ahead(images):
    """Yield images (`one_image.Image`) from an iterator in sequence, and prepare enough later images that workers are
    never idle."""
    waiting = deque()
    for image in images:
        waiting.append(image)
        while len(waiting) > MOST_AHEAD or any(one.fills_pool for one in list(waiting)[1:]):
            yield waiting.popleft()
    yield from waiting


def _title(options):
    return f"'{options.scene}'" + ("" if options.frame is None else f", frame {options.frame}")


def _fill(title, text, **names):
    """Replace `{name}`, or `{name:04}`, in a text."""
    try:
        return text.format(**names)
    except (KeyError, IndexError, ValueError, TypeError):
        raise UsageError(f"{title}: '{text}' has other braces than {{{'}, {'.join(names)}}}") from None
