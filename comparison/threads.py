"""Number of Dr.Jit's threads, at least two.

Mitsuba gives the reading and writing of EXR files to Dr.Jit's thread pool, and waits for the result. In a pool of one
thread no other thread does the work, so `mi.Bitmap(file)`, `mi.util.write_bitmap` and `mi.load_file` of a scene with an
EXR texture wait for ever.
"""

import drjit as dr
import mitsuba as mi

from .machine import cores


def avoid_single_thread():
    """Set two threads on a machine of one core, and log a warning if Dr.Jit had a single one. A number of threads that
    the caller has set does not change."""
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
