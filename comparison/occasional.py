"""Files that are written every now and then while a render goes on."""

import time

import mitsuba as mi


class OccasionalWriter:
    """Writes a file by calling `write`, at most once in `seconds`; `title` is what the log calls it."""

    def __init__(self, title, write, seconds):
        self._title, self._write, self._seconds = title, write, seconds
        self._written = time.monotonic()

    def offer(self):
        """There is something new: write it if that was not done for some time."""
        if time.monotonic() - self._written > self._seconds:
            self.write()

    def write(self):
        """Write it; return whether that was possible. A disk that is full ends no render."""
        try:
            self._write()
        except OSError as error:
            mi.Log(mi.LogLevel.Warn, f"{self._title} could not be written: {error}")
            return False
        finally:
            self._written = time.monotonic()  # not before: a disk may be slower than passes
        return True
