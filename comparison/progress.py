"""Progress bars of comparisons and images, with the time left; hidden if the output is no terminal."""

import time
from collections import Counter
from contextlib import contextmanager

from tqdm import tqdm

BAR = "{desc} |{bar}| {n_fmt}/{total_fmt} runs{postfix}"
# Numbers of equal parts of (scene, label, setting), by which the time of a run is expected from that of others: the
# same setting on the scene, the same label on the scene, any run
SAME = 3, 2, 0
IMAGE_BAR = "{desc}|{bar}| {percentage:.0f}%{postfix}"


class ImageBar:
    """Progress bar of an image: fraction of the expected time, stage of the pass, samples per pixel, shadow rays and
    error."""

    def __init__(self):
        self._bar = tqdm(total=1.0, disable=None, bar_format=IMAGE_BAR)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._bar.close()

    def show(self, took, *more):
        """Show the `render.Took` of a running render, and the texts `more`."""
        left = took.seconds_left
        if left is not None:
            self._bar.n = took.seconds / max(took.seconds + left, 1e-9)
        shown = [f"{took.spp} spp", *more]
        if rays := took.statistics.get("shadow_rays"):
            shown.append(f"{tqdm.format_sizeof(rays)} shadow rays")
        if took.error is not None:
            shown.append(f"error {took.error:.2%}")
        if left is not None:
            shown.append(f"{tqdm.format_interval(left)} left")
        self._bar.set_description_str(f"{took.stage} " if took.stage else "", refresh=False)
        self._bar.set_postfix_str(", ".join(shown), refresh=False)
        self._bar.refresh()


class Progress:
    """Progress bar of a comparison: each of several scenes (paths) has the same runs, (setting, seed).

    The expected time of a run is that of the same setting with other seeds; for a new setting, the mean time of its
    label on the scene, or of all runs.
    """

    def __init__(self, scenes, runs):
        # (scene, label, setting) -> number of runs
        self._planned = Counter((str(scene), setting.label, setting.name) for scene in scenes for setting, _ in runs)
        self._bar = tqdm(total=self._planned.total(), disable=None, bar_format=BAR)
        # Beginning of such a key, as `SAME` has them -> seconds and number of finished runs
        self._took, self._running, self._began = {}, None, 0.0

    def begin(self, scene, setting):
        """Start a run."""
        self._running, self._began = (str(scene), setting.label, setting.name), time.monotonic()
        self._planned[self._running] -= 1
        self._bar.set_description_str(setting.title, refresh=False)
        self.tick()

    def end(self, kept):
        """End the run; `kept`: its result was already there."""
        if not kept:
            spent = time.monotonic() - self._began
            for same in SAME:
                seconds, number = self._took.get(self._running[:same], (0.0, 0))
                self._took[self._running[:same]] = seconds + spent, number + 1
        self._running = None
        self._bar.update()
        self.tick()

    def skip(self, scene):
        """Drop the remaining runs of a scene."""
        left = Counter({run: number for run, number in self._planned.items() if run[0] != str(scene)})
        self._bar.update(self._planned.total() - left.total())
        self._planned = left

    def tick(self):
        """Update the time left. Takes next to no time beside a measured process."""
        if self._bar.disable:
            return
        left = self.seconds_left()
        self._bar.set_postfix_str("" if left is None else f"{tqdm.format_interval(left)} left", refresh=False)
        self._bar.refresh()

    def seconds_left(self):
        """Return the expected seconds of the planned and the current runs, None if unknown."""
        if not self._took:
            return None
        left = sum(number * self._expected(run) for run, number in self._planned.items() if number)
        if self._running is not None:
            left += max(0.0, self._expected(self._running) - (time.monotonic() - self._began))
        return left

    def _expected(self, run):
        seconds, number = next(self._took[run[:same]] for same in SAME if run[:same] in self._took)
        return seconds / number

    @contextmanager
    def paused(self):
        """Hide the bar within the block, in favour of another bar."""
        self._bar.clear()
        try:
            yield
        finally:
            self._bar.refresh()

    def write(self, text):
        """Print text to the standard output, above the bar."""
        self._bar.write(text)

    def close(self):
        """Remove the bar."""
        self._bar.leave = False
        self._bar.close()
