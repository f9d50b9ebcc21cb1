"""Render and measure one integrator on one scene, in a process of its own: `python -m comparison.worker`.

In a fresh process with an empty kernel cache the first pass is honestly cold, the memory's peak is this integrator's,
and a crash loses nothing else. The job is a line of JSON on the standard input (see `Job`), the result one on the
standard output (see `run`): a pipe has room where the disk has none.
"""

import hashlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from . import images, machine
from .command_line import failure, set_variant, versions
from .denoising import Denoiser
from .measuring import measure
from .rendering import Progressive, total_statistics
from .scene_files import SceneFile

ROOT = Path(__file__).resolve().parent.parent
TICK = 0.5  # seconds


@dataclass
class Job:
    """Render to make: either for `budget` seconds or with `spp` samples per pixel, in passes of `pass_spp` (None
    chooses). `output` is the EXR file to write, which `run` is noted in. `vpl_folder`, if given, is where to keep the
    same passes rendered by `vpl`, with the same VPLs: once for all jobs that share them. `kernel_cache` is the folder
    of compiled kernels, a fresh one if None. `cold` asks for times that include compilation. `denoised_output`, if
    given, is the EXR file for the denoised image."""

    label: str
    integrator: str
    scene: str
    output: str
    variant: str = "llvm_ad_rgb"
    parameters: dict = field(default_factory=dict)
    defines: dict = field(default_factory=dict)
    width: int | None = None
    max_depth: int | None = None
    seed: int = 0
    budget: float | None = None
    spp: int | None = None
    pass_spp: int | None = None
    threads: int | None = None
    vpl_folder: str | None = None
    denoised_output: str | None = None
    kernel_cache: str | None = None
    cold: bool = False
    run: str | None = None


def run(job, tick=lambda: None):
    """Run a job in a new process and return its result: a dict with the keys of the job that identify it, and

    `width`, `height`; `load_seconds`; `load_average` (before the run, see machine.load); `cold_seconds` (the first
    pass, compilation included; None if the kernel cache was not empty); `warm_seconds` (mean of the later passes that
    are in the image, None if there are none); `seconds`, `spp`, `passes` (of the image); `pass_spp`; `cold_pass_kept`
    (whether the first pass is in the image, as `cold` asks for); `peak_memory_bytes`; `statistics` (the integrator's
    counters, added up, {} if it has none); `rays_per_sample`, `bounds_per_sample`, `cut_size_per_sample` (per pixel
    sample, None if not counted); `vpl_output` (the EXR file with what `vpl` made of the same passes, None if not asked
    for); `denoise_seconds` and `cold_denoise_seconds` (what denoising takes beyond that, the second time and,
    compilation included, the first; None if not asked for).

    After a failure it holds `error` (one line) and `traceback` instead. `tick` is called every half second. The process
    ends with this one, even if this one is killed.
    """
    result = asdict(job) | {"load_average": machine.load()}
    try:
        return result | _in_new_process(job, tick)
    except OSError as error:
        return result | failure(error)


