"""Compare integrators on one scene: reference, renders in processes of their own, errors, pictures."""

import traceback
from pathlib import Path

import numpy as np

from . import images, metrics, references, worker
from .command_line import explain, own_integrators
from .scene_files import SceneFile


class SceneComparison:
    """The comparison on one scene. `options` are those of compare.py's command line.

    `result` is the scene's part of `results.json` (see report.py); `pictures` maps titles ("reference", the labels of
    the integrators, and those with ".error" added) to PNG files. Both fill up as `run` goes on.
    """

    def __init__(self, path, options):
        self.path, self.options, self.pictures = path, options, {}
        self._aovs = {}  # channel -> label -> values, (height, width)
        self.result = {"scene": str(path), "name": Path(path).stem, "renders": []}

    def run(self, integrators):
        """Render all integrators (label -> name and parameters). What fails is recorded, and the others go on."""
        try:
            file = self._parse()
            self.result |= {"name": file.name, "hash": file.fingerprint()}
            reference = self._reference(file)
            exposure = self._show_reference(reference) if reference else None
        except Exception as error:  # whatever it is, it must not lose the other scenes
            self.result |= _failure(error)
            return
        for label, (name, parameters) in integrators.items():
            # Its width is the reference's, unless given: then a difference is an error.
            width = self.options.width or (reference.size[0] if reference else None)
            result = worker.run(self._job(label, name, parameters, width))
            self.result["renders"].append(result)
            if "error" not in result:
                try:
                    exposure = self._assess(result, reference, exposure)
                except Exception as error:
                    result |= _failure(error)

    def _parse(self):
        file = SceneFile(self.path, dict(self.options.define))
        if self.options.max_depth is not None:
            file.set_max_depth(self.options.max_depth)
        if self.options.width:
            file.set_width(self.options.width)
        return file

    def _reference(self, file):
        """Return the reference, or None if each image has one of its own."""
        wanted = self.options.reference
        if wanted == "vpl":
            return None
        if wanted.startswith("path:"):
            return references.path_traced(self._parse(), int(wanted[5:]), self.options.cache)
        reference = references.read(Path(wanted) / f"{file.name}.exr" if Path(wanted).is_dir() else wanted)
        depth, known = file.integrator[1].get("max_depth", -1), reference.description.get("max_depth")
        if known not in (None, depth):
            raise ValueError(f"the reference has max_depth {known}, the scene {depth}; try --max-depth {known}")
        return reference

    def _show_reference(self, reference):
        """Tone-map the reference and describe it in the results; return its exposure, which all images share."""
        exposure = images.automatic_exposure(reference.image)
        self._picture("reference", images.tone_map(reference.image, exposure))
        noise = None
        if reference.standard_error is not None:
            noise = metrics.compare(reference.image, reference.image, reference.standard_error)["noise"]
        self.result["reference"] = reference.description | {"noise": noise}
        return exposure

    def _job(self, label, name, parameters, width):
        options = self.options
        # Mitsuba's own integrators have no virtual lights to share.
        with_vpl = options.reference == "vpl" and name in own_integrators()
        return worker.Job(
            label=label,
            integrator=name,
            parameters=parameters,
            scene=str(self.path),
            output=str(self._output(label, ".exr")),
            vpl_output=str(self._output(label, ".vpl.exr")) if with_vpl else None,
            variant=options.mode,
            defines=dict(options.define),
            width=width,
            max_depth=options.max_depth,
            seed=options.seed,
            budget=options.time,
            spp=options.spp,
            pass_spp=options.pass_spp,
            threads=options.threads,
        )

    def _assess(self, result, reference, exposure):
        """Add the errors of a render to its result, and make its pictures; return the exposure that they have."""
        planes, channels, _ = images.read_exr(result["output"])
        image, label = images.colour(planes, channels).astype(np.float64), result["label"]
        if result["vpl_output"]:
            reference = references.read(result["vpl_output"])
        exposure = exposure or images.automatic_exposure(image)
        self._picture(label, images.tone_map(image, exposure))
        if reference:
            result["errors"] = metrics.compare(image, reference.image, reference.standard_error)
            self._picture(f"{label}.error", images.false_colours(metrics.relative_error(image, reference.image)))
        self._show_aovs(label, planes, channels)
        return exposure

    def _show_aovs(self, label, planes, channels):
        """Draw the AOV channels of a render, and those of earlier ones anew, as this one may widen their scale."""
        for aov in self.options.aovs:
            for index, channel in enumerate(channels):
                if channel.partition(".")[0] == aov:  # "aov", or "aov.R" of one that is a colour
                    self._aovs.setdefault(channel, {})[label] = planes[..., index].copy()
        for channel, of in self._aovs.items():
            ends, files = images.logarithmic_ends(of.values()), {}
            for label, values in of.items():
                files[label] = str(self._output(f"{label}.{channel}", ".png"))
                images.write_png(files[label], images.false_colours(values, ends))
            self.result.setdefault("aovs", {})[channel] = {"scale": ends, "files": files}

    def _picture(self, title, pixels):
        self.pictures[title] = self._output(title, ".png")
        images.write_png(self.pictures[title], pixels)

    def _output(self, title, suffix):
        return self.options.out / f"{self.result['name']}.{title}{suffix}"


def _failure(error):
    return {"error": explain(error), "traceback": traceback.format_exc()}
