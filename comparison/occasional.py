"""Files written periodically during a render."""

import time

import mitsuba as mi


class OccasionalWriter:
    """Writes a file at most once per `seconds`; `title` names the file in the log."""

    def __init__(self, title, seconds):
        self._title, self._seconds = title, seconds
        self._written = time.monotonic()

    def offer(self, write):
        """Write new content by `write()` if the last attempt is more than `seconds` ago."""
        if time.monotonic() - self._written > self._seconds:
            self.write(write)

    def write(self, write):
        """Write the file by `write()`; return success. A full disk does not end the render."""
        try:
            write()
        except OSError as error:
            mi.Log(mi.LogLevel.Warn, f"{self._title} could not be written: {error}")
            return False
        finally:
            self._written = time.monotonic()  # at the end: a disk may be slower than passes
        return True
