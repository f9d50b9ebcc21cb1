"""Tables of a comparison as rows of text, for the terminal and for the report; warnings about the runs."""

from collections import Counter

from . import metrics

COLUMNS = (
    "integrator", "seeds", "time [s]", "cold [s]", "spp", "rel. L1", "RMSE", "relMSE", "trimmed", "95%", "FLIP", "bias",
    "rays", "bounds", "memory", "load",
)  # fmt: skip
EXPLANATION = (
    "Values are means over seeds. time: passes of the image with compiled kernels (with --cold: including "
    "compilation); cold: first pass with an empty kernel cache, including compilation. rel. L1: sum |x - r| / sum r; "
    f"relMSE: mean (x - r)² / (r² + {metrics.EPSILON:g} mean(r)²); trimmed: the same without the worst "
    f"{metrics.TRIMMED:.1%} of the pixels; 95%: confidence interval of the mean error in curves (--metric); FLIP: "
    "mean of HDR-FLIP at 67 pixels per degree; bias: relative error of the image mean. RMSE and relMSE are corrected "
    "for the noise of the reference; < marks an error below that noise and gives the noise (for rel. L1: √2 times the "
    "noise). rays, bounds: shadow rays and computed upper bounds per pixel sample. memory: peak in MB. load: maximum "
    "load average of the machine before the runs."
)
BUSY = 1.5  # load per core; the measured process itself contributes up to 1
UNEQUAL = 0.1  # tolerated relative difference of times with equal budgets
HEADS = {"seconds": "time [s]", "rays": "rays per pixel"}


def text(rows):
    """Format rows as columns, the first left-aligned; without trailing spaces."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def title(entry):
    """Return the title of the setting of a run or point, such as "lightcuts error=0.02"."""
    return f"{entry['label']} {entry['setting']}".strip()


def settings(scene):
    """Return title -> results of its runs, in the order of labels."""
    labels = list(dict.fromkeys(render["label"] for render in scene["renders"]))
    found = {}
    for label in labels:
        of_label = [render for render in scene["renders"] if render["label"] == label]
        # Runs proceed seed by seed; the first seed determines the order of settings
        for render in of_label:
            found.setdefault(title(render), []).append(render)
    return found


def rows(scene):
    """Return the rows of a scene: as many cells as `COLUMNS`, or (title, message) for a failure."""
    intervals, found = _intervals(scene), []
    for name, renders in settings(scene).items():
        good = [render for render in renders if "error" not in render]
        if good:
            found.append(_row(name, good, intervals.get(name, "")))
        failures = Counter(render["error"] for render in renders if "error" in render)
        found += [
            (name, message if len(renders) == 1 else f"{message} ({count} of {len(renders)} seeds)")
            for message, count in failures.items()
        ]
    return found


def _intervals(scene):
    """Return the 95% intervals of errors as text, by title, except for single seeds and errors hidden by the
    reference's noise."""
    found = {}
    for point in scene.get("points", []):
        low, high = point["error"]["low"], point["error"]["high"]
        if low is not None and not point["below_noise"]:
            found[title(point)] = f"{number(low)} to {number(high)}"
    return found


def _row(name, renders, interval):
    errors = [render["errors"] for render in renders if "errors" in render]
    bad = sum(one["bad_pixels"] for one in errors)
    cold = [render["cold_seconds"] for render in renders if render["cold_seconds"] is not None]
    return [
        name + (f" ({bad} pixels not finite)" if bad else ""),
        str(len(renders)),
        number(_mean(render["seconds"] for render in renders)),
        number(_mean(cold)) if cold else "",
        number(_mean(render["spp"] for render in renders)),
        *(
            error(errors, *column)
            for column in (("relative_l1", ".2%"), ("rmse", ".3g"), ("relmse", ".3g"), ("relmse_trimmed", ".3g"))
        ),
        interval,
        f"{_mean(one['flip'] for one in errors):.4f}" if errors else "n/a",
        f"{_mean(one['bias'] for one in errors):+.2%}" if errors else "n/a",
        *(_count(renders, key) for key in ("rays_per_sample", "bounds_per_sample")),
        f"{max(render['peak_memory_bytes'] for render in renders) / 1e6:.0f}",
        f"{max(render['load_average'] for render in renders):.1f}",
    ]


def _mean(values):
    values = list(values)
    return sum(values) / len(values)


def _count(renders, key):
    return "n/a" if renders[0][key] is None else f"{_mean(render[key] for render in renders):.0f}"


