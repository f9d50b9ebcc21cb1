"""Ctrl-C during a render: finished passes are kept, and the process does not wait for an unfinished one."""

import os
import signal
import sys
import threading
from contextlib import contextmanager

import mitsuba as mi

PATIENCE = 4.0  # seconds


def is_interruption(error):
    """Return whether an exception is KeyboardInterrupt or replaced it: Mitsuba and Dr.Jit replace exceptions that pass
    through them. The new exception has the old one as its cause, or names it in its message."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt) or KeyboardInterrupt.__name__ in str(error):
            return True
        error = error.__cause__
    return False


@contextmanager
def interruptions_kept():
    """Within the block, exceptions that replaced KeyboardInterrupt become KeyboardInterrupt again."""
    try:
        yield
    except Exception as error:
        if is_interruption(error):
            raise KeyboardInterrupt from error
        raise


class Interruption:
    """Within the block, a first Ctrl-C sets `asked`, which ends the loop over the passes; a second one acts at once.

    Only the main thread receives Ctrl-C; in another thread the block has no effect.
    """

    def __init__(self):
        self.asked = False

    def __enter__(self):
        self._heard = threading.current_thread() is threading.main_thread()
        if self._heard:
            self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_):
        if self._heard:
            signal.signal(signal.SIGINT, self._before)

    def _ask(self, *_):
        self.asked = True
        signal.signal(signal.SIGINT, self._before)
        mi.Log(mi.LogLevel.Warn, "Stopping; Ctrl-C again to stop at once.")


class Deadline:
    """Ends the process if the block is still running `PATIENCE` seconds after Ctrl-C. Another thread calls `save`,
    which returns the exit status; an exception of `save` is printed, and the status is 1.

    A running kernel cannot be stopped, and delays signal handlers of Python, but not the wake-up pipe. For the main
    thread of a command.
    """

    def __init__(self, save):
        self._save, self._over = save, threading.Event()

    def restart(self):
        """Let the first Ctrl-C, before this call, not end the process; another one will."""
        over, self._over = self._over, threading.Event()
        over.set()

    def __enter__(self):
        self._reading, self._writing = os.pipe()
        os.set_blocking(self._writing, False)
        self._before = signal.set_wakeup_fd(self._writing)
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._over.set()
        signal.set_wakeup_fd(self._before)
        os.close(self._writing)
        self._thread.join()
        os.close(self._reading)

    def _watch(self):
        while signals := os.read(self._reading, 64):
            over = self._over  # `restart` replaces it
            if signal.SIGINT in signals and not over.wait(PATIENCE):
                try:
                    status = self._save()
                except Exception as error:  # of any kind, as the process must end
                    print(f"manylights: {error}", file=sys.stderr)
                    status = 1
                sys.stderr.flush()
                os._exit(status)
