"""Comparison of integrators on a scene: reference, runs in separate processes, errors, curves, pictures."""

import math
from pathlib import Path

import numpy as np

from . import analysis, images, metrics, paper_tables, references, tables, worker
from .command_line import failure
from .pictures import REFERENCE, Pictures
from .scene_files import SceneFile, known_parameters, short_name
from .sweeps import order
from .verdict import denoised_label

FIRST_SPP = 64  # initial samples of an automatic reference
GROWTH = (1.2, 4.0)  # minimum and maximum factor of its refinement steps


class SceneComparison:
    """Comparison on one scene: `settings` (label -> list of `sweeps.Setting`) with each of `options.seeds`.

    `options`: the command line of compare.py; `store`: finished runs (`runs.Runs`); `progress`: receives the progress
    (`progress.Progress`); `runner`: `worker` (processes of this machine) or `cluster.runs.DistributedRuns`. After
    `finish`, `result` is the complete entry of the scene in `results.json`, and `pictures` are ready.
    """

    def __init__(self, path, settings, options, store, progress, runner=worker):
        self.path, self.settings, self.options = path, settings, options
        self._store, self._progress, self._runner = store, progress, runner
        self._reference, self.pictures = None, None
        self._expected = set()  # runs and labels that were announced to a distributed runner
        self.result = {"scene": str(path), "name": short_name(path), "renders": []}

    def prepare(self):
        """Parse the scene and load the first reference; announce the runs to a distributed runner. Records a failure.
        Repeated calls have no effect."""
        if "hash" in self.result or "error" in self.result:
            return
        try:
            file = self._parse()
            self.result["hash"] = file.fingerprint()
            self.result["sampler"] = file.sampler_name
            self._reference = self._first_reference(file)
            if self._runner is not worker:
                self._expect_runs()
        except Exception as error:  # of any kind: the comparison continues with the next scene
            self._fail(error)

    def _expect_runs(self):
        for setting, seed in order(self.settings, self.options.seeds):
            job = self._job(setting, seed)
            if not (self.options.resume and self._store.find(job)):
                self._expected.add((job.run, job.label))
                self._runner.expect(job, SceneFile(self.path, dict(self.options.define)))

    def run(self):
        """Make all runs. Records failures and continues."""
        if "error" in self.result:
            return
        for setting, seed in order(self.settings, self.options.seeds):
            self._render(setting, seed)
        if self.options.reference.fraction:
            try:
                self._refine_reference()
            except Exception as error:
                self._fail(error)

    def finish(self):
        """Compute the errors of all finished runs, curves and pictures. Records failures."""
        if "hash" not in self.result:
            return
        try:
            self._finish()
        except Exception as error:
            self.pictures = None
            self._fail(error)

    def _finish(self):
        self.pictures = Pictures(self.options.out, self.result["name"])
        if self._reference:
            self._describe_reference()
            exr = self.pictures.path(REFERENCE, ".exr")
            images.write_exr(exr, self._reference.image, "RGB", self._reference.description)
            self.pictures.show(REFERENCE, None, REFERENCE, exr.name, self._reference.image)
        labels = [label for raw in self.settings for label in (raw, denoised_label(raw))]
        for result in sorted(self._finished(), key=lambda result: labels.index(result["label"])):
            try:
                self._assess(result)
            except Exception as error:
                result |= failure(error)
        names = {setting.title: setting.file_name for group in self.settings.values() for setting in group}
        if aovs := self.pictures.write_aovs(names):
            self.result["aovs"] = aovs
        self.result |= analysis.analyse(self.result["renders"], labels, self.options.metric)
        raw = [result for result in self.result["renders"] if not result["denoised"]]
        self.result["paper_tables"] = paper_tables.make(raw)
        self.result["pictures"] = {"exposure": self.pictures.exposure, "block": self.pictures.block}

    # --- References ---

    def _parse(self):
        file = SceneFile(self.path, dict(self.options.define))
        if self.options.max_depth is not None:
            file.set_max_depth(self.options.max_depth)
        if self.options.width:
            file.set_width(self.options.width)
        if self.options.sampler:
            file.set_sampler(self.options.sampler)
        return file

    def _first_reference(self, file):
        """Return the reference; None if each image is compared with an image by `vpl`."""
        wanted = self.options.reference
        if wanted.kind == "vpl":
            return None
        if wanted.kind == "path":
            return self._path_traced(wanted.spp or FIRST_SPP)
        reference = references.read(wanted.file_of(file.name))
        depth, known = file.integrator[1].get("max_depth", -1), reference.description.get("max_depth")
        # Some programs write all attributes as text
        if known not in (None, depth, str(depth)):
            raise ValueError(f"the reference has max_depth {known}, the scene {depth}; try --max-depth {known}")
        return reference

    def _path_traced(self, spp):
        with self._progress.paused():
            return references.path_traced(self._parse(), spp, self.options.cache)

    def _refine_reference(self):
        """Continue the reference until its noise is at most the permitted fraction of the smallest error, or until the
        limit of samples."""
        wanted = self.options.reference
        while True:
            spp, share = self._reference.description["spp"], self._noise_share()
            if share is None or share <= wanted.fraction or spp >= self.options.reference_limit:
                finite = None if share == np.inf else share  # JSON has no infinity
                self.result |= {"reference_share": finite, "reference_fraction": wanted.fraction}
                return
            growth = np.clip((share / wanted.fraction) ** 2, *GROWTH)
            self._reference = self._path_traced(min(self.options.reference_limit, math.ceil(spp * growth)))

    def _noise_share(self):
        """Return the largest ratio of the reference's noise to the error of a run: infinite if an error is hidden, None
        without runs. For squared errors this is the ratio of their roots."""
        metric, shares = self.options.metric, []
        for result in self._finished():
            errors = self._errors(images.colour(*images.read_exr(result["output"])[:2]), self._reference)
            noise, error = errors["noise"][metric], errors[metric]
            share = noise / error if error > 0 else np.inf
            shares.append(float(np.sqrt(share) if metric in metrics.SQUARED else share))
        return max(shares, default=None)

    def _describe_reference(self):
        noise = None
        if self._reference.standard_error is not None:
            noise = self._errors(self._reference.image, self._reference)["noise"]
        self.result["reference"] = self._reference.description | {"noise": noise}

    # --- Runs ---

    def _render(self, setting, seed):
        job = self._job(setting, seed)
        # An expected run may have been finished and saved since
        looks = self.options.resume and (job.run, job.label) not in self._expected
        result = self._store.find(job) if looks else None
        kept = result is not None
        self._progress.begin(self.path, setting)
        if not kept:
            result = self._runner.run(job, self._progress.tick)
            if self._runner is worker:
                self._keep(result)
        result |= {"setting": setting.name, "swept": setting.swept, "denoised": False}
        self._progress.end(kept)
        self.result["renders"].append(result)
        if self.options.denoise and "error" not in result:
            self.result["renders"].append(_denoised(result))

    def _keep(self, result):
        """Save the result of a successful run; failure to save fails the run."""
        if "error" not in result:
            try:
                self._store.save(result)
            except OSError as error:
                result |= failure(error)

    def _job(self, setting, seed):
        options, name = self.options, self.result["name"]
        # Other integrators have no lights that `vpl` could share, or, as `manylights`, choose them by themselves
        with_vpl = options.reference.kind == "vpl" and known_parameters(setting.integrator, {"vpl_count": 1})
        of_seed = f".seed{seed}" if len(options.seeds) > 1 else ""
        denoised = options.out / f"{name}.{setting.file_name}.denoised{of_seed}.exr"
        job = worker.Job(
            label=setting.label,
            integrator=setting.integrator,
            parameters=setting.parameters,
            scene=str(self.path),
            output=str(options.out / f"{name}.{setting.file_name}{of_seed}.exr"),
            denoised_output=str(denoised) if options.denoise else None,
            vpl_folder=str(options.out) if with_vpl else None,
            variant=options.mode,
            defines=dict(options.define),
            # Defaults to the width of a file; a width given by the user must match, or the comparison fails
            width=options.width or (self._reference.size[0] if options.reference.kind == "file" else None),
            max_depth=options.max_depth,
            sampler=options.sampler,
            seed=seed,
            budget=setting.time,
            spp=setting.spp,
            pass_spp=options.pass_spp,
            threads=options.threads,
            kernel_cache=None if options.cold else str(self._store.kernels / f"{name}.{setting.label}"),
            cold=options.cold,
        )
        job.run = self._store.key(job, self.result["hash"])
        return job

    def _finished(self):
        return [result for result in self.result["renders"] if "error" not in result]

    # --- Errors and pictures ---

    def _assess(self, result):
        """Add the errors of a run to its result; add the image of the first seed to the pictures."""
        planes, channels, _ = images.read_exr(result["output"])
        image = images.colour(planes, channels).astype(np.float64)
        reference = references.read(result["vpl_output"]) if result["vpl_output"] else self._reference
        flip, error = None, ""
        if reference:
            result["errors"] = self._errors(image, reference)
            flip, result["errors"]["flip"], result["errors"]["flip_settings"] = metrics.flip(image, reference.image)
            error = tables.error([result["errors"]], self.options.metric, ".3g")
        if result["seed"] == self.options.seeds[0]:
            title = tables.title(result)
            file_name = Path(result["output"]).name[len(self.result["name"]) + 1 : -len(".exr")]
            file_name = file_name.removesuffix(f".seed{result['seed']}")
            self.pictures.show(
                title, result["label"], file_name, Path(result["output"]).name, image,
                reference.image if reference else None, flip, error,
            )  # fmt: skip
            if not result["denoised"]:
                self.pictures.add_aovs(self.options.aovs, title, planes, channels)

    @staticmethod
    def _errors(image, reference):
        return metrics.compare(image, reference.image, reference.standard_error)

    def _fail(self, error):
        self.result |= failure(error)


def _denoised(result):
    """Return the result of the denoised image of a run, with the time of denoising added."""
    cold = result["cold_seconds"]
    return result | {
        "label": denoised_label(result["label"]),
        "output": result["denoised_output"],
        "seconds": result["seconds"] + result["denoise_seconds"],
        "cold_seconds": None if cold is None else cold + result["cold_denoise_seconds"],
        "denoised": True,
    }
