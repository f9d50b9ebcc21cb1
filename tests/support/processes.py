"""Processes that tests start, and conditions that tests wait for.

A machine may be busy with other work, so a wait ends early only if its condition holds or its process has ended.
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
