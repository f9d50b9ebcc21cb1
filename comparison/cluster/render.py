"""Images in passes on the workers of a pool; the counterpart of `comparison.render.render`."""

import math
import time as clock

from ..denoising import Denoiser, quality_of
from ..ending import Ending, checked
from ..features import check_layers, hides_emitters, layers_of
from ..pass_sizes import PassSizes
from ..render import render_passes
from ..single_pass import check_film
from .passes import DistributedPasses, samples_of_a_pass
from .pool import TASKS_PER_WORKER
from .scene_travel import bundle


class DistributedRender:
    """Image whose passes idle workers begin while earlier images finish.

    `scene`: a `LazyScene`. The other parameters are those of `comparison.render.render`, but passes have a fixed size:
    `pass_spp`, or the result of `samples_of_a_pass`. Raises ValueError for a sensor that does not exist, and for a
    checkpoint of another render.
    """

    def __init__(
        self, pool, scene, sensor=0, *, error=None, time=None, spp=None, seed=0, pass_spp=None, checkpoint=None,
    ):  # fmt: skip
        error, time, spp, pass_spp = checked(error=error, time=time, spp=spp, pass_spp=pass_spp)
        pixels, sampler = scene.file.sampling(sensor)
        if error is None and time is None and spp is None:
            spp = sampler.sample_count()
        self.spp, self._error, self._time, self._checkpoint = spp, error, time, checkpoint
        self._scene, self._sensor, self._seed, self._pool = scene, sensor, seed, pool
        self._pass_spp = pass_spp or samples_of_a_pass(pixels, spp)
        travelling = bundle(scene.file)
        self.passes = DistributedPasses(pool, travelling, seed, sensor, pixels, sampler, self._pass_spp, spp)
        self._seconds = checkpoint.restore(self.passes) if checkpoint else 0.0
        self.passes.start()

    @property
    def fills_pool(self):
        """Whether the image has enough passes for all workers while earlier images finish."""
        wanted = TASKS_PER_WORKER * len(self._pool.workers)
        return self.spp is None or math.ceil(self.spp / self._pass_spp) >= wanted

    @property
    def workers(self):
        """Number of passes of each worker, by address."""
        return dict(self.passes.workers)

    def render(self, denoise=False, progress=None, layers=()):
        """Render; return the image and the cost, as `comparison.render.render` does. Raises ClusterError if the workers
        fail."""
        begin = clock.perf_counter() - self._seconds
        try:
            scene = self._scene.get() if denoise or layers else None
            if layers:
                check_layers(layers, self._scene.integrator)
            if denoise:
                check_film(scene.sensors()[self._sensor], self._scene.integrator, "denoise")
            of_image = {"seed": self._seed, "spp": self.spp, "time_limit": self._time}
            if scene:
                of_image["hide_emitters"] = hides_emitters(self._scene.integrator)
            denoiser = Denoiser(scene, self._sensor, **of_image, quality=quality_of(denoise)) if denoise else None
            self.passes.keeps_halves = bool(denoiser) and denoiser.restores
            planes = layers_of(layers, scene, self._sensor, denoiser, **of_image)
            reserved = denoiser.expected_seconds if denoiser else 0.0
            ending = Ending(self.spp, self._time and self._time - reserved, self._error, reserved)
            if self._time:
                self.passes.deadline = begin + self._time - reserved
            sizes = PassSizes(self.passes.pixels, self.spp, fixed=self._pass_spp)
            return render_passes(self.passes, sizes, ending, begin, progress, denoiser, self._checkpoint, planes)
        finally:
            self.close()

    def close(self):
        """Drop the passes that are not finished."""
        self.passes.close()
