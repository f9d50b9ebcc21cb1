"""Progressive rendering: passes with different seeds, and their average."""

import math

import numpy as np

from vpl.core.sampling import derived_seed
from vpl.split.pixel_rays import Continued

from .convergence import ErrorEstimate
from .fine_film import merged
from .images import colour
from .sample_density import LEAST_SAMPLES, SampleDensity
from .single_pass import SharedStart, largest_pass, pass_seed, render_pass, sample_count

# Camera rays for a second of a limit: a low estimate, so that the pilot of `manylights` takes little of the limit
# (kitchen: 900 000 rays in a second on two cores)
_RAYS_PER_SECOND = 100_000
# The same for what `manylights` learns of the emitters, about as many as a render has: denoised images of 5 seconds,
# error over that with learning for 16 samples: geometric mean of seven scenes 0.97 (decisions.md)
_LEARNING_PER_SECOND = 600_000
# Seed of the lattices that passes share, of the seed of the render
_CONTINUED_STREAM = 0x5EC0


class Passes:
    """Running average of the passes of a render by their weights (`Pass.weight`).

    The average depends only on the passes and their order. `parts`, `filter`: of the film that passes are rendered
    with, see fine_film.py. `channels`: names of the channels ("R", "G", "B", AOVs), empty before the first pass;
    `passes`: a list of `Pass`; `estimate`: the `ErrorEstimate` of the passes; `keeps_halves`: whether there is an
    average of each of two halves of the passes, for the detail of denoised images (detail.py). It is set before the
    first pass.
    """

    keeps_halves = False

    def __init__(self, seed, parts=1, filter=None):
        self.seed, self.parts, self.filter = seed, parts, filter
        self.restart()

    def restart(self):
        """Remove all passes."""
        self.passes, self.channels, self.sum, self.estimate = [], [], 0.0, ErrorEstimate()
        self.first_sum = 0.0  # of the passes of the first half; None for passes of a checkpoint without halves
        self._image = 0, None  # number of passes, and their average in the resolution of the sensor's film

    def add(self, image):
        """Add a `PassImage`, and return its `Pass`."""
        # In double precision, as long sums of single-precision numbers drift
        planes, one = image.planes.astype(np.float64), image.taken
        self.channels = image.channels
        self.sum = self.sum + one.weight * planes
        if self.has_halves and _lighter(self.half_weights) == 0:
            self.first_sum = self.first_sum + one.weight * planes
        if self.has_error:
            level = _shown(planes, self.channels).mean(axis=-1, keepdims=True)
            self.estimate.add(self.merged(level), one.weight)
        self.passes.append(one)
        return one

    @property
    def decisions(self):
        """Arrays by name that later passes depend on, besides the passes (settable)."""
        return {}

    @decisions.setter
    def decisions(self, arrays):
        """Take nothing: these passes depend on nothing else."""

    @property
    def has_error(self):
        """Whether the passes tell the error of the image."""
        return True

    def error(self):
        """Return the relative standard error, as `ErrorEstimate.relative`; None if the passes do not tell it."""
        return self.estimate.relative() if self.has_error else None

    @property
    def spp(self):
        """Samples per pixel of all passes."""
        return sum(one.spp for one in self.passes)

    @property
    def seconds(self):
        """Sum of the wall-clock seconds of all passes."""
        return sum(one.seconds for one in self.passes)

    @property
    def has_halves(self):
        """Whether the averages of the halves are known."""
        return self.keeps_halves and self.first_sum is not None

    @property
    def half_weights(self):
        """Weights of the two halves of the passes: a pass belongs to the half with the smaller weight before."""
        weights = [0.0, 0.0]
        for one in self.passes:
            weights[_lighter(weights)] += one.weight
        return weights

    @property
    def fine_halves(self):
        """The averages of the halves, in the form of `fine_image`, of at least two passes."""
        first, second = self.half_weights
        return [self.first_sum / first, (self.sum - self.first_sum) / second]

    @property
    def fine_image(self):
        """The average in the resolution of the film, (height, width, channels) float64."""
        return self.sum / sum(one.weight for one in self.passes)

    @property
    def image(self):
        """The average, (height, width, channels) float64, or float32 from a fine film."""
        if self.parts == 1:
            return self.fine_image
        if self._image[0] != len(self.passes):
            # Once: the filter takes 0.6 s for 1920 × 1080 pixels, 1.0 s in double precision
            self._image = len(self.passes), self.merged(np.float32(self.fine_image))
        return self._image[1]

    def merged(self, planes):
        """Return the image in the resolution of the sensor's film, from that in the resolution of the passes."""
        return merged(planes, self.parts, self.filter)


