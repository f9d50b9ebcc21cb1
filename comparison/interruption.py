"""Ctrl-C during a render: what is finished is kept, and nobody waits for what is not."""

import os
import signal
import sys
import threading

import mitsuba as mi

PATIENCE = 4.0  # seconds


class Interruption:
    """While in force, a first Ctrl-C sets `asked`, for the loop over the passes to end; a second one acts at once.

    Outside of the main thread, where nobody can hear Ctrl-C, it does nothing.
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
    """While in force, ends this process when `PATIENCE` seconds after Ctrl-C it is still in force: `save` is called, in
    another thread, and returns the exit status; if it raises, that is told, and the status is 1.

    No kernel can be stopped, and Python hears of a signal only after it. But the wake-up pipe hears it at once. For the
    main thread of a command.
    """

    def __init__(self, save):
        self._save, self._over = save, threading.Event()

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
            if signal.SIGINT in signals and not self._over.wait(PATIENCE):
                try:
                    status = self._save()
                except Exception as error:  # whatever it is: nobody else would end this process
                    print(f"manylights: {error}", file=sys.stderr)
                    status = 1
                sys.stderr.flush()
                os._exit(status)
