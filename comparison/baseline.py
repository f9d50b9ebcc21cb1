"""`--check`: detect slow-downs relative to the first integrator since an earlier comparison.

The check compares speed-ups at equal error over the first integrator. Unlike seconds, speed-ups carry over between
machines. They are interpolated on the new curves at the errors of the earlier comparison.
"""

import json
from pathlib import Path

from . import analysis, curves
from .command_line import UsageError
from .report import FORMAT


def read(path, metric, names):
    """Return the content of a `results.json`. Raises UsageError if the file is invalid, has another format, contains no
    speed-ups, uses another metric, or has none of the scenes `names`."""
    try:
        results = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise UsageError(f"--check: '{path}' cannot be read: {error}") from None
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise UsageError(f"--check: '{path}' is no results.json of format {FORMAT}")
    if not list(_speed_ups(results)):
        raise UsageError(f"--check: '{path}' has no speed-ups at equal error; make it with --sweep")
    if results["metrics"]["compared"] != metric:
        raise UsageError(f"--check: the errors of '{path}' are {results['metrics']['compared']}, not {metric}")
    if not {scene for scene, *_ in _speed_ups(results)} & set(names):
        raise UsageError(f"--check: '{path}' has none of these scenes")
    return results


def _speed_ups(results):
    """Yield (scene, first label, label, cost, error, speed-up) for every known speed-up."""
    for scene in results.get("scenes", []):
        for cost, entries in scene.get("equal_errors", {}).items():
            for entry in entries:
                base, *others = entry["costs"]
                for label in others:
                    if entry["costs"][label]["speed_up"] is not None:
                        yield scene["name"], base, label, cost, entry["error"], entry["costs"][label]["speed_up"]


def check(results, baseline, share):
    """Return a list of messages: speed-ups that fell by more than the fraction `share`, or are no longer measurable.
    A known lower bound above the permitted minimum passes. Compares only scenes present in both results."""
    metric = results["metrics"]["compared"]
    found, lines = {scene["name"]: scene for scene in results["scenes"]}, []
    for name, base, label, cost, error, before in _speed_ups(baseline):
        if name not in found:
            continue
        readings = _readings(found[name], base, label, cost, error, metric)
        message = _fall(*readings, before, share) if readings else "no such curves now"
        if message:
            lines.append(f"{name}: {label} over {base}, {cost} at error {error:.3g}: {before:.3g}× before, {message}")
    return lines


def _fall(first, other, before, share):
    """Describe the fall of a speed-up (None: no fall); `first` and `other` are the readings of the two labels."""
    now, least = other["speed_up"], other["speed_up_at_least"]
    if now is not None:
        return f"{now:.3g}× now, {1 - now / before:.0%} less" if now < (1 - share) * before else None
    if least is not None and least >= (1 - share) * before:
        return None
    if other["value"] is None and other["at_most"] is None:
        return "not reached now"
    if first["value"] is None and first["at_most"] is None:
        return "not reached now by the first"
    return "only bounds are known now"


def _readings(scene, base, label, cost, error, metric):
    """Return the readings of two labels at an error (see `curves.equal_errors`), None if one has no curve."""
    points = dict(analysis.points_by_cost(scene["renders"], metric))[cost]
    pair = analysis.make_curves(points, [base, label])
    if [curve.label for curve in pair] != [base, label]:
        return None
    costs = curves.equal_errors(pair, [error])[0]["costs"]
    return costs[base], costs[label]
