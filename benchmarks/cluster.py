"""Overhead of passes on workers: against a single process, per pass, and as idle time of the workers.

    python benchmarks/cluster.py --parts speed overhead busy

`speed`: seconds of an image by a process with two threads, and by two workers with one thread each; compiled kernels.
`overhead`: seconds of an empty pass, with and without the transfer of an image.
`busy`: fraction of the time during which simulated workers, whose passes sleep, are busy.
"""

import argparse
import statistics
import sys
import time
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import manylights
from comparison.cluster import passes
from comparison.cluster.connection import connected
from comparison.cluster.pool import TASKS_PER_WORKER, Task
from comparison.cluster.render import DistributedRender
from comparison.one_image import LazyScene
from comparison.scene_files import SceneFile
from comparison.single_pass import Pass, PassImage

ROOT = Path(__file__).resolve().parent.parent
SECONDS, PASSES = 0.5, 20  # per sleeping pass; per worker


def sleeping_pass(shape, seconds, spp, seed):
    """Replacement of `worker.render_pass` that sleeps for some seconds and returns a black image of this shape."""
    time.sleep(seconds)
    return PassImage(np.zeros(shape, np.float32), ["R", "G", "B"], Pass(seed, spp, seconds))


class Sleeping(passes.DistributedPasses):
    """Sleeping passes of an image of this shape (height, width, channels)."""

    def __init__(self, pool, shape, seconds, count):
        sampler = mi.load_dict({"type": "independent"})
        super().__init__(pool, None, 0, 0, shape[0] * shape[1], sampler, 1, count)
        self._function = partial(sleeping_pass, shape, seconds)
        self._function.__name__ = "sleep"

    def next_task(self, queued):
        """Return the task of `DistributedPasses` with the sleeping function."""
        task = super().next_task(queued)
        return task and Task(self, task.name, self._function, task.arguments[2:])


def run(pool, shape, seconds, count):
    """Return the wall-clock seconds of passes on the workers of a pool, and the CPU seconds of this process."""
    sleeping = Sleeping(pool, shape, seconds, count)
    sleeping.start()
    begin, used = time.perf_counter(), time.process_time()
    for _ in range(count):
        sleeping.render(1)
    sleeping.close()
    return time.perf_counter() - begin, time.process_time() - used


def speed(options):
    """Print times of two workers with a thread each, and of a process with two threads."""
    for name in options.scenes:
        print(f"{Path(name).stem}, {options.integrator}, {options.passes} passes of {options.spp} samples per pixel")

        def prepared(name=name):
            file = SceneFile(name, {"resx": str(options.width), "resy": str(options.width)} if options.width else {})
            file.set_integrator(options.integrator)
            return file

        samples = {"seed": 1, "pass_spp": options.spp, "spp": options.spp * options.passes}
        scene, times = prepared().load(2), {"one process": [], "two workers": []}
        with connected(2, 2) as pool:
            for repetition in range(options.repetitions + 1):
                here = manylights.render(scene, **samples)[1].seconds
                there = DistributedRender(pool, LazyScene(prepared()), **samples).render()[1].seconds
                if repetition:  # the first one compiles
                    times["one process"].append(here)
                    times["two workers"].append(there)
        here, there = map(statistics.median, times.values())
        print(f"  one process × 2 threads {here:.2f} s, 2 workers × 1 thread {there:.2f} s: {here / there:.2f}")


def overhead(_):
    """Print the overhead of a pass beyond rendering."""
    with connected(1, 1) as pool:
        run(pool, (1, 1, 3), 0, 10)
        for shape in ((1, 1, 3), (512, 512, 3), (1080, 1920, 3)):
            taken, used = (1000 * seconds / 40 for seconds in run(pool, shape, 0, 40))
            print(f"  image {shape[1]} × {shape[0]}: {taken:.1f} ms per pass, of which {used:.1f} ms client CPU")


def busy(_):
    """Print the busy fraction of sleeping workers."""
    for count in (2, 8, 16):
        with connected(count, count) as pool:
            run(pool, (1, 1, 3), 0, count * TASKS_PER_WORKER)
            for shape in ((1, 1, 3), (256, 256, 3)):
                taken, _ = run(pool, shape, SECONDS, count * PASSES)
                print(f"  {count} workers, {shape[1]} × {shape[0]}: busy {SECONDS * PASSES / taken:.0%}")


PARTS = {"speed": speed, "overhead": overhead, "busy": busy}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS), help="default: all")
    parser.add_argument("--scenes", nargs="+", default=[str(ROOT / "scenes" / "hall.xml")])
    parser.add_argument("--integrator", default="manylights")
    parser.add_argument("--width", type=int, help="width and height (default: of the scene)")
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel of a pass (default: 16)")
    parser.add_argument("--passes", type=int, default=8, help="default: 8")
    parser.add_argument("--repetitions", type=int, default=3, help="default: 3, after a warm-up run")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for part in options.parts:
        print(part)
        PARTS[part](options)


if __name__ == "__main__":
    main()
