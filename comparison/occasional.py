"""Files written periodically during a render."""

import time

import mitsuba as mi


class OccasionalWriter:
    """Writes a file by calling `write`, at most once per `seconds`; `title` names the file in the log."""

    def __init__(self, title, write, seconds):
        self._title, self._write, self._seconds = title, write, seconds
        self._written = time.monotonic()

    def offer(self):
        """Write new content if the last attempt is more than `seconds` ago."""
        if time.monotonic() - self._written > self._seconds:
            self.write()

    def write(self):
        """Write the file; return success. A full disk does not end the render."""
        try:
            self._write()
        except OSError as error:
            mi.Log(mi.LogLevel.Warn, f"{self._title} could not be written: {error}")
            return False
        finally:
            self._written = time.monotonic()  # at the end: a disk may be slower than passes
        return True
