"""Division of an image into passes, for a time budget or a number of samples per pixel; warm-up passes."""

from itertools import count

import numpy as np

from vpl.direct.environment_regions import forget_regions

from .pass_sizes import FIRST_SAMPLES
from .single_pass import pass_seed, pass_sizes
from .timed_sizes import sizes_of

LONG_PASS = 60.0  # seconds; with given samples, passes longer than this are warmed up by small passes alone
WARM_SPP = 4  # Mitsuba compiles different kernels below this number, and for numbers other than powers of two
PASSES_IN_BUDGET = 3  # target number; fewer if starting them would exceed this share of the budget:
START_SHARE = 0.3
UNUSED_PASSES = 2**31  # first number of warm-up passes, which must not share lights with passes of the image


def measure(progressive, job):
    """Render the passes of a job; return the seconds of the first pass, including compilation.

    With `job.cold` the image includes all passes. Otherwise warm-up passes compile the kernels first and are excluded
    from image and time, whatever they take.
    """
    if job.cold:
        _render_cold(progressive, job)
        return progressive.passes[0].seconds
    unused = (pass_seed(job.seed, index) for index in count(UNUSED_PASSES))
    if progressive.in_parts and not job.spp and not job.pass_spp:
        # Once to compile the kernels of all sizes
        _render_in_time(progressive, job.budget, unused)
        cold = progressive.passes[0].seconds
        _begin(progressive)
        _render_in_time(progressive, job.budget)
        return cold
    if job.spp:
        sizes = _sizes_of_samples(progressive, job)
        cold = _compile(progressive, sizes, unused)
        _begin(progressive)
        for spp in sizes:
            progressive.render(spp)
        return cold
    if job.pass_spp:
        smaller = [WARM_SPP, WARM_SPP + 1] if job.pass_spp > WARM_SPP else []  # possible sizes of the last pass
        cold, (spp, start) = _compile(progressive, [job.pass_spp, *smaller], unused), (job.pass_spp, 0.0)
    else:
        cold = _compile(progressive, [1], unused)
        spp, start = _samples_of_a_pass(progressive, job.budget, unused)
    _begin(progressive)
    following = spp
    while following:
        progressive.render(following)
        following = _samples_that_fit(progressive, spp, job.budget, start)
    return cold


def _begin(progressive):
    """Begin a render without what warm-up passes have learned; compiled kernels remain."""
    progressive.restart()
    forget_regions()


def _sizes_of_samples(progressive, job):
    """Return the sizes of the passes of a job with a number of samples per pixel: `job.pass_spp`, or the largest size
    that the sampler does not round up. Otherwise the image would have more samples than the job asks for."""
    largest, least = job.pass_spp or progressive.largest_pass, progressive.parts**2
    while not job.pass_spp and least < largest < job.spp and not progressive.accepts(largest):
        largest -= 1
    return pass_sizes(job.spp, largest)


def _render_in_time(progressive, budget, seeds=None):
    """Render passes in parts within a `budget` in seconds, of the sizes that `render` uses with a limit of time."""
    sizes = sizes_of(progressive, time=budget)
    while not isinstance(spp := sizes.next(progressive.passes, progressive.seconds), str):
        seed = next(seeds) if seeds else None
        progressive.render(spp, seed, is_probe=sizes.is_probe, is_last=sizes.is_last)


