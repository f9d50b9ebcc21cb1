"""An image of the command `manylights`: rendered by this process or by workers, and written from time to time."""

import sys
import time

import mitsuba as mi
import numpy as np

from . import batch, command_line, images, machine
from .checkpoint import Checkpoint, file_of
from .interruption import Deadline, interruptions_kept
from .occasional import OccasionalWriter
from .progress import ImageBar
from .render import DENOISING, render
from .scene_files import SceneFile
from .single_pass import check_film

WRITE_SECONDS = 10.0  # between writes of the unfinished image
INTERRUPTED = 130  # exit status


class LazyScene:
    """Scene of a `SceneFile`, loaded at first access; the `SceneFile` stays usable. `before`: the `LazyScene` of the
    previous frame, or None."""

    def __init__(self, file, threads=None, before=None):
        self.file, self.seconds, self._threads, self._scene = file, 0.0, threads, None
        self._before = before if self.keeps_lights else None
        self.integrator = self._without_camera = None

    @property
    def keeps_lights(self):
        """Whether the integrator keeps the lights for later images of the scene."""
        return self.file.integrator[1].get("keep_lights", False)

    def get(self):
        """Return the `mi.Scene`, and set `seconds`, the time of loading, and `integrator`. The integrator, with its
        kept lights, is that of the previous frame if only the camera differs, otherwise the scene's."""
        if self._scene is None:
            begin = time.perf_counter()
            before, self._before = self._before, None  # frees the scene of that frame
            if self.keeps_lights:
                self._without_camera = self.file.fingerprint(camera=False)
                # As loaded: the files of that frame may have changed since
                if before and before._without_camera == self._without_camera:
                    self.integrator = before.integrator
            del before
            self._scene = SceneFile(self.file.path, self.file.defines, self.file.changes).load(self._threads)
            self.integrator = self.integrator or self._scene.integrator()
            self.seconds = time.perf_counter() - begin
        return self._scene


class Image:
    """Image to render from the sensor of index `sensor` of a `LazyScene`, with the options of the command: by the
    workers of a `pool`, or by this process if it is None. `described`: "integrator", "parameters" and "replaced"."""

    def __init__(self, options, scene, described, sensor, pool):
        self._options, self._scene, self._sensor = options, scene, sensor
        self._name = described["integrator"]
        if described["replaced"]:
            self._name += f" in place of {described['replaced']}"
            mi.Log(mi.LogLevel.Info, f"The integrator is {self._name}; -i scene would keep the scene's.")
        self._described = {"scene": str(options.scene), **described, "variant": options.mode, "seed": options.seed}
        self.path, self._checkpoint, self._remote = batch.output(options, sensor), None, None
        if pool or options.resume:
            made_by = {
                "value of denoised": scene.file.integrator[1].get("denoised", False),
                "scene": scene.file.fingerprint(),
                "sensor": sensor,
                "seed": options.seed,
                **machine.software(),
            }
            # Until the image is written
            self._checkpoint = Checkpoint(file_of(self.path), made_by, options.resume, stays=True)
        if pool:
            from .cluster.render import DistributedRender

            self._remote = DistributedRender(pool, scene, sensor, checkpoint=self._checkpoint, **self._limits())

    @property
    def fills_pool(self):
        """Whether the image has enough passes for all workers while earlier images finish."""
        return self._remote.fills_pool

    def run(self):
        """Render and write; return the exit status."""
        output = Output(self.path, self._options.exposure, self._checkpoint)
        try:
            with interruptions_kept():
                if not self._remote:
                    self._check_file(self._scene.get())
                output.metadata = self._described | {"load_seconds": self._scene.seconds, **command_line.versions()}
                image, took = self._render(output)
            if self._remote:
                output.metadata["workers"] = self._remote.workers
            output.keep(took, image)
            if took.ended_by != "interruption":
                output.write_last()
        except KeyboardInterrupt:
            return output.end_early()
        if took.ended_by == "interruption":
            return output.end_early()
        if self._checkpoint:
            self._checkpoint.remove()
        print(
            f"{self.path}: {self._name}, {took.spp} samples per pixel, {took.seconds:.2f} s{self._error(took)}, ended "
            f"by {took.ended_by}"
        )
        return 0

    def _error(self, took):
        """Return the words for the estimated error, none if it is neither known nor asked for."""
        if took.error is None:
            return ", error unknown (one pass)" if self._options.error else ""
        return f", error {took.error:.2%}"

    def _check_file(self, scene):
        """Raise ValueError before the render if its images have no colour for a PNG file."""
        if self.path.suffix == ".png":
            check_film(scene.sensors()[self._sensor], self._scene.integrator, f"'{self.path}'")

    def _limits(self):
        return {name: getattr(self._options, name) for name in ("error", "time", "spp", "seed", "pass_spp")}

    def _render(self, output):
        """Render with a progress bar, and write from time to time."""
        denoise = self._options.denoise_quality or self._options.denoise
        with ImageBar() as bar, Deadline(output.end_early) as deadline:

            def progress(took, image):
                if took.stage == DENOISING:
                    # An interrupted image is denoised, too, which may take longer than the deadline allows
                    deadline.restart()
                bar.show(took, *([f"{took.passes} passes"] if self._remote else []))
                if image is not None:
                    output.keep(took, image)

            if self._remote:
                return self._remote.render(denoise=denoise, progress=progress, layers=self._options.layers)
            scene = self._scene.get()
            return render(
                scene, self._scene.integrator, self._sensor, denoise=denoise, progress=progress,
                checkpoint=self._checkpoint, layers=self._options.layers, **self._limits(),
            )  # fmt: skip


