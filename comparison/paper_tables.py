"""The tables of the papers, filled from the runs of a scene, for `results.json` and as text for the report.

`published` lists the tables. If the runs form curves, methods are compared at equal error or equal rays, as in the
paper: each setting of the first method is a target, and curves of further methods are interpolated at it. All
quantities of a row are weighted means, in logarithmic axes, of the same two settings.
"""

import math

from . import analysis, metrics, tables
from .published import PAPERS, TABLES
from .quantities import QUANTITIES

ROUNDING = 1e-9  # relative tolerance for means summed in another order


def make(renders):
    """Return the tables filled by the runs of a scene (see worker.run), a list of dicts for `results.json`. Omits
    failed runs, and tables whose required integrators are missing."""
    good = [run for run in renders if "error" not in run]
    return [found for table in TABLES if (found := _fill(table, good))]


def _fill(table, runs):
    """Return a table, None if the runs do not fill it."""
    runs = [run for run in runs if table.method_of(run)]
    if not set(table.needed) <= {run["integrator"] for run in runs}:
        return None
    rows = _equal_rows(table, runs)
    is_equal = bool(rows)
    if not is_equal and not table.curves_only:
        rows = _plain_rows(table, runs)
    if not rows:
        return None
    names = {row["method"] for row in rows}
    return {
        "paper": table.paper,
        "table": table.name,
        "equal": table.equal if is_equal else None,
        "metric": table.metric,
        "columns": [*table.quantities, *table.ratios],
        "rows": rows,
        "published": [_published(table, method) for method in table.methods if method.name in names],
    }


# --- Runs without interpolation ---


def _measured(table, runs):
    """Return (label, setting) -> row, grouped by label; values are means over seeds."""
    labels, found = _labels(runs), {}
    for run in sorted(runs, key=lambda run: labels.index(run["label"])):
        found.setdefault((run["label"], run["setting"]), []).append(run)
    return {key: _mean_row(table, group) for key, group in found.items()}


def _labels(runs):
    return list(dict.fromkeys(run["label"] for run in runs))


def _mean_row(table, runs):
    """Return the row of a setting. An error hidden by the reference's noise is replaced by that noise, an upper
    bound."""
    values, at_most = {}, []
    for name in table.quantities:
        numbers = [QUANTITIES[name].of(run) for run in runs]
        values[name] = None if None in numbers else sum(numbers) / len(numbers)
        if name in metrics.NAMES and values[name] is not None:
            least = sum(metrics.detection_threshold(name, run["errors"]["noise"]) for run in runs) / len(runs)
            if values[name] <= least and least > 0:
                values[name] = least
                at_most.append(name)
    method = table.method_of(runs[0]).name
    shares = {runs[0]["setting"]: 1.0}
    return _row(method, runs[0]["label"], shares, values, at_most)


def _row(method, label, shares, values, at_most=(), beyond=False):
    return {
        "method": method, "label": label, "settings": shares, "beyond": beyond, "values": values,
        "at_most": sorted(at_most),
    }  # fmt: skip


def _plain_rows(table, runs):
    """Return a row per setting. Ratios refer to the row of the first method with the same setting, or to its only row;
    with a time budget there are none."""
    rows = list(_measured(table, runs).values())
    label = next((row["label"] for row in rows if row["method"] == table.methods[0].name), None)
    first = [] if any(run["budget"] for run in runs) else [row for row in rows if row["label"] == label]
    alone = first[0] if len(first) == 1 else None
    same = {tuple(row["settings"]): row for row in first}
    return [_with_ratios(table, row, same.get(tuple(row["settings"]), alone)) for row in rows]


def _with_ratios(table, row, first):
    """Add the ratios to the row `first`; None if a number is unknown."""
    return row | {"values": row["values"] | _ratios(table, row["values"], first["values"] if first else {})}


def _ratios(table, own, first):
    found = {}
    for name, ratio in table.ratios.items():
        over, under = first.get(ratio.quantity), own.get(ratio.quantity)
        if not ratio.less:
            over, under = under, over
        found[name] = over / under if over is not None and under else None
    return found


# --- At equal errors or rays ---


def _equal_rows(table, runs):
    """Return, for each setting on the curve of the first method, its row and those of the further methods; [] without
    curves."""
    if table.equal is None:
        return []
    cost = "rays" if table.equal == "rays" else "seconds"
    first = next(run["label"] for run in runs if table.method_of(run) is table.methods[0])
    points = dict(analysis.points_by_cost(runs, table.metric))[cost]
    curves = analysis.make_curves(points, [first, *(label for label in _labels(runs) if label != first)])
    several = len(curves) > 1 and any(len(curve.points) > 1 for curve in curves)
    if not several or curves[0].label != first:
        return []
    axis, measured, rows = 0 if table.equal == "rays" else 1, _measured(table, runs), []
    for target in curves[0].front()[axis].tolist():
        found = [_place(table, measured, curve, target, axis) for curve in curves]
        rows += [_with_ratios(table, row, found[0]) for row in found]
    return rows