class Progressive(Passes):
    """Running average of passes in this process. `integrator` is by default the scene's; `denoise`: see
    `SampleDensity`, for an image that will be denoised; `parts`: see fine_film.py; `seconds`, `spp`: limits of the
    render, or None. `shares_lattices`: whether the samples of later passes continue those of earlier ones where pixels
    have equal numbers of samples. The estimated error, which takes passes for independent, is then an upper estimate.
    It is set before the first pass."""

    shares_lattices = False

    def __init__(self, scene, seed, sensor=0, integrator=None, denoise=None, parts=1, seconds=None, spp=None):
        self._scene, self._sensor, self._denoise = scene, sensor, denoise
        most = spp * self.pixels if spp else math.inf
        per_second = {"rays": _RAYS_PER_SECOND, "learning": _LEARNING_PER_SECOND}
        self._rays = {name: int(min(rays * (seconds or 0), most)) for name, rays in per_second.items()}
        self.integrator = integrator or scene.integrator()
        super().__init__(seed, parts, scene.sensors()[sensor].film().rfilter())

    def restart(self):
        """Remove all passes and what they share."""
        super().restart()
        self._shared, self.density = SharedStart(**self._rays), SampleDensity(self._denoise, self.parts)

    def render(self, spp, seed=None, accept=lambda: True, is_probe=False, is_last=False):
        """Render and add a pass of `spp` samples per pixel; return the `Pass`.

        The default `seed` is `pass_seed(seed of the render, index of the pass)`. `is_probe`: whether the pass
        determines the samples of the pixels in later passes; `is_last`: whether it will probably end the render. If the
        pass raises an exception, or `accept` returns False afterwards (the result is then None), the average does not
        change.
        """
        seed = pass_seed(self.seed, len(self.passes)) if seed is None else seed
        first = (self.passes[0].spp, self.passes[0].seed) if self.passes else None
        sensor = self._scene.sensors()[self._sensor]
        density = self.density.of_pass(self.integrator, sensor, spp)
        half = is_probe and self.density.suits_probe(self.integrator, sensor, spp)
        continued = self._continued(sensor, density, is_last)
        image = render_pass(
            self._scene, self._sensor, self.integrator, spp, seed, first, self._shared, density=density, half=half,
            parts=self.parts, continued=continued, measures=self._may_compile,
        )  # fmt: skip
        if not accept():
            return None
        if half:
            self.density.learn(*(self.merged(one) for one in (image.planes, image.half)), image.channels)
        return self.add(image)

    @property
    def _may_compile(self):
        """Whether the next pass may compile much: it is the first one, or the pass before it compiled kernels."""
        return not self.passes or bool(self.passes[-1].compile_seconds)

    def _continued(self, sensor, density, is_last):
        """Return the passes so far whose lattices a pass continues, None for lattices of its own. `density`: samples of
        pixels over their mean, None for equal numbers."""
        if density is not None:
            # The first two passes determine the numbers, and small passes have equal ones
            earlier = (one.spp for one in self.passes[2:] if self.density.suits(self.integrator, sensor, one.spp))
        elif self._shares(is_last):
            earlier = (one.spp for one in self.passes[1:])
        else:
            return None
        return Continued(sum(earlier), derived_seed(self.seed, _CONTINUED_STREAM))

    def _shares(self, is_last):
        """Return whether a pass with equal numbers of samples shares lattices: not the first one, which is small, nor a
        second one that is the last. A lattice of its own is more even."""
        alone = not self.passes or (is_last and len(self.passes) == 1)
        return self.shares_lattices and not alone and getattr(self.integrator, "may_continue", False)

    def accepts(self, spp):
        """Return whether the sampler keeps a number of samples per pixel, which some samplers round up, and whether
        pixels may have the different numbers of samples that the render has determined."""
        cells, multiple = self.parts**2, self.density.multiple
        with sample_count(self._scene.sensors()[self._sensor].sampler(), -(-spp // cells)) as rounded:
            is_multiple = spp % multiple == 0 or spp < multiple or self.density.relative is None
            return cells * rounded == spp and is_multiple

    @property
    def seconds(self):
        """Sum of the wall-clock seconds of all passes, and of the decision on the samples of pixels."""
        return super().seconds + self.density.seconds

    @property
    def differs(self):
        """Whether pixels may have different numbers of samples after the second pass."""
        suits = self.density.suits(self.integrator, self._scene.sensors()[self._sensor])
        return suits and self.largest_pass >= max(LEAST_SAMPLES, self.density.multiple)

    @property
    def decisions(self):
        """Samples of pixels over their mean, if they differ."""
        return {} if self.density.relative is None else {"density": self.density.relative}

    @decisions.setter
    def decisions(self, arrays):
        self.density.relative = arrays.get("density")

    @property
    def has_error(self):
        """Whether pixels have equal numbers of samples, so that a common weight describes the precision of a pass."""
        return self.density.relative is None

    def should_stop(self):
        """Return whether the integrator's `cancel` was called."""
        return self.integrator.should_stop()

    def is_late(self):
        """Return False: passes in this process are never refused for lack of time."""
        return False

    @property
    def in_parts(self):
        """Whether passes are rendered in parts: a pass can stop between parts, and needs little memory per sample."""
        return getattr(self.integrator, "renders_in_parts", False)

    @property
    def largest_pass(self):
        """Maximum samples per pixel of a pass, whatever its time."""
        return largest_pass(self.pixels, self.in_parts, self._in_one_kernel)

    @property
    def _in_one_kernel(self):
        # Plugins of this project have the attribute, and most of them store arrays for each sample. Passes of Mitsuba's
        # integrators are single kernels, as comparisons have no nested integrators
        return not hasattr(self.integrator, "renders_in_parts")

    @property
    def shares_kernels(self):
        """Whether passes of four samples or more have equal kernels, except that a power of two has others: those of
        Mitsuba's integrators with the sampler `independent`. Kernels of other samplers contain the number of
        samples."""
        if not self._in_one_kernel:
            return False
        return self._scene.sensors()[self._sensor].sampler().class_name() == "IndependentSampler"

    @property
    def pixels(self):
        """Number of pixels of the image."""
        return int(np.prod(self._scene.sensors()[self._sensor].film().crop_size()))


def _lighter(weights):
    """Return the index of the smaller one of two weights, 0 if they are equal."""
    return int(weights[1] < weights[0])


def _shown(planes, channels):
    """Return the colour of an image, or all channels if the film has no colour."""
    try:
        return colour(planes, channels)
    except ValueError:
        return planes
