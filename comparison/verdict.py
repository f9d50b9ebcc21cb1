"""Summary of a comparison: each integrator relative to the first, per scene, in geometric means, and in a sentence.

A ratio divides a number of an integrator by the number of the first; below 1 is better. Denoised images are compared
with denoised images of the first, and come first, because people use them. With curves, ratios are geometric means of
interpolated values, otherwise ratios of single images. Single images give a time at equal error only if they are raw
images and the first integrator is one of Mitsuba's unbiased integrators: only then the error is known to fall with the
number of samples.
"""

from statistics import geometric_mean

import numpy as np

from . import analysis, curves, metrics, tables

UNBIASED = ("path", "direct", "volpath", "volpathmis", "ptracer")
DENOISED = ", denoised"  # end of the labels of denoised images
KINDS = ("error", "time")
ALIKE = 1.05  # ratios up to this factor count as equal if there is no interval
PARTS = ("half", "a third", "a quarter", "a fifth", "a sixth", "a seventh", "an eighth", "a ninth", "a tenth")


def denoised_label(label):
    """Return the label of the denoised images of a label."""
    return f"{label}{DENOISED}"


def summarise(scenes, metric):
    """Return the "summary" of results.schema.json for the results of some scenes."""
    raw = _labels(scenes, denoised=False)
    merged = {"base": raw[0] if raw else None, "bases": {}, "scenes": {}, "means": {}, "sentences": []}
    for group, labels in _groups(scenes, raw, metric):
        rows, means, sentences = _summary_of(group, labels, metric)
        merged["bases"] |= dict.fromkeys(labels, *labels[:1])
        for name, row in rows.items():
            merged["scenes"].setdefault(name, {}).update(row)
        merged["means"] |= means
        merged["sentences"] += sentences
    return merged


def _labels(scenes, denoised):
    """Return the labels of raw or of denoised images, in the order of the runs."""
    renders = [render for scene in scenes for render in scene["renders"]]
    return list(dict.fromkeys(render["label"] for render in renders if render["denoised"] is denoised))


def _groups(scenes, raw, metric):
    """Return (scenes, labels) of the denoised images, if there are any, and of the raw images with the labels `raw`."""
    if not _labels(scenes, denoised=True):
        return [(scenes, raw)]
    # The order of raw labels, because failed runs have no denoised image
    kinds = (True, [denoised_label(label) for label in raw]), (False, raw)
    return [([_only(scene, denoised, labels, metric) for scene in scenes], labels) for denoised, labels in kinds]


def _only(scene, denoised, labels, metric):
    """Return the results of a scene with its raw or its denoised images alone."""
    renders = [render for render in scene["renders"] if render["denoised"] is denoised]
    return {**scene, "renders": renders} | analysis.analyse(renders, labels, metric)


def _summary_of(scenes, labels, metric):
    """Return (rows by scene, means by label, sentences) of images with the given labels, the first as base."""
    rows = {scene["name"]: _row(scene, labels, metric) for scene in scenes}
    means = {
        label: {kind: _over_scenes([row[label][kind] for row in rows.values() if label in row]) for kind in KINDS}
        for label in labels[1:]
    }
    order = sorted(means, key=lambda label: (means[label]["time"] or means[label]["error"] or {}).get("value", np.inf))
    sentences = [text for label in order if (text := _sentence(label, labels[0], rows))]
    if means and not sentences:
        sentences = [f"These runs do not determine the performance of {_listed(order)} relative to {labels[0]}."]
    return rows, means, sentences


def _row(scene, labels, metric):
    """Return the summary of a scene: label -> entry."""
    all_points = dict(analysis.points_by_cost(scene["renders"], metric))["seconds"]
    found = {}
    for label in labels:
        points = [point for point in all_points if point.label == label]
        if not points:
            continue
        best = min(points, key=lambda point: np.mean(list(point.error.values())))
        errors = [
            render["errors"] for render in scene["renders"]
            if "errors" in render and (render["label"], render["setting"]) == (label, best.name)
        ]  # fmt: skip
        found[label] = {
            "setting": best.name,
            "seconds": float(np.mean(list(best.cost.values()))),
            "measured": float(np.mean(list(best.error.values()))),
            "hidden": best.mean() is None,
            "bias": float(np.mean([one["bias"] for one in errors])),
            "error": None,
            "time": None,
        }
    if labels and labels[0] in found:
        for label in found:
            if label != labels[0]:
                found[label] |= _ratios(scene, all_points, labels[0], label, metric)
    return found


def _ratios(scene, points, base, label, metric):
    """Return "error" (at equal time) and "time" (at equal error) of a label over the first; None: unknown."""
    at_errors, at_costs = (scene.get(key, {}).get("seconds") for key in ("equal_errors", "equal_costs"))
    if at_errors:
        return {
            "time": _mean_of_readings([entry["costs"] for entry in at_errors], base, label),
            "error": _mean_of_readings([entry["errors"] for entry in at_costs], base, label),
        }
    first, other = (next(point for point in points if point.label == name) for name in (base, label))
    seconds = sorted(float(np.mean(list(point.cost.values()))) for point in (first, other))
    is_equal_time = seconds[1] <= (1 + tables.UNEQUAL) * seconds[0]
    error = _ratio_of_points(first, other, lambda cost, error: error) if is_equal_time else None
    of_base = next(render for render in scene["renders"] if render["label"] == base)
    if of_base["integrator"] not in UNBIASED or of_base["denoised"]:
        return {"error": error, "time": None}
    power = 1 if metric in metrics.SQUARED else 2
    time = _ratio_of_points(first, other, lambda cost, error: cost * error**power)
    return {"error": error, "time": time and time | {"extrapolated": True}}


