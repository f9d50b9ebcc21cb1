"""Processes of tests, and waits for conditions.

On a busy machine any step may be slow: a wait ends only with its condition, its process, or after PATIENCE.
"""

import time

PATIENCE = 900.0  # seconds after which a test gives up


def wait_until(condition, process=None):
    """Return the first true value of ``condition()``; fail if ``process`` ends before, or after PATIENCE."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end, "the condition never held"
        time.sleep(0.02)
    return found
