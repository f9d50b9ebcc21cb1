"""Render and measure an integrator on a scene in a separate process: `python -m comparison.worker`.

A new process with an empty kernel cache measures the true cold start and the peak memory of an integrator, and isolates
crashes. The job is a line of JSON on standard input (see `Job`), the result a line on standard output (see `run`):
pipes work even if the disk is full.
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
from .command_line import check_integrator, failure, set_variant, versions
from .counters import total_statistics
from .denoising import Denoiser
from .features import hides_emitters
from .fine_film import usual_parts
from .measuring import measure
from .rendering import Progressive
from .scene_files import SceneFile

ROOT = Path(__file__).resolve().parent.parent
TICK = 0.5  # seconds


@dataclass
class Job:
    """Render job, for `budget` seconds or `spp` samples per pixel, in passes of `pass_spp` (None: automatic).

    `output`, `denoised_output`: EXR files to write, with the key `run` as metadata. `vpl_folder`: folder for images of
    the same passes by `vpl` with the same VPLs, shared between jobs. `kernel_cache`: folder of compiled kernels (None:
    a new one). `cold`: include compilation in the times.
    """

    label: str
    integrator: str
    scene: str
    output: str
    variant: str = "llvm_ad_rgb"
    parameters: dict = field(default_factory=dict)
    defines: dict = field(default_factory=dict)
    width: int | None = None
    max_depth: int | None = None
    sampler: str | None = None
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
    """Run a job in a new process; return a dict with the fields of the job and

    `width`, `height`
    `load_seconds`       time to load the scene
    `load_average`       before the run, see machine.load
    `cold_seconds`       first pass including compilation; None if the kernel cache was not empty
    `warm_seconds`       mean of the later passes of the image, None without any
    `seconds`, `spp`, `passes`   of the image
    `pass_spp`           largest pass
    `cold_pass_kept`     whether the image includes the first pass (`job.cold`)
    `peak_memory_bytes`
    `statistics`         sums of the integrator's counters, {} without any
    `rays_per_sample`, `bounds_per_sample`, `cut_size_per_sample`   per pixel sample, None if not counted
    `vpl_output`         EXR file of the same passes by `vpl`, None if not requested
    `denoise_seconds`, `cold_denoise_seconds`   warm and cold time of denoising, None if not requested

    After a failure the dict holds `error` (one line) and `traceback` instead. `tick` is called every half second. The
    new process ends with the current one, even if the latter is killed.
    """
    result = asdict(job) | {"load_average": machine.load()}
    try:
        return result | _in_new_process(job, tick)
    except OSError as error:
        return result | failure(error)


def _in_new_process(job, tick):
    """Return the measurements of a job. Raises OSError if the process or its folder of kernels cannot be created."""
    cache = nullcontext(job.kernel_cache) if job.kernel_cache else tempfile.TemporaryDirectory(prefix="manylights-")
    with cache as kernels:
        Path(kernels).mkdir(parents=True, exist_ok=True)
        is_cold = not any(Path(kernels).iterdir())
        environment = os.environ | {"DRJIT_CACHE_DIR": str(kernels)}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        # In its own session: Ctrl-C reaches only this process, which then ends the worker
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
    """Send a job to a process; return its exit status and answer. Ends the process, also after an interruption."""
    try:
        with suppress(BrokenPipeError):  # the process has already ended; its status says why
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
    """Execute a job in this process; return the measurements (see `run`)."""
    set_variant(job.variant)
    # Imports the module of a plugin, which is no part of loading a scene
    check_integrator(job.integrator)
    begin = time.perf_counter()
    file = _parse(job)
    parameters, scene = file.integrator[1], file.load(job.threads)
    load_seconds = time.perf_counter() - begin

    denoiser = _denoiser(scene, job) if job.denoised_output else None
    # Pixels may have different numbers of samples, which the denoiser decides, if the render ends by time
    decides = denoiser and job.budget and hasattr(scene.integrator(), "may_differ")
    parts, denoise = denoiser.parts if denoiser else 1, denoiser.denoise if decides else None
    progressive = Progressive(scene, job.seed, denoise=denoise, parts=parts, seconds=job.budget)
    progressive.keeps_halves = bool(denoiser) and denoiser.restores
    progressive.shares_lattices = not denoiser
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
    result |= _denoise(job, scene, progressive, denoiser, described)
    return result | {"vpl_output": _render_vpl(job, progressive, described) if job.vpl_folder else None}


def _denoiser(scene, job, like=None):
    """Return the `Denoiser` for the image of a job; `like`: see there."""
    integrator = scene.integrator()
    parts = usual_parts(scene.sensors()[0], integrator, job.spp)
    return Denoiser(
        scene, seed=job.seed, spp=None if job.budget else job.spp, time_limit=job.budget, parts=parts,
        hide_emitters=hides_emitters(integrator), like=like,
    )  # fmt: skip


def _denoise(job, scene, progressive, denoiser, described):
    """Write the image denoised by another denoiser that decides as a `denoiser` did, if requested; return the times of
    both, as the first one compiles."""
    if not denoiser:
        return {"denoise_seconds": None, "cold_denoise_seconds": None}
    seconds = []
    for one in (denoiser, _denoiser(scene, job, denoiser)):
        begin = time.perf_counter()
        image = one.denoise_passes(progressive)
        seconds.append(one.start_seconds + time.perf_counter() - begin)
    described = described | {"run": job.run or "", "denoise_seconds": seconds[1]} | one.description
    images.write_exr(job.denoised_output, image, progressive.channels, described)
    return {"denoise_seconds": seconds[1], "cold_denoise_seconds": seconds[0]}


def _parse(job):
    """Return the `SceneFile` of a job with the job's integrator."""
    file = SceneFile(job.scene, job.defines)
    if job.width:
        file.set_width(job.width)
    if job.max_depth is not None:
        file.set_max_depth(job.max_depth)
    if job.sampler:
        file.set_sampler(job.sampler)
    file.set_integrator(job.integrator, job.parameters)
    return file


def _render_vpl(job, rendered, described):
    """Render the passes of another integrator, those of the `Progressive` `rendered`, by `vpl`, with equal seeds and
    parameters and so equal lights and camera rays: the image that the integrator approximates. Return its file. An
    existing file of the same passes and parameters is reused."""
    file = _parse(job)
    file.set_integrator("vpl", {"aovs": ""}, keep=None)  # AOVs are not needed, and `vpl` may not know them
    passes, parts = rendered.passes, rendered.parts
    shared = [file.fingerprint(), machine.software(), parts, [(one.spp, one.seed) for one in passes]]
    key = hashlib.sha256(json.dumps(shared).encode()).hexdigest()[:16]
    output = Path(job.vpl_folder) / f"{file.name}.vpl.{key}.exr"
    if not output.is_file():
        parameters, progressive = file.integrator[1], Progressive(file.load(job.threads), job.seed, parts=parts)
        for one in passes:
            progressive.render(one.spp, one.seed)
        described |= {"integrator": "vpl", "parameters": parameters, "seconds": progressive.seconds}
        images.write_exr(output, progressive.image, progressive.channels, described)
    return str(output)


def _peak_memory():
    """Return the peak memory of this process so far in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _end_with_parent():
    """End this process when standard input closes, which the end of the parent process causes."""
    os.read(0, 1)
    os._exit(1)


def main():
    # Redirect output of libraries, such as Mitsuba's log, to standard error
    answer = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    line = sys.stdin.readline()
    if not line:  # the parent was interrupted before it sent a job
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