def _ratio(value, bound=None, low=None, high=None):
    """Return a ratio; `bound` ("at_most" or "at_least") marks an inequality."""
    return {"value": float(value), "bound": bound, "low": low, "high": high, "extrapolated": False}


def _mean_of_readings(entries, base, label):
    """Return the geometric mean of the ratios interpolated on two curves; a bound if only bounds are known."""
    readings = [entry[label] for entry in entries if label in entry and base in entry]
    exact = [one for one in readings if one["speed_up"]]
    if exact:
        ends = [None, None]
        if all(one["speed_up_low"] for one in exact):
            ends = [1 / geometric_mean(one[f"speed_up_{end}"] for one in exact) for end in ("high", "low")]
        return _ratio(1 / geometric_mean(one["speed_up"] for one in exact), None, *ends)
    least = [one["speed_up_at_least"] for one in readings if one["speed_up_at_least"]]
    if least:
        return _ratio(1 / geometric_mean(least), "at_most")
    pairs = [(entry[label]["value"], entry[base]["at_most"]) for entry in entries if label in entry and base in entry]
    over = [value / most for value, most in pairs if value and most]
    return _ratio(geometric_mean(over), "at_least") if over else None


def _ratio_of_points(first, other, value):
    """Return the ratio of `value(cost, error)` of two points; a bound if noise hides one of the errors."""

    def ratio(without):
        pair = [point.mean(without) for point in (other, first)]
        return value(*pair[0]) / value(*pair[1]) if all(pair) else None

    if exact := ratio(None):
        return _ratio(exact, None, *curves.interval(ratio, sorted({*first.cost, *other.cost})))
    means, bounds = ([at(point) for point in (other, first)] for at in (curves.Point.mean, curves.Point.bound))
    if bounds[0] and means[1]:
        return _ratio(value(*bounds[0]) / value(*means[1]), "at_most")
    return _ratio(value(*means[0]) / value(*bounds[1]), "at_least") if means[0] and bounds[1] else None


def _over_scenes(ratios):
    """Return the geometric mean of the known ratios of several scenes, with their number "scenes". Return None without
    known ratios, or with bounds in both directions."""
    known = [ratio for ratio in ratios if ratio]
    bounds = {ratio["bound"] for ratio in known} - {None}
    if not known or len(bounds) > 1:
        return None
    mean = _ratio(geometric_mean(ratio["value"] for ratio in known), *bounds)
    return mean | {"extrapolated": any(ratio["extrapolated"] for ratio in known), "scenes": len(known)}


def verdict_of(ratio):
    """Return "better", "worse", "alike", or None if undetermined."""
    if ratio is None:
        return None
    low, high = ratio["low"], ratio["high"]
    if low is None:
        low, high = ratio["value"] / ALIKE, ratio["value"] * ALIKE
    if high < 1 and ratio["bound"] != "at_least":
        return "better"
    if low > 1 and ratio["bound"] != "at_most":
        return "worse"
    return None if ratio["bound"] else "alike"


def _sentence(label, base, rows):
    """Compare an integrator with the first in a sentence; None without a known ratio."""
    kind = "time" if any(row.get(label, {}).get("time") for row in rows.values()) else "error"
    intro = "Denoised, " if base.endswith(DENOISED) else ""
    shown, of = (name.removesuffix(DENOISED) for name in (label, base))
    ratios = {name: row[label][kind] for name, row in rows.items() if row.get(label, {}).get(kind)}
    if not ratios:
        return None
    if len(rows) == 1:
        ratio = in_words(*ratios.values())
        return f"{intro}{shown} {WORDS[kind]['one'].format(ratio=ratio, base=of)} in {next(iter(ratios))}."
    mean = _over_scenes(ratios.values())
    names = {one: [name for name, ratio in ratios.items() if verdict_of(ratio) == one] for one in ("better", "worse")}
    text = f"{intro}{shown} {WORDS[kind]['less'].format(base=of)} in {len(names['better'])} of {len(rows)} scenes"
    if mean:
        over = f" over {mean['scenes']} scenes" if mean["scenes"] < len(rows) else ""
        text += f" (geometric mean{over}: {in_words(mean)} the {kind})"
    worse = [f"{name} ({number(ratios[name])})" for name in names["worse"]]
    return f"{text}. {WORDS[kind]['more']} in {_listed(worse)}." if worse else f"{text}."


WORDS = {
    "time": {
        "one": "needs {ratio} the time of {base} for the same error",
        "less": "needs less time than {base} for the same error",
        "more": "It needs more time",
    },
    "error": {
        "one": "has {ratio} the error of {base} at equal time",
        "less": "has a smaller error than {base} at equal time",
        "more": "It has a larger error",
    },
}


def in_words(ratio):
    """Format a ratio to precede "the time": "a fifth of", "1.4 times", "at most half of"."""
    value, parts = ratio["value"], round(1 / ratio["value"])
    about = "about " if ratio["extrapolated"] else ""
    bound = {"at_most": "at most ", "at_least": "at least ", None: about}[ratio["bound"]]
    if not ratio["bound"] and 1 / ALIKE <= value <= ALIKE:
        return "about"
    if value > 1:
        return f"{bound}{value:.0f} times" if value >= 9.5 else f"{bound}{value:.2g} times"
    if parts > 10:
        return f"{bound}1/{parts} of"
    if parts >= 2 and abs(value * parts - 1) < 0.08:
        return f"{bound}{PARTS[parts - 2]} of"
    return f"{bound}{value:.0%} of"


def number(ratio):
    """Format a ratio for a table: "0.21×", "≤ 0.5×"."""
    sign = {"at_most": "≤ ", "at_least": "≥ ", None: ""}[ratio["bound"]]
    return f"{sign}{tables.number(float(format(ratio['value'], '.2g')))}×"


def _listed(names):
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