def _render_cold(progressive, job):
    """Render the passes of a job from the first; with a time budget, double their sizes while the budget allows."""
    if job.spp:
        for spp in _sizes_of_samples(progressive, job):
            progressive.render(spp)
        return
    first = WARM_SPP if WARM_SPP * progressive.pixels <= FIRST_SAMPLES else 1
    spp, largest = job.pass_spp or first, job.pass_spp or progressive.largest_pass
    least, expected = {}, 0.0  # seconds: minimum by size, and expectation for the next pass
    while (left := job.budget - progressive.seconds) > expected / 2:
        one, is_first = progressive.render(spp), spp not in least
        spp, seconds = one.spp, one.seconds
        least[spp] = min(seconds, least.get(spp, seconds))
        if is_first:  # may include compilation; repeat it
            expected = min(least[spp], 2 * least.get(spp // 2, 0.0))
            continue
        each = seconds / spp
        if seconds < left / 4 and 2 * spp <= largest:
            spp *= 2
        elif seconds > left / 2 and not job.pass_spp:
            spp = max(1, spp // 2)
        expected = least.get(spp, spp * each)


def _compile(progressive, sizes, seeds):
    """Render warm-up passes that compile the kernels for passes of `sizes` (samples per pixel); return the seconds of
    the first. Small passes come first. Full-size passes follow if they take at most `LONG_PASS`, unless they have the
    kernels of the small ones."""
    least = progressive.parts**2  # samples of a pass of a fine film
    # Keeps "is a power of two"
    small = {spp: min(spp, least * (WARM_SPP + (spp & (spp - 1) != 0))) for spp in sizes}
    cold, *_ = [progressive.render(spp, next(seeds)).seconds for spp in dict.fromkeys(small.values())]
    for spp in [] if progressive.shares_kernels else sorted({*sizes} - {*small.values()}):
        seconds = progressive.render(small[spp], next(seeds)).seconds
        if seconds * spp / small[spp] <= LONG_PASS:
            progressive.render(spp, next(seeds))
    return cold


def _samples_that_fit(progressive, spp, budget, start):
    """Return the samples per pixel of the next pass, 0 at the end of the budget. `start`: seconds to start a pass.

    The last pass has as many samples as still fit. Below `WARM_SPP` (or `spp`, if smaller) it renders this minimum if
    that ends closer to the budget than stopping does.
    """
    if progressive.passes[-1].spp < spp:
        return 0
    sampling = progressive.seconds - len(progressive.passes) * start
    each, least = max(sampling, 0.1 * progressive.seconds) / progressive.spp, min(spp, WARM_SPP)
    left = budget - progressive.seconds
    if left - start >= least * each:
        return min(spp, int((left - start) / each))
    return least if left > (start + least * each) / 2 else 0


def _samples_of_a_pass(progressive, budget, seeds):
    """Return the samples per pixel of each pass of a budget, from trial passes, and the seconds to start a pass.

    Aims at `PASSES_IN_BUDGET` passes, or fewer if starting them (each pass traces VPLs and builds trees) would take
    more than `START_SHARE` of the budget. If one sample already takes half of the budget, or a pass may have no more,
    returns one sample and an unknown start of 0 s.
    """
    largest, one = progressive.largest_pass, progressive.render(1, next(seeds))
    # A fine film has more than one sample for a pixel
    few = min(WARM_SPP * one.spp, largest)
    if one.seconds > budget / 2 or few <= one.spp:
        return one.spp, 0.0
    for spp in dict.fromkeys((few, min(few + 1, largest))):
        progressive.render(spp, next(seeds))  # compiles
    more = progressive.render(few, next(seeds))
    each = max(more.seconds - one.seconds, 0.01 * one.seconds) / (more.spp - one.spp)
    start = max(one.seconds - one.spp * each, 0)
    affordable = START_SHARE * budget / start if start > 0 else PASSES_IN_BUDGET
    seconds = budget / np.clip(int(affordable), 1, PASSES_IN_BUDGET)  # per pass
    spp = int(np.clip((seconds - start) / each, 1, largest))
    for _ in range(3):
        taken = progressive.render(spp, next(seeds)).seconds
        if taken > 1.1 * seconds:  # may include the compilation of other kernels; repeat it
            taken = progressive.render(spp, next(seeds)).seconds
        if taken <= 1.1 * seconds:
            break
        spp = max(int(spp * seconds / taken), 1)
    return spp, start
