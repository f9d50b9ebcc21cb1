"""The scenes of scenes.py, rendered by Cycles and by the add-on. They need a process of their own, which `bpy` may
abort at its end:

    python -m tests.blender.cases FOLDER [NAME...]

Writes FOLDER/NAME.npz for each case: images `ours` and `cycles` (height, width, 4), `problems` of the export, and
`seconds` of the add-on. The file of a case that raises an exception has its text as `error` alone.
"""

import os
import sys
import time
import traceback
from pathlib import Path

import bpy
import mitsuba as mi
import numpy as np

from tests.blender.scenes import CASES, Progress
from tests.support.blender import rendered


def problems():
    """Sentences about what the current scene has and the export lacks."""
    from manylights_blender.scene import export

    return export(bpy.context.evaluated_depsgraph_get()).problems


def main(folder, *chosen):
    mi.set_variant("llvm_ad_rgb")
    is_stopped = Progress.is_stopped
    for name, build in CASES.items() if not chosen else [(one, CASES[one]) for one in chosen]:
        began = time.perf_counter()
        try:
            build()
            found = {"problems": problems(), "ours": rendered("MANYLIGHTS", folder)}
            found["seconds"] = time.perf_counter() - began
            found["cycles"] = rendered("CYCLES", folder)
        except Exception:  # of any kind: the test of this case fails with the text
            found = {"error": traceback.format_exc()}
        Progress.is_stopped = is_stopped
        np.savez(folder / f"{name}.npz", **found)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
    sys.stdout.flush()
    os._exit(0)  # bpy may crash while Python ends