def _in_new_process(job, tick):
    """Return what `run` adds to a job. Raises OSError where there cannot be a process, or a folder for its kernels."""
    cache = nullcontext(job.kernel_cache) if job.kernel_cache else tempfile.TemporaryDirectory(prefix="manylights-")
    with cache as kernels:
        Path(kernels).mkdir(parents=True, exist_ok=True)
        is_cold = not any(Path(kernels).iterdir())
        environment = os.environ | {"DRJIT_CACHE_DIR": str(kernels)}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        # In a session of its own, so that Ctrl-C is for this process alone, which then ends that one.
        process = subprocess.Popen(
            [sys.executable, "-m", "comparison.worker"],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        status, answer = _ask(process, job, tick)
    if answer:
        result = json.loads(answer)
        return result if is_cold or "error" in result else result | {"cold_seconds": None}
    ended = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
    return {"error": f"the renderer {ended}", "traceback": ""}


def _ask(process, job, tick):
    """Give a process its job; return its status and its answer when it has ended, which it also does if this one is
    interrupted."""
    try:
        with suppress(BrokenPipeError):  # it has ended already, as its status tells
            process.stdin.write(json.dumps(asdict(job)).encode() + b"\n")
            process.stdin.flush()
        while not select.select([process.stdout], [], [], TICK)[0]:
            tick()
        answer = process.stdout.read()
        return process.wait(), answer
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        with suppress(BrokenPipeError):
            process.stdin.close()


def render(job):
    """Do a job in this process; return the measurements (see `run`)."""
    set_variant(job.variant)
    begin = time.perf_counter()
    file = _parse(job)
    parameters, scene = file.integrator[1], file.load(job.threads)
    load_seconds = time.perf_counter() - begin

    progressive = Progressive(scene, job.seed)
    cold = measure(progressive, job)
    passes, spp, pixels = progressive.passes, progressive.spp, progressive.pixels
    warm = [one.seconds for one in passes[1 if job.cold else 0 :]]
    statistics = total_statistics(passes)
    result = {
        "parameters": parameters,
        "height": progressive.image.shape[0],
        "width": progressive.image.shape[1],
        "load_seconds": load_seconds,
        "cold_seconds": cold,
        "warm_seconds": sum(warm) / len(warm) if warm else None,
        "seconds": progressive.seconds,
        "spp": spp,
        "passes": len(passes),
        "pass_spp": max(one.spp for one in passes),
        "cold_pass_kept": job.cold,
        "peak_memory_bytes": _peak_memory(),
        "statistics": statistics,
    }
    for key, counter in (("rays", "shadow_rays"), ("bounds", "bound_computations"), ("cut_size", "cut_size")):
        result[f"{key}_per_sample"] = statistics[counter] / (pixels * spp) if counter in statistics else None

    described = {key: result[key] for key in ("parameters", "spp", "passes", "seconds")}
    described |= {"integrator": job.integrator, "scene": job.scene, "seed": job.seed, **versions()}
    images.write_exr(job.output, progressive.image, progressive.channels, described | {"run": job.run or ""})
    result |= _denoise(job, scene, progressive, described)
    return result | {"vpl_output": _render_vpl(job, passes, described) if job.vpl_folder else None}


def _denoise(job, scene, progressive, described):
    """Write the denoised image, if it is asked for; return its times."""
    if not job.denoised_output:
        return {"denoise_seconds": None, "cold_denoise_seconds": None}
    seconds = []
    for _ in range(2):
        denoiser = Denoiser(scene, seed=job.seed)
        image = denoiser.denoise(progressive.image, progressive.channels)
        seconds.append(denoiser.seconds)
    described = described | {"run": job.run or "", "denoise_seconds": seconds[1]}
    images.write_exr(job.denoised_output, image, progressive.channels, described)
    return {"denoise_seconds": seconds[1], "cold_denoise_seconds": seconds[0]}


def _parse(job):
    """Return the `SceneFile` of a job with its integrator."""
    file = SceneFile(job.scene, job.defines)
    if job.width:
        file.set_width(job.width)
    if job.max_depth is not None:
        file.set_max_depth(job.max_depth)
    file.set_integrator(job.integrator, job.parameters)
    return file


def _render_vpl(job, passes, described):
    """Render the passes of another integrator (same seeds and parameters, so same lights and camera rays) by `vpl`, and
    write the image, which is all that the other one approximates. Return its file; one that is there already, of the
    same passes with the same parameters, is left as it is."""
    file = _parse(job)
    file.set_integrator("vpl", {"aovs": ""}, keep=None)  # nobody asks for its channels, and it may not know them all
    shared = [file.fingerprint(), machine.versions(), [(one.spp, one.seed) for one in passes]]
    key = hashlib.sha256(json.dumps(shared).encode()).hexdigest()[:16]
    output = Path(job.vpl_folder) / f"{file.name}.vpl.{key}.exr"
    if not output.is_file():
        parameters, progressive = file.integrator[1], Progressive(file.load(job.threads), job.seed)
        for one in passes:
            progressive.render(one.spp, one.seed)
        described |= {"integrator": "vpl", "parameters": parameters, "seconds": progressive.seconds}
        images.write_exr(output, progressive.image, progressive.channels, described)
    return str(output)


def _peak_memory():
    """Return the largest memory that this process has had so far, in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _end_with_parent():
    """End this process when the one that holds the other end of its standard input does."""
    os.read(0, 1)
    os._exit(1)


def main():
    # What others print, such as Mitsuba's log, goes to the standard error
    answer = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    line = sys.stdin.readline()
    if not line:  # who wanted to give a job was interrupted
        return 1
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        result = json.dumps(render(Job(**json.loads(line))), allow_nan=False)
        status = 0
    except Exception as error:
        result, status = json.dumps(failure(error)), 1
    with answer:
        answer.write(result + "\n")
    return status


if __name__ == "__main__":
    sys.exit(main())