def error(errors, name, style):
    """Format the mean of an error, or "< noise" if the reference's noise hides it (as in curves)."""
    if not errors:
        return "n/a"
    mean = _mean(one[name] for one in errors)
    least = _mean(metrics.detection_threshold(name, one["noise"]) for one in errors)
    return f"< {least:{style}}" if mean <= least and least > 0 else f"{mean:{style}}"


def equal_errors(scene, cost):
    """Return the table of costs at equal errors, with its head; [] without curves."""
    return _comparison(scene.get("equal_errors", {}).get(cost, []), "error", "costs", "error")


def equal_costs(scene, cost):
    """Return the table of errors at equal costs, with its head; [] without curves."""
    return _comparison(scene.get("equal_costs", {}).get(cost, []), "cost", "errors", HEADS[cost])


def _comparison(entries, what, read, head):
    if not entries:
        return []
    labels = list(entries[0][read])
    return [
        [head, *labels],
        *([number(entry[what]), *(_reading(entry[read][label]) for label in labels)] for entry in entries),
    ]


def number(value):
    """Format a number with three significant digits, larger numbers as integers, without exponent down to 1e-4."""
    return f"{value:.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def _reading(reading):
    if reading["at_most"] is not None:
        least = reading["speed_up_at_least"]
        return f"≤ {number(reading['at_most'])}" + (f" (≥ {number(least)}×)" if least is not None and least > 1 else "")
    if reading["value"] is None:
        return "not reached"
    cell = number(reading["value"])
    if reading["speed_up_low"] is not None:
        low, high = number(reading["speed_up_low"]), number(reading["speed_up_high"])
        return f"{cell} ({number(reading['speed_up'])}×, {low} to {high})"
    return f"{cell} ({number(reading['speed_up'])}×)" if reading["speed_up"] not in (None, 1) else cell


def warnings(scene, cores):
    """Return the sentences of all warnings about the results of a scene."""
    return load_warnings(scene["renders"], cores) + scene_warnings(scene)


def load_warnings(renders, cores):
    """Return a list with a sentence if the machine was busy with other processes."""
    load = max((render["load_average"] for render in renders), default=0)
    if load <= BUSY * cores:
        return []
    return [f"The machine was busy with other processes (load {load:.1f} on {cores} cores); times are unreliable."]


def scene_warnings(scene):
    """Return warnings about the scene, independent of the machine's load."""
    return _machines(scene) + _unequal_times(scene) + _hidden(scene) + _unequal_samplers(scene)


def _machines(scene):
    """Return a list with a sentence if times stem from several machines, or from several workers on one machine."""
    made_by = [render["machine"] for render in scene["renders"] if "machine" in render]
    names, workers = (sorted({machine[key] for machine in made_by}) for key in ("name", "worker"))
    if len(names) > 1:
        return [f"Runs were made on different machines ({', '.join(names)}); their times are not comparable."]
    if len(workers) > 1:
        return [f"{len(workers)} workers shared the machine {names[0]}; times are unreliable."]
    return []


def _unequal_times(scene):
    """Return a sentence for each time budget that runs used unequally."""
    budgets = {}
    for name, renders in settings(scene).items():
        seconds = [render["seconds"] for render in renders if "error" not in render and render["budget"]]
        if seconds:
            # The denoiser works after the budget, so denoised images have times of their own
            budgets.setdefault((renders[0]["budget"], renders[0]["denoised"]), {})[name] = _mean(seconds)
    found = []
    for (budget, _), seconds in budgets.items():
        shortest, longest = (choose(seconds, key=seconds.get) for choose in (min, max))
        if seconds[longest] > (1 + UNEQUAL) * seconds[shortest]:
            found.append(
                f"Not at equal time: of {number(budget)} s, {shortest} took {number(seconds[shortest])} s and "
                f"{longest} {number(seconds[longest])} s."
            )
    return found


def _hidden(scene):
    """Return a list with a sentence about errors hidden by the reference's noise."""
    hidden = [title(point) for point in scene.get("points", []) if point["below_noise"] and point["cost"] == "seconds"]
    if not hidden:
        return []
    return [f"The reference's noise hides the error of {', '.join(hidden)}; use a reference with more samples."]


def _unequal_samplers(scene):
    """Return a list with a sentence if only some integrators stratify camera samples."""
    if scene.get("sampler") != "independent":
        return []
    shown = {render["integrator"]: render["parameters"] for render in scene["renders"] if "error" not in render}
    ours = shown.get("manylights")
    if ours is None or len(shown) == 1 or not ours.get("stratified", True):
        return []
    return [
        "The scene's sampler is independent: manylights stratifies camera samples, and other integrators do not. With "
        "--sampler multijitter, all of them do."
    ]
