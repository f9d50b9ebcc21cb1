"""Dr.Jit's threads, where there would be a single one.

Mitsuba hands the reading and writing of EXR files to Dr.Jit's thread pool, and waits. Of a pool of one thread nobody
else does the work, so `mi.Bitmap(file)`, `mi.util.write_bitmap` and `mi.load_file` of a scene with an EXR texture wait
for ever.
"""

import drjit as dr
import mitsuba as mi

from .machine import cores


def avoid_single_thread():
    """Give Dr.Jit two threads if it has one because there is one core; log a warning in any case where it has one. A
    number that the caller has set stays."""
    if dr.thread_count() > 1:
        return
    waits = "with one thread Mitsuba waits for ever when it reads or writes EXR files"
    if cores() == 1:
        dr.set_thread_count(2)
        mi.Log(mi.LogLevel.Warn, f"Dr.Jit uses two threads on this one core: {waits}.")
    else:
        mi.Log(
            mi.LogLevel.Warn,
            f"Dr.Jit was set to one thread, and {waits}: load scenes by manylights.render(path), write images by "
            "manylights.write, or call drjit.set_thread_count(2).",
        )