def _place(table, measured, curve, target, axis):
    """Return the interpolated row of a curve at a cost (axis 0) or an error (axis 1)."""
    shares = curve.interpolation_weights(target, axis)
    parts = [measured[curve.label, name] for name in shares]
    method = measured[curve.label, curve.points[0].name]["method"]
    if not parts:
        return _row(method, curve.label, {}, dict.fromkeys(table.quantities))
    values = {name: _weighted([part["values"][name] for part in parts], shares.values()) for name in table.quantities}
    held = values["rays" if axis == 0 else table.metric]
    at_most = {name for part in parts for name in part["at_most"]}
    return _row(method, curve.label, shares, values, at_most, beyond=held < target * (1 - ROUNDING))


def _weighted(numbers, weights):
    """Return the weighted geometric mean, or the arithmetic mean if a number is zero; None if a number is unknown."""
    if None in numbers:
        return None
    if len(numbers) == 1 or min(numbers) <= 0:
        return sum(number * weight for number, weight in zip(numbers, weights, strict=True))
    return math.exp(sum(math.log(number) * weight for number, weight in zip(numbers, weights, strict=True)))


# --- Figures of the papers ---


def _published(table, method):
    """Return the smallest and largest figures of a method over the paper's scenes, including ratios per scene."""
    figures = {name: method.figures[name] for name in table.quantities if name in method.figures}
    scenes = max(map(len, figures.values()))
    ratios = [
        _ratios(
            table,
            *({name: numbers[scene] for name, numbers in one.figures.items()} for one in (method, table.methods[0])),
        )
        for scene in range(scenes)
    ]
    figures |= {name: [one[name] for one in ratios] for name in table.ratios if ratios[0][name] is not None}
    return {
        "method": method.name,
        "figures": {name: {"low": min(numbers), "high": max(numbers)} for name, numbers in figures.items()},
    }


# --- Text ---


def shown(scene):
    """Return the tables of a scene as text, a list of dicts: "title", "reading" (how the rows were obtained),
    "departures" (differences from the paper), "head", "rows" (lists of cells) and "classes" (of rows): "begins" at the
    start of a group of equal error or rays, "published" for figures of the paper, otherwise ""."""
    described = {(table.paper, table.name): table for table in TABLES}
    return [_shown(described[entry["paper"], entry["table"]], entry) for entry in scene.get("paper_tables", [])]


def _shown(table, entry):
    columns = entry["columns"]
    heads = [(QUANTITIES | table.ratios)[name].head for name in columns]
    ours = [[_title(row), *_cells(row, columns)] for row in entry["rows"]]
    theirs = [
        [f"[{table.paper}] {one['method']}", *(_range(name, one["figures"].get(name)) for name in columns)]
        for one in entry["published"]
    ]
    return {
        "title": f"[{table.paper}] {table.name}: {table.title}",
        "reading": _how_read(table, entry),
        "departures": table.departures,
        "head": ["integrator", *heads],
        "rows": ours + theirs,
        "classes": [_class(entry, row) for row in entry["rows"]] + ["published"] * len(theirs),
    }


def _class(entry, row):
    return "begins" if entry["equal"] and row["label"] == entry["rows"][0]["label"] else ""


def _how_read(table, entry):
    """Describe how the rows were obtained."""
    paper = (
        f"[{table.paper}]: figures of {PAPERS[table.paper]}, minimum to maximum over the paper's scenes; blank: not "
        "published."
    )
    if entry["equal"] is None:
        ratios = " The errors differ: ratios are not at equal error." if table.ratios else ""
        return f"Single settings, means over seeds.{ratios} {paper}"
    held = "shadow rays per pixel" if entry["equal"] == "rays" else QUANTITIES[table.metric].head
    first = entry["rows"][0]["label"]
    return (
        f"At equal {held}: each setting of {first}, followed by the further methods, interpolated between two of their "
        "settings in logarithmic axes, without extrapolation; 'less already' marks a setting with a smaller value. "
        f"{paper}"
    )


def _title(row):
    names = " to ".join(row["settings"])
    return f"{row['label']} {names}".strip() + (", less already" if row["beyond"] else "")


def _cells(row, columns):
    if not row["settings"]:
        return ["not reached", *[""] * (len(columns) - 1)]
    return [_cell(row, name) for name in columns]


def _cell(row, name):
    value = row["values"][name]
    return "n/a" if value is None else ("< " if name in row["at_most"] else "") + _number(name, value)


def _range(name, figures):
    if figures is None:
        return ""
    low, high = (_number(name, figures[end]) for end in ("low", "high"))
    return low if low == high else f"{low.removesuffix('%')}–{high}"


def _number(name, value):
    is_percent = name in QUANTITIES and QUANTITIES[name].percent
    return f"{value:.2%}" if is_percent else tables.number(value)
