"""Which passes an image is made of, and which of them are measured: for a time budget, or given samples per pixel."""

from itertools import count

import numpy as np

from .pass_sizes import FIRST_SAMPLES
from .rendering import pass_seed, pass_sizes

LONG_PASS = 60.0  # seconds; with given samples, only small passes compile for passes longer than this
WARM_SPP = 4  # Mitsuba compiles other kernels for passes of fewer samples per pixel, and for no power of two
PASSES_IN_BUDGET = 3  # or about so many; fewer, where starting that many would take more of it than
START_SHARE = 0.3
UNUSED_PASSES = 2**31  # passes that are not in the image are numbered from here, so that they share no lights with it


def measure(progressive, job):
    """Render the passes of a job; return the seconds of the first of all.

    With `job.cold` all are in the image, as for a person who waits for it. Otherwise those that compile kernels are
    not, whatever they take, so that times are warm.
    """
    if job.cold:
        _render_cold(progressive, job)
        return progressive.passes[0].seconds
    unused = (pass_seed(job.seed, index) for index in count(UNUSED_PASSES))
    if job.spp:
        sizes = pass_sizes(job.spp, job.pass_spp or progressive.largest_pass)
        cold = _compile(progressive, sizes, unused)
        progressive.restart()
        for spp in sizes:
            progressive.render(spp)
        return cold
    if job.pass_spp:
        smaller = [WARM_SPP, WARM_SPP + 1] if job.pass_spp > WARM_SPP else []  # which the last pass may be
        cold, (spp, start) = _compile(progressive, [job.pass_spp, *smaller], unused), (job.pass_spp, 0.0)
    else:
        cold = _compile(progressive, [1], unused)
        spp, start = _samples_of_a_pass(progressive, job.budget, unused)
    progressive.restart()
    following = spp
    while following:
        progressive.render(following)
        following = _samples_that_fit(progressive, spp, job.budget, start)
    return cold


def _render_cold(progressive, job):
    """Render the passes of a job from the first on; in a budget their sizes double as long as it has room for more."""
    if job.spp:
        for spp in pass_sizes(job.spp, job.pass_spp or progressive.largest_pass):
            progressive.render(spp)
        return
    first = WARM_SPP if WARM_SPP * progressive.pixels <= FIRST_SAMPLES else 1
    spp, largest = job.pass_spp or first, job.pass_spp or progressive.largest_pass
    least, expected = {}, 0.0  # seconds, by size and of the next pass
    while (left := job.budget - progressive.seconds) > expected / 2:
        seconds, is_first = progressive.render(spp).seconds, spp not in least
        least[spp] = min(seconds, least.get(spp, seconds))
        if is_first:  # it may have compiled, and is repeated
            expected = min(least[spp], 2 * least.get(spp // 2, 0.0))
            continue
        each = seconds / spp
        if seconds < left / 4 and 2 * spp <= largest:
            spp *= 2
        elif seconds > left / 2 and not job.pass_spp:
            spp = max(1, spp // 2)
        expected = least.get(spp, spp * each)


def _compile(progressive, sizes, seeds):
    """Render passes that are in no image, so that those of `sizes` (samples per pixel) find their kernels compiled;
    return the seconds of the first. They are small; where passes take no longer than `LONG_PASS`, those of their own
    size follow, as integrators may do other things for more samples."""
    small = {spp: min(spp, WARM_SPP + (spp & (spp - 1) != 0)) for spp in sizes}  # both powers of two, or neither
    cold, *_ = [progressive.render(spp, next(seeds)).seconds for spp in dict.fromkeys(small.values())]
    for spp in sorted({*sizes} - {*small.values()}):
        seconds = progressive.render(small[spp], next(seeds)).seconds
        if seconds * spp / small[spp] <= LONG_PASS:
            progressive.render(spp, next(seeds))
    return cold


def _samples_that_fit(progressive, spp, budget, start):
    """Return the samples per pixel of the next pass, 0 if the budget is used up: `spp`, or in the last pass as many as
    there is time for, when it has been started in `start` seconds. Fewer than `WARM_SPP` are not worth one, unless
    `spp` is; whether that many are still rendered is decided by what is nearer to the budget."""
    if progressive.passes[-1].spp < spp:
        return 0
    sampling = progressive.seconds - len(progressive.passes) * start
    each, least = max(sampling, 0.1 * progressive.seconds) / progressive.spp, min(spp, WARM_SPP)
    left = budget - progressive.seconds
    if left - start >= least * each:
        return min(spp, int((left - start) / each))
    return least if left > (start + least * each) / 2 else 0


def _samples_of_a_pass(progressive, budget, seeds):
    """Return the samples per pixel of the passes that a budget is divided into, found by rendering some, and the
    seconds that starting one takes.

    Of about `PASSES_IN_BUDGET` passes, or of fewer where starting them (every pass has VPLs of its own, and
    trees) would take more than `START_SHARE` of the time; one sample, and no time to start that is known, if even that
    takes half of the budget.
    """
    largest = progressive.largest_pass
    if largest < WARM_SPP:
        return 1, 0.0
    first = progressive.render(1, next(seeds)).seconds
    if first > budget / 2:
        return 1, 0.0
    for spp in (WARM_SPP, WARM_SPP + 1):
        progressive.render(spp, next(seeds))  # compiles
    more = progressive.render(WARM_SPP, next(seeds)).seconds - first
    each = max(more, 0.01 * first) / (WARM_SPP - 1)
    start = max(first - each, 0)
    affordable = START_SHARE * budget / start if start > 0 else PASSES_IN_BUDGET
    seconds = budget / np.clip(int(affordable), 1, PASSES_IN_BUDGET)  # of one pass
    spp = int(np.clip((seconds - start) / each, 1, largest))
    for _ in range(3):
        taken = progressive.render(spp, next(seeds)).seconds
        if taken > 1.1 * seconds:  # it may have compiled, as integrators do other things for more samples
            taken = progressive.render(spp, next(seeds)).seconds
        if taken <= 1.1 * seconds:
            break
        spp = max(int(spp * seconds / taken), 1)
    return spp, start
