"""The page `report.html`, self-contained and usable offline. Its sources are in the folder `page`."""

import base64
import json
from pathlib import Path

import jinja2
import numpy as np
from matplotlib import colormaps

from . import analysis, images, page_images, paper_tables, plots, tables, verdict
from .curves import pareto
from .pictures import DISTANCE_FACTOR

PARTS = Path(__file__).parent / "page"
SCRIPTS = ("pixels.js", "pointer.js", "tiles.js", "viewer.js", "keys.js")
KINDS = {"relative": "relative error", "signed": "signed error", "distance": "distance × 16", "flip": "FLIP"}


def section(scene, pictures, results, reference_text):
    """Return the section of a scene, whose entry in the content of `results.json` is `scene`. `pictures`: its
    `Pictures`, or None."""
    return _template("scene.html.jinja").render(
        results=results,
        scene=_scene(scene, pictures, results),
        columns=tables.COLUMNS,
        reference_text=reference_text,
        embedded=embedded,
        kinds=KINDS,
        metric=plots.ERRORS[results["metrics"]["compared"]],
    )


def render(results, sections):
    """Return the page for the content of `results.json` and the `section` of each scene."""
    return _template("report.html.jinja").render(
        results=results,
        sections=sections,
        summary=_summary(results),
        warnings=_warnings(results),
        explanation=tables.EXPLANATION,
        metric=plots.ERRORS[results["metrics"]["compared"]],
        error_range=[f"{value:.0%}" for value in images.ERROR_RANGE],
        false_colours=", ".join(f"rgb{tuple(map(int, stop))}" for stop in images.FALSE_COLOURS),
        palettes=_palettes(),
        script="\n".join((PARTS / name).read_text() for name in SCRIPTS),
        style=(PARTS / "report.css").read_text(),
    )


def _template(name):
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(PARTS), autoescape=True, trim_blocks=True, lstrip_blocks=True
    ).get_template(name)


def _scene(scene, pictures, results):
    """Return the template variables of a scene."""
    metric = results["metrics"]["compared"]
    labels = list(dict.fromkeys(render["label"] for render in scene["renders"]))
    shown = {"result": scene, "name": scene["name"], "error": scene.get("error"), "rows": tables.rows(scene)}
    shown |= {"views": None, "bars": None, "plots": [], "comparisons": [], "block": pictures.block if pictures else 1}
    if pictures and pictures.views:
        data = {"views": pictures.views, "exposure": pictures.exposure, "metric": plots.ERRORS[metric]}
        shown["views"] = json.dumps(data).replace("</", "<\\/")  # "</" would end the enclosing script element
        shown["has_maps"] = any(view["maps"] for view in pictures.views)
        shown["stills"] = pictures.stills
    for cost, points in analysis.points_by_cost(scene["renders"], metric):
        are_curves = len({point.label for point in points}) < len(points)
        if cost == "seconds" and not are_curves and len(points) > 1:
            shown["bars"] = plots.error_bars(points, labels, metric)
        if are_curves:
            shown["plots"].append(plots.error_against(cost, points, pareto(points), labels, metric))
        for title, table in (("equal error", tables.equal_errors), ("equal cost", tables.equal_costs)):
            if rows := table(scene, cost):
                shown["comparisons"].append((cost, title, rows))
    shown["paper_tables"] = paper_tables.shown(scene)
    shown["warnings"] = tables.scene_warnings(scene)
    counted = {render["label"] for render in scene["renders"] if render.get("rays_per_sample") is not None}
    shown["uncounted"] = [label for label in labels if label not in counted]
    return shown


def _warnings(results):
    """Return (scene name or None, sentence) for all scenes; warnings on the machine appear once, without a scene."""
    renders = [render for scene in results["scenes"] for render in scene["renders"]]
    found = [(None, sentence) for sentence in tables.load_warnings(renders, results["machine"]["cores"])]
    return found + [
        (scene["name"], sentence) for scene in results["scenes"] for sentence in tables.scene_warnings(scene)
    ]


def _summary(results):
    """Return labels, rows (scene, cells) and cells of the means of the summary table; a cell is a list of
    (text, verdict) for error, time and bias."""
    summary = results["summary"]
    labels = list(dict.fromkeys(label for row in summary["scenes"].values() for label in row))
    rows = [
        (name, [_outcome(row.get(label), label == summary["bases"].get(label)) for label in labels])
        for name, row in summary["scenes"].items()
    ]
    means = [summary["means"].get(label) for label in labels]
    empty = ("", None)
    cells = [
        [_mean_cell(mean[kind], len(rows)) if mean else empty for kind in verdict.KINDS] + [empty] for mean in means
    ]
    return {**summary, "labels": labels, "rows": rows, "mean_cells": cells}


def _outcome(outcome, is_base):
    if outcome is None:
        return [("n/a", None)] * 3
    bias = (f"{outcome['bias']:+.2%}", None)
    if is_base:
        error, seconds = (tables.number(outcome[key]) for key in ("measured", "seconds"))
        return [(("< noise" if outcome["hidden"] else error), None), (f"{seconds} s", None), bias]
    return [*(_ratio_cell(outcome[kind]) for kind in verdict.KINDS), bias]


def _mean_cell(ratio, scenes):
    text, found = _ratio_cell(ratio)
    return (text if ratio is None or ratio["scenes"] == scenes else f"{text} (of {ratio['scenes']})", found)


def _ratio_cell(ratio):
    if ratio is None:
        return ("–", None)
    text = ("≈ " if ratio["extrapolated"] and not ratio["bound"] else "") + verdict.number(ratio)
    if ratio["low"]:
        text += f" ({tables.number(ratio['low'])} to {tables.number(ratio['high'])})"
    return (text, verdict.verdict_of(ratio))


def _palettes():
    """Return, as JSON, the colours of each kind of map (256 × 3 bytes, a flat list), and the scales."""
    steps = np.linspace(0, 1, 256)
    found = {name: _bytes(colormaps[scale](steps)) for name, scale in (("flip", "magma"), ("signed", "RdBu_r"))}
    found["distance"] = images.tone_map(np.repeat(steps[:, None], 3, axis=1), 1.0)
    found["relative"] = images.palette(steps)
    scales = {"range": images.ERROR_RANGE, "stored": page_images.RELATIVE_ENDS, "whitest": 1 / DISTANCE_FACTOR}
    return json.dumps({"scales": scales} | {kind: colours.ravel().tolist() for kind, colours in found.items()})


def _bytes(colours):
    return (colours[:, :3] * 255 + 0.5).astype(int)


def embedded(file):
    """Encode a PNG file as a data URL."""
    return "data:image/png;base64," + base64.b64encode(Path(file).read_bytes()).decode()
