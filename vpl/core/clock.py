"""Clock: seconds that a render spends in each of its stages."""

from __future__ import annotations

from time import perf_counter

import drjit as dr

from .compilation import compiled_since_last
from .stages import Stage, tell


class Clock:
    """Seconds by stage; the first stage begins at once.

    A stage ends when the next one begins or the clock is stopped, and the device has finished.  A stage that is handed
    over ends at once: the device works for the next stage.  A listener
    (:func:`vpl.core.stages.listening`) is told of each stage.  Within
    :func:`vpl.core.compilation.compilation_measured`, the compilation of kernels is a stage of its own.
    """

    def __init__(self, stage: Stage):
        self.seconds: dict[str, float] = {}
        self._stage: Stage | None = None
        # (Stage, seconds) of stages that were handed over, with compilation, which only a device at rest tells
        self._handed: list[tuple[Stage, float]] = []
        self.begin(stage)

    def begin(self, stage: Stage) -> None:
        """End the current stage and begin another one."""
        self.stop()
        tell(stage)
        self._stage, self._start = stage, perf_counter()

    def hand_over(self, stage: Stage) -> None:
        """End the current stage, and let another one begin with the kernels that the device is running."""
        self._handed.append((self._stage, perf_counter() - self._start))
        self._stage = None
        self.begin(stage)

    def stop(self) -> None:
        """End the current stage."""
        if self._stage is None:
            return
        dr.sync_thread()
        ended = [*self._handed, (self._stage, perf_counter() - self._start)]
        left = compiled_since_last()
        for stage, spent in ended:
            # Less than the stages: other threads may compile at the same time
            compiled = min(left, spent)
            left -= compiled
            self.add({stage: spent - compiled} | ({Stage.COMPILE: compiled} if compiled else {}))
        self._stage, self._handed = None, []

    def add(self, seconds: dict[str, float]) -> None:
        """Add times of stages that were measured elsewhere."""
        for stage, spent in seconds.items():
            # Plain text, because statistics are printed
            self.seconds[str(stage)] = self.seconds.get(stage, 0.0) + spent