class Failed:
    """Placeholder for an image whose preparation raised an error."""

    fills_pool = False

    def __init__(self, path, error):
        self.path, self._error = path, error

    def run(self):
        """Raise the error."""
        raise self._error


class Output:
    """Output file of an image; `metadata` is a dict of properties that are known before the render."""

    def __init__(self, path, exposure=None, checkpoint=None):
        self.path, self.metadata, self._exposure, self._checkpoint = path, {}, exposure, checkpoint
        self._image, self._took = None, None
        self._writer = OccasionalWriter("The image so far", WRITE_SECONDS)

    def keep(self, took, image):
        """Take an image, and write it from time to time. Raises ValueError for a PNG file without colour."""
        if self.path.suffix == ".png":
            # The first image by workers, as only they have the scene
            images.check_colour(took.channels, f"'{self.path}'")
        self._image, self._took = np.array(image), took
        self._writer.offer(self.write)

    def end_early(self):
        """Write the last image, report on the standard error what there is, and return the exit status."""
        if self._took is not None:
            resume = "; --resume goes on" if self._checkpoint and self._checkpoint.leave() else ""
            self.write()
            said = f"; wrote {self._took.spp} samples per pixel to {self.path}{resume}"
        elif self._checkpoint and self._checkpoint.path.is_file():
            # Of an earlier process, perhaps with all passes
            said = f" without a new pass; '{self._checkpoint.path}' stays, and --resume goes on from it"
        else:
            said = " before the first pass was finished; nothing was written"
        print(f"manylights: interrupted{said}", file=sys.stderr)
        return INTERRUPTED

    def write_last(self):
        """Write the image of a finished render. If that fails, a checkpoint with all passes stays."""
        try:
            self.write()
        except Exception:
            if self._checkpoint:
                self._checkpoint.leave()
            raise

    def write(self):
        """Write the last image."""
        took, image = self._took, self._image
        metadata = self.metadata | {
            "spp": took.spp,
            "passes": took.passes,
            "render_seconds": took.seconds,
            "estimated_error": took.error,
            "ended_by": took.ended_by,
            "statistics": took.statistics,
        }
        if took.layer_spp is not None:
            metadata["layer_spp"] = took.layer_spp
        if took.raw is not None:
            denoised = metadata | {"denoise_seconds": took.denoise_seconds} | took.denoiser
            if self.path.suffix == ".png":
                metadata = denoised
            else:
                images.write(self.path.with_suffix(".denoised.exr"), image, took.channels, denoised)
                image = np.array(took.raw)
        images.write(self.path, image, took.channels, metadata, self._exposure)
