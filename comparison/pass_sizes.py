"""Samples per pixel of the next pass of a render.

Without a limit of time the sizes follow from the numbers of pixels and samples alone, so that the image does not depend
on the speed of the machine. The first pass is small, so that an image appears soon. Later passes in parts, which can be
stopped between parts, have the largest size: large passes are the most efficient, as virtual lights pay only from a
certain size, and samples are stratified within a pass. Passes that are not in parts double the number of samples, so
that each takes about as long as all passes before it. Renders that end by error have at least eight passes of similar
sizes. With a limit of time the speed of the machine counts as well (timed_sizes.py).

In images that will be denoised, the second pass may determine the samples of the pixels in later passes, if some 60
samples or more are expected in all. It is then small, because its own pixels have equal numbers.

Sizes of passes that are not in parts, or end by error, are powers of two, from 4 if the number of pixels allows:
Mitsuba compiles a single kernel for these sizes, but other kernels for sizes between, and, with some film filters,
below 4. Sizes of passes in parts may be any number: `manylights` needs a single further kernel for them.
"""

import math

from .sample_density import LEAST_SAMPLES
from .single_pass import largest_pass

USUAL = 4  # samples per pixel; all powers of two from here have the same kernels
FIRST_SAMPLES = 2**19  # maximum pixel samples of a first pass, unless one per pixel is more
PARTS = 8  # with an error limit, a pass has at most this fraction, 1/8, of the samples so far
# Least samples per pixel of a render with a pass that determines samples. Error of images of 40 and 80 samples with
# one, over that of a single pass, which is stratified as a whole and may have virtual lights (decisions.md): 1.11, 0.98
LEAST_PROBED = 60
PROBE = 0.25  # fraction of the remaining samples, or time, for a pass that determines the samples of the pixels


class PassSizes:
    """Sizes of the passes of an image of `pixels` pixels, up to `spp` samples per pixel (None: no limit).

    `fixed`: size of all passes except the last, or None. `many`: at least eight passes of similar sizes, for an
    estimate of the error. `in_parts`: whether passes are rendered in parts. `accepts`: whether the sampler keeps a
    number of samples per pixel. `probes`: whether the second pass determines the samples of the pixels in later passes;
    its samples are then a multiple of `multiple`. `least`: minimum size.
    """

    def __init__(
        self, pixels, spp=None, fixed=None, many=False, in_parts=False, accepts=lambda spp: True, probes=False,
        multiple=1, least=1,
    ):  # fmt: skip
        self._spp, self._fixed, self._many, self._in_parts = spp, fixed, many, in_parts
        self._any_size = in_parts and not many and not fixed  # after the first pass, not only powers of two
        self._accepts, self._probes = accepts, probes and self._any_size
        # Whether the last pass that was asked for determines the samples of pixels, and will probably end the render
        self.is_probe = self.is_last = False
        self._minimum, self._multiple, self._least_probe = least, multiple, max(LEAST_SAMPLES, multiple)
        self._largest = max(power_of_two(largest_pass(pixels, in_parts)), least)
        self._least = max(USUAL if USUAL * pixels <= FIRST_SAMPLES else 1, least)

    def next(self, passes, elapsed):
        """Return the samples per pixel of the pass after `passes` (list of `Pass`) and `elapsed` seconds, or "spp" if
        this limit ends the render."""
        done = sum(one.spp for one in passes)
        if self._spp is not None and done >= self._spp:
            return "spp"
        self.is_probe = self._probes and len(passes) == 1 and self._expected_samples(done, elapsed) >= LEAST_PROBED
        size = self._size(passes, done, elapsed)
        if self.is_probe and size < self._least_probe:
            # Too few for the halves of a pass: a pass of the usual size
            self.is_probe = False
            size = self._size(passes, done, elapsed)
        size = size - size % self._multiple if self.is_probe else size
        self.is_last = self._spp is not None and size >= self._spp - done
        return size

    def _expected_samples(self, done, elapsed):
        """Return the expected samples per pixel of the render, of which `done` are rendered."""
        return math.inf if self._spp is None else self._spp

    def _size(self, passes, done, elapsed):
        """Return the size of the next pass."""
        size = self._intended(done)
        return size if self._spp is None else self._of_the_rest(size, self._spp - done)

    def _intended(self, done):
        """Return the size of a pass after `done` samples, whatever is left."""
        if self._fixed or not done:
            return self._fixed or self._least
        if self._any_size:
            return self._kept(self._largest)
        return min(power_of_two(max(done / PARTS if self._many else done, USUAL)), self._largest)

    def _of_the_rest(self, size, left):
        """Return the size of the next pass, about `size` samples, with `left` samples until the limit."""
        if self.is_probe:
            return min(size, self._kept(int(PROBE * left)))
        if self._any_size and left < 2 * size and left <= self._largest:
            return self._kept(left) if self._probes else left
        if self._any_size and size < left < 2 * size:
            # No small pass at the end, if the sampler keeps a half
            return next(filter(self._accepts, range(-(-left // 2), size)), size)
        return min(size, left if self._fixed or left < USUAL else power_of_two(left))

    def _kept(self, size):
        """Return the largest size up to `size` that the sampler keeps."""
        while size > 1 and not self._accepts(size):
            size -= 1
        return size


def power_of_two(number):
    """Return the largest power of two up to a number, at least 1."""
    return 2 ** math.floor(math.log2(number)) if number >= 1 else 1
